"""Closest-point queries on a surface."""

from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from scipy import sparse
from scipy.spatial import cKDTree

from torch_modal import extras
from torch_modal.arrays import BoolArray, FloatArray, IntArray
from torch_modal.geometry.connectivity import Connectivity, vertex_areas
from torch_modal.geometry.inspect import signed_volume
from torch_modal.geometry.vectors import vertex_normals

LEAN = 0.01
"""Weight of normals relative to positions, in diagonals; distinguishes sheets closer than twice this distance."""


class Closest(NamedTuple):
    """Closest points on a surface."""

    distances: FloatArray
    """*Shape:* ``(n,)``."""
    faces: IntArray
    """Face of each point. *Shape:* ``(n,)``."""
    points: FloatArray
    """*Shape:* ``(n, 3)``."""


class MeshSurface:
    """A triangle mesh with cached derived quantities.

    Args:
        vertices: *Shape:* ``(V, 3)``.
        faces: *Shape:* ``(F, 3)``, or their connectivity.
    """

    def __init__(self, vertices: FloatArray, faces: IntArray | Connectivity) -> None:
        self.vertices = np.ascontiguousarray(vertices, dtype=np.float64)
        self.connectivity = faces if isinstance(faces, Connectivity) else Connectivity(faces, len(self.vertices))
        self.faces = self.connectivity.faces

    @cached_property
    def area_vectors(self) -> FloatArray:
        """Face normals scaled by area. *Shape:* ``(F, 3)``."""
        a, b, c = (self.vertices[corner] for corner in self.faces.T)
        return 0.5 * np.cross(b - a, c - a)

    @cached_property
    def face_areas(self) -> FloatArray:
        """*Shape:* ``(F,)``."""
        return np.linalg.norm(self.area_vectors, axis=1)

    @cached_property
    def face_normals(self) -> FloatArray:
        """Unit vectors; zero where a face has no area. *Shape:* ``(F, 3)``."""
        return unit(self.area_vectors)

    @cached_property
    def vertex_normals(self) -> FloatArray:
        """Area-weighted means of the normals of incident faces. *Shape:* ``(V, 3)``."""
        return vertex_normals(self.vertices, self.faces)

    @cached_property
    def vertex_areas(self) -> FloatArray:
        """A third of the area of incident faces. *Shape:* ``(V,)``."""
        return vertex_areas(self.vertices, self.faces)

    @property
    def edges(self) -> IntArray:
        """*Shape:* ``(E, 2)``."""
        return self.connectivity.edges

    @cached_property
    def open_sides(self) -> BoolArray:
        """Whether the edge opposite to each corner is a boundary edge. *Shape:* ``(F, 3)``."""
        is_open = (self.connectivity.counts == 1)[self.connectivity.sides].reshape(3, -1).T
        return np.roll(is_open, -1, axis=1)  # the edge opposite to a corner starts at the next one

    @cached_property
    def on_boundary(self) -> BoolArray:
        """Whether vertices are on the boundary. *Shape:* ``(V,)``."""
        found = np.zeros(len(self.vertices), dtype=bool)
        found[self.connectivity.boundary_edges] = True
        return found

    @property
    def diagonal(self) -> float:
        """Diagonal of the bounding box."""
        return float(np.linalg.norm(np.ptp(self.vertices, axis=0)))

    @property
    def area(self) -> float:
        """Total area."""
        return float(self.face_areas.sum())

    @cached_property
    def _tree(self) -> Any:
        tree = extras.require("igl", "register", "registration").AABB()
        tree.init(self.vertices, self.faces)
        return tree

    def closest(self, points: FloatArray) -> Closest:
        """The closest point on the surface to each query. *Shape:* ``(n, 3)``."""
        squared, faces, found = self._tree.squared_distance(
            self.vertices, self.faces, np.ascontiguousarray(points, dtype=np.float64)
        )
        distances = np.sqrt(np.maximum(np.asarray(squared).reshape(-1), 0))
        return Closest(distances, np.asarray(faces).reshape(-1).astype(np.int64), np.asarray(found).reshape(-1, 3))

    @cached_property
    def _sides_tree(self) -> cKDTree:
        return cKDTree(np.hstack([self.vertices, LEAN * self.diagonal * self.vertex_normals]))

    def nearest_alike(self, points: FloatArray, normals: FloatArray) -> IntArray:
        """The nearest vertex in position and normal, which distinguishes touching sheets.

        *Shape:* ``(n, 3), (n, 3) -> (n,)``.
        """
        return self._sides_tree.query(np.hstack([points, LEAN * self.diagonal * normals]))[1].astype(np.int64)

    def looks_away(self, points: FloatArray, normals: FloatArray) -> BoolArray:
        """Whether normals oppose those of the closest point and of the nearest sheet with a similar normal.

        *Shape:* ``(n, 3), (n, 3) -> (n,)``.
        """
        away = np.einsum("ni,ni->n", normals, self.face_normals[self.closest(points).faces]) < 0
        some = np.flatnonzero(away)
        there = self.vertex_normals[self.nearest_alike(points[some], normals[some])]
        away[some] = np.einsum("ni,ni->n", normals[some], there) < 0
        return away

    def barycentric(self, closest: Closest) -> FloatArray:
        """Non-negative barycentric coordinates of closest points. *Shape:* ``(n, 3)``."""
        a, b, c = (self.vertices[self.faces[closest.faces, corner]] for corner in range(3))
        normal = np.cross(b - a, c - a)
        squared = np.einsum("ni,ni->n", normal, normal)
        p = closest.points
        weights = np.stack(
            [
                np.einsum("ni,ni->n", np.cross(c - b, p - b), normal),
                np.einsum("ni,ni->n", np.cross(a - c, p - c), normal),
            ]
        )
        weights = weights / np.where(squared > 0, squared, 1)
        weights = np.concatenate([weights, 1 - weights.sum(0, keepdims=True)]).T
        weights[squared <= 0] = 1 / 3
        weights = np.clip(weights, 0, 1)
        return weights / weights.sum(1, keepdims=True)

    def rows(self, closest: Closest) -> sparse.csr_matrix:
        """Interpolation matrix from vertices to closest points. *Shape:* ``(n, V)``."""
        n = len(closest.faces)
        where = (np.repeat(np.arange(n), 3), self.faces[closest.faces].reshape(-1))
        return sparse.csr_matrix((self.barycentric(closest).reshape(-1), where), shape=(n, len(self.vertices)))

    def moved(self, vertices: FloatArray) -> "MeshSurface":
        """The same connectivity with other positions."""
        return MeshSurface(vertices, self.connectivity)


def unit(vectors: FloatArray) -> FloatArray:
    """Unit vectors; zero for zero. *Shape:* ``(n, 3)``."""
    length = np.linalg.norm(vectors, axis=1, keepdims=True)
    return vectors / np.where(length > 0, length, 1)


def outward(vertices: FloatArray, faces: IntArray) -> IntArray:
    """Faces with outward winding if the surface is closed, otherwise unchanged. *Shape:* ``(F, 3)``."""
    closed = not len(Connectivity(faces).boundary_edges)
    centred = vertices - vertices[faces].mean((0, 1))
    return faces[:, ::-1].copy() if closed and signed_volume(centred, faces) < 0 else faces


def referenced(vertices: FloatArray, faces: IntArray) -> tuple[MeshSurface, IntArray]:
    """Remove unreferenced vertices; returns the indices of the others, too. *Shape of the second:* ``(V',)``."""
    used, renumbered = np.unique(faces, return_inverse=True)
    return MeshSurface(vertices[used], renumbered.reshape(-1, 3)), used


def without_dust(surface: MeshSurface, share: float = 0.01) -> MeshSurface:
    """The connected pieces with a minimum share of the area; at least the largest."""
    pieces = surface.connectivity.vertex_pieces
    if pieces.max() == 0:
        return surface
    of_faces = pieces[surface.faces[:, 0]]
    areas = np.bincount(of_faces, surface.face_areas, minlength=pieces.max() + 1)
    return referenced(surface.vertices, surface.faces[areas[of_faces] >= min(share * surface.area, areas.max())])[0]


def sewn(surface: MeshSurface, reach: float) -> MeshSurface:
    """Join the boundaries of adjacent pieces by strips of triangles, to close cuts.

    Args:
        surface: A surface of several pieces.
        reach: Widest closed gap, in diagonals.
    """
    mesh = surface.connectivity
    pieces = mesh.vertex_pieces
    open_sides = np.flatnonzero((mesh.counts == 1)[mesh.sides])
    if pieces.max() == 0 or not len(open_sides):
        return surface
    start, end = mesh.start[open_sides], mesh.end[open_sides]
    strips = []
    for piece in np.unique(pieces[start]):
        own = pieces[start] == piece
        others = np.unique(start[~own])
        if not len(others):
            break
        middle = 0.5 * (surface.vertices[start[own]] + surface.vertices[end[own]])
        distances, found = cKDTree(surface.vertices[others]).query(middle)
        near = distances < reach * surface.diagonal
        strips.append(np.column_stack([end[own], start[own], others[found]])[near])
    return MeshSurface(surface.vertices, np.concatenate([surface.faces, *strips]))


def largest_piece(surface: MeshSurface) -> MeshSurface:
    """The connected piece with the largest area."""
    pieces = surface.connectivity.vertex_pieces
    if pieces.max() == 0:
        return surface
    of_faces = pieces[surface.faces[:, 0]]
    kept = of_faces == np.bincount(of_faces, surface.face_areas).argmax()
    return referenced(surface.vertices, surface.faces[kept])[0]
