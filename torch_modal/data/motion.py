"""Key-frames that follow each other in time."""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from torch_modal.keyframes.arrays import checked_times


class Span(NamedTuple):
    """An interval between two successive key-frames, in either direction, with their neighbours."""

    keyframes: list[int]
    """Indices of these two and their neighbours, three or four in all, in the order of time."""
    times: Tensor
    """Times of these: 0 at the start of the interval, 1 at its end. *Shape:* ``(3,)`` or ``(4,)``."""


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
        """The motion of key-frames; None without times.

        Raises:
            ValueError: As for the constructor, or cyclic key-frames without times.
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
        """The interval from key-frame ``i`` to ``j``.

        Returns:
            None if they are not successive, or have no neighbours.
        """
        n, ahead, back = self.n_keyframes, j - i, i - j
        if self.cyclic:
            ahead, back = ahead % n, back % n
        if n < 3 or 1 not in (ahead, back):
            return None
        if ahead == 1:
            return self._to_next(i)
        keyframes, times = self._to_next(j)
        return Span(keyframes[::-1], 1 - times.flip(0))

    def _to_next(self, i: int) -> Span:
        """The interval from a key-frame to the next."""
        n = self.n_keyframes
        places = [place for place in range(i - 1, i + 3) if self.cyclic or 0 <= place < n]
        period = self.times[-1] - self.times[0]
        when = torch.stack([self.times[place % n] + place // n * period for place in (i, i + 1, *places)])
        return Span([place % n for place in places], (when[2:] - when[0]) / (when[1] - when[0]))
