"""Key-frames that follow each other in time."""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from torch_modal.keyframes.times import checked_times


class Span(NamedTuple):
    """The way from one key-frame to another that follows it in time, or comes before it, and what it depends on."""

    keyframes: list[int]
    """These two and their neighbours, three or four in all, in the order in which they are passed."""
    times: Tensor
    """When that is: 0 at the start of the way, 1 at its end. *Shape:* ``(3,)`` or ``(4,)``."""


class Motion:
    """The order and the times of the key-frames of a motion.

    Args:
        times: When the key-frames are, ascending; if cyclic, one more, when the first comes again. *Shape:* ``(K,)``,
            or ``(K + 1,)`` if cyclic.
        n_keyframes: Their number, K.
        cyclic: Whether the last key-frame leads on to the first.

    Raises:
        ValueError: Another number of times, or times that do not ascend.
    """

    def __init__(self, times: Tensor | Sequence[float], n_keyframes: int, cyclic: bool = False) -> None:
        self.times = checked_times(times, n_keyframes, cyclic)
        self.n_keyframes = n_keyframes
        self.cyclic = cyclic

    @classmethod
    def of(cls, times: Tensor | Sequence[float] | None, n_keyframes: int, cyclic: bool) -> "Motion | None":
        """The motion; None of key-frames that have no times.

        Raises:
            ValueError: As for the constructor, or there are no times though it is said to be cyclic.
        """
        if times is None and cyclic:
            raise ValueError(f"cyclic key-frames are a motion and need their times: range({n_keyframes + 1}) if even")
        return None if times is None else cls(times, n_keyframes, cyclic)

    @property
    def neighbours(self) -> Tensor:
        """The key-frames before and after each in time; twice the same at an end. *Shape:* ``(K, 2)``."""
        last = self.n_keyframes - 1
        both = torch.arange(self.n_keyframes)[:, None] + torch.tensor([-1, 1])
        return both % self.n_keyframes if self.cyclic else last - (last - both.abs()).abs()

    def span(self, i: int, j: int) -> Span | None:
        """The way from key-frame ``i`` to ``j``.

        Returns:
            None where they do not follow each other, or have no neighbours.
        """
        n, ahead, back = self.n_keyframes, j - i, i - j
        if self.cyclic:
            ahead, back = ahead % n, back % n
        if n < 3 or 1 not in (ahead, back):
            return None
        if ahead == 1:
            return self._onwards(i)
        keyframes, times = self._onwards(j)
        return Span(keyframes[::-1], 1 - times.flip(0))

    def _onwards(self, i: int) -> Span:
        """The way from a key-frame to the next."""
        n = self.n_keyframes
        places = [place for place in range(i - 1, i + 3) if self.cyclic or 0 <= place < n]
        period = self.times[-1] - self.times[0]
        when = torch.stack([self.times[place % n] + place // n * period for place in (i, i + 1, *places)])
        return Span([place % n for place in places], (when[2:] - when[0]) / (when[1] - when[0]))
