"""Between the caller's coordinates and a frame that is centred, scaled and turned to a reference."""

from typing import NamedTuple

import torch
from torch import Tensor, nn

from torch_modal.geometry.hermite import Spacing, TangentOffset, beyond, squared_length, tangent_offset
from torch_modal.geometry.rigid import RigidMotion, best_fit, centroid
from torch_modal.geometry.rotations import exp, log


class Around(NamedTuple):
    """The key-frames before and after two others, and the rigid motion that passes through all."""

    before: Tensor | None
    """Turned on to the first of the pair; None where there is none. *Shape:* ``(B, V, 3)``."""
    after: Tensor | None
    """Turned on to the second. *Shape:* ``(B, V, 3)``."""
    spacing: Spacing
    """Durations of the three intervals."""
    turn: TangentOffset
    """Of the rotation, axis times angle in coordinates that turn along. *Shape:* ``(B, 3)``."""
    move: TangentOffset
    """Of the centroid. *Shape:* ``(B, 3)``."""


class Pair(NamedTuple):
    """Two key-frames of each sample, centred, scaled and turned to the first basis' reference."""

    first: Tensor
    """*Shape:* ``(B, V, 3)``."""
    second: Tensor
    """Turned on to ``first``. *Shape:* ``(B, V, 3)``."""
    placed: RigidMotion
    """From the caller's first key-frame to that of the frame, in the caller's units."""
    between: RigidMotion
    """From the first key-frame's pose to the second's, in the frame and its units."""
    around: Around | None = None
    """The tangent offsets from the neighbours in time, for smooth trajectories."""

    @property
    def shapes(self) -> Tensor:
        """Both key-frames. *Shape:* ``(B, 2, V, 3)``."""
        return torch.stack([self.first, self.second], 1)

    def motions(self) -> "Pair":
        """The same without vertices, for the way back to the caller's coordinates."""
        around = None if self.around is None else self.around._replace(before=None, after=None)
        return self._replace(first=self.first[:, :0], second=self.second[:, :0], around=around)


class Alignment(nn.Module):
    """Between the caller's coordinates and a frame that is centred, scaled and turned to a reference.

    Args:
        reference: The shape that others are turned to, centred and scaled. *Shape:* ``(V, 3)``.
        scale: From the caller's units to the frame's.
        weights: Of the vertices. *Shape:* ``(V,)``.
    """

    scale: Tensor
    weights: Tensor
    reference: Tensor

    def __init__(self, reference: Tensor, scale: Tensor, weights: Tensor) -> None:
        super().__init__()
        self.register_buffer("scale", scale, persistent=False)
        self.register_buffer("weights", weights, persistent=False)
        self.register_buffer("reference", reference, persistent=False)

    def finite(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Key-frames, the reference in the place of those that are not finite; which are. *Shape:* ``(P, V, 3)``.

        What is not finite must not reach the factorisations of the other samples.
        """
        finite = x.isfinite().flatten(1).all(1)
        return torch.where(finite[:, None, None], x, self.reference / self.scale), finite

    def place(self, x_a: Tensor, x_b: Tensor) -> Pair:
        """Bring key-frames into the frame. *Shape:* ``(B, V, 3)`` each."""
        placed = best_fit(x_a, (self.reference / self.scale).expand_as(x_a), self.weights)
        first, second = (placed.apply(x) * self.scale for x in (x_a, x_b))
        back = best_fit(second, first, self.weights)
        return Pair(first, back.apply(second), placed, back.inverse())

    def surround(self, pair: Pair, before: Tensor | None, after: Tensor | None, spacing: Spacing) -> Pair:
        """The pair with its neighbours in time, of the caller. *Shape of each:* ``(B, V, 3)``."""
        wide = spacing.mapped(lambda h: h[:, None])
        turns: list[Tensor | None] = [None, None]
        moves: list[Tensor | None] = [None, None]
        if before is not None:
            placed = pair.placed.apply(before) * self.scale
            back = best_fit(placed, pair.first, self.weights)
            before, turns[0], moves[0] = back.apply(placed), log(back.rotation), back.target - back.source
        if after is not None:
            placed = pair.placed.apply(after) * self.scale
            unturned = pair.between.inverse().apply(placed)
            back = best_fit(unturned, pair.second, self.weights)
            moves[1] = centroid(placed, self.weights) - pair.between.target
            after, turns[1] = back.apply(unturned), log(back.rotation.mT)
        turn = tangent_offset(log(pair.between.rotation), turns[0], turns[1], wide, squared_length)
        move = tangent_offset(pair.between.target - pair.between.source, moves[0], moves[1], wide, squared_length)
        return pair._replace(around=Around(before, after, spacing, turn, move))

    def motion(self, pair: Pair, t: Tensor) -> RigidMotion:
        """From the frame to the pose at the time ``t``, in its units."""
        straight = pair.between.fraction(t)
        if pair.around is None:
            return straight
        bent = exp(beyond(pair.around.turn, t[:, None]))
        moved = straight.target + beyond(pair.around.move, t[:, None])
        return RigidMotion(straight.rotation @ bent, straight.source, moved)

    def restore(self, x: Tensor, pair: Pair, t: Tensor) -> Tensor:
        """Bring a shape at the time ``t`` back to the caller, moved along the trajectory of the rigid motion.

        Args:
            x: Shapes of the frame. *Shape:* ``(B, V, 3)``.
            pair: The key-frames that they lie between.
            t: *Shape:* ``(B,)``.
        """
        return pair.placed.inverse().apply(self.motion(pair, t).apply(x) / self.scale)

    def bring(self, points: Tensor, pair: Pair, t: Tensor) -> Tensor:
        """The inverse of :meth:`restore`, of points of the caller's. *Shape:* ``(B, P, 3), (B,) -> (B, P, 3)``."""
        return self.motion(pair, t).inverse().apply(pair.placed.apply(points) * self.scale)


def vertex_tangent_offset(pair: Pair) -> TangentOffset:
    """Tangent offsets of the vertices of a pair, from its neighbours in time. *Shape of each:* ``(B, V, 3)``."""
    step = pair.second - pair.first
    if pair.around is None:
        return TangentOffset(torch.zeros_like(step), torch.zeros_like(step))
    before, after, spacing = pair.around[:3]
    earlier = None if before is None else pair.first - before
    later = None if after is None else after - pair.second
    return tangent_offset(step, earlier, later, spacing.mapped(lambda h: h[:, None, None]), squared_length)
