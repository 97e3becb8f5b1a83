"""The energy on the caller's mesh with every vertex free, and steps of a truncated Newton method."""

from collections.abc import Callable, Sequence
from functools import reduce
from typing import NamedTuple, Protocol, TypeVar

import torch
from torch import Tensor, nn

from torch_modal import trees
from torch_modal.autograd import is_eager
from torch_modal.elastic import formulas
from torch_modal.elastic.energy import ENERGY_ROUNDING, Energy, EnergyAt, Reference, RestShapes
from torch_modal.elastic.term import Mesh, Term
from torch_modal.geometry.canonical import CANONICAL_SIZE

# The curvature along a shorter step is rounding of energies.
SHORTEST_MOVE = 1e-5 * CANONICAL_SIZE

# Vertices of all samples that are relaxed at a time: more would not fit into a processor's caches, or, of a GPU, into
# its memory (6 KB a vertex where gradients are recorded).
VERTICES_AT_ONCE_OF_CPU = 20_000
VERTICES_AT_ONCE_OF_GPU = 1_000_000


class Point(NamedTuple):
    """An energy at given shapes, with a convex Hessian."""

    value: Tensor
    """*Shape:* ``(B,)``."""
    gradient: Tensor
    """*Shape:* ``(B, V, 3)``."""
    diagonal: Tensor
    """The blocks of the Hessian's diagonal, packed. *Shape:* ``(B, V, 6)``."""
    product: Callable[[Tensor], Tensor]
    """With the Hessian. *Shape:* ``(B, V, 3) -> (B, V, 3)``."""

    def slope(self, direction: Tensor) -> Tensor:
        """Derivative of the energy along a direction. *Shape:* ``(B, V, 3) -> (B,)``."""
        return (self.gradient * direction).sum((1, 2))


class FreeEnergy(Protocol):
    """An energy of all vertices."""

    def value(self, x: Tensor) -> Tensor:
        """*Shape:* ``(B, V, 3) -> (B,)``."""

    def at(self, x: Tensor) -> Point:
        """*Shape:* ``(B, V, 3)``."""


class AnyPoint(Protocol):
    """Parts of a :class:`Point` that the choice of a step needs; points of kernels have them too."""

    @property
    def value(self) -> Tensor:
        """*Shape:* ``(B,)``."""

    def slope(self, direction: Tensor) -> Tensor:
        """*Shape:* ``(B, V, 3) -> (B,)``."""


Kind = TypeVar("Kind", bound=AnyPoint)
Step = tuple[Tensor, Kind, Tensor, Tensor, tuple[Tensor, ...]]
"""Start, energy there, whole step and its length; what the solver kept."""


class Problem(Protocol[Kind]):
    """An energy of all vertices, with a solver for its Newton steps."""

    def value(self, x: Tensor) -> Tensor:
        """*Shape:* ``(B, V, 3) -> (B,)``."""

    def at(self, x: Tensor) -> Kind:
        """*Shape:* ``(B, V, 3)``."""

    def newton_direction(self, at: Kind, n_products: int, keep: bool) -> tuple[Tensor, ...]:
        """An approximate solution, *shape* ``(B, V, 3)``, and what its gradient needs if it is to be kept."""


def inverse_of_symmetric(blocks: Tensor) -> Tensor:
    """:func:`torch_modal.elastic.formulas.symmetric_inverse` as full matrices. *Shape:* ``(6, ...) -> (3, 3, ...)``."""
    xx, xy, xz, yy, yz, zz = formulas.symmetric_inverse(blocks.unbind())
    return torch.stack([xx, xy, xz, xy, yy, yz, xz, yz, zz]).unflatten(0, (3, 3))


def descend(
    problem: Problem[Kind], x: Tensor, products: Sequence[int], taken: list[Step[Kind]] | None = None
) -> Tensor:
    """Steps of a truncated Newton method on all vertices, shortened where the energy would rise.

    Each step solves with a convex Hessian by conjugate gradients, preconditioned by its diagonal blocks and cut short:
    the error of a base or a modal space is local, so a few iterations suffice. Every sample takes the same number of
    both, so that the result is differentiable.

    Args:
        problem: A :class:`SumOfEnergies`, or one that kernels solve.
        x: Where to start. *Shape:* ``(B, V, 3)``.
        products: Iterations of conjugate gradients in each Newton step.
        taken: A list to which each step is added.
    """
    at = None
    for k, n_products in enumerate(products, 1):
        at = problem.at(x) if at is None else at
        solution, *kept = problem.newton_direction(at, n_products, taken is not None)
        reached, there = x + solution, None
        if k < len(products) and is_eager(reached):  # the whole step is nearly always the one that is taken
            there = problem.at(reached)
        after = problem.value(reached) if there is None else there.value
        length = step_length(at.value, at.slope(solution), after, solution.abs().amax((1, 2)))
        if taken is not None:
            taken.append((x, at, solution, length, tuple(kept)))
        if there is not None and bool((length == 1).all()):
            x, at = reached, there
        else:
            x, at = x + length[:, None, None] * solution, None
    return x


def step_length(before: Tensor, slope: Tensor, after: Tensor, largest: Tensor) -> Tensor:
    """Length that minimises the parabola along a step, at most 1: continuous in the step, unlike a line search.

    Args:
        before: The energy where the step starts. *Shape:* ``(B,)``, here and below.
        slope: Its derivative along the step, at most zero.
        after: The energy where the whole step leads.
        largest: Largest coordinate of the step; none below :data:`SHORTEST_MOVE` is shortened, and one of ten times
            that in full.
    """
    half, finite = -0.5 * slope, after.isfinite()
    rounding = ENERGY_ROUNDING * torch.finfo(before.dtype).eps * before.detach().abs()
    gap = torch.where(finite, after, before) - before + half - rounding
    if not torch.is_grad_enabled() and is_eager(gap) and bool((finite & (gap <= 0)).all()):
        return torch.ones_like(gap)  # nearly always
    surplus = gap.clamp_min(0)
    counts = ((largest / SHORTEST_MOVE - 1) / 9).clamp(0, 1)
    shorter = (surplus > 0) & (counts > 0)
    length = torch.where(shorter, 1 - counts * surplus / torch.where(shorter, half + surplus, 1), 1)
    return torch.where(finite, length, 0)


class SumOfEnergies:
    """Several energies as one, and the solution with its Hessian by torch."""

    def __init__(self, energies: Sequence[FreeEnergy]) -> None:
        self.energies = energies

    def value(self, x: Tensor) -> Tensor:
        """*Shape:* ``(B, V, 3) -> (B,)``."""
        return reduce(torch.add, [one.value(x) for one in self.energies])

    def at(self, x: Tensor) -> Point:
        """*Shape:* ``(B, V, 3)``."""
        each = [one.at(x) for one in self.energies]
        values, gradients, diagonals, products = zip(*each, strict=True)
        value, gradient, diagonal = (reduce(torch.add, summands) for summands in (values, gradients, diagonals))
        return Point(
            value, gradient, diagonal, lambda field: reduce(torch.add, [product(field) for product in products])
        )

    @staticmethod
    def newton_direction(at: Point, n_products: int, keep: bool = False) -> tuple[Tensor]:
        """An approximate solution with the Hessian for the opposite of the gradient. *Shape:* ``(B, V, 3)``."""
        inverse = inverse_of_symmetric(at.diagonal.movedim(-1, 0))
        solution = conjugate_gradients(
            lambda field: at.product(field.movedim(0, -1)).movedim(-1, 0),
            lambda residual: (inverse * residual).sum(1),
            lambda a, b: (a * b).sum((0, -1))[:, None],
            -at.gradient.movedim(-1, 0),
            n_products,
        )
        return (solution.movedim(0, -1),)


def conjugate_gradients(
    product: Callable[[Tensor], Tensor],
    precondition: Callable[[Tensor], Tensor],
    dot: Callable[[Tensor, Tensor], Tensor],
    right: Tensor,
    n_products: int,
    tolerance: float | None = None,
) -> Tensor:
    """An approximate solution, preconditioned, of one or more systems.

    Args:
        product: With the matrix, symmetric and never negative; with a tolerance, it may be indefinite.
        precondition: With an approximate inverse.
        dot: Inner products of two such fields, one of each system, that broadcast against them.
        right: The right side.
        n_products: How many.
        tolerance: Of one system, the relative residual that ends the iteration. It also ends, in a direction that goes
            downhill, where the curvature is not positive. Default: all products are taken.
    """
    solution = torch.zeros_like(right)
    residual = right
    direction = preconditioned = precondition(residual)
    size = first = dot(residual, preconditioned)
    for k in range(n_products):
        along = product(direction)
        curvature = dot(direction, along)
        if tolerance is not None and not curvature > 0:
            return solution if k else preconditioned
        length = formulas.quotient(size, curvature)
        solution = solution + length * direction
        if k == n_products - 1:
            break
        residual = residual - length * along
        preconditioned = precondition(residual)
        previous, size = size, dot(residual, preconditioned)
        if tolerance is not None and not size > tolerance**2 * first:
            break
        direction = preconditioned + formulas.quotient(size, previous) * direction
    return solution


class TermsTowards:
    """Terms towards a reference, perhaps with fixed points as anchors. *Shape:* ``(B, P, 3)``."""

    def __init__(self, energy: Energy, reference: Reference, anchors: Tensor | None = None) -> None:
        self.energy, self.reference = energy, reference
        self.anchors = None if anchors is None else anchors.movedim(-1, 0)

    def _extend(self, x: Tensor) -> Tensor:
        return self.energy.extend(x.movedim(-1, 0), self.anchors)

    def value(self, x: Tensor) -> Tensor:
        """*Shape:* ``(B, V, 3) -> (B,)``."""
        return self.energy.value(self._extend(x), self.reference)

    def at(self, x: Tensor) -> Point:
        """*Shape:* ``(B, V, 3)``."""
        energy, n = self.energy, x.shape[1]
        at = EnergyAt(energy, self._extend(x), self.reference)
        return Point(
            at.value,
            energy.fold(at.gradient()).movedim(0, -1),
            at.diagonal()[..., :n].movedim(0, -1),
            lambda field: energy.fold(at.product(energy.extend(field.movedim(-1, 0)))).movedim(0, -1),
        )


ExtraEnergies = Callable[[slice, Tensor], Sequence[FreeEnergy]]
"""Makes further energies for some of the samples, in the dtype of a tensor."""


class FineEnergy(nn.Module):
    """All terms on the caller's mesh; the terms of Eq. 5 come first."""

    def __init__(self, mesh: Mesh, terms: Sequence[Term]) -> None:
        super().__init__()
        self.mesh = mesh
        self.energy = Energy(mesh, terms)

    def relax(
        self, x: Tensor, rests: RestShapes, products: Sequence[int], extra: ExtraEnergies = lambda *_: ()
    ) -> Tensor:
        """Steps of all vertices, never uphill, by :func:`descend`. *Shape:* ``(B, V, 3)``."""
        most = VERTICES_AT_ONCE_OF_CPU if x.device.type == "cpu" else VERTICES_AT_ONCE_OF_GPU
        n = max(1, most // x.shape[1])
        if len(x) <= n:
            return self.relax_chunk(x, rests, products, extra(slice(None), x))
        chunks = [slice(i, i + n) for i in range(0, len(x), n)]
        return torch.cat([self.relax_chunk(x[i], trees.rows(rests, i), products, extra(i, x[i])) for i in chunks])

    def relax_chunk(self, x: Tensor, rests: RestShapes, products: Sequence[int], extra: Sequence[FreeEnergy]) -> Tensor:
        """:meth:`relax` of samples that fit into the caches, with their own further energies."""
        terms = TermsTowards(self.energy, rests.reference(self.energy, x, relative=True), rests.anchors)
        return descend(SumOfEnergies([terms, *extra]), x, products)

    def descend_towards(
        self, x: Tensor, reference: Reference, products: Sequence[int], extra: Sequence[FreeEnergy] = ()
    ) -> Tensor:
        """Steps of all vertices towards a reference that is known. *Shape:* ``(B, V, 3)``."""
        return descend(SumOfEnergies([TermsTowards(self.energy, reference), *extra]), x, products)
