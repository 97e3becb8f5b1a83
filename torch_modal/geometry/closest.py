"""Exact closest points on a surface. NumPy and SciPy only."""

import numpy as np
from scipy.spatial import cKDTree

from torch_modal.arrays import FloatArray, IntArray
from torch_modal.geometry.box_tree import leaves

# Triangles with less than this part of the area that their sides allow are lines.
FLAT = 1e-12

# Pairs of a point and a box that are tested at a time.
CHUNK = 2**18


class ClosestFaces:
    """Exact queries for the closest triangle of a surface, by a tree of bounding boxes.

    Args:
        vertices: *Shape:* ``(V, 3)``.
        faces: At least one. *Shape:* ``(F, 3)``.
    """

    def __init__(self, vertices: FloatArray, faces: IntArray) -> None:
        #: *Shape:* ``(F, 3, 3)``.
        self.corners = vertices[faces]
        self.centroids = cKDTree(self.corners.mean(1))
        self._leaves, n = leaves(faces, vertices[None]), len(faces)
        ordered = self.corners[self._leaves]
        self._low, self._high = np.empty((2, 2 * n, 3))
        self._low[n:], self._high[n:] = ordered.min(1), ordered.max(1)
        first = n
        while first > 1:  # the nodes of first to 2 first - 1 are done; their parents are next
            own = np.arange((first + 1) // 2, first)
            self._low[own] = np.minimum(self._low[2 * own], self._low[2 * own + 1])
            self._high[own] = np.maximum(self._high[2 * own], self._high[2 * own + 1])
            first = (first + 1) // 2

    def __call__(self, points: FloatArray) -> IntArray:
        """The triangle that is closest to each point. *Shape:* ``(n, 3) -> (n,)``."""
        face = np.asarray(self.centroids.query(points)[1], dtype=np.int64)
        nearest = closest_on_triangles(points, self.corners[face])[1]
        n = len(self.corners)
        left = [(np.arange(len(points)), np.ones(len(points), np.int64))]
        while left:  # depth first, so that few pairs are kept
            row, node = left.pop()
            gap = np.maximum(np.maximum(self._low[node] - points[row], points[row] - self._high[node]), 0)
            near = _dot(gap, gap) < nearest[row] ** 2
            row, node = row[near], node[near]
            at, found = row[node >= n], self._leaves[node[node >= n] - n]
            distance = closest_on_triangles(points[at], self.corners[found])[1]
            nearer = distance < nearest[at]
            np.minimum.at(nearest, at, distance)
            nearer &= distance == nearest[at]
            face[at[nearer]] = found[nearer]
            row, node = np.repeat(row[node < n], 2), (2 * node[node < n, None] + np.arange(2)).reshape(-1)
            left += [(row[i : i + CHUNK], node[i : i + CHUNK]) for i in range(0, len(row), CHUNK)]
        return face


def closest_on_triangles(points: FloatArray, corners: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Barycentric coordinates of the closest points on triangles, and the distances.

    Args:
        points: *Shape:* ``(..., 3)``.
        corners: *Shape:* ``(..., 3, 3)``.

    Returns:
        *Shape:* ``(..., 3)``, ``(...)``.
    """
    a = corners[..., 0, :]
    first, second, to_point = corners[..., 1, :] - a, corners[..., 2, :] - a, points - a
    along, across = _dot(first, to_point), _dot(second, to_point)
    ff, ss, fs = _dot(first, first), _dot(second, second), _dot(first, second)
    determinant = ff * ss - fs**2
    tiny = np.finfo(np.float64).tiny
    per_area = 1 / np.maximum(determinant, tiny)
    v, w = (ss * along - fs * across) * per_area, (ff * across - fs * along) * per_area
    inside = (v >= 0) & (w >= 0) & (v + w <= 1) & (determinant > FLAT * ff * ss)
    # Else it is on a side: the nearest of three.
    zero, third = np.zeros_like(v), second - first
    on_first, on_second, on_third = (
        np.clip(part / np.maximum(whole, tiny), 0, 1)
        for part, whole in ((along, ff), (across, ss), (_dot(third, to_point - first), _dot(third, third)))
    )
    pairs = (on_first, zero), (zero, on_second), (1 - on_third, on_third)
    sides = np.stack([np.stack(pair, -1) for pair in pairs], -2)  # (..., 3, 2)
    gaps = to_point[..., None, :] - sides @ np.stack([first, second], -2)
    nearest = _dot(gaps, gaps).argmin(-1)[..., None, None]
    at = np.where(inside[..., None], np.stack([v, w], -1), np.take_along_axis(sides, nearest, -2)[..., 0, :])
    gap = to_point - at[..., :1] * first - at[..., 1:] * second
    return np.maximum(np.concatenate([1 - at.sum(-1, keepdims=True), at], -1), 0), np.sqrt(_dot(gap, gap))


def _dot(x: FloatArray, y: FloatArray) -> FloatArray:
    product: FloatArray = np.einsum("...i,...i->...", x, y)
    return product
