"""An energy of several terms on one mesh: values, gradients, and products with a convex Hessian.

Components come first, ``(3, ..., V)``. Shapes are *extended* by further vertices that elements may have: the centre of
the mesh, and the anchors of the terms.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from torch_modal.autograd import outside_inference_mode
from torch_modal.elastic.term import Mesh, Term
from torch_modal.geometry.vectors import pick


def energy_rounding(dtype: torch.dtype) -> float:
    """Relative difference of energies that is rounding."""
    return 64.0 * torch.finfo(dtype).eps


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
    weight. *Shape of each:* ``(..., R, M)``; for kernels ``(B, M, R)``."""
    constant: Tensor
    """The energy that remains, whatever the shape. *Shape:* ``(...)``."""

    def transpose(self) -> "Reference":
        """Records in the layout of kernels from the layout of torch, or the other way round."""
        return Reference(tuple(record.mT.contiguous() for record in self.records), self.constant)


class Linearised(NamedTuple):
    """One term at given shapes."""

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


def _outlasting_buffers(module: nn.Module) -> None:
    """Replace buffers that are inference tensors: terms may have been made in inference mode."""
    for child in module.modules():
        for name, buffer in child.named_buffers(recurse=False):
            if buffer.is_inference():
                setattr(child, name, outside_inference_mode(buffer.clone)())


class AssembledTerm(nn.Module):
    """A term on a mesh.

    Args:
        term: The term. It is not registered here: a term serves several meshes and is owned by the layer.
        elements: Numbers of the vertices of each element. *Shape:* ``(M, n)``.
    """

    term: Term
    corners: Tensor

    def __init__(self, term: Term, elements: Tensor) -> None:
        super().__init__()
        self.__dict__["term"] = term
        self.register_buffer("corners", elements.T.contiguous(), persistent=False)

    def edge_vectors(self, rows: Tensor) -> Tensor:
        """Vectors from the first vertex of each element to the others. *Shape:* ``(3, ..., V) -> (n-1, 3, ..., M)``."""
        first, *others = (pick(rows, corner) for corner in self.corners)
        return torch.stack([other - first for other in others])

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

    def on_elements(self, weights: Tensor) -> Tensor:
        """Weights of vertices on the elements: means of their corners. *Shape:* ``(..., V) -> (..., M or 1)``."""
        return weights.mean(-1, keepdim=True) if self.term.total else weights[..., self.corners].mean(-2)

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

    parts: Any
    used: Tensor
    vertices: Tensor

    def __init__(self, mesh: Mesh, terms: Sequence[Term], sampled: bool = False) -> None:
        super().__init__()
        n, elements = mesh.n_vertices, []
        n_anchors = [0 if term.anchors is None else len(term.anchors) for term in terms]
        for term, more in zip(terms, n_anchors, strict=True):
            _outlasting_buffers(term)
            corners, last = term.elements(mesh), n + more
            if corners.dim() != 2 or corners.shape[1] < 2 or corners.is_floating_point():
                raise ValueError(
                    f"{type(term).__name__}.elements gave {tuple(corners.shape)} of {corners.dtype}; they are rows of "
                    "two vertex indices or more, (M, n)"
                )
            lowest, highest = (int(corners.min()), int(corners.max())) if corners.numel() else (0, last)
            if not 0 <= lowest <= highest <= last:
                raise ValueError(
                    f"{type(term).__name__}.elements gave vertices from {lowest} to {highest}; they are 0 to {last}: "
                    "vertices of the mesh, its centre, and the anchors of the term"
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
        self.parts = nn.ModuleList(parts)
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
        """The vertices, their centre and the anchors.

        Args:
            rows: *Shape:* ``(3, ..., V)``.
            anchors: Zeros where None, for displacements. *Shape:* ``(3, ..., P)``.
        """
        centre = pick(rows, self.used).mean(-1, keepdim=True)
        n_anchors = self.n_extended - self.n_vertices - 1
        if not n_anchors:
            return torch.cat([rows, centre], -1)
        fixed = rows.new_zeros(*rows.shape[:-1], n_anchors) if anchors is None else anchors
        return torch.cat([rows, centre, fixed.expand(*rows.shape[:-1], n_anchors)], -1)

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

    def rest_of(self, x: Tensor) -> Rest:
        """The rest shape from vertices alone. *Shape:* ``(B, V, 3)``."""
        return self.rest(self.extend(x.movedim(-1, 0).contiguous()))

    def merge_rests(self, rest: Rest, weights: Tensor, stiffness: Sequence[float | Tensor]) -> Reference:
        r"""K rest shapes as one: :math:`\sum_k s_k \sum w_k (q - q_k)^2`, by Eq. 8 for any number of them.

        Args:
            rest: Of the rest shapes. *Shape of each:* ``(..., K, M)``.
            weights: ``s``. *Shape:* ``(..., K)``.
            stiffness: Of each term: a number, or *shape* ``(..., M)`` or ``(..., 1)``.
        """
        records, constant = [], torch.zeros_like(weights[..., 0])
        for summand, measures, own, factor in zip(self.parts, *rest, stiffness, strict=True):
            record, left = summand.term.merge_rests(measures, weights[..., None] * own.expand_as(measures), factor)
            records.append(record)
            constant = constant + left.sum(-1)
        return Reference(tuple(records), constant)

    def mix_rests(self, rest: Rest, weights: Tensor) -> Rest:
        """One rest shape whose measures are weighted sums of the measures of K shapes.

        Where weights differ from vertex to vertex, or are far below zero, :meth:`merge_rests` asks for harmonic means.

        Args:
            rest: Of K shapes.
            weights: They add up to one. *Shape:* ``(K, V)``.
        """
        measures, stiffness = [], []
        for summand, values, rest_weights in zip(self.parts, rest.measures, rest.weights, strict=True):
            element_weights, rest_weights = summand.on_elements(weights), rest_weights.expand_as(values)
            measures.append((element_weights * summand.term.on_one_branch(values, rest_weights)).sum(-2))
            stiffness.append((element_weights * rest_weights).sum(-2).clamp_min(0))
        return Rest(tuple(measures), tuple(stiffness))

    def reference_of(self, rest: Rest, stiffness: Sequence[float | Tensor]) -> Reference:
        """One rest shape as the reference."""
        alone = Rest(*(tuple(values.unsqueeze(-2) for values in each) for each in rest))
        return self.merge_rests(alone, torch.ones_like(rest.measures[0][..., :1]), stiffness)

    # --------------------------------------------------------------------------------------------------------- values
    def value(self, extended: Tensor, reference: Reference) -> Tensor:
        """The energy of shapes. *Shape:* ``(3, ..., V) -> (...)``."""
        total: Any = reference.constant
        for summand, record in zip(self.parts, reference.records, strict=True):
            total = total + summand.term.energies(summand.measures(summand.edge_vectors(extended)), record).sum(-1)
        return total

    # ---------------------------------------------------------------------------------------------------- derivatives
    def linearise(self, extended: Tensor, reference: Reference) -> list[Linearised]:
        """All terms at given shapes. *Shape:* ``(3, B, V)``, extended."""
        each = []
        for summand, record in zip(self.parts, reference.records, strict=True):
            edge_vectors = summand.edge_vectors(extended)
            measures, gradients = summand.term.measures_and_gradients(edge_vectors)
            if summand.term.total:
                measures = measures.sum(-1, keepdim=True)
                gradients = summand.scatter_vectors(torch.zeros_like(extended), gradients)
            slope, curvatures = summand.term.slopes(measures, record), summand.term.curvatures(measures, record)
            each.append(Linearised(edge_vectors, measures, gradients, slope, *curvatures))
        return each

    def value_at(self, at: Sequence[Linearised], reference: Reference) -> Tensor:
        """The energy of linearised shapes. *Shape:* ``(B,)``."""
        total: Any = reference.constant
        for summand, one, record in zip(self.parts, at, reference.records, strict=True):
            total = total + summand.term.energies(one.measures, record).sum(-1)
        return total

    def rates(self, at: Sequence[Linearised], field: Tensor) -> list[Tensor]:
        """First change of the measures with a displacement. *Shape:* ``(3, B, V)``, extended; ``(B, M)`` of each."""
        return [
            (one.gradients * field).sum((0, -1))[:, None]
            if summand.term.total
            else (one.gradients * summand.edge_vectors(field)).sum((0, 1))
            for summand, one in zip(self.parts, at, strict=True)
        ]

    def scatter(self, at: Sequence[Linearised], on_elements: Sequence[Tensor]) -> Tensor:
        """From the elements to the vertices.

        Args:
            at: Gives the gradients of totals.
            on_elements: Of each term what its edge vectors receive, *shape* ``(n-1, 3, B, M)``; of a total, the factor
                of its gradient, *shape* ``(B, 1)``.

        Returns:
            *Shape:* ``(3, B, V)``, extended.
        """
        out = on_elements[0].new_zeros(*at[0].gradients.shape[-3:-1], self.n_extended)
        for summand, one, received in zip(self.parts, at, on_elements, strict=True):
            out = out + received * one.gradients if summand.term.total else summand.scatter_vectors(out, received)
        return out

    def gradient(self, at: Sequence[Linearised]) -> Tensor:
        """Gradient of the energy. *Shape:* ``(3, B, V)``, extended."""
        pairs = zip(self.parts, at, strict=True)
        slopes = [one.slope if summand.term.total else one.slope * one.gradients for summand, one in pairs]
        return self.scatter(at, slopes)


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

    def rows(self, some: slice | Tensor) -> "RestShapes":
        """Rest shapes of some of the samples."""
        anchors = None if self.anchors is None else self.anchors[some]
        return RestShapes(self.shapes[some], self.weights[some], [each[some] for each in self.stiffness], anchors)

    def reference(self, energy: Energy, start: Tensor | None = None, relative: bool = False) -> Reference:
        """Merge the rest shapes into one reference of an energy, of the terms that the stiffnesses belong to.

        Args:
            energy: The energy.
            start: Where a minimisation starts, for :meth:`torch_modal.elastic.term.Term.softening`. *Shape:* ``(B, V,
                3)``.
            relative: Elements keep as much of their stiffness as the rest shapes have of it.
        """
        rows, begin = energy.extend(self.shapes.movedim(-1, 0)), None
        if start is not None:
            begin = energy.extend(start.movedim(-1, 0))
        pairs = zip(energy.parts, self.stiffness, strict=True)
        merged = [summand.merge_rests(rows, self.weights, own, begin, relative) for summand, own in pairs]
        records, left = zip(*merged, strict=True)
        return Reference(records, sum((own.sum(-1) for own in left), start=torch.zeros_like(self.weights[:, 0])))
