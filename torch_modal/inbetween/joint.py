"""The joint space: one unknown shape in the sum of both modal spaces and the difference of the key-frames."""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from torch_modal import trees
from torch_modal.autograd import lasting
from torch_modal.backends.torch.alignment import Pair, vertex_tangent_offset
from torch_modal.energy.modal_energy import Placement, SumOfEnergies
from torch_modal.geometry.hermite import beyond
from torch_modal.inbetween.blend import RotationBlend
from torch_modal.inbetween.columns import Columns
from torch_modal.inbetween.frame import Frame
from torch_modal.inbetween.guess import Guess
from torch_modal.inbetween.levels import Levels


class Difference(NamedTuple):
    """The part of ``x_b - x_a`` that neither rigid motions nor modes have, of length one: a column of its own."""

    whole: Tensor
    """``x_b - x_a``. *Shape:* ``(B, V, 3)``."""
    rigid: Tensor
    """How much of it is rigid. *Shape:* ``(B, 6)``."""
    modal: Tensor
    """How much of the rest is modal. *Shape:* ``(B, n)``."""
    scale: Tensor
    """One over the length of the remainder. *Shape:* ``(B,)``."""


class JointProblem(NamedTuple):
    """The in-between of each sample as a minimisation."""

    placement: tuple[Placement, ...]
    """The inputs that the minimiser depends on."""
    start: Tensor | None
    """Where the minimisation may start; None: at zeros. *Shape:* ``(B, n)``."""
    base: Tensor
    """The fine shape that the modes are added to. *Shape:* ``(B, V, 3)``."""
    starts: tuple[Tensor, ...]
    """Shapes that the result must not be worse than. *Shape of each:* ``(B, V, 3)``."""
    difference: Difference
    """The column of the last amplitude."""


class _Modal(nn.Module):
    """The modes of both ends, the energy in their amplitudes, and where to start. Arguments as for the space."""

    def __init__(
        self,
        frame: Frame,
        levels: Callable[[], Levels],
        modes: Sequence[Tensor],
        references: Tensor,
        guess: bool,
        anchor: float,
    ) -> None:
        super().__init__()
        self.levels = levels()
        self.columns = frame.elastic_columns(*frame.modes(*modes))
        self.energy = self.levels.modal(self.columns, anchor)
        # With the blend as the base there is nothing left to guess.
        self.guess = Guess(self.levels.mesh, self.columns.coarse, frame.coarsen(references)) if guess else None


class JointSpace(nn.Module):
    r"""In-betweens ``x(a) = base + [Phi_a, Phi_b, x_b - x_a] a``.

    What is minimised is :math:`(1-t)\, d(x_a, x) + t\, d(x_b, x) + \tfrac{1}{2} \rho\, |a|^2`, with Eq. 5 for ``d``.
    The base is the blend by local rotations, or linear interpolation. The columns are orthonormal under vertex weights
    that add up to one, so that the anchor ``rho`` holds the mean squared distance from the base: without it, the
    minimiser jumps between far minima of almost the same energy.

    Args:
        frame: Frame of the two bases.
        levels: Makes the energies of the modal solve.
        modes: Modes of both ends. *Shape of each:* ``(k, V, 3)``.
        references: Shapes that the modes belong to, in the frame. *Shape:* ``(2, V, 3)``.
        blend: By local rotations, if the base is to be one.
        anchor: Weight of the anchor.
    """

    def __init__(
        self,
        frame: Frame,
        levels: Callable[[], Levels],
        modes: Sequence[Tensor],
        references: Tensor,
        blend: RotationBlend | None,
        anchor: float,
    ) -> None:
        super().__init__()
        self.frame = frame
        self.blend = blend
        self._modal: Any = None
        self._make: Any = partial(_Modal, frame, levels, modes, references, blend is None, anchor)

    @property
    def modal(self) -> "_Modal":
        """Tables that only minimisations need, built on first use."""
        if self._modal is None:
            self._modal, self._make = lasting(self._make)(), None
        return self._modal

    @property
    def levels(self) -> Levels:
        """The energies of the modal solve."""
        return self.modal.levels

    @property
    def columns(self) -> Columns:
        """The modes of both ends."""
        return self.modal.columns

    @property
    def energy(self) -> SumOfEnergies:
        """In the amplitudes."""
        return self.modal.energy

    @property
    def n_unknowns(self) -> int:
        """Number of amplitudes."""
        return len(self.columns) + 1

    def problem(
        self,
        pair: Pair,
        index: Tensor | None,
        t: Tensor,
        stiffness: list[list[Tensor]],
        mu: Tensor,
        anchors: Tensor | None,
    ) -> JointProblem:
        """Set up the in-betweens of a batch.

        Args:
            pair: P pairs of key-frames.
            index: Which of them each sample lies between; each its own where None. *Shape:* ``(B,)``.
            t: Times. *Shape:* ``(B,)``.
            stiffness: On each level.
            mu: Plays no part.
            anchors: Of the terms, in the frame. *Shape:* ``(B, P, 3)``.
        """
        levels = self.levels
        coarse_first, coarse_second = self.frame.coarsen(pair.first), self.frame.coarsen(pair.second)
        difference, column = self.difference(pair.second - pair.first, coarse_second - coarse_first, pair.first)
        # The fine column is not needed before the end, unless terms look at vertices.
        extras = levels.seen(self.column(difference), column) if levels.sampled else [column] * len(levels.energies)
        difference, extras = trees.picked((difference, extras), index)
        start = None
        if pair.around is not None:
            starts = self.on_trajectory(pair, index, t)
            base = starts[0]
            seen = levels.seen(base, self.frame.coarsen(base))
            references = levels.references([x[:, None] for x in seen], torch.ones_like(t)[:, None], stiffness)
            return JointProblem(
                levels.place(self.energy, seen, references, extras, anchors), start, base, starts, difference
            )
        shapes, coarse = trees.picked((pair.shapes, torch.stack([coarse_first, coarse_second], 1)), index)
        weights = torch.stack([1 - t, t], -1)
        references = levels.references(levels.seen(shapes, coarse), weights, stiffness)
        straight = torch.lerp(shapes[:, 0], shapes[:, 1], t[:, None, None])
        if self.blend is None:
            base, starts = straight, (straight,)
            seen = levels.seen(base, torch.lerp(coarse[:, 0], coarse[:, 1], t[:, None, None]))
        else:
            base = self.blend(shapes, weights, straight)
            starts, seen = (base, straight), levels.seen(base, self.frame.coarsen(base))
            references = levels.softened(references, seen)
        placement = levels.place(self.energy, seen, references, extras, anchors)
        if self.modal.guess is not None:
            with torch.no_grad():
                start = self.modal.guess(coarse, weights, extras[0])
        return JointProblem(placement, start, base, starts, difference)

    def on_trajectory(self, pair: Pair, index: Tensor | None, t: Tensor) -> tuple[Tensor, ...]:
        """The shape on the smooth path through the neighbours in time, then the shapes that it is compared with.

        *Shape of each:* ``(B, V, 3)``.
        """
        around = pair.around
        assert around is not None
        # Of one pair for all there is no need of copies.
        which = None if len(pair.first) == 1 else index
        first, second, bend = trees.picked((pair.first, pair.second, vertex_tangent_offset(pair)), which)
        u = t[:, None, None]
        straight = torch.lerp(first, second, u) + beyond(bend, u)
        if self.blend is None:
            return (straight,)
        if self.blend.rotations.clusters is not None:
            # Beyond a full turn, no single axis tells how a triangle goes on: it turns evenly from one to the other.
            ends = torch.stack([first, second], 1).expand(len(t), -1, -1, -1)
            return self.blend(ends, torch.stack([1 - t, t], -1), straight), straight
        trajectory = self.blend.rotations.trajectory(
            around.before, pair.first, pair.second, around.after, around.spacing
        )
        which = torch.arange(len(t), device=t.device) if index is None else index
        return self.blend.along(trajectory, which, straight, t), straight

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
        own, base = problem.difference, problem.base
        scale = (own.scale * a[:, -1])[:, None]
        found = self.columns.added(base, a[:, :-1] - scale * own.modal)
        found = torch.addmm(found.flatten(1), scale * own.rigid, self.frame.rigid.fine.flatten(1), alpha=-1)
        return torch.addcmul(found, scale, own.whole.flatten(1)).view_as(base)

    def difference(self, whole: Tensor, coarse: Tensor, like: Tensor) -> tuple[Difference, Tensor]:
        """The difference of the key-frames as a column, and that on the coarse mesh. *Shape:* ``(B, V_coarse, 3)``.

        Args:
            whole: *Shape:* ``(B, V, 3)``.
            coarse: The same on the coarse mesh. *Shape:* ``(B, V_coarse, 3)``.
            like: A shape as large as the key-frames, which tells their rounding. *Shape:* ``(B, V, 3)``.
        """
        rigid, coarse = self.frame.split(coarse, self.frame.rigid)
        modal, coarse = self.frame.split(coarse, self.columns)
        squared = (coarse**2 * self.frame.coarse.weights[:, None]).sum((-1, -2))
        # Coincident key-frames leave no difference, nor do modes that span all shapes: its column is then zero, not a
        # quotient of rounding errors, which are others on the coarse mesh than on the fine one.
        rounding = 1e3 * torch.finfo(coarse.dtype).eps * like.abs().amax((-1, -2))
        scale = torch.where(squared > rounding**2, (squared + rounding**2).rsqrt(), 0)
        return Difference(whole, rigid, modal, scale), coarse * scale[:, None, None]

    def column(self, own: Difference) -> Tensor:
        """The difference as a column on the fine mesh. *Shape:* ``(B, V, 3)``."""
        left = own.whole - self.frame.rigid.combine(own.rigid) - self.columns.combine(own.modal)
        return own.scale[:, None, None] * left
