"""The joint space: one unknown shape in the sum of both modal spaces and the difference of the key-frames."""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor, nn

from torch_modal.energy.terms import Mesh
from torch_modal.geometry.hermite import Spacing, beyond, excess, squared_length
from torch_modal.nn import trees
from torch_modal.nn.blend import RotationBlend
from torch_modal.nn.frame import Frame, Pair
from torch_modal.nn.guess import Guess
from torch_modal.nn.levels import Levels, Stiffness
from torch_modal.nn.modal_energy import Placement


class JointProblem(NamedTuple):
    """The in-between of each sample as a minimisation."""

    placement: tuple[Placement, ...]
    """What the minimiser depends on."""
    start: Tensor | None
    """Where the minimisation may start; None: at zeros. *Shape:* ``(B, n)``."""
    base: Tensor
    """The fine shape that the modes are added to. *Shape:* ``(B, V, 3)``."""
    difference: Tensor
    """The fine column of the last amplitude. *Shape:* ``(B, V, 3)``."""


class JointSpace(nn.Module):
    r"""In-betweens ``x(a) = base + [Phi_a, Phi_b, x_b - x_a] a``.

    What is minimised is :math:`(1-t)\, d(x_a, x) + t\, d(x_b, x)`, with Eq. 5 for ``d``. The base is linear
    interpolation, or the blend by local rotations where that has less energy, so that the energy of the result is never
    above that of linear interpolation.

    Args:
        frame: Frame of the two bases.
        levels: The energies of the modal solve.
        modes: Modes of both ends, in the frame. *Shape of each:* ``(k, V, 3)``.
        references: Shapes that the modes belong to, in the frame. *Shape:* ``(2, V, 3)``.
        fine: The fine mesh, if there is a blend by local rotations.
    """

    def __init__(
        self, frame: Frame, levels: Levels, modes: Sequence[Tensor], references: Tensor, fine: Mesh | None
    ) -> None:
        super().__init__()
        self.frame, self.levels = frame, levels
        self.columns = frame.elastic_columns(torch.cat(list(modes)))
        self.energy = levels.modal(self.columns)
        # With the blend as the base there is nothing left to guess.
        self.blend = None if fine is None else RotationBlend(fine.connectivity, references)
        coarse = frame.coarsen(references)
        self.guess = Guess(levels.mesh, self.columns.coarse, coarse) if fine is None else None

    @property
    def n_unknowns(self) -> int:
        """Number of amplitudes."""
        return len(self.columns.fine) + 1

    def problem(
        self, pair: Pair, index: Tensor | None, t: Tensor, stiffness: Stiffness, mu: Tensor, anchors: Tensor | None
    ) -> JointProblem:
        """Set up the in-betweens of a batch.

        Args:
            pair: P pairs of key-frames.
            index: Which of them each sample lies between; each its own where None. *Shape:* ``(B,)``.
            t: Times. *Shape:* ``(B,)``.
            stiffness: Of each sample.
            mu: Plays no part.
            anchors: Of the terms, in the frame. *Shape:* ``(B, P, 3)``.
        """
        levels = self.levels
        difference = self._difference(pair)
        extras = levels.seen(difference, self.frame.coarsen(difference))
        difference, extras = trees.picked((difference, extras), index)
        start = None
        if pair.around is not None:
            base = self.on_course(pair, index, t)
            coarse = self.frame.coarsen(base)
            references = levels.against(base, coarse, stiffness)
            placement = levels.place(self.energy, levels.seen(base, coarse), references, extras, anchors)
            return JointProblem(placement, start, base, difference)
        coarse_first, coarse_second = self.frame.coarsen(pair.first), self.frame.coarsen(pair.second)
        rests_a, rests_b = (
            levels.rests(levels.seen(x, own)) for x, own in ((pair.first, coarse_first), (pair.second, coarse_second))
        )
        references = levels.between(rests_a, rests_b, index, t, stiffness)
        first, second, coarse_first, coarse_second = trees.picked(
            (pair.first, pair.second, coarse_first, coarse_second), index
        )
        base = torch.lerp(first, second, t[:, None, None])
        coarse = torch.lerp(coarse_first, coarse_second, t[:, None, None])
        placement = levels.place(self.energy, levels.seen(base, coarse), references, extras, anchors)
        if self.guess is not None:
            with torch.no_grad():
                start = self.guess(coarse_first, coarse_second, extras[0], t)
        if self.blend is not None:
            blend = self.blend(first, second, t)
            seen = levels.seen(blend, self.frame.coarsen(blend))
            turned = levels.place(self.energy, seen, references, extras, anchors)
            with torch.no_grad():
                better = levels.value(turned) < levels.value(placement)
            base = torch.where(better[:, None, None], blend, base)
            placement = tuple(
                straight._replace(base=torch.where(better[:, None, None], bent.base, straight.base))
                for bent, straight in zip(turned, placement, strict=True)
            )
        return JointProblem(placement, start, base, difference)

    def on_course(self, pair: Pair, index: Tensor | None, t: Tensor) -> Tensor:
        """The shape that the motion passes through, by what the neighbours in time say. *Shape:* ``(B, V, 3)``."""
        around = pair.around
        assert around is not None
        earlier = None if around.before is None else pair.first - around.before
        later = None if around.after is None else around.after - pair.second
        wide = Spacing(*(h[:, None, None] for h in around.spacing))
        bend = excess(pair.second - pair.first, earlier, later, wide, squared_length)
        first, second, bend = trees.picked((pair.first, pair.second, bend), index)
        u = t[:, None, None]
        straight = torch.lerp(first, second, u) + beyond(bend, u)
        if self.blend is None:
            return straight
        course = self.blend.rotations.course(around.before, pair.first, pair.second, around.after, around.spacing)
        return self.blend.along(course if index is None else course.rows(index), straight, t)

    @staticmethod
    def require(t: Tensor) -> None:
        """Times in [0, 1].

        Raises:
            ValueError: Others: outside, one of the two pulls would be negative.
        """
        outside = ~((t >= 0) & (t <= 1))
        if bool(outside.any()):
            raise ValueError(f"t lies in [0, 1], from key-frame to key-frame; got {float(t[outside][0])}")

    def lift(self, a: Tensor, problem: JointProblem) -> Tensor:
        """The fine shape of given amplitudes. *Shape:* ``(B, n) -> (B, V, 3)``."""
        return problem.base + self.columns.combine(a[:, :-1]) + a[:, -1, None, None] * problem.difference

    def _difference(self, pair: Pair) -> Tensor:
        """The part of ``x_b - x_a`` that the modes do not have, of length one. *Shape:* ``(B, V, 3)``."""
        frame = self.frame
        own = frame.remove(frame.remove(pair.second - pair.first, frame.rigid), self.columns)
        squared = (frame.coarsen(own) ** 2 * frame.coarse_weights[:, None]).sum((-1, -2), keepdim=True)
        # Coincident key-frames leave no difference: its column is then zero, not a quotient of rounding errors.
        rounding = 1e3 * torch.finfo(own.dtype).eps * pair.first.abs().amax((-1, -2), keepdim=True)
        return own * (squared + rounding**2).rsqrt()
