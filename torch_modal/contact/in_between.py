"""In-betweens whose parts do not pass through each other: each sample alone, or all times between two key-frames."""

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from torch_modal import trees
from torch_modal.contact.acceleration import AccelerationLimit
from torch_modal.contact.active import ContactEnergy, ContactSearch, refuse_transforms
from torch_modal.contact.modal import modal_displacement
from torch_modal.contact.separate import separate, spline_weights
from torch_modal.elastic.energy import RestShapes
from torch_modal.elastic.minimise import Solution
from torch_modal.elastic.steps import ExtraEnergies
from torch_modal.inbetween.alignment import Pose
from torch_modal.inbetween.joint import JointSpace
from torch_modal.inbetween.results import InBetweenResult, Samples
from torch_modal.inbetween.solver import InBetweenSolver

PRODUCTS = 20
"""Iterations of conjugate gradients in a Newton step with contacts, which are stiff."""


class ContactSolver(InBetweenSolver):
    """In-betweens whose parts do not pass through each other. Arguments as for :class:`InBetweenSolver`.

    Samples are separated independently; those without intersections are the ones without contact.
    """

    def forward(self, samples: Samples) -> InBetweenResult:
        """Solve. Arguments as for :class:`InBetweenSolver`.

        Samples with contacts are solved again alone: rounding depends on the batch, and contacts amplify it.
        """
        whole = super().forward(samples)
        n_crossing = whole.solution.n_crossing
        if len(samples.weights) == 1 or n_crossing is None or not bool(n_crossing.any()):
            return whole
        some = torch.nonzero(n_crossing).flatten()
        parts = [super(ContactSolver, self).forward(trees.rows(samples, slice(i, i + 1))) for i in some.tolist()]
        each = zip(*map(trees.leaves, (whole, *parts)), strict=True)
        return trees.fill(whole, (values.index_copy(0, some, torch.cat(new)) for values, *new in each))  # type: ignore[no-any-return]

    def finish(self, x: Tensor, solution: Solution, rests: RestShapes) -> tuple[Tensor, Solution]:
        """Shapes and solutions with the numbers of far pairs; only one sample alone is separated."""
        refuse_transforms(x)
        searches = [contact_search(self, shape, 1) for shape in rests.shapes]
        if len(x) == 1:
            x, n_crossing = separate(x, _steps(self, rests), searches[0])
        else:
            counts = [search.count(shape[None]) for search, shape in zip(searches, x, strict=True)]
            n_crossing = torch.cat([torch.zeros_like(solution.status[:0]), *counts])
        return x, solution._replace(n_crossing=n_crossing)


class Displacement(NamedTuple):
    """The displacement that separates the shapes between two key-frames, in their frame, at all times.

    The field is None where nothing intersects; ``n_crossing`` are the far pairs that are left.
    *Shape:* ``(T, V, 3), (T,), (T,)``.
    """

    field: Tensor | None
    times: Tensor
    n_crossing: Tensor
    search: ContactSearch

    def apply(self, x: Tensor, u: Tensor) -> tuple[Tensor, Tensor]:
        """Displace shapes at any times, by a spline in time through the field; and the far pairs left in each.

        The gradient reaches shapes and times; the field is a constant. *Shape:* ``(B, V, 3), (B,) -> (B, V, 3), (B,)``.
        """
        if self.field is None:
            return x, torch.zeros_like(u, dtype=torch.int64)
        if torch.equal(u, self.times) and not u.requires_grad:
            return x + self.field, self.n_crossing
        # Not undone where it adds some in between: the motion would jump.
        displaced = x + torch.tensordot(spline_weights(self.times, u), self.field, 1)
        return displaced, self.search.count(displaced)


@torch.no_grad()
def push_apart(
    core: InBetweenSolver, x: Tensor, u: Tensor, rests: RestShapes, pose: Pose, ends: Tensor, goes_on: tuple[bool, bool]
) -> Displacement:
    """Find the displacement that separates the parts of shapes between two key-frames.

    Args:
        core: Has the energy and, where there are some, the modes.
        x: The shapes in the frame. *Shape:* ``(T, V, 3)``.
        u: Their times, even, between 0 and 1. *Shape:* ``(T,)``.
        rests: Rest shapes of the energy of each.
        pose: Of each.
        ends: The key-frames in the frame, then in the caller's coordinates. *Shape:* ``(2, 2, V, 3)``.
        goes_on: True where the motion goes on before the first and after the last key-frame.
    """
    scale = core.alignment.scale
    seen = torch.cat([ends[1, :1], core.alignment.to_caller(x, pose), ends[1, 1:]]) * scale
    limit = AccelerationLimit(seen, pose.rotation, goes_on)

    def in_modes(some: Tensor, contact: ContactEnergy, accelerations: Tensor) -> Tensor:
        space = core.space
        placement = space.place(x[some], trees.rows(rests, some), u[some])
        zeros = x.new_zeros(len(some), space.n_amplitudes)
        at = space.derivatives(zeros, placement, second_order=False)
        stiffness = at.gauss_newton - space.anchor * torch.eye(zeros.shape[1]).to(at.gauss_newton)
        basis = space.basis, core.alignment.weights, at.gradient.to(u), stiffness.to(u)
        return modal_displacement(*basis, x[some], contact, accelerations)

    search = contact_search(core, ends[0], len(u))
    start = in_modes if isinstance(core.space, JointSpace) else None
    pushed, n_crossing = separate(x, _steps(core, rests), search, limit, start)
    field = pushed - x if pushed is not x or bool(n_crossing.any()) else None
    return Displacement(field, u, n_crossing, search)


def contact_search(core: InBetweenSolver, ends: Tensor, n_shapes: int) -> ContactSearch:
    """Search in shapes between key-frames. *Shape:* ``(K, V, 3)``."""
    return ContactSearch(core.backend, core.mesh.connectivity, ends, core.alignment.reference, n_shapes)


def _steps(core: InBetweenSolver, rests: RestShapes) -> Callable[[Tensor, Tensor, ExtraEnergies], Tensor]:
    """Newton steps of all vertices of some of the shapes, with further energies."""
    return lambda x, some, extra: core.fine.relax(x, trees.rows(rests, some), [PRODUCTS], extra)
