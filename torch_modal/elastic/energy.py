"""An energy of several terms on one mesh: values, gradients, and products with a convex Hessian.

Components come first, ``(3, ..., V)``. Shapes are *extended* by further vertices that elements may have: the centre of
the mesh, and the anchors of the terms.
"""

from collections.abc import Iterable, Sequence
from functools import cached_property, reduce
from typing import NamedTuple

import torch
from torch import Tensor, nn

from torch_modal.elastic.term import Mesh, Term
from torch_modal.geometry.vectors import pick

# Rows and columns of the upper triangle of a symmetric block.
_ROWS, _COLUMNS = [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]

# Relative difference of energies that is rounding, in units of the dtype.
ENERGY_ROUNDING = 64.0


class Rest(NamedTuple):
    """Measures of a rest shape and their weights, term by term."""

    measures: tuple[Tensor, ...]
    """*Shape of each:* ``(..., M)``."""
    weights: tuple[Tensor, ...]
    """Without the stiffness. *Shape of each:* ``(..., M)``."""


class Reference(NamedTuple):
    """K rest shapes of each sample as one: what the terms compare their measures with."""

    records: tuple[Tensor, ...]
    """Record of each term (:meth:`torch_modal.elastic.term.Term.merge_rests`), with the stiffness; its first row is the
    weight. *Shape of each:* ``(..., R, M)``."""
    constant: Tensor
    """The energy that remains, whatever the shape. *Shape:* ``(...)``."""


class Linearised(NamedTuple):
    """One term at given shapes."""

    energy: Tensor
    """But for what remains at the reference. *Shape:* ``(B,)``."""
    edge_vectors: Tensor
    """*Shape:* ``(n-1, 3, B, M)``."""
    measures: Tensor
    """*Shape:* ``(B, M)``; M is 1 of a total, here and below."""
    gradients: Tensor
    """Gradients in the edge vectors, *shape* ``(n-1, 3, B, M)``; of a total, in the vertices, *shape* ``(3, B, V)``."""
    slope: Tensor
    """First derivative of the energy in each measure. *Shape:* ``(B, M)``."""
    curvature: Tensor
    """Second derivative, or a bound that is never negative. *Shape:* ``(B, M)``."""
    beyond: Tensor | None
    """The second derivative beyond that, if any. *Shape:* ``(B, M)``."""


def edge_vectors_of(rows: Tensor, corners: Tensor) -> Tensor:
    """Vectors from the first vertex of each element to others. *Shape:* ``(3, ..., V), (n, M) -> (n-1, 3, ..., M)``."""
    first, *others = (pick(rows, corner) for corner in corners)
    return torch.stack([other - first for other in others])


class AssembledTerm(nn.Module):
    """A term on a mesh, from the vertices of each element. *Shape:* ``(M, n)``.

    The term is not registered here: it may be on several meshes, and belongs to the layer.
    """

    term: Term
    corners: Tensor

    def __init__(self, term: Term, elements: Tensor) -> None:
        super().__init__()
        self.__dict__["term"] = term
        self.register_buffer("corners", elements.T.contiguous(), persistent=False)

    def edge_vectors(self, rows: Tensor) -> Tensor:
        """Vectors from the first vertex of each element to the others. *Shape:* ``(3, ..., V) -> (n-1, 3, ..., M)``."""
        return edge_vectors_of(rows, self.corners)

    def measures(self, edge_vectors: Tensor) -> Tensor:
        """The measures, or their sum for a total. *Shape:* ``(n-1, 3, ..., M) -> (..., M or 1)``."""
        measures = self.term.measures(edge_vectors)
        return measures.sum(-1, keepdim=True) if self.term.total else measures

    def merge_rests(
        self,
        rows: Tensor,
        weights: Tensor,
        stiffness: float | Tensor,
        start: Tensor | None = None,
        relative: bool = False,
    ) -> tuple[Tensor, Tensor]:
        """The record of K rest shapes and the energy that remains. *Shape:* ``(3, B, K, V) -> (B, R, M), (B, M)``."""
        edge_vectors = self.edge_vectors(rows)
        measures = self.measures(edge_vectors)
        if start is not None:
            factor = self.term.softening(self.edge_vectors(start), edge_vectors, weights if relative else None)
            stiffness = stiffness if factor is None else factor * stiffness
        rest_weights = weights[..., None] * self.term.weights(edge_vectors, measures).expand_as(measures)
        return self.term.merge_rests(self.term.at_rest(measures), rest_weights, stiffness)

    def linearise(self, extended: Tensor, record: Tensor, by_torch: bool = False) -> "Linearised":
        """The term at given shapes; by :meth:`Term.jacobian` if wanted. *Shape:* ``(3, B, V)``, extended."""
        edge_vectors = self.edge_vectors(extended)
        measures, gradients = (self.term.jacobian if by_torch else self.term.linearise)(edge_vectors)
        if self.term.total:
            measures = measures.sum(-1, keepdim=True)
            gradients = self.scatter_vectors(torch.zeros_like(extended), gradients)
        energy = self.term.energies(measures, record).sum(-1)
        return Linearised(energy, edge_vectors, measures, gradients, *self.term.derivatives(measures, record))

    def along(self, one: "Linearised", field: Tensor) -> tuple[Tensor, Tensor]:
        """Edge vectors of a displacement ``(3, B, V)``, for a total itself, and the first change of the measures."""
        if self.term.total:
            return field, (one.gradients * field).sum((0, -1))[:, None]
        vectors = self.edge_vectors(field)
        return vectors, (one.gradients * vectors).sum((0, 1))

    def on_corners(self, on_edge_vectors: Tensor) -> list[Tensor]:
        """From the edge vectors to each vertex of the elements. *Shape:* ``(n-1, 3, ..., M)``; ``(3, ..., M)`` each."""
        return [-on_edge_vectors.sum(0), *on_edge_vectors]

    def scatter_vectors(self, out: Tensor, on_edge_vectors: Tensor) -> Tensor:
        """Values of the vertices, and what the edge vectors give to them. *Shape:* ``(3, ..., V)``."""
        for corner, value in zip(self.corners, self.on_corners(on_edge_vectors), strict=True):
            out = out.index_add(-1, corner, value)
        return out


class Energy(nn.Module):
    """The sum of terms on one mesh.

    Args:
        mesh: The mesh.
        terms: The terms.
        sampled: Whether shapes consist of the :attr:`vertices` that elements have, and of no others. Terms then have
            no centre.
    """

    parts: Sequence[AssembledTerm]
    used: Tensor
    vertices: Tensor

    def __init__(self, mesh: Mesh, terms: Sequence[Term], sampled: bool = False) -> None:
        super().__init__()
        n, elements = mesh.n_vertices, []
        #: Number of anchors of each term.
        self.n_anchors = n_anchors = [0 if term.anchors is None else len(term.anchors) for term in terms]
        for term, more in zip(terms, n_anchors, strict=True):
            corners, last = term.elements(mesh), n + more
            lowest, highest = (float(corners.min()), float(corners.max())) if corners.numel() else (0, last)
            rows = corners.dim() == 2 and corners.shape[1] >= 2 and not corners.is_floating_point()
            if not (rows and 0 <= lowest <= highest <= last):
                raise ValueError(
                    f"{type(term).__name__}.elements are rows of two vertex indices or more, (M, n), from 0 to {last}: "
                    "vertices of the mesh, its centre, and the anchors of the term; got "
                    f"{tuple(corners.shape)} of {corners.dtype}, from {lowest:g} to {highest:g}"
                )
            elements.append(corners)
        vertices = torch.arange(n)
        if sampled:
            vertices = torch.cat([corners.flatten() for corners in elements]).unique()
            vertices = vertices[vertices < n]
        self.n_vertices = len(vertices)
        # Indices of the mesh's vertices and its centre in the extended shape; the anchors of the terms follow in order.
        numbers = torch.full((n + 1,), -1).index_copy(0, vertices, torch.arange(self.n_vertices))
        numbers[n] = -1 if sampled else n
        parts, self.n_extended = [], self.n_vertices + 1
        for term, corners, more in zip(terms, elements, n_anchors, strict=True):
            anchors = torch.arange(self.n_extended, self.n_extended + more)
            parts.append(AssembledTerm(term, torch.cat([numbers, anchors])[corners]))
            self.n_extended += more
        self.parts = nn.ModuleList(parts)  # type: ignore[assignment]
        self.sampled = sampled
        self.register_buffer("vertices", vertices, persistent=False)
        used = torch.arange(self.n_vertices) if sampled else torch.tensor(mesh.connectivity.used)
        self.register_buffer("used", used, persistent=False)

    @property
    def anchors(self) -> Tensor | None:
        """Anchors of all terms, in the caller's coordinates; None where there are none. *Shape:* ``(P, 3)``."""
        points = [summand.term.anchors for summand in self.parts if summand.term.anchors is not None]
        return torch.cat(points) if points else None

    # ------------------------------------------------------------------------------------------------------- vertices
    def extend(self, rows: Tensor, anchors: Tensor | None = None) -> Tensor:
        """The vertices ``(3, ..., V)``, their centre and the anchors ``(3, ..., P)``: by default zeros, as if moved."""
        centre = pick(rows, self.used).mean(-1, keepdim=True)
        shape = *rows.shape[:-1], self.n_extended - self.n_vertices - 1
        return torch.cat([rows, centre, rows.new_zeros(shape) if anchors is None else anchors.expand(shape)], -1)

    def fold(self, extended: Tensor) -> Tensor:
        """The adjoint of :meth:`extend`: distributes the centre's value to the vertices. *Shape:* ``(3, ..., V)``."""
        share = extended[..., self.n_vertices, None] / len(self.used)
        values = extended[..., : self.n_vertices].contiguous()
        return values.index_add(-1, self.used, share.expand(*share.shape[:-1], len(self.used)).contiguous())

    # ---------------------------------------------------------------------------------------------------- references
    def rest(self, extended: Tensor) -> Rest:
        """Measures and weights of rest shapes. *Shape:* ``(3, ..., V)``, extended."""
        measures, weights = [], []
        for summand in self.parts:
            edge_vectors = summand.edge_vectors(extended)
            values = summand.measures(edge_vectors)
            measures.append(summand.term.at_rest(values))
            weights.append(summand.term.weights(edge_vectors, values))
        return Rest(tuple(measures), tuple(weights))

    def reference_of(self, rest: Rest, stiffness: Sequence[float | Tensor]) -> Reference:
        """One rest shape as the reference, with the stiffness of each term: ``(..., M)``, ``(..., 1)`` or a number."""
        merged = [
            summand.term.merge_rests(measures[..., None, :], weights.expand_as(measures)[..., None, :], factor)
            for summand, measures, weights, factor in zip(self.parts, *rest, stiffness, strict=True)
        ]
        return join_references(merged)

    # --------------------------------------------------------------------------------------------------------- values
    def value(self, extended: Tensor, reference: Reference) -> Tensor:
        """The energy of shapes. *Shape:* ``(3, ..., V) -> (...)``."""
        total = reference.constant
        for summand, record in zip(self.parts, reference.records, strict=True):
            total = total + summand.term.energies(summand.measures(summand.edge_vectors(extended)), record).sum(-1)
        return total


def join_references(merged: Sequence[tuple[Tensor, Tensor]]) -> Reference:
    """The reference of several terms, from the record and the remaining energies of each."""
    records, left = zip(*merged, strict=True)
    return Reference(records, reduce(torch.add, (energies.sum(-1) for energies in left)))


class EnergyAt:
    """An energy at given shapes: value, gradient, and products with a convex Hessian. *Shape:* ``(3, B, V)``, extended.

    The Hessian is Gauss-Newton's and the second-order term of stretched edges: it is never negative.
    """

    def __init__(self, energy: Energy, extended: Tensor, reference: Reference) -> None:
        self.energy = energy
        pairs = zip(energy.parts, reference.records, strict=True)
        #: Each term there.
        self.terms: list[Linearised] = [summand.linearise(extended, record) for summand, record in pairs]
        #: The energy. *Shape:* ``(B,)``.
        self.value = reduce(torch.add, (one.energy for one in self.terms), reference.constant)

    @cached_property
    def tensions(self) -> list[Tensor | None]:
        """Stiffness across each element of two vertices; along it, there is the curvature. *Shape:* ``(B, M)``."""
        return [
            summand.term.tension(one.edge_vectors, one.slope, one.curvature)
            for summand, one in zip(self.energy.parts, self.terms, strict=True)
        ]

    def _scatter(self, values: Iterable[Tensor]) -> Tensor:
        """Values of edge vectors, of totals in the vertices, at the vertices. *Shape:* ``(3, B, V)``, extended."""
        out = self.value.new_zeros(3, len(self.value), self.energy.n_extended)
        for summand, value in zip(self.energy.parts, values, strict=True):
            out = out + value if summand.term.total else summand.scatter_vectors(out, value)
        return out

    def gradient(self) -> Tensor:
        """Gradient of the energy. *Shape:* ``(3, B, V)``, extended."""
        return self._scatter(one.slope * one.gradients for one in self.terms)

    def product(self, field: Tensor) -> Tensor:
        """The convex Hessian times displacements. *Shape:* ``(3, B, V)``, extended."""
        values = []
        for summand, one, tension in zip(self.energy.parts, self.terms, self.tensions, strict=True):
            vectors, rate = summand.along(one, field)
            value = one.curvature * rate * one.gradients
            values.append(value if tension is None else value + tension * (vectors - rate * one.gradients))
        return self._scatter(values)

    def diagonal(self) -> Tensor:
        """The convex Hessian's blocks of all vertices, the upper triangle of each. *Shape:* ``(6, B, V)``, extended."""
        like = self.terms[0].gradients
        summed = like.new_zeros(6, like.shape[-2], self.energy.n_extended)
        for summand, one, tension in zip(self.energy.parts, self.terms, self.tensions, strict=True):
            if summand.term.total:
                continue  # of rank one: it couples all vertices, and adds little to each
            along = one.curvature if tension is None else one.curvature - tension
            for corner, end in zip(summand.corners, summand.on_corners(one.gradients), strict=True):
                blocks = (along * end)[_ROWS] * end[_COLUMNS]
                if tension is not None:
                    eye = torch.eye(3, dtype=end.dtype, device=end.device)[_ROWS, _COLUMNS]
                    blocks = blocks + eye[:, None, None] * tension
                summed = summed.index_add(-1, corner, blocks)
        return summed


class RestShapes(NamedTuple):
    """K rest shapes of each sample with their weights, and the stiffnesses of the terms."""

    shapes: Tensor
    """*Shape:* ``(B, K, V, 3)``."""
    weights: Tensor
    """*Shape:* ``(B, K)``."""
    stiffness: Sequence[Tensor]
    """One of each term. *Shape of each:* ``(B, M)`` or ``(B, 1)``."""
    anchors: Tensor | None = None
    """Fixed points of the terms, where they have some. *Shape:* ``(B, P, 3)``."""

    def of_terms(self, energy: Energy, numbers: Sequence[int]) -> "RestShapes":
        """Stiffnesses and anchors of some terms of an energy, by their numbers."""
        anchors = self.anchors
        if anchors is not None:
            each = anchors.split(energy.n_anchors, 1)
            anchors = torch.cat([each[i] for i in numbers], 1)
        return self._replace(stiffness=[self.stiffness[i] for i in numbers], anchors=anchors)

    def reference(self, energy: Energy, start: Tensor | None = None, relative: bool = False) -> Reference:
        """Merge the rest shapes into one reference of an energy, of the terms that the stiffnesses belong to.

        Elements are softened by :meth:`torch_modal.elastic.term.Term.softening` where a minimisation starts, ``(B, V,
        3)``; relative to the rest shapes if wanted.
        """
        rows = energy.extend(self.shapes.movedim(-1, 0))
        begin = None if start is None else energy.extend(start.movedim(-1, 0))
        pairs = zip(energy.parts, self.stiffness, strict=True)
        merged = [summand.merge_rests(rows, self.weights, stiffness, begin, relative) for summand, stiffness in pairs]
        return join_references(merged)
