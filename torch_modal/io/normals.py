"""Normals of a file, rotated with the surface."""

import numpy as np

from torch_modal.arrays import FloatArray, IntArray
from torch_modal.geometry.normals import vertex_normals
from torch_modal.geometry.turning import surface_frames, turn


class CarriedNormals:
    """Rotates a file's normals with the surface, so that hard edges stay hard and smooth ones smooth.

    Points with one place and one normal are one: seams of texture coordinates do not show in the shading.

    Args:
        normals: As the file has them. *Shape:* ``(P, 3)``.
        positions: Of the same points, as the file has them. *Shape:* ``(P, 3)``.
        triangles: Of points. *Shape:* ``(F, 3)``.
    """

    def __init__(self, normals: FloatArray, positions: FloatArray, triangles: IntArray) -> None:
        self.normals = normals
        rows = np.concatenate([positions, normals], axis=1)
        _, self.first, group = np.unique(rows, axis=0, return_index=True, return_inverse=True)
        self.group = group.reshape(-1)
        self.triangles = self.group[triangles]
        # The other end of an edge of each point: with the normal it defines a frame of the surface.
        self.neighbour = np.arange(len(self.first))
        for corner in (2, 1, 0):
            self.neighbour[self.triangles[:, corner]] = self.triangles[:, (corner + 1) % 3]
        self.before = self._surface(positions)

    def _surface(self, positions: FloatArray) -> FloatArray:
        """Frames of the surface at each point. *Shape:* ``(P, 3, 3)``."""
        x = positions[self.first]
        return surface_frames(vertex_normals(x, self.triangles), x[self.neighbour] - x)[self.group]

    def at(self, positions: FloatArray) -> FloatArray:
        """The normals of the surface with other positions; bit for bit those of the file where it has not moved.

        Args:
            positions: *Shape:* ``(P, 3)``.
        """
        return turn(self.normals, self.before, self._surface(positions))
