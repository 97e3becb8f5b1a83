r"""Contact along a course of shapes: what passes through itself is pushed apart, the same way at all times.

Shapes that are pushed apart one by one jump where a contact begins and ends. Here one displacement serves all times of
an interval between two key-frames: a cubic spline in time, :math:`d(t) = \sum_j B_j(t)\, c_j`, which vanishes at the
key-frames. What is minimised is the sum of the energies of all shapes, with the contact term, and of the squared
accelerations of the displacement:

.. math:: \sum_i E_i(x_i + d(t_i)) + \lambda \sum_v A_v \int |\ddot d_v|^2 dt
"""

from functools import partial
from typing import Any, NamedTuple

import numpy as np
import torch
from scipy.interpolate import BSpline
from torch import Tensor

from torch_modal.energy.energy import Energy
from torch_modal.energy.terms import Mesh
from torch_modal.nn import trees
from torch_modal.nn.between import Between, fine_chunk
from torch_modal.nn.contact import Contacts, ContactSearch
from torch_modal.nn.relax import STEP_LENGTHS, ConvexHessian, conjugate_gradients, inverse_of_symmetric
from torch_modal.nn.samples import Samples

KNOTS = 16
"""Intervals of the spline."""
SMOOTHNESS = 100.0
"""``lambda``, at a diagonal of 100, with the time between two key-frames as the unit."""
REGION = 0.2
"""Of the diagonal, along the surface: how far from what is held vertices move on their own, beside the modes."""
WIDE_REGION = 0.5
"""The same once nothing passes through anything any more, for :data:`FINAL_STEPS`."""
ROUNDS = 5
MODAL_STEPS = 2
FINE_STEPS = 2
FINAL_STEPS = 2
FINE_PRODUCTS = 15


class Displacement(NamedTuple):
    """What pushes the shapes between two key-frames apart, at all times."""

    coefficients: Tensor | None
    """Of :func:`splines`, in the frame; None where nothing passes through anything. *Shape:* ``(3, J, V)``."""
    n_before: Tensor
    """Pairs of triangles of parts that went through each other, in the shapes that were searched. *Shape:* ``(T,)``."""
    n_crossing: Tensor
    """Those that are left. *Shape:* ``(T,)``, int64."""

    def apply(self, member: Between, samples: Samples, shapes: Tensor) -> Tensor:
        """Push shapes apart, at any times.

        The gradient reaches shapes and times; the coefficients are constants.

        Args:
            member: In-betweens of the pair of key-frames.
            samples: Of that pair, with the times of the shapes.
            shapes: In the caller's coordinates. *Shape:* ``(T, V, 3)``.
        """
        if self.coefficients is None:
            return shapes
        frame, t = member.frame, samples.t
        placed = trees.picked(member.placed(samples), samples.which)
        moved = (splines(t).values @ self.coefficients).movedim(0, -1)
        return frame.restore(frame.bring(shapes, placed, t) + moved, placed, t)


class Splines(NamedTuple):
    """Cubic B-splines that vanish at 0 and 1."""

    values: Tensor
    """*Shape:* ``(T, J)``."""
    bend: Tensor
    """Integrals of products of their second derivatives. *Shape:* ``(J, J)``."""


def splines(t: Tensor, n: int | None = None) -> Splines:
    """The splines at given times, with their first derivative as a gradient.

    Args:
        t: Times in [0, 1]. *Shape:* ``(T,)``.
        n: Number of their intervals, J - 1. Default: :data:`KNOTS`.
    """
    n = KNOTS if n is None else n
    knots = np.concatenate([np.zeros(3), np.linspace(0, 1, n + 1), np.ones(3)])
    at = t.detach().double().cpu().numpy()
    every = BSpline(knots, np.eye(n + 3), 3)
    values, slopes = (torch.from_numpy(f(at)[:, 1:-1]).to(t) for f in (every, every.derivative()))
    if t.requires_grad:
        values = values + slopes * (t - t.detach())[:, None]
    # Second derivatives are linear in each interval: Gauss' rule with two points is exact for their products.
    middle, half = (np.arange(n) + 0.5) / n, 0.5 / n / np.sqrt(3)
    second = every.derivative(2)(np.concatenate([middle - half, middle + half]))[:, 1:-1]
    return Splines(values, torch.from_numpy(second.T @ second / (2 * n)).to(t.detach()))


class _Fine:
    """The energy of all shapes of an interval around what is held, by chunks that fit into caches.

    Vertices farther away are moved by the modes only. There the energy has no term that sees all vertices at once, such
    as the volume: the modes keep that.
    """

    def __init__(self, member: Between, samples: Samples, pair: Any, held: Contacts, near: Tensor) -> None:
        mesh = member.mesh
        touched = near[mesh.faces].any(1)
        faces = mesh.faces[touched]
        #: The vertices of the region, and of faces that reach into it.
        self.vertices = torch.cat([faces.flatten(), held.elements.flatten().cpu()]).unique()
        numbers = torch.full((mesh.n_vertices,), -1).index_copy(0, self.vertices, torch.arange(len(self.vertices)))
        #: Which of them may move.
        self.free = near[self.vertices].to(held.weights)
        local = Mesh.of(numbers[faces], len(self.vertices))
        terms = [term for term in member.terms if not term.total and not term.sampled and _is_number(term.stiffness)]
        held = held._replace(elements=numbers[held.elements.cpu()].to(held.elements.device))
        self.held = held
        self.energy = held.fine(local, terms)
        own = Energy(local, terms).to(held.weights.device)
        stiffness = [k for term, k in zip(member.terms, samples.stiffness, strict=True) if term in terms]
        self.references = member.fine_reference(samples, pair, own, self.vertices, stiffness)
        self.size = fine_chunk(len(self.vertices), held.weights.device)

    def _parts(self, rows: Tensor) -> Any:
        """Chunks of extended rows, with their references. *Shape:* ``(3, T, R)``."""
        for i in range(0, rows.shape[1], self.size):
            own = slice(i, i + self.size)
            reference = self.held.rows(own).joined(trees.rows(self.references, own))
            yield reference, self.energy.extend(rows[:, own].contiguous()), own

    def value(self, rows: Tensor) -> Tensor:
        """*Shape:* ``(3, T, R) -> (T,)``."""
        return torch.cat([self.energy.value(x, reference) for reference, x, _ in self._parts(rows)])

    def linearised(self, rows: Tensor) -> tuple[Tensor, list[Any], Tensor]:
        """Gradients, *shape* ``(3, T, R)``, convex Hessians of the chunks, their blocks, *shape* ``(3, 3, T, R)``."""
        gradients, hessians, diagonals = [], [], []
        for reference, x, own in self._parts(rows):
            at = self.energy.linearise(x, reference)
            hessian = ConvexHessian(self.energy, at)
            gradients.append(self.energy.fold(self.energy.gradient(at)))
            diagonals.append(hessian.diagonal()[..., : rows.shape[-1]])
            hessians.append((own, hessian))
        return torch.cat(gradients, 1), hessians, torch.cat(diagonals, 2)

    def product(self, hessians: list[Any], field: Tensor) -> Tensor:
        """*Shape:* ``(3, T, R) -> (3, T, R)``."""
        energy = self.energy
        products = [energy.fold(hessian(energy.extend(field[:, own].contiguous()))) for own, hessian in hessians]
        return torch.cat(products, 1)


def _is_number(stiffness: Any) -> bool:
    return not isinstance(stiffness, Tensor) or stiffness.numel() == 1


@torch.no_grad()
def push_apart(member: Between, samples: Samples, shapes: Tensor, every: int = 1) -> Displacement:
    """Find what pushes shapes between two key-frames apart where parts went through each other.

    Args:
        member: In-betweens of the pair.
        samples: Of one pair of key-frames, with the times of the shapes.
        shapes: In the caller's coordinates. *Shape:* ``(T, V, 3)``.
        every: Of so many shapes, one is searched first: where none of these has a crossing, the others have none that
            lasts.
    """
    frame, t = member.frame, samples.t
    pair = member.placed(samples)
    placed = trees.picked(pair, samples.which)
    start = frame.bring(shapes, placed, t)
    search = ContactSearch(member.mesh, pair.first, pair.second, samples.which, t)
    if every > 1 and not search.crosses(start, range(every - 1, len(t), every)):
        return Displacement(None, search.n_far, search.n_far)
    held = search(start)
    n_before = n_far = search.n_far
    if held is None:
        return Displacement(None, n_far, n_far)
    rows = start.movedim(-1, 0).contiguous()
    solver = _Coupled(member, samples, pair, rows)
    at = rows.new_zeros(3, solver.basis.shape[1], rows.shape[-1])
    best: tuple[Tensor | None, Tensor] = None, n_far
    kept = torch.arange(len(t), device=t.device)
    for _ in range(ROUNDS):
        held = held.of_all(kept)
        at = solver.fine(solver.modal(at, held), held, search.near(REGION), FINE_STEPS)
        found = search(solver.moved(at).movedim(0, -1))
        if int(search.n_far.sum()) < int(best[1].sum()):
            best = at, search.n_far
        if found is None or not bool(search.n_far.any()):
            break
        held = found
    if best[0] is not None and not bool(best[1].any()):
        # What was pushed apart in a hurry is brought to rest, in a wider region.
        held = held.of_all(kept) if len(held.samples) < len(t) else held
        rested = solver.fine(best[0], held, search.near(WIDE_REGION), FINAL_STEPS)
        search(solver.moved(rested).movedim(0, -1))
        if not bool(search.n_far.any()):
            best = rested, search.n_far
    return Displacement(best[0], n_before, best[1])


class _Coupled:
    """Steps of the displacement of all times."""

    def __init__(self, member: Between, samples: Samples, pair: Any, rows: Tensor) -> None:
        self.member, self.samples, self.pair, self.rows = member, samples, pair, rows
        self.basis, bend = splines(samples.t)
        self.bend = SMOOTHNESS * bend
        self.area = member.frame.weights / member.frame.weights.sum()
        self.coarse = member.coarse_reference(samples, pair)

    def moved(self, at: Tensor) -> Tensor:
        """The shapes. *Shape:* ``(3, J, V) -> (3, T, V)``."""
        return self.rows + self.expand(at)

    def expand(self, at: Tensor) -> Tensor:
        """From the spline to the times. *Shape:* ``(3, J, V) -> (3, T, V)``."""
        return self.basis @ at

    def gather(self, field: Tensor) -> Tensor:
        """The adjoint of :meth:`expand`. *Shape:* ``(3, T, V) -> (3, J, V)``."""
        return self.basis.T @ field

    def bent(self, at: Tensor, area: Tensor) -> Tensor:
        """Half the gradient of the squared acceleration. *Shape:* ``(3, J, V), (V,) -> (3, J, V)``."""
        return (self.bend @ at) * area

    def fine(self, at: Tensor, held: Contacts, near: Tensor, n_steps: int) -> Tensor:
        """Steps of a truncated Newton method on the vertices near by, at all times, never uphill.

        Args:
            at: *Shape:* ``(3, J, V)``.
            held: Of all times.
            near: The vertices that may move. *Shape:* ``(V,)``.
            n_steps: How many.
        """
        local = _Fine(self.member, self.samples, self.pair, held, near)
        chosen = local.vertices.to(at.device)
        rows, own, area = self.rows[..., chosen], at[..., chosen], self.area[chosen]

        def value(own: Tensor) -> float:
            return float(local.value(rows + self.basis @ own).sum() + (own * self.bent(own, area)).sum())

        before = value(own)
        for _ in range(n_steps):
            gradient, hessians, diagonal = local.linearised(rows + self.basis @ own)
            right = -self.gather(gradient) - 2 * self.bent(own, area)
            step = self._solved(local, hessians, self._preconditioner(diagonal, area), right * local.free, area)
            for length in STEP_LENGTHS:
                after = value(own + length * step)
                if after < before:
                    own, before = own + length * step, after
                    break
            else:
                break
        return at.index_copy(2, chosen, own)

    def _preconditioner(self, diagonal: Tensor, area: Tensor) -> Tensor:
        """Inverses of the blocks of each function of the spline at each vertex. *Shape:* ``(3, 3, J, R)``."""
        eye = torch.eye(3).to(diagonal)[..., None, None]
        return inverse_of_symmetric((self.basis**2).T @ diagonal + 2 * self.bend.diagonal()[:, None] * area * eye)

    def _solved(self, local: _Fine, hessians: list[Any], inverse: Tensor, right: Tensor, area: Tensor) -> Tensor:
        def product(field: Tensor) -> Tensor:
            found = self.gather(local.product(hessians, self.expand(field))) + 2 * self.bent(field, area)
            return found * local.free

        def precondition(residual: Tensor) -> Tensor:
            return (inverse * residual).sum(1)

        def dot(a: Tensor, b: Tensor) -> Tensor:
            return (a * b).sum()

        return conjugate_gradients(product, precondition, dot, right, FINE_PRODUCTS)

    def modal(self, at: Tensor, held: Contacts) -> Tensor:
        """Newton steps in the modes, with the energy of the coarse mesh, never uphill. *Shape:* ``(3, J, V)``."""
        member = self.member
        columns = member.space.columns
        inner, contact = member.space.energy.parts[0], held.modal(member.mesh, columns.fine)
        n, j = len(columns.fine), self.basis.shape[1]
        weighted = (columns.fine * self.area[:, None]).flatten(1)
        gram = weighted @ columns.fine.flatten(1).T
        for _ in range(MODAL_STEPS):
            x = self.moved(at).movedim(0, -1)
            zero = x.new_zeros(len(x), n)
            places = (
                (inner, inner.place(member.frame.coarsen(x), self.coarse)),
                (contact, held.place(contact, x, None)),
            )
            each = [energy.derivatives(zero, place, second_order=False) for energy, place in places]
            stiffness, slope = (
                torch.stack(values).sum(0) for values in ([d.gauss_newton for d in each], [d.gradient for d in each])
            )
            hessian = torch.einsum("ti,tj,tab->iajb", self.basis, self.basis, stiffness)
            hessian = hessian + 2 * self.bend[:, None, :, None] * gram[:, None, :]
            hessian = hessian.reshape(n * j, n * j)
            pulled = (2 * self.bent(at, self.area)).permute(1, 2, 0).flatten(1) @ columns.fine.flatten(1).T
            gradient = (self.basis.T @ slope + pulled).reshape(-1)
            ridge = 1e-9 * hessian.diagonal().mean()
            factor, info = torch.linalg.cholesky_ex(hessian + ridge * torch.eye(n * j).to(hessian))
            if int(info):
                return at
            step = -torch.cholesky_solve(gradient[:, None], factor).reshape(j, n)
            field = columns.combine(step).permute(2, 0, 1)
            value = partial(self._along, places, at, field, self.basis @ step)
            before = value(0.0)
            taken = next((length for length in STEP_LENGTHS if value(length) < before), 0.0)
            at = at + taken * field
            if not taken:
                break
        return at

    def _along(self, places: Any, at: Tensor, field: Tensor, step: Tensor, length: float) -> float:
        """What is minimised after a part of a step in the modes."""
        bent = at + length * field
        total = sum(energy.value(length * step, place).sum() for energy, place in places)
        return float(total + (bent * self.bent(bent, self.area)).sum())
