"""Key-frames that follow each other in time."""

from collections.abc import Sequence

import torch
from torch import Tensor

from torch_modal.keyframes.arrays import checked_times


class Motion:
    """The order and the times of the key-frames of a motion.

    Args:
        times: Times of the key-frames, ascending; if cyclic, one more, when the first comes again. *Shape:* ``(K,)``,
            or ``(K + 1,)`` if cyclic.
        n_keyframes: Their number, K.
        cyclic: Whether the last key-frame leads on to the first.

    Attributes:
        neighbours: The key-frames before and after each in time; twice the same at an end. *Shape:* ``(K, 2)``.

    Raises:
        ValueError: Another number of times, or times that do not ascend.
    """

    def __init__(self, times: Tensor | Sequence[float], n_keyframes: int, cyclic: bool = False) -> None:
        self.times = checked_times(times, n_keyframes, cyclic)
        self.n_keyframes = n_keyframes
        self.cyclic = cyclic
        both, last = torch.arange(n_keyframes)[:, None] + torch.tensor([-1, 1]), n_keyframes - 1
        self.neighbours = both % n_keyframes if cyclic else last - (last - both.abs()).abs()

    @classmethod
    def of(cls, times: Tensor | Sequence[float] | None, n_keyframes: int, cyclic: bool) -> "Motion | None":
        """The motion of key-frames; None without times.

        Raises:
            ValueError: As for the constructor, or cyclic key-frames without times.
        """
        if times is None and cyclic:
            raise ValueError(f"cyclic key-frames are a motion and need their times: range({n_keyframes + 1}) if even")
        return None if times is None else cls(times, n_keyframes, cyclic)

    def span(self, i: int, j: int) -> tuple[float, float] | None:
        """The times of two successive key-frames, in either direction.

        Returns:
            The times of ``i`` and of ``j``; in a cycle, those before the first and after the last go on. None if they
            are not successive, or have no neighbours.
        """
        n, back = self.n_keyframes, -1 % self.n_keyframes if self.cyclic else -1
        step = (j - i) % n if self.cyclic else j - i
        if n < 3 or step not in (1, back):
            return None
        first = i if step == 1 else j
        period = self.times[-1] - self.times[0]
        start, end = (float(self.times[place % n] + place // n * period) for place in (first, first + 1))
        return (start, end) if step == 1 else (end, start)
