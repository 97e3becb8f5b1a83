"""Normals of a file, rotated with the surface."""

from collections.abc import Sequence

import numpy as np

from torch_modal.arrays import FloatArray, IntArray
from torch_modal.geometry.vectors import vertex_normals


class CarriedNormals:
    """Rotates a file's normals with the surface, so that hard edges stay hard and smooth ones smooth.

    Points of equal position and normal count as one: seams of texture coordinates do not show in the shading. Arguments
    are as the file has them. *Shape:* ``(P, 3), (P, 3), (F, 3)``.
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
        """Right-handed frame at each point: the normal, an edge made perpendicular to it. *Shape:* ``(P, 3, 3)``."""
        x = positions[self.first]
        normals, sides = vertex_normals(x, self.triangles), x[self.neighbour] - x
        along = sides - np.einsum("ij,ij->i", sides, normals)[:, None] * normals
        with np.errstate(invalid="ignore"):
            second = along / np.linalg.norm(along, axis=1, keepdims=True)
        return np.stack([normals, second, np.cross(normals, second)], axis=2)[self.group]

    def at(self, positions: FloatArray) -> FloatArray:
        """Normals of the surface with other positions.

        The file's, bit for bit, where the surface has not moved, and at edges of no length.
        """
        after = self._frames(positions)
        rotated = np.einsum("nij,nkj,nk->ni", after, self.before, self.normals)
        stays = (self.before == after).all(axis=(1, 2)) | ~np.isfinite(rotated).all(axis=1)
        return np.where(stays[:, None], self.normals, rotated)


def carry_together(
    parts: Sequence[tuple[FloatArray | None, FloatArray, IntArray]], frames: Sequence[FloatArray]
) -> list[FloatArray | None]:
    """Rotate the normals of several parts of a surface with each frame; where parts meet, their normals stay equal.

    Parts are arguments of :class:`CarriedNormals`; a part without normals gives None. *Shape of each in the frames, and
    of the results:* ``(N, P, 3)``.
    """
    carried_normals: list[FloatArray | None] = [None] * len(parts)
    with_normals = [k for k, (normals, _, _) in enumerate(parts) if normals is not None]
    if with_normals:
        normals, positions, triangles = zip(*(parts[k] for k in with_normals), strict=True)
        ends = np.cumsum([len(points) for points in positions])
        shifted = [rows + end - len(points) for rows, end, points in zip(triangles, ends, positions, strict=True)]
        carried = CarriedNormals(np.concatenate(normals), np.concatenate(positions), np.concatenate(shifted))
        rotated = np.stack([carried.at(x) for x in np.concatenate([frames[k] for k in with_normals], axis=1)])
        for k, directions in zip(with_normals, np.split(rotated, ends[:-1], axis=1), strict=True):
            carried_normals[k] = directions
    return carried_normals
