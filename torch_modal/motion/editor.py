"""A motion that is edited by hand: key-frames replaced and added, with only the affected intervals computed again."""

import torch
from torch import Tensor

from torch_modal.autograd import outside_inference_mode
from torch_modal.keyframes.arrays import check_tensor
from torch_modal.motion.path import Path
from torch_modal.times import fill_linear

UNSEEN_CHANGE = 1e-6
"""An interval is computed again where an edit moves its shapes by more than about this part of the diagonal."""


class PathEditor:
    """The dense shapes of a path while its key-frames change.

    Args:
        path: The path.
        keyframes: Its key-frames. *Shape:* ``(K, V, 3)``.
        steps: Shapes of each interval.

    Raises:
        ValueError: The key-frames do not fit the path, or ``steps`` is below 1.
    """

    @outside_inference_mode
    def __init__(self, path: Path, keyframes: Tensor, steps: int = 16) -> None:
        check_tensor("keyframes", keyframes, path.n_keyframes, *path.bases[0].reference.shape)
        if steps < 1:
            raise ValueError(f"steps is 1 or more, got {steps}")
        self.path, self.keyframes, self.steps = path, keyframes.clone(), steps
        # The shapes of each interval, with what they were made of.
        self._made: list[tuple[Tensor, tuple[Tensor, Tensor]] | None] = [None] * (len(path.times) - 1)

    def replace(self, i: int, shape: Tensor) -> None:
        """Replace a key-frame by another shape.

        Args:
            i: Number of the key-frame.
            shape: *Shape:* ``(V, 3)``.

        Raises:
            IndexError: There is no such key-frame.
            ValueError: The shape does not fit.
        """
        self.keyframes[i] = self._check_shape(shape)

    @outside_inference_mode
    def insert(self, t: float, shape: Tensor | None = None) -> int:
        """Pin the motion at a time: the shape becomes a key-frame.

        Args:
            t: When, between the others; modulo the period, if the path is cyclic.
            shape: *Shape:* ``(V, 3)``. Default: where the motion passes then.

        Returns:
            Number of the new key-frame.

        Raises:
            ValueError: The time is outside, or equal to the time of a key-frame; the shape does not fit. Nothing is
                changed then.
        """
        if shape is None:
            shape = self.path(self.keyframes, t)
        shape = self._check_shape(shape)
        path = self.path.insert(t)
        i = int((path.times[:-1] == self.path.times).cumprod(0).sum())  # up to there, all times are as before
        self.keyframes = torch.cat([self.keyframes[:i], shape[None], self.keyframes[i:]])
        self._made = [*self._made[: i - 1], None, None, *self._made[i:]]
        self.path = path
        return i

    def times(self) -> Tensor:
        """Times of the shapes. *Shape:* ``(T,)``, float64."""
        times = self.path.times
        at = fill_linear(times, range(0, self.steps * len(times), self.steps))
        return at[:-1] if self.path.cyclic else at

    @outside_inference_mode
    def shapes(self) -> Tensor:
        """All shapes; intervals that no change has touched are not computed again. *Shape:* ``(T, V, 3)``."""
        at, intervals = self.times(), []
        for i, (made, needed) in enumerate(zip(self._made, self._dependencies(), strict=True)):
            same = made is not None and torch.equal(made[1][0], needed[0])
            if made is None or not same or not bool(((made[1][1] - needed[1]).abs() <= UNSEEN_CHANGE).all()):
                times = at[i * self.steps : (i + 1) * self.steps]
                self._made[i] = made = self.path(self.keyframes, times), needed
            intervals.append(made[0])
        return torch.cat(intervals if self.path.cyclic else [*intervals, self.keyframes[-1:]])

    def _dependencies(self) -> list[tuple[Tensor, Tensor]]:
        """Key-frames and velocities that each interval follows from, in visible units. *Shape:* ``(2, V, 3), (n,)``."""
        path, closed = self.path, torch.cat([self.keyframes, self.keyframes[:1]])
        ends = [closed[i : i + 2] for i in range(len(self._made))]
        if not path.smooth:
            return [(pair, pair.new_zeros(0)) for pair in ends]
        size = (self.keyframes.amax(1) - self.keyframes.amin(1)).norm(dim=-1).amax()
        velocities = []
        for knots in path.knots(self.keyframes[None].to(path.dtype)):
            for quantity, unit in ((knots.vertices, knots.shapes.abs().amax()), (knots.turns, 1), (knots.moves, size)):
                velocities += [velocity.flatten(1) / unit for velocity in quantity[1:]]
        return list(zip(ends, torch.cat(velocities, 1), strict=True))

    def _check_shape(self, shape: Tensor) -> Tensor:
        check_tensor("shape", shape, *self.keyframes.shape[1:], finite=True)
        return shape.to(self.keyframes)
