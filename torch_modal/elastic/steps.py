"""The energy on the caller's mesh with every vertex free: a convex Hessian, never assembled, and steps with it."""

from collections.abc import Callable, Sequence
from typing import NamedTuple, Protocol

import torch
from torch import Tensor, nn

from torch_modal.autograd import plain
from torch_modal.elastic.energy import Energy, Linearised, Reference, RestShapes, energy_rounding
from torch_modal.elastic.shell import N_SHELL_TERMS
from torch_modal.elastic.term import Mesh, Term
from torch_modal.geometry.canonical import CANONICAL_SIZE

# Added to the diagonal blocks, relative to their trace: a vertex in a flat fan has no stiffness along its normal.
RIDGE = 1e-6

# Rows and columns of the upper triangle of a symmetric block.
_ROWS, _COLUMNS = [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]

# Where steps are small, the curvature along them is rounding of energies.
SLIGHT = 1e-5 * CANONICAL_SIZE

# Vertices of all samples that are relaxed at a time: more would not fit into a processor's caches, or, of a GPU, into
# its memory (6 KB a vertex where gradients are recorded).
CHUNK = 20_000
CHUNK_OF_GPU = 1_000_000


class FurtherDerivatives(NamedTuple):
    """An energy beside Eq. 5 at given shapes."""

    value: Tensor
    """*Shape:* ``(B,)``."""
    gradient: Tensor
    """*Shape:* ``(B, V, 3)``."""
    diagonal: Tensor
    """The blocks of its convex Hessian's diagonal, packed. *Shape:* ``(B, V, 6)``."""
    product: Callable[[Tensor], Tensor]
    """With the convex Hessian. *Shape:* ``(B, V, 3) -> (B, V, 3)``."""


class FurtherEnergy(Protocol):
    """An energy that steps of all vertices take beside Eq. 5."""

    def value(self, x: Tensor) -> Tensor:
        """*Shape:* ``(B, V, 3) -> (B,)``."""

    def at(self, x: Tensor) -> FurtherDerivatives:
        """*Shape:* ``(B, V, 3)``."""


class ConvexHessian:
    """Gauss-Newton's Hessian and the second-order term of stretched edges: never negative.

    Args:
        energy: The energy.
        at: Where it is linearised.
    """

    def __init__(self, energy: Energy, at: Sequence[Linearised]) -> None:
        self.energy, self.at = energy, at
        #: Stiffness across each element of two vertices; along it, there is the curvature. *Shape:* ``(B, M)``.
        self.tensions = [
            part.term.tension(one.edge_vectors, one.slope, one.curvature)
            for part, one in zip(energy.parts, at, strict=True)
        ]

    def __call__(self, field: Tensor) -> Tensor:
        """The product with displacements. *Shape:* ``(3, B, V)``, extended."""
        received = []
        for part, one, tension in zip(self.energy.parts, self.at, self.tensions, strict=True):
            if part.term.total:
                received.append(one.curvature * (one.gradients * field).sum((0, -1))[:, None])
                continue
            edge_vectors = part.edge_vectors(field)
            rate = (one.gradients * edge_vectors).sum((0, 1))
            if tension is None:
                received.append(one.curvature * rate * one.gradients)
            else:
                received.append(tension * edge_vectors + (one.curvature - tension) * rate * one.gradients)
        return self.energy.scatter(self.at, received)

    def diagonal(self) -> Tensor:
        """The blocks of all vertices, the upper triangle of each. *Shape:* ``(6, B, V)``, extended."""
        like = self.at[0].gradients
        summed = like.new_zeros(6, like.shape[-2], self.energy.n_extended)
        for part, one, tension in zip(self.energy.parts, self.at, self.tensions, strict=True):
            if part.term.total:
                continue  # of rank one: it couples all vertices, and adds little to each
            along = one.curvature if tension is None else one.curvature - tension
            for corner, end in zip(part.corners, part.on_corners(one.gradients), strict=True):
                blocks = (along * end)[_ROWS] * end[_COLUMNS]
                if tension is not None:
                    eye = torch.eye(3, dtype=end.dtype, device=end.device)[_ROWS, _COLUMNS]
                    blocks = blocks + eye[:, None, None] * tension
                summed = summed.index_add(-1, corner, blocks)
        return summed


def inverse_of_symmetric(blocks: Tensor) -> Tensor:
    """Inverse by cofactors, with a ridge. *Shape:* ``(6, ...) -> (3, 3, ...)``."""
    trace = blocks[0] + blocks[3] + blocks[5]
    # Vertices that no face uses have no stiffness at all, and no gradient either.
    trace = torch.where(trace > 0, trace, 1)
    a, b, c, d, e, f = blocks / trace
    a, d, f = a + RIDGE, d + RIDGE, f + RIDGE
    aa, bb, cc = d * f - e * e, c * e - b * f, b * e - c * d
    determinant = a * aa + b * bb + c * cc
    cofactors = torch.stack([aa, bb, cc, bb, a * f - c * c, b * c - a * e, cc, b * c - a * e, a * d - b * b])
    return (cofactors / (determinant * trace)).unflatten(0, (3, 3))


def relax(
    energy: Energy,
    x: Tensor,
    reference: Reference,
    n_steps: int,
    n_products: int,
    anchors: Tensor | None = None,
    beside: Sequence[FurtherEnergy] = (),
) -> Tensor:
    """Steps of a truncated Newton method on all vertices, shortened where the energy would rise.

    Each step solves with :class:`ConvexHessian` by conjugate gradients, preconditioned by its diagonal blocks and cut
    short: what a modal space leaves to be done is local, and a few iterations see far enough. Every sample takes the
    same number of both, so that the result is differentiable like any other expression.

    Args:
        energy: The energy.
        x: Where to start. *Shape:* ``(B, V, 3)``.
        reference: What is compared with.
        n_steps: Newton steps.
        n_products: Iterations of conjugate gradients in each.
        anchors: Of the energy's terms, where there are some. *Shape:* ``(B, P, 3)``.
        beside: Further energies.

    Returns:
        *Shape:* ``(B, V, 3)``.
    """
    fixed = None if anchors is None else anchors.movedim(-1, 0)
    rows, at = x.movedim(-1, 0).contiguous(), None
    for k in range(n_steps):
        at = energy.linearise(energy.extend(rows, fixed), reference) if at is None else at
        more = [one.at(rows.movedim(0, -1).contiguous()) for one in beside]
        right = -sum((one.gradient.movedim(-1, 0) for one in more), start=energy.fold(energy.gradient(at)))
        direction = _solved(energy, ConvexHessian(energy, at), right, n_products, more)
        reached = rows + direction
        there = reached.movedim(0, -1).contiguous()
        before = sum((one.value for one in more), start=energy.value_at(at, reference))
        extended, at = energy.extend(reached, fixed), None
        if k < n_steps - 1 and plain(reached):  # the whole step is nearly always the one that is taken
            at = energy.linearise(extended, reference)
        after = energy.value(extended, reference) if at is None else energy.value_at(at, reference)
        after = sum((one.value(there) for one in beside), start=after)
        length = step_length(before, -(right * direction).sum((0, -1)), after, direction.abs().amax((0, -1)))
        if at is not None and bool((length == 1).all()):
            rows = reached
        else:
            rows, at = rows + length[:, None] * direction, None
    return rows.movedim(0, -1)


def step_length(before: Tensor, slope: Tensor, after: Tensor, largest: Tensor) -> Tensor:
    """Where the parabola along a step is least, at most 1: a continuous function of the step, unlike a line search.

    Args:
        before: The energy where the step starts. *Shape:* ``(B,)``.
        slope: Its derivative along the step, at most zero. *Shape:* ``(B,)``.
        after: The energy where the whole step leads. *Shape:* ``(B,)``.
        largest: Largest coordinate of the step; none below :data:`SLIGHT` is shortened, and one of ten times
            that in full. *Shape:* ``(B,)``.

    Returns:
        *Shape:* ``(B,)``.
    """
    half, finite = -0.5 * slope, after.isfinite()
    rounding = energy_rounding(before.dtype) * before.detach().abs()
    gap = torch.where(finite, after, before) - before + half - rounding
    if not torch.is_grad_enabled() and plain(gap) and bool((finite & (gap <= 0)).all()):
        return torch.ones_like(gap)  # nearly always
    surplus = gap.clamp_min(0)
    counts = ((largest / SLIGHT - 1) / 9).clamp(0, 1)
    shorter = (surplus > 0) & (counts > 0)
    length = torch.where(shorter, 1 - counts * surplus / torch.where(shorter, half + surplus, 1), 1)
    return torch.where(finite, length, 0)


def _solved(
    energy: Energy,
    hessian: ConvexHessian,
    right: Tensor,
    n_products: int,
    more: Sequence[FurtherDerivatives],
) -> Tensor:
    """An approximate solution. *Shape:* ``(3, B, V)``."""
    blocks = hessian.diagonal()[..., : right.shape[-1]]
    for one in more:
        blocks = blocks + one.diagonal.movedim(-1, 0)
    inverse = inverse_of_symmetric(blocks)

    def product(field: Tensor) -> Tensor:
        own = energy.fold(hessian(energy.extend(field)))
        return sum((one.product(field.movedim(0, -1).contiguous()).movedim(-1, 0) for one in more), start=own)

    def precondition(residual: Tensor) -> Tensor:
        return (inverse * residual).sum(1)

    def dot(a: Tensor, b: Tensor) -> Tensor:
        return (a * b).sum((0, -1))[:, None]

    return conjugate_gradients(product, precondition, dot, right, n_products)


def conjugate_gradients(
    product: Callable[[Tensor], Tensor],
    precondition: Callable[[Tensor], Tensor],
    dot: Callable[[Tensor, Tensor], Tensor],
    right: Tensor,
    n_products: int,
) -> Tensor:
    """An approximate solution, preconditioned, of one or more systems.

    Args:
        product: With the matrix, symmetric and never negative.
        precondition: With an approximate inverse.
        dot: Inner products of two such fields, one of each system, that broadcast against them.
        right: The right side.
        n_products: How many.
    """

    def quotient(a: Tensor, b: Tensor) -> Tensor:
        # A system that is solved exactly has nothing left: 0 / 0.
        return torch.where(b > 0, a / torch.where(b > 0, b, 1), 0)

    solution = torch.zeros_like(right)
    residual = right
    direction = preconditioned = precondition(residual)
    size = dot(residual, preconditioned)
    for k in range(n_products):
        along = product(direction)
        length = quotient(size, dot(direction, along))
        solution = solution + length * direction
        if k == n_products - 1:
            break
        residual = residual - length * along
        preconditioned = precondition(residual)
        previous, size = size, dot(residual, preconditioned)
        direction = preconditioned + quotient(size, previous) * direction
    return solution


class FurtherTerms(FurtherEnergy):
    """The terms beyond Eq. 5 as an energy beside it.

    Args:
        energy: Their energy.
        rests: The rest shapes of all terms.
    """

    def __init__(self, energy: Energy, rests: RestShapes) -> None:
        own = rests._replace(stiffness=rests.stiffness[N_SHELL_TERMS:])
        self.energy, self.reference = energy, own.reference(energy)
        self.anchors = None if rests.anchors is None else rests.anchors.movedim(-1, 0)

    def _extended(self, x: Tensor) -> Tensor:
        return self.energy.extend(x.movedim(-1, 0).contiguous(), self.anchors)

    def value(self, x: Tensor) -> Tensor:
        """*Shape:* ``(B, V, 3) -> (B,)``."""
        return self.energy.value(self._extended(x), self.reference)

    def at(self, x: Tensor) -> FurtherDerivatives:
        """*Shape:* ``(B, V, 3)``."""
        energy, n = self.energy, x.shape[1]
        at = energy.linearise(self._extended(x), self.reference)
        hessian = ConvexHessian(energy, at)
        packed = hessian.diagonal()[..., :n].movedim(0, -1)

        def product(field: Tensor) -> Tensor:
            rows = energy.extend(field.movedim(-1, 0).contiguous())
            return energy.fold(hessian(rows)).movedim(0, -1)

        gradient = energy.fold(energy.gradient(at)).movedim(0, -1)
        return FurtherDerivatives(energy.value_at(at, self.reference), gradient, packed, product)


Beside = Callable[[slice, Tensor], Sequence[FurtherEnergy]]
"""Makes energies beside that of the terms, for some of the samples, in the dtype of a tensor."""


class FineEnergy(nn.Module):
    """All terms on the caller's mesh.

    Args:
        mesh: The mesh.
        terms: The terms; those of Eq. 5 come first.
    """

    def __init__(self, mesh: Mesh, terms: Sequence[Term]) -> None:
        super().__init__()
        self.mesh = mesh
        self.energy = Energy(mesh, terms)

    def relax(
        self, x: Tensor, rests: RestShapes, stages: Sequence[tuple[int, int]], beside: Beside | None = None
    ) -> Tensor:
        """Steps of all vertices, never uphill: stages of :func:`relax` by numbers of steps and products.

        *Shape:* ``(B, V, 3)``.
        """
        size, parts = chunk_of(x.shape[1], x.device), []
        for i in range(0, len(x), size):
            some = slice(i, i + size)
            own = x[some]
            parts.append(self.relax_chunk(own, rests.rows(some), stages, () if beside is None else beside(some, own)))
        return torch.cat(parts)

    def relax_chunk(
        self, x: Tensor, rests: RestShapes, stages: Sequence[tuple[int, int]], beside: Sequence[FurtherEnergy]
    ) -> Tensor:
        """:meth:`relax` of samples that fit into the caches, with their own further energies."""
        reference = rests.reference(self.energy, x, relative=True)
        for n_steps, n_products in stages:
            x = relax(self.energy, x, reference, n_steps, n_products, rests.anchors, beside)
        return x

    def towards(
        self, x: Tensor, reference: Reference, n_steps: int, n_products: int, beside: Sequence[FurtherEnergy] = ()
    ) -> Tensor:
        """Steps of all vertices towards a reference that is known. *Shape:* ``(B, V, 3)``."""
        return relax(self.energy, x, reference, n_steps, n_products, None, beside)


def chunk_of(n_vertices: int, device: torch.device) -> int:
    """Number of samples of so many vertices that are relaxed at a time."""
    return max(1, (CHUNK if device.type == "cpu" else CHUNK_OF_GPU) // n_vertices)
