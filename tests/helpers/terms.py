"""Energy terms of a user's own."""

from __future__ import annotations

import torch
from torch import Tensor

from torch_modal.elastic.bind import Scalar, Vector, Vectors, atan2, cross, dot, real, rows, sqrt
from torch_modal.elastic.term import Mesh, PeriodicTerm, Term


class Edges(Term):
    """Lengths of edges."""

    def elements(self, mesh: Mesh) -> Tensor:
        return mesh.edges

    def measure(self, edge_vectors: Tensor) -> Tensor:
        return edge_vectors[0].norm()


class Area(Term):
    """Areas of all faces, a part of those at rest."""

    part = 1.0

    def elements(self, mesh: Mesh) -> Tensor:
        return mesh.faces

    def measure(self, edge_vectors: Tensor) -> Tensor:
        return 0.5 * torch.linalg.cross(edge_vectors[0], edge_vectors[1]).norm()

    def at_rest(self, measures: Tensor) -> Tensor:
        return self.part * measures


class Spring(Term):
    """Some vertices of the fine mesh pulled to points of the caller's coordinates."""

    sampled = True

    def __init__(self, vertices: list[int], points: Tensor, stiffness: float | Tensor = 1.0) -> None:
        super().__init__(stiffness)
        self.vertices = vertices
        self.register_buffer("points", points)

    @property
    def anchors(self) -> Tensor:
        return self.points

    def elements(self, mesh: Mesh) -> Tensor:
        places = torch.arange(len(self.vertices))
        return torch.stack([mesh.first_anchor + places, torch.tensor(self.vertices)], 1)

    def measure(self, edge_vectors: Tensor) -> Tensor:
        return edge_vectors[0].norm()

    def at_rest(self, measures: Tensor) -> Tensor:
        return torch.zeros_like(measures)


class Pull(Spring):
    """All vertices of the mesh that the energy is evaluated on, pulled to one point."""

    sampled = False

    def __init__(self, point: Tensor, stiffness: float = 1.0) -> None:
        super().__init__([], point[None], stiffness)

    def elements(self, mesh: Mesh) -> Tensor:
        vertices = torch.arange(mesh.n_vertices)
        return torch.stack([torch.full_like(vertices, mesh.first_anchor), vertices], 1)


def squared(e: Vector) -> Scalar:
    """Formulas may call others."""
    return dot(e, e)


def fibre_length(x: Vectors) -> Scalar:
    return sqrt(squared(x[0]))


def linearised_fibre(x: Vectors) -> tuple[Scalar, Vectors]:
    size = sqrt(squared(x[0]))
    return size, rows(x[0] / size)


def fibres(weighted: bool = True) -> type[Term]:
    """Lengths of edges, with weights along an axis, also for kernels."""

    class Fibres(Term):
        formula, linearised = staticmethod(fibre_length), staticmethod(linearised_fibre)

        def elements(self, mesh: Mesh) -> Tensor:
            return mesh.edges

    class Along(Fibres):
        def weights(self, edge_vectors: Tensor, measures: Tensor) -> Tensor:
            return edge_vectors[0, 1] ** 4 / measures**5

    return Along if weighted else Fibres


def edge_slope(x: Vectors) -> Scalar:
    """Angle of an edge with a plane."""
    return atan2(x[0][2], sqrt(x[0][0] * x[0][0] + x[0][1] * x[0][1]))


class Slopes(PeriodicTerm):
    """Angles of edges, which depend on the orientation."""

    formula = staticmethod(edge_slope)

    def elements(self, mesh: Mesh) -> Tensor:
        return mesh.edges


def doubled_area(x: Vectors) -> Scalar:
    normal = cross(x[0], x[1])
    return sqrt(dot(normal, normal))


def linearised_area(x: Vectors) -> tuple[Scalar, Vectors]:
    normal = cross(x[0], x[1])
    size = sqrt(dot(normal, normal))
    return size, rows(cross(x[1], normal) / size, cross(normal, x[0]) / size)


class WholeArea(Term):
    """The area of the surface, also for kernels."""

    total = True
    formula, linearised = staticmethod(doubled_area), staticmethod(linearised_area)

    def elements(self, mesh: Mesh) -> Tensor:
        return mesh.faces


class WholeSlope(PeriodicTerm):
    """The sum of the slopes of some edges, as an angle."""

    total = True
    formula = staticmethod(edge_slope)

    def elements(self, mesh: Mesh) -> Tensor:
        return mesh.edges[:3]


def mixed_product(x: Vectors) -> Scalar:
    return dot(x[0], cross(x[1], x[2])) / real(100.0)


def linearised_product(x: Vectors) -> tuple[Scalar, Vectors]:
    first, second, third = cross(x[1], x[2]), cross(x[2], x[0]), cross(x[0], x[1])
    return dot(x[0], first) / real(100.0), rows(first / real(100.0), second / real(100.0), third / real(100.0))


class Anchored(Term):
    """Tetrahedra of edges with the centre and a point, also for kernels."""

    formula, linearised = staticmethod(mixed_product), staticmethod(linearised_product)

    def __init__(self, stiffness: float | Tensor = 1.0, point: tuple[float, ...] = (0.3, 0.2, 0.1)) -> None:
        super().__init__(stiffness)
        self.register_buffer("points", torch.tensor([point], dtype=torch.float64))

    @property
    def anchors(self) -> Tensor:
        return self.points

    def elements(self, mesh: Mesh) -> Tensor:
        further = torch.tensor([mesh.centre, mesh.first_anchor]).expand(len(mesh.edges), -1)
        return torch.cat([mesh.edges, further], 1)


class WholeAnchored(Anchored):
    """The sum of these."""

    total = True
