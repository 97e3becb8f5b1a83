r"""Terms of an energy: measures of the elements of a mesh, and their weights.

A term has the energy :math:`\sum_m k_m w_m (q_m - \bar q_m)^2` over its elements ``m``, with a measure ``q`` of each,
its value at rest, weights ``w`` that depend on the rest shape, and the stiffness ``k``. All that a term must say is
which elements it sees and what it measures on one of them: derivatives then come from ``torch.func``. The terms of
Eq. 5 write theirs out. Angles take a smooth periodic function in the place of the square (:class:`PeriodicTerm`).
"""

import math
from typing import Any

import torch
from torch import Tensor, nn
from torch.func import jacrev, vmap

from torch_modal.geometry.connectivity import Connectivity
from torch_modal.geometry.vectors import inverse


class Mesh:
    """The vertices that elements may be made of: those of a mesh, their centre, and the anchors of a term.

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

    def __reduce__(self) -> tuple[Any, ...]:
        return Mesh, (self.connectivity,)

    @classmethod
    def of(cls, faces: Tensor, n_vertices: int) -> "Mesh":
        """The mesh of these faces."""
        return cls(Connectivity(faces.detach().cpu().numpy(), n_vertices))


class Term(nn.Module):
    """One kind of measure on a mesh, as a term of an energy.

    A term of your own is a class with two methods::

        class Area(tm.Term):
            def elements(self, mesh):
                return mesh.faces

            def measure(self, edge_vectors):
                return 0.5 * torch.linalg.cross(edge_vectors[0], edge_vectors[1]).norm()

    and is passed as ``tm.Objective(terms=(Area(5.0),))``. Measures are taken at a size of 100, like
    those of Eq. 5.

    Args:
        stiffness: ``k``: a number, or a tensor or parameter whose last dimension counts the elements, or is 1, and
            whose others broadcast against the samples. *Shape:* ``()``, ``(..., M)`` or ``(..., 1)``.
    """

    total = False
    """Whether the measures of all elements add up to one, such as a volume."""
    sampled = False
    """Whether elements name vertices of the caller's mesh, for which a coarse mesh has no counterpart."""
    stiffness: Any

    def __init__(self, stiffness: float | Tensor = 1.0) -> None:
        super().__init__()
        if isinstance(stiffness, Tensor) and not isinstance(stiffness, nn.Parameter):
            self.register_buffer("stiffness", stiffness)
        else:
            self.stiffness = stiffness

    # ------------------------------------------------------------------------------------------- what a term must say
    def elements(self, mesh: Mesh) -> Tensor:
        """The vertices of each element. *Shape:* ``(M, n)``, with n of 2 or more."""
        raise NotImplementedError

    def measure(self, edge_vectors: Tensor) -> Tensor:
        """The measure of one element, of the vectors from its first vertex to the others. *Shape:* ``(n-1, 3) -> ()``.

        Only operations that ``torch.func`` can differentiate twice.
        """
        raise NotImplementedError

    # -------------------------------------------------------------------------------------------- what a term may say
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
        """The measures that cost nothing, from those of a rest shape. *Shape:* ``(..., M) -> (..., M)``."""
        return measures

    def difference(self, measures: Tensor, rest: Tensor) -> Tensor:
        """Differences of measures from others. *Shape:* ``(..., M), (..., M) -> (..., M)``."""
        return measures - rest

    # ---------------------------------------------------------------- the square of the difference, and its derivatives
    def merged(self, measures: Tensor, pulls: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """K parabolas as one (Eq. 8).

        Weights below zero may outweigh the others: then there is no minimum, and no weight.

        Args:
            measures: Of K rest shapes. *Shape:* ``(..., K, M)``.
            pulls: Their weights. *Shape:* ``(..., K, M)``.

        Returns:
            The reference that measures are compared with, *shape* ``(..., R, M)``; its weights, and the energy that
            remains, *shape* ``(..., M)``.
        """
        whole = pulls.sum(-2)
        shares = pulls * inverse(whole, whole <= 0)[..., None, :]
        first = measures[..., :1, :]
        value = first + (shares * self.difference(measures, first)).sum(-2, keepdim=True)
        constant = (pulls * self.difference(measures, value) ** 2).sum(-2)
        return value, torch.where(whole > 0, whole, 0), constant

    def energies(self, measures: Tensor, rest: Tensor, weights: Tensor) -> Tensor:
        """Energy of each element.

        Args:
            measures: *Shape:* ``(..., M)``.
            rest: Of :meth:`merged`. *Shape:* ``(..., R, M)``.
            weights: Of :meth:`merged`, with the stiffness. *Shape:* ``(..., M)``.

        Returns:
            *Shape:* ``(..., M)``.
        """
        return weights * self.difference(measures, rest.squeeze(-2)) ** 2

    def slopes(self, measures: Tensor, rest: Tensor, weights: Tensor) -> Tensor:
        """First derivative of :meth:`energies` in the measures. *Shape:* ``(..., M)``."""
        return 2 * weights * self.difference(measures, rest.squeeze(-2))

    def curvatures(self, measures: Tensor, rest: Tensor, weights: Tensor) -> tuple[Tensor, Tensor | None]:
        """A second derivative that is never negative, and what the true one has beyond it; None where nothing."""
        return 2 * weights.expand_as(measures), None

    def on_one_branch(self, measures: Tensor, pulls: Tensor) -> Tensor:
        """The measures of K rest shapes, such that weighted sums make sense. *Shape:* ``(..., K, M)`` each."""
        return measures

    # ---------------------------------------------- all elements at once; written out by the terms that have to be fast
    def measures(self, edge_vectors: Tensor) -> Tensor:
        """The measure of each element. *Shape:* ``(n-1, 3, ..., M) -> (..., M)``."""
        return self._each(self.measure, edge_vectors)

    def gradients(self, edge_vectors: Tensor) -> Tensor:
        """Gradients of the measures in the edge vectors. *Shape:* ``(n-1, 3, ..., M) -> (n-1, 3, ..., M)``."""
        return self._each(jacrev(self.measure), edge_vectors)

    def linearised(self, edge_vectors: Tensor) -> tuple[Tensor, Tensor]:
        """The measures and their gradients; overridden, with these, where both share work.

        *Shape:* ``(n-1, 3, ..., M) -> (..., M), (n-1, 3, ..., M)``.
        """
        return self.measures(edge_vectors), self.gradients(edge_vectors)

    def hessians(self, edge_vectors: Tensor) -> Tensor:
        """Hessians of the measures in the edge vectors. *Shape:* ``(n-1, 3, ..., M) -> (n-1, 3, n-1, 3, ..., M)``."""
        return self._each(jacrev(jacrev(self.measure)), edge_vectors)

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
    r"""A term whose measures are angles, with a smooth periodic function in the place of the square.

    .. math:: f(d) = 2 (1 - \cos d) + \tfrac{1}{3} (1 - \cos d)^2 = d^2 + O(d^6)

    It is 1.2 % below the square at 60 degrees, 5 % at 90, and has no pull at half a turn, where the square of the
    wrapped difference jumps from one side to the other. It is a trigonometric polynomial of second order, so that its
    weighted mean over K rest angles follows exactly from five numbers, the rows of a reference: one of the angles and,
    of the differences ``d`` from it, the weighted means of ``1 - cos d``, ``sin d``, ``1 - cos 2d`` and ``sin 2d``.
    """

    def merged(self, measures: Tensor, pulls: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """K rest angles by their first two trigonometric moments; arguments as in the base class."""
        whole = pulls.sum(-2)
        shares = pulls * inverse(whole, whole <= 0)[..., None, :]
        # From the heaviest, for the sake of rounding; elementwise, at a tenth of what argmax takes over few long rows.
        first, heaviest = measures[..., 0, :], pulls[..., 0, :]
        for own, pull in zip(measures.unbind(-2)[1:], pulls.unbind(-2)[1:], strict=True):
            first, heaviest = torch.where(pull > heaviest, own, first), torch.maximum(pull, heaviest)
        means = ((shares * part).sum(-2) for part in _turns(measures - first[..., None, :]))
        rows = torch.stack([first, *means], -2)
        return rows, torch.where(whole > 0, whole, 0), torch.zeros_like(whole)

    def energies(self, measures: Tensor, rest: Tensor, weights: Tensor) -> Tensor:
        """Overrides the square."""
        angle, a, b, c, d = rest.unbind(-2)
        v, s, v2, s2 = _turns(measures - angle)
        first, second = a * (1 - v) - b * s, c * (1 - v2) - d * s2
        return weights * (v * (2 + v / 3) + 8 / 3 * first - second / 6)

    def slopes(self, measures: Tensor, rest: Tensor, weights: Tensor) -> Tensor:
        """First derivative of :meth:`energies` in the measures. *Shape:* ``(..., M)``."""
        angle, a, b, c, d = rest.unbind(-2)
        v, s, v2, s2 = _turns(measures - angle)
        first, second = a * s + b * (1 - v), c * s2 + d * (1 - v2)
        return weights * (s * (2 + 2 / 3 * v) - 8 / 3 * first + second / 3)

    def curvatures(self, measures: Tensor, rest: Tensor, weights: Tensor) -> tuple[Tensor, Tensor]:
        """The largest second derivative, which is that of the square, and what the true one lacks of it."""
        angle, a, b, c, d = rest.unbind(-2)
        v, s, v2, s2 = _turns(measures - angle)
        first, second = a * (1 - v) - b * s, c * (1 - v2) - d * s2
        lacking = weights * (-4 / 3 * v.square() - 8 / 3 * first + 2 / 3 * second)
        return 2 * weights.expand_as(measures), lacking

    def on_one_branch(self, measures: Tensor, pulls: Tensor) -> Tensor:
        """Bring angles within half a turn of their weighted mean. *Shape:* ``(..., K, M)`` each."""
        with torch.no_grad():
            mean = torch.atan2((pulls * measures.sin()).sum(-2, True), (pulls * measures.cos()).sum(-2, True))
        return mean + wrap_angle(measures - mean)


def periodic_square(difference: Tensor) -> Tensor:
    """The function of :class:`PeriodicTerm`."""
    versine = _turns(difference)[0]
    return versine * (2 + versine / 3)


def _turns(angle: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """``1 - cos``, without cancellation, and ``sin`` of an angle, and those of twice the angle."""
    half = 0.5 * angle
    s, c = half.sin(), half.cos()
    versine, sine = 2 * s * s, 2 * s * c
    return versine, sine, 2 * sine * sine, 2 * sine * (1 - versine)


def wrap_angle(angle: Tensor) -> Tensor:
    """Bring an angle into ``[-pi, pi)``, with derivative one."""
    return angle - 2 * math.pi * torch.floor(angle.detach() / (2 * math.pi) + 0.5)
