r"""Terms of an energy: measures of the elements of a mesh, and their weights.

A term has the energy :math:`\sum_m k_m w_m (q_m - \bar q_m)^2` over its elements ``m``, with a measure ``q`` of each,
its value at rest, weights ``w`` that depend on the rest shape, and the stiffness ``k``. A term defines
its elements and the measure of one of them; derivatives then come from ``torch.func``. The terms of Eq. 5 have theirs
in closed form. Angles take a smooth periodic function instead of the square (:class:`PeriodicTerm`).

Kernels of NVIDIA Warp are made from the same formulas (:class:`Formulas`, ``formulas.py``).
"""

import math
from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.func import vjp, vmap

from torch_modal.autograd import as_normal_tensor, outside_inference_mode
from torch_modal.elastic import formulas
from torch_modal.elastic.bind import Formula, real
from torch_modal.geometry.connectivity import Connectivity


class Mesh:
    """The vertices that elements may have: the vertices of a mesh, their centre, and the anchors of a term.

    Args:
        connectivity: Of the faces.

    Attributes:
        connectivity: The same.
        faces: *Shape:* ``(F, 3)``.
        edges: *Shape:* ``(E, 2)``.
        hinges: Rows of :class:`torch_modal.geometry.connectivity.Connectivity`. *Shape:* ``(H, 4)``.
        n_vertices: Number of vertices, V.
        centre: The number that the mean of all vertices of faces has as a vertex.
        first_anchor: The number that the first of the :attr:`Term.anchors` has as a vertex.
    """

    def __init__(self, connectivity: Connectivity) -> None:
        self.connectivity = connectivity
        tables = connectivity.faces, connectivity.edges, connectivity.hinges
        self.faces, self.edges, self.hinges = (torch.tensor(table) for table in tables)
        self.n_vertices = self.centre = connectivity.n_vertices
        self.first_anchor = self.n_vertices + 1

    @classmethod
    def of(cls, faces: Tensor, n_vertices: int) -> "Mesh":
        """The mesh of these faces."""
        return cls(Connectivity(faces.detach().cpu().numpy(), n_vertices))


class Formulas(NamedTuple):
    """Formulas that kernels of a term are made from: functions of the edge vectors in the names of ``bind.py``."""

    name: str
    """Name of the modules of the kernels."""
    n: int
    """Edge vectors of an element."""
    measure: Formula
    linearised: Formula | None = None
    """Measure and its gradient; without it kernels compute no gradients of results."""
    weight: Formula | None = None
    """Weight at rest: edge vectors, measure, mean of the measures; None where torch merges the rest shapes."""
    fullness: Formula | None = None
    """Edge vectors, square of an altitude -> 0 to 1 by how far the element is from a needle."""
    tension: Formula | None = None
    """Stiffness across an element of two vertices: measure, slope, twice the weight."""
    periodic: bool = False
    """True for an angle."""
    gives_phase: bool = False
    """True for an angle whose formulas give its cosine and sine."""
    uses_mean: bool = False
    """True if weights at rest depend on the mean of the measures."""
    even: bool = False
    """True if an edge may have either direction."""

    @property
    def exact(self) -> bool:
        """True if the gradient is in closed form, so that it can be differentiated."""
        return self.linearised is not None


@outside_inference_mode
def register_weight(module: nn.Module, name: str, value: float | Tensor) -> None:
    """Keep a number or a parameter as an attribute, another tensor as a buffer."""
    if isinstance(value, Tensor) and not isinstance(value, nn.Parameter):
        module.register_buffer(name, as_normal_tensor(value))
    else:
        setattr(module, name, value)


class Term(nn.Module):
    """One kind of measure on a mesh, as a term of an energy.

    A term of your own is a class with two methods::

        class Area(tm.Term):
            def elements(self, mesh):
                return mesh.faces

            def measure(self, edge_vectors):
                return 0.5 * torch.linalg.cross(edge_vectors[0], edge_vectors[1]).norm()

    or a :attr:`formula` instead of the second, and is passed as ``tm.Objective(terms=(Area(5.0),))``. Measures are
    taken at a size of 100, as in Eq. 5.

    Args:
        stiffness: ``k``: a number, or a tensor or parameter whose last dimension counts the elements, or is 1, and
            whose others broadcast against the samples. *Shape:* ``()``, ``(..., M)`` or ``(..., 1)``.
    """

    total = False
    """True if the measures of all elements add up to one measure, such as a volume."""
    sampled = False
    """True if elements name vertices of the caller's mesh, for which a coarse mesh has no counterpart."""
    formula: Formula = None  # type: ignore[assignment]  # or there is a measure
    """The measure as a static function of the edge vectors, in the names of :mod:`torch_modal.elastic.bind`: torch
    evaluates it on all elements at once, and kernels are made from it."""
    linearised: Formula | None = None
    """Measure and its gradient in the edge vectors likewise: then kernels compute gradients of results, too."""
    own_formulas: Formulas | None = None
    """Formulas that kernels of exactly this class are made from, where they are not its own measure's."""
    stiffness: float | Tensor

    def __init__(self, stiffness: float | Tensor = 1.0) -> None:
        super().__init__()
        register_weight(self, "stiffness", stiffness)

    # ------------------------------------------------------------------------------------------- required of a term
    def elements(self, mesh: Mesh) -> Tensor:
        """The vertices of each element. *Shape:* ``(M, n)``, with n of 2 or more."""
        raise NotImplementedError

    def measure(self, edge_vectors: Tensor) -> Tensor:
        """The measure of one element, of the vectors from its first vertex to the others. *Shape:* ``(n-1, 3) -> ()``.

        Only operations that ``torch.func`` can differentiate twice. A term has a :attr:`formula` or this.
        """
        return self.formula(edge_vectors)

    # ------------------------------------------------------------------------------------------- optional for a term
    @property
    def anchors(self) -> Tensor | None:
        """Points of the caller's coordinates that elements may have as vertices, and that do not move.

        *Shape:* ``(P, 3)``.
        """
        return None

    def weights(self, edge_vectors: Tensor, measures: Tensor) -> Tensor:
        """Weights ``w`` of elements at rest. *Shape:* ``(n-1, 3, ..., M), (..., M) -> (..., M)``; one if total."""
        return torch.ones_like(measures)

    def at_rest(self, measures: Tensor) -> Tensor:
        """The measures with no energy, from the measures of a rest shape. *Shape:* ``(..., M) -> (..., M)``."""
        return measures

    def difference(self, measures: Tensor, rest: Tensor) -> Tensor:
        """Differences of measures from others. *Shape:* ``(..., M), (..., M) -> (..., M)``."""
        return measures - rest

    # ---------------------------------------------------------------- the square of the difference, and its derivatives
    def merge_rests(self, measures: Tensor, weights: Tensor, factor: float | Tensor = 1.0) -> tuple[Tensor, Tensor]:
        """K parabolas as one (Eq. 8).

        Weights below zero may outweigh the others: then there is no minimum, and no weight.

        Args:
            measures: Of K rest shapes. *Shape:* ``(..., K, M)``.
            weights: Their weights. *Shape:* ``(..., K, M)``.
            factor: Of all weights: the stiffness. *Shape:* ``(..., M)`` or ``(..., 1)``.

        Returns:
            The record of the rest shapes, weight and value, *shape* ``(..., 2, M)``; and the energy that remains,
            *shape* ``(..., M)``.
        """
        first = measures[..., :1, :]
        sums = [each.sum(-2) for each in formulas.square_moments(self.difference(measures, first), weights)]
        weight, value = formulas.square_record(sums, factor)
        left = formulas.square_left(sums, factor, (weight, value))
        return torch.stack(torch.broadcast_tensors(weight, first[..., 0, :] + value), -2), left

    def energies(self, measures: Tensor, record: Tensor) -> Tensor:
        """Energy of each element, but for what remains.

        *Shape:* measures ``(..., M)``, a record of :meth:`merge_rests` ``(..., R, M) -> (..., M)``.
        """
        weight, value = record.unbind(-2)
        return formulas.square_energy(self.difference(measures, value), (weight, real(0.0)))

    def derivatives(self, measures: Tensor, record: Tensor) -> tuple[Tensor, Tensor, Tensor | None]:
        """Derivatives of :meth:`energies` in the measures. *Shape of each:* ``(..., M)``.

        Returns:
            The first; an upper bound of the second that is never negative; and its correction, None where it is zero.
        """
        weight, value = record.unbind(-2)
        slope = formulas.square_slope(self.difference(measures, value), (weight, real(0.0)))
        return slope, 2 * weight.expand_as(measures), None

    def kernel_formulas(self, n: int) -> Formulas | None:
        """Formulas that kernels are made from, of ``n`` edge vectors; None for a term that torch computes."""
        if (own := vars(type(self)).get("own_formulas")) is not None:
            return own  # type: ignore[no-any-return]
        periodic = isinstance(self, PeriodicTerm)
        kind, fixed = (PeriodicTerm, ()) if periodic else (Term, ("difference", "tension"))
        overridden = (
            getattr(type(self), each) is not getattr(kind, each)
            for each in ("energies", "derivatives", "measure", "measures", "linearise", *fixed)
        )
        if self.formula is None or any(overridden):
            return None
        name = f"{type(self).__module__}.{type(self).__qualname__}"
        merged = ("weights", "at_rest", "merge_rests", "softening")
        plain = all(getattr(type(self), each) is getattr(kind, each) for each in merged)
        weight = formulas.unit_weight if plain else None
        return Formulas(name, n, self.formula, self.linearised, weight, periodic=periodic)

    def softening(self, start: Tensor, rest: Tensor, weights: Tensor | None) -> Tensor | None:
        """Factors of the stiffness where minimisations start; None for one.

        Args:
            start: Edge vectors there. *Shape:* ``(n-1, 3, B, M)``.
            rest: Edge vectors of K rest shapes. *Shape:* ``(n-1, 3, B, K, M)``.
            weights: Of the rest shapes, where the factors are relative to them. *Shape:* ``(B, K)``.

        Returns:
            *Shape:* ``(B, M)``.
        """
        return None

    # ---------------------------------------------- all elements at once; written out by the terms that have to be fast
    def measures(self, edge_vectors: Tensor) -> Tensor:
        """The measure of each element. *Shape:* ``(n-1, 3, ..., M) -> (..., M)``."""
        if type(self).measure is Term.measure:
            return self.formula(edge_vectors)
        return self._each(self.measure, edge_vectors)

    def jacobian(self, edge_vectors: Tensor) -> tuple[Tensor, Tensor]:
        """The measures and their gradients in the edge vectors, by ``torch.func``: one pass back of all elements.

        *Shape:* ``(n-1, 3, ..., M) -> (..., M), (n-1, 3, ..., M)``.
        """
        measures, back = vjp(self.measures, edge_vectors)[:2]
        return measures, back(torch.ones_like(measures))[0]

    def linearise(self, edge_vectors: Tensor) -> tuple[Tensor, Tensor]:
        """:meth:`jacobian`, or :attr:`linearised`, which terms that have to be fast have."""
        if self.linearised is None or type(self).measure is not Term.measure:
            return self.jacobian(edge_vectors)
        return self.linearised(edge_vectors)  # type: ignore[no-any-return]

    def hessians(self, edge_vectors: Tensor) -> Tensor:
        """Hessians of the measures in the edge vectors: Jacobians of :meth:`linearise`, by ``torch.func``.

        *Shape:* ``(n-1, 3, ..., M) -> (n-1, 3, n-1, 3, ..., M)``.
        """
        n, back = len(edge_vectors), vjp(lambda e: self.linearise(e)[1], edge_vectors)[1]
        units = torch.eye(3 * n, dtype=edge_vectors.dtype, device=edge_vectors.device)
        units = units.view(3 * n, n, 3, *[1] * (edge_vectors.dim() - 2)).expand(-1, *edge_vectors.shape)
        return vmap(lambda unit: back(unit)[0])(units).unflatten(0, (n, 3))

    def tension(self, edge_vectors: Tensor, slope: Tensor, curvature: Tensor) -> Tensor | None:
        """Stiffness that stretched elements of two vertices have across; None for elements of more.

        *Shape:* ``(1, 3, B, M)``, first and second derivatives of the energy in the measures ``(B, M) -> (B, M)``.
        """
        return None

    @staticmethod
    def _each(function: Callable[[Tensor], Tensor], edge_vectors: Tensor) -> Tensor:
        """A function of one element on all, which stay the last dimensions."""
        flat = edge_vectors.flatten(2)
        # vmap needs one element at least.
        each = flat if flat.shape[-1] else flat.new_ones(*flat.shape[:2], 1)
        out = vmap(function, in_dims=2, out_dims=-1)(each)[..., : flat.shape[-1]]
        return out.unflatten(-1, edge_vectors.shape[2:])


class PeriodicTerm(Term):
    r"""A term whose measures are angles, with a smooth periodic function instead of the square.

    .. math:: f(d) = 2 (1 - \cos d) + \tfrac{1}{3} (1 - \cos d)^2 = \tfrac{5}{2} - \tfrac{8}{3} \cos d
        + \tfrac{1}{6} \cos 2d = d^2 + O(d^6)

    It is 1.2 % below the square at 60 degrees, 5 % at 90, and no slope at half a turn, where the square of the
    wrapped difference jumps from one side to the other. It is a trigonometric polynomial of second order, so that its
    weighted sum over K rest angles follows exactly from six numbers, the rows of a record: the weight; cosine and sine
    of the mean angle; the sums of the phases along the mean, and of the phases of twice the angles along and across it.
    """

    def merge_rests(self, measures: Tensor, weights: Tensor, factor: float | Tensor = 1.0) -> tuple[Tensor, Tensor]:
        """K rest angles by their first two trigonometric moments; arguments as in the base class."""
        moments = formulas.periodic_moments(formulas.phase(measures), weights)
        sums = [each.sum(-2) for each in moments]
        record = formulas.periodic_record(sums, factor)
        return torch.stack(torch.broadcast_tensors(*record), -2), formulas.periodic_left(sums, factor, record)

    def energies(self, measures: Tensor, record: Tensor) -> Tensor:
        """Overrides the square."""
        return formulas.periodic_energy(formulas.phase(measures), record.unbind(-2))

    def derivatives(self, measures: Tensor, record: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Overrides the derivatives of the square."""
        q, to = formulas.phase(measures), record.unbind(-2)
        twice = 2 * to[0].expand_as(measures)
        return formulas.periodic_slope(q, to), twice, formulas.periodic_curvature(q, to) - twice


def wrap_angle(angle: Tensor) -> Tensor:
    """Bring an angle into ``[-pi, pi)``, with derivative one."""
    return angle - 2 * math.pi * torch.floor(angle.detach() / (2 * math.pi) + 0.5)
