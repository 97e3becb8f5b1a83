"""Normals of a file, rotated with the surface."""

from collections.abc import Sequence

import numpy as np

from torch_modal.arrays import FloatArray, IntArray
from torch_modal.geometry.vectors import vertex_normals


class CarriedNormals:
    """Rotates a file's normals with the surface, so that hard edges stay hard and smooth ones smooth.

    Points with one place and one normal are one: seams of texture coordinates do not show in the shading. All are as
    the file has them. *Shape:* ``(P, 3), (P, 3), (F, 3)``.
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
        self.before = self._frames(positions)

    def _frames(self, positions: FloatArray) -> FloatArray:
        """Right-handed frames at each point: the normal, the edge made perpendicular to it. *Shape:* ``(P, 3, 3)``."""
        x = positions[self.first]
        normals, sides = vertex_normals(x, self.triangles), x[self.neighbour] - x
        along = sides - np.einsum("ij,ij->i", sides, normals)[:, None] * normals
        length = np.linalg.norm(along, axis=1, keepdims=True)
        usable = length > 1e-9 * np.maximum(np.linalg.norm(sides, axis=1, keepdims=True), np.finfo(np.float64).tiny)
        other = np.cross(normals, np.eye(3)[np.abs(normals).argmin(axis=1)])
        other /= np.maximum(np.linalg.norm(other, axis=1, keepdims=True), 1e-12)
        second = np.where(usable, along / np.where(usable, length, 1.0), other)
        return np.stack([normals, second, np.cross(normals, second)], axis=2)[self.group]

    def at(self, positions: FloatArray) -> FloatArray:
        """The normals of the surface with other positions; bit for bit those of the file where it has not moved."""
        after = self._frames(positions)
        turned = np.einsum("nij,nkj,nk->ni", after, self.before, self.normals)
        return np.where((self.before == after).all(axis=(1, 2))[:, None], self.normals, turned)


def carry_together(
    parts: Sequence[tuple[FloatArray | None, FloatArray, IntArray]], frames: Sequence[FloatArray]
) -> list[FloatArray | None]:
    """Normals of several parts of a surface in each frame, None for those without; where parts meet, they stay equal.

    Parts are arguments of :class:`CarriedNormals`. *Shape of each in the frames, and of the results:* ``(N, P, 3)``.
    """
    found: list[FloatArray | None] = [None] * len(parts)
    own = [k for k, (normals, _, _) in enumerate(parts) if normals is not None]
    if own:
        normals, positions, triangles = zip(*(parts[k] for k in own), strict=True)
        ends = np.cumsum([len(part) for part in positions])
        shifted = [part + end - len(place) for part, end, place in zip(triangles, ends, positions, strict=True)]
        carried = CarriedNormals(np.concatenate(normals), np.concatenate(positions), np.concatenate(shifted))
        turned = np.stack([carried.at(x) for x in np.concatenate([frames[k] for k in own], axis=1)])
        for k, part in zip(own, np.split(turned, ends[:-1], axis=1), strict=True):
            found[k] = part
    return found
