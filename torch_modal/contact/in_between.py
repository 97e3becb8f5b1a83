"""In-betweens whose parts do not pass through each other: each sample alone, or all times between two key-frames."""

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from torch_modal import trees
from torch_modal.backends.torch.alignment import Pair
from torch_modal.backends.torch.fine_energy import Beside
from torch_modal.backends.torch.rests import Rests
from torch_modal.contact.acceleration import AccelerationLimit
from torch_modal.contact.active import ContactSearch, refuse_transforms
from torch_modal.contact.modal import ModalModel
from torch_modal.contact.separate import Timeline, separate, through
from torch_modal.geometry.connectivity import vertex_areas
from torch_modal.inbetween.between import Batch, Between
from torch_modal.inbetween.samples import InBetweenResult, Samples
from torch_modal.solve.solver import Solution

PRODUCTS = 20
"""Iterations of conjugate gradients in a Newton step with contacts, which are stiff."""


class ContactBetween(Between):
    """In-betweens of one pair of bases whose parts do not pass through each other. Arguments as for :class:`Between`.

    Samples are separated independently; those without intersections are the ones without contact.
    """

    def forward(self, samples: Samples, report: Callable[[Solution], None] | None) -> InBetweenResult:
        """Solve. Arguments as for :class:`Between`.

        Samples with contacts are solved again alone: rounding depends on the batch, and contacts amplify it.
        """
        if len(samples.t) == 1:
            return super().forward(_alone(samples, 0), report)
        whole = super().forward(samples, report)
        n_crossing = whole.solution.n_crossing
        if n_crossing is None or not bool(n_crossing.any()):
            return whole
        some = torch.nonzero(n_crossing).flatten()
        parts = [super(ContactBetween, self).forward(_alone(samples, i), None) for i in some.tolist()]
        each = zip(whole.solution, *(part.solution for part in parts), strict=True)
        merged = (values[0].index_copy(0, some, torch.cat(values[1:])) for values in each)  # type: ignore[union-attr, arg-type]
        shapes = whole.shapes.index_copy(0, some, torch.cat([part.shapes for part in parts]))
        return InBetweenResult(shapes, Solution(*merged))

    def solved(self, batch: Batch) -> tuple[Tensor, Solution]:
        """Shapes and solutions with the numbers of far pairs; only one sample alone is separated."""
        x, solution = super().solved(batch)
        refuse_transforms(x)
        which = range(len(x)) if batch.samples.which is None else batch.samples.which.tolist()
        searches = {i: _search(self, batch.pair, i, 1) for i in set(which)}
        if len(x) == 1:
            x, _, n_crossing = separate(x, _steps(self, self.rests_of(batch)), searches[which[0]])
        else:
            counts = [searches[i].count(own[None]) for i, own in zip(which, x, strict=True)]
            n_crossing = torch.cat([torch.zeros_like(solution.status[:0]), *counts])
        return x, solution._replace(n_crossing=n_crossing)


class Displacement(NamedTuple):
    """The displacement that separates the shapes between two key-frames, at all times."""

    field: Tensor | None
    """At the times of the shapes, in the frame; None where nothing intersects. *Shape:* ``(T, V, 3)``."""
    times: Tensor
    """*Shape:* ``(T,)``."""
    n_before: Tensor
    """Numbers of far pairs of triangles before, of shapes that were looked at. *Shape:* ``(T,)``."""
    n_crossing: Tensor
    """Numbers of far pairs that are left. *Shape:* ``(T,)``, int64."""

    def apply(self, member: Between, samples: Samples, shapes: Tensor) -> tuple[Tensor, Tensor]:
        """Displace shapes at any times; between those of the field, along a cubic spline.

        A shape that would have more far pairs stays as it is. The gradient reaches shapes and times; the field is a
        constant.

        Args:
            member: In-betweens of the pair of key-frames.
            samples: Times of the shapes between that pair.
            shapes: In the caller's coordinates. *Shape:* ``(B, V, 3)``.

        Returns:
            The shapes, and the far pairs that are left in each. *Shape:* ``(B, V, 3), (B,)``.
        """
        if self.field is None:
            return shapes, torch.zeros_like(samples.t, dtype=torch.int64)
        frame, t = member.frame, samples.t
        pair = member.placed(samples)
        placed = trees.picked(pair, samples.which)
        own = frame.bring(shapes, placed, t)
        if torch.equal(t, self.times) and not t.requires_grad:
            return frame.restore(own + self.field, placed, t), self.n_crossing
        found = own + torch.tensordot(through(self.times, t), self.field, 1)
        search = _search(member, pair, 0, 1)
        before, after = search.count(own), search.count(found)
        found = torch.where((after <= before)[:, None, None], found, own)
        return frame.restore(found, placed, t), torch.minimum(after, before)


@torch.no_grad()
def push_apart(member: Between, samples: Samples, shapes: Tensor) -> Displacement:
    """Find the displacement that separates the parts of shapes between two key-frames.

    Args:
        member: In-betweens of the pair.
        samples: Times of the shapes between one pair of key-frames, which are even.
        shapes: In the caller's coordinates. *Shape:* ``(T, V, 3)``.
    """
    frame, t = member.frame, samples.t
    pair = member.placed(samples)
    placed = trees.picked(pair, samples.which)
    start = frame.bring(shapes, placed, t)
    rests = member.rests(samples, pair, member.anchors(placed, t))

    def model(some: Tensor) -> ModalModel:
        energy, columns = member.space.energy.parts[0], member.space.columns.fine
        place = energy.place(frame.coarsen(start[some]), member.coarse_reference(samples.rows(some), pair))
        found = energy.derivatives(place.base.new_zeros(len(some), len(columns)), place, second_order=False)
        return ModalModel(columns, frame.weights / frame.weights.sum(), found.gradient.to(t), found.gauss_newton.to(t))

    seen = torch.cat([samples.x_a[:1], shapes, samples.x_b[:1]]) * frame.scale
    rotations = placed.placed.rotation.mT @ frame.motion(placed, t).rotation
    limit = AccelerationLimit(seen, rotations, (samples.before is not None, samples.after is not None))
    search = _search(member, pair, 0, len(t))
    found = separate(start, _steps(member, rests), search, Timeline(t, limit, model))
    return Displacement(None if found.x is start else found.x - start, t, found.n_before, found.n_crossing)


def _search(member: Between, pair: Pair, i: int, n_shapes: int) -> ContactSearch:
    """Search in shapes between the i-th pair of key-frames."""
    known, reference = torch.stack([pair.first[i], pair.second[i]]), member.frame.reference
    areas = torch.from_numpy(vertex_areas(reference.cpu().double().numpy(), member.mesh.connectivity.faces))
    return ContactSearch(member.mesh, known, areas.to(reference), n_shapes, member.crossing_pairs)


def _steps(member: Between, rests: Rests) -> Callable[[Tensor, Tensor, Beside], Tensor]:
    """Newton steps of all vertices of some of the samples, with energies beside that of the terms."""

    def relax(x: Tensor, some: Tensor, beside: Beside) -> Tensor:
        which = some if rests.which is None else rests.which[some]
        t, stiffness, anchors = trees.rows((rests.t, rests.stiffness, rests.anchors), some)
        own = Rests(rests.shapes, which, t, stiffness, anchors)
        return member.fine.relax(x, own, [(1, PRODUCTS)], beside)

    return relax


def _alone(samples: Samples, i: int) -> Samples:
    """One sample as a batch."""
    pair = slice(i, i + 1) if samples.which is None else samples.which[i : i + 1]
    around = samples.before, samples.after, samples.spacing
    x_a, x_b, before, after, spacing = trees.rows((samples.x_a, samples.x_b, *around), pair)
    t, mu, stiffness = trees.rows((samples.t, samples.mu, samples.stiffness), slice(i, i + 1))
    return Samples(x_a, x_b, None, t, mu, stiffness, before, after, spacing)
