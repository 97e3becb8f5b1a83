r"""Terms of an energy: measures of the elements of a mesh, and their weights.

A term has the energy :math:`\sum_m k_m w_m (q_m - \bar q_m)^2` over its elements ``m``, with a measure ``q`` of each,
its value at rest, weights ``w`` that depend on the rest shape, and the stiffness ``k``. A term defines
its elements and the measure of one of them; derivatives then come from ``torch.func``. The terms of Eq. 5 have theirs
in closed form. Angles take a smooth periodic function instead of the square (:class:`PeriodicTerm`).

Kernels of NVIDIA Warp are made from the same functions of one element, written once more for them
(:class:`KernelFunctions`) next to the torch code, inside functions, as Warp is loaded only where it is used.
"""

import math
from dataclasses import dataclass
from functools import cache
from typing import Any, NamedTuple, no_type_check

import torch
from torch import Tensor, nn
from torch.func import vjp, vmap

from torch_modal.autograd import as_normal_tensor, outside_inference_mode
from torch_modal.geometry.connectivity import Connectivity
from torch_modal.geometry.vectors import inverse


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


class Potential(NamedTuple):
    """A function of measures and of a record of K rest shapes, as functions of Warp on one element."""

    record: Any
    """The type of a row of :attr:`torch_modal.elastic.energy.Reference.records`; its first number is the weight."""
    kind: Any
    """The type of the measures."""
    sums: Any
    """The type of the sums over rest shapes."""
    moments: Any
    """Summands of the sums over rest shapes: measure, weight -> vector."""
    merge_rests: Any
    """From the sums, and a factor of the weights, to the record."""
    energy: Any
    """Measure, record -> energy, but for what is left at the record."""
    slope: Any
    left: Any
    """Energy that is left: sums, factor, record."""
    n_rows: int
    """Numbers of a record."""


@dataclass(frozen=True, eq=False)
class KernelFunctions:
    """Functions of Warp that kernels of a term are made from, of one element: a matrix of its edge vectors, by row.

    A term of your own has them by :attr:`Term.kernel_measure`.
    """

    name: str
    """Name of the modules of the kernels."""
    n: int
    """Edge vectors of an element."""
    potential: Potential
    measure: Any
    """Edge vectors -> measure."""
    linearise: Any
    """Edge vectors -> measure, gradient."""
    exact: bool = True
    """True if the gradient is in closed form, so that it can be differentiated."""
    weight: Any = None
    """Weight at rest: edge vectors, measure, mean of the measures; None where torch merges the rest shapes."""
    uses_mean: bool = False
    fullness: Any = None
    """Edge vectors, square of an altitude -> 0 to 1 by how far the element is from a needle."""
    across: Any = None
    """Stiffness across an element: measure, slope, twice the weight."""
    even: bool = False
    """True if an edge may have either direction."""


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

    and is passed as ``tm.Objective(terms=(Area(5.0),))``. Measures are taken at a size of 100, as
    in Eq. 5.

    Args:
        stiffness: ``k``: a number, or a tensor or parameter whose last dimension counts the elements, or is 1, and
            whose others broadcast against the samples. *Shape:* ``()``, ``(..., M)`` or ``(..., 1)``.
    """

    total = False
    """True if the measures of all elements add up to one measure, such as a volume."""
    sampled = False
    """True if elements name vertices of the caller's mesh, for which a coarse mesh has no counterpart."""
    kernel_measure: Any = None
    """The measure as a ``wp.func`` of a matrix of the edge vectors, by row: then kernels compute the term."""
    kernel_gradient: Any = None
    """Its gradient likewise, a matrix: then they compute gradients of results, too; torch does so where it is None."""
    stiffness: Any

    def __init__(self, stiffness: float | Tensor = 1.0) -> None:
        super().__init__()
        register_weight(self, "stiffness", stiffness)

    # ------------------------------------------------------------------------------------------- required of a term
    def elements(self, mesh: Mesh) -> Tensor:
        """The vertices of each element. *Shape:* ``(M, n)``, with n of 2 or more."""
        raise NotImplementedError

    def measure(self, edge_vectors: Tensor) -> Tensor:
        """The measure of one element, of the vectors from its first vertex to the others. *Shape:* ``(n-1, 3) -> ()``.

        Only operations that ``torch.func`` can differentiate twice.
        """
        raise NotImplementedError

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
        whole = weights.sum(-2)
        shares = weights * inverse(whole, whole <= 0)[..., None, :]
        first = measures[..., 0, :]
        value = first + (shares * self.difference(measures, first[..., None, :])).sum(-2)
        left = (weights * self.difference(measures, value[..., None, :]) ** 2).sum(-2)
        record = torch.broadcast_tensors(factor * torch.where(whole > 0, whole, 0), value)
        return torch.stack(record, -2), factor * left

    def energies(self, measures: Tensor, record: Tensor) -> Tensor:
        """Energy of each element, but for what remains.

        Args:
            measures: *Shape:* ``(..., M)``.
            record: Of :meth:`merge_rests`. *Shape:* ``(..., R, M)``.

        Returns:
            *Shape:* ``(..., M)``.
        """
        weight, value = record.unbind(-2)
        return weight * self.difference(measures, value) ** 2

    def derivatives(self, measures: Tensor, record: Tensor) -> tuple[Tensor, Tensor, Tensor | None]:
        """Derivatives of :meth:`energies` in the measures. *Shape of each:* ``(..., M)``.

        Returns:
            The first; an upper bound of the second that is never negative; and its correction, None where it is zero.
        """
        weight, value = record.unbind(-2)
        return 2 * weight * self.difference(measures, value), 2 * weight.expand_as(measures), None

    def kernel_functions(self, n: int) -> KernelFunctions | None:
        """Functions that kernels are made from, of ``n`` edge vectors; None for a term that torch computes."""
        angle = isinstance(self, PeriodicTerm)
        kind, written = (PeriodicTerm, ()) if angle else (Term, ("difference", "tension"))
        overridden = (
            getattr(type(self), each) is not getattr(kind, each) for each in ("energies", "derivatives", *written)
        )
        if self.kernel_measure is None or self.total or any(overridden):
            return None
        name = f"{type(self).__module__}.{type(self).__qualname__}"
        return _functions_of_measure(name, n, angle, self.kernel_measure, self.kernel_gradient)

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
        return self._each(self.measure, edge_vectors)

    def jacobian(self, edge_vectors: Tensor) -> tuple[Tensor, Tensor]:
        """The measures and their gradients in the edge vectors, by ``torch.func``: one pass back of all elements.

        *Shape:* ``(n-1, 3, ..., M) -> (..., M), (n-1, 3, ..., M)``.
        """
        measures, back = vjp(self.measures, edge_vectors)[:2]
        return measures, back(torch.ones_like(measures))[0]

    def linearise(self, edge_vectors: Tensor) -> tuple[Tensor, Tensor]:
        """:meth:`jacobian`, which terms that have to be fast write out."""
        return self.jacobian(edge_vectors)

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

        Args:
            edge_vectors: *Shape:* ``(1, 3, B, M)``.
            slope: First derivative of the energy in each measure. *Shape:* ``(B, M)``.
            curvature: Second derivative. *Shape:* ``(B, M)``.
        """
        return None

    @staticmethod
    def _each(function: Any, edge_vectors: Tensor) -> Tensor:
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
        c, s = measures.cos(), measures.sin()
        weight, *sums = ((weights * moment).sum(-2) for moment in (torch.ones_like(c), c, s, c * c - s * s, 2 * c * s))
        some = weight > 0
        weight, x, y, x2, y2 = (torch.where(some, moment, 0) for moment in (weight, *sums))
        squared = x * x + y * y
        none = squared <= torch.finfo(squared.dtype).tiny
        size = torch.where(none, 1, squared).sqrt()
        c, s = torch.where(none, 1, x / size), torch.where(none, 0, y / size)
        once, c2, s2 = c * x + s * y, c * c - s * s, 2 * c * s
        along, across = c2 * x2 + s2 * y2, c2 * y2 - s2 * x2
        record = [factor * weight, c, s, factor * once, factor * along, factor * across]
        left = factor * (5 / 2 * weight - 8 / 3 * once + 1 / 6 * along)
        return torch.stack(torch.broadcast_tensors(*record), -2), left

    def energies(self, measures: Tensor, record: Tensor) -> Tensor:
        """Overrides the square."""
        _, c, s, once, along, across = record.unbind(-2)
        v, _, v2, s2 = _turns(measures, c, s)
        return 8 / 3 * once * v - 1 / 6 * (along * v2 - across * s2)

    def derivatives(self, measures: Tensor, record: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Overrides the derivatives of the square."""
        weight, c, s, once, along, across = record.unbind(-2)
        v, sine, v2, s2 = _turns(measures, c, s)
        slope = 8 / 3 * once * sine - 1 / 3 * (along * s2 - across * (1 - v2))
        curvature = 8 / 3 * once * (1 - v) - 2 / 3 * (along * (1 - v2) + across * s2)
        return slope, 2 * weight.expand_as(measures), curvature - 2 * weight


def periodic_square(difference: Tensor) -> Tensor:
    """The function of :class:`PeriodicTerm`."""
    sine = (0.5 * difference).sin()
    versine = 2 * sine * sine
    return versine * (2 + versine / 3)


def _turns(angle: Tensor, c: Tensor, s: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """``1 - cos``, without cancellation, and ``sin`` of angles relative to a phase; then of twice the angles."""
    x, y = angle.cos(), angle.sin()
    off_x, off_y, sine = x - c, y - s, c * y - s * x
    versine = 0.5 * (off_x * off_x + off_y * off_y)
    return versine, sine, 2 * sine * sine, 2 * sine * (1 - versine)


def wrap_angle(angle: Tensor) -> Tensor:
    """Bring an angle into ``[-pi, pi)``, with derivative one."""
    return angle - 2 * math.pi * torch.floor(angle.detach() / (2 * math.pi) + 0.5)


# --------------------------------------------------------------------------------------------------------- for kernels
@cache
@no_type_check
def square() -> Potential:
    """The potential of :class:`Term`."""
    import warp as wp

    real, vec3, record = wp.float64, wp.vec3d, wp.vec2d

    @wp.func
    def moments(q: real, w: real):
        return w * vec3(real(1.0), q, q * q)

    @wp.func
    def merge_rests(m: vec3, factor: real):
        to = record()
        if m[0] > real(0.0):
            to = record(factor * m[0], m[1] / m[0])
        return to

    @wp.func
    def energy(q: real, to: record):
        return to[0] * (q - to[1]) * (q - to[1])

    @wp.func
    def slope(q: real, to: record):
        return real(2.0) * to[0] * (q - to[1])

    @wp.func
    def left(m: vec3, factor: real, to: record):
        energy_left = real(0.0)
        if m[0] > real(0.0):
            energy_left = factor * (m[2] - m[1] * to[1])
        return energy_left

    return Potential(record, real, vec3, moments, merge_rests, energy, slope, left, 2)


@cache
@no_type_check
def periodic() -> Potential:
    """The potential of :class:`PeriodicTerm`, of cosine and sine of the measure, with the rows of its record."""
    import warp as wp

    real, vec2 = wp.float64, wp.vec2d
    vec5, record = (wp.types.vector(length=n, dtype=real) for n in (5, 6))
    third = wp.constant(real(1 / 3))

    @wp.func
    def moments(q: vec2, w: real):
        return w * vec5(real(1.0), q[0], q[1], q[0] * q[0] - q[1] * q[1], real(2.0) * q[0] * q[1])

    @wp.func
    def merge_rests(m: vec5, factor: real):
        c = real(1.0)
        s = real(0.0)
        squared = m[1] * m[1] + m[2] * m[2]
        if m[0] > real(0.0) and squared > real(2.2250738585072014e-308):
            per = real(1.0) / wp.sqrt(squared)
            c = per * m[1]
            s = per * m[2]
        c2 = c * c - s * s
        s2 = real(2.0) * c * s
        once = c * m[1] + s * m[2]
        whole = real(0.0)
        if m[0] > real(0.0):
            whole = factor
        along = whole * (c2 * m[3] + s2 * m[4])
        return record(whole * m[0], c, s, whole * once, along, whole * (c2 * m[4] - s2 * m[3]))

    # Written out twice: the adjoint of a function that calls another computes that one once more.
    @wp.func
    def energy(q: vec2, to: record):
        x = q[0] - to[1]
        y = q[1] - to[2]
        v = real(0.5) * (x * x + y * y)
        s = to[1] * q[1] - to[2] * q[0]
        return third * (real(8.0) * to[3] * v - s * (to[4] * s - to[5] * (real(1.0) - v)))

    @wp.func
    def slope(q: vec2, to: record):
        x = q[0] - to[1]
        y = q[1] - to[2]
        cosine = real(1.0) - real(0.5) * (x * x + y * y)
        s = to[1] * q[1] - to[2] * q[0]
        twice = real(2.0) * s * (to[4] * cosine + to[5] * s)
        return third * (real(8.0) * to[3] * s - twice + to[5])

    @wp.func
    def left(m: vec5, factor: real, to: record):
        return real(2.5) * to[0] - third * (real(8.0) * to[3] - real(0.5) * to[4])

    return Potential(record, vec2, vec5, moments, merge_rests, energy, slope, left, 6)


@cache
@no_type_check
def _functions_of_measure(name: str, n: int, angle: bool, measure: Any, gradient: Any) -> KernelFunctions:
    """Functions of a measure alone, or with its gradient; kernels represent angles by cosine and sine."""
    import warp as wp

    kind, edges = measure, wp.types.matrix(shape=(n, 3), dtype=wp.float64)
    if angle:

        @wp.func
        def kind(e: edges):
            q = measure(e)
            return wp.vec2d(wp.cos(q), wp.sin(q))

    if gradient is None:

        @wp.func
        def linearise(e: edges):
            return kind(e), wp.grad(measure)(e)

    else:

        @wp.func
        def linearise(e: edges):
            return kind(e), gradient(e)

    return KernelFunctions(name, n, periodic() if angle else square(), kind, linearise, gradient is not None)
