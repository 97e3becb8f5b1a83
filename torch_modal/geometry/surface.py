"""Positions of a triangle mesh, with the areas and normals of its faces and vertices."""

from functools import cached_property

import numpy as np

from torch_modal.arrays import FloatArray, IntArray
from torch_modal.geometry.connectivity import Connectivity, vertex_areas
from torch_modal.geometry.inspect import volume_of
from torch_modal.geometry.vectors import vertex_normals


class Surface:
    """A triangle mesh whose areas and normals are computed once, when first needed.

    *Shape:* ``(V, 3)``, and ``(F, 3)`` or a connectivity.
    """

    def __init__(self, vertices: FloatArray, faces: IntArray | Connectivity) -> None:
        self.vertices = np.ascontiguousarray(vertices, dtype=np.float64)
        self.connectivity = faces if isinstance(faces, Connectivity) else Connectivity(faces, len(self.vertices))
        self.faces, self.edges = self.connectivity.faces, self.connectivity.edges

    @cached_property
    def face_centres(self) -> FloatArray:
        """Means of the corners of the faces. *Shape:* ``(F, 3)``."""
        return self.vertices[self.faces].mean(axis=1)

    @cached_property
    def area_vectors(self) -> FloatArray:
        """Normals of the faces times their areas. *Shape:* ``(F, 3)``."""
        a, b, c = self.vertices[self.faces.T]
        return 0.5 * np.cross(b - a, c - a)

    @cached_property
    def face_areas(self) -> FloatArray:
        """*Shape:* ``(F,)``."""
        return np.linalg.norm(self.area_vectors, axis=1)

    @cached_property
    def face_normals(self) -> FloatArray:
        """Unit vectors; zero where a face has no area. *Shape:* ``(F, 3)``."""
        return self.area_vectors / np.where(self.face_areas > 0, self.face_areas, 1)[:, None]

    @cached_property
    def vertex_normals(self) -> FloatArray:
        """Area-weighted means of the normals of incident faces. *Shape:* ``(V, 3)``."""
        return vertex_normals(self.vertices, self.faces)

    @cached_property
    def vertex_areas(self) -> FloatArray:
        """A third of the area of incident faces. *Shape:* ``(V,)``."""
        return vertex_areas(self.vertices, self.faces)

    @property
    def area(self) -> float:
        """Total area."""
        return float(self.face_areas.sum())

    @property
    def thickness(self) -> float:
        """Mean thickness of the body: twice the volume over the area."""
        return 2 * abs(volume_of(self.vertices, self.faces)) / self.area

    @property
    def diagonal(self) -> float:
        """Diagonal of the bounding box."""
        return float(np.linalg.norm(np.ptp(self.vertices, axis=0)))
