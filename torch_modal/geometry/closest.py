"""Exact closest points on a surface, by trees of centroids. NumPy and SciPy only."""

import numpy as np
from scipy.spatial import cKDTree

from torch_modal.arrays import FloatArray, IntArray

# Triangles with less than this part of the area that their sides allow count as segments.
FLAT_FACE = 1e-12

# Groups of triangles of similar size.
N_GROUPS = 8

# Triangles of a group that are tested first for each point; four times as many follow where these are not all.
FIRST_CANDIDATES = 4

# Pairs of a point and a triangle that are tested together.
PAIRS_AT_ONCE = 2**18


class ClosestFaces:
    """Exact queries for the closest triangle of a surface, which has one or more. *Shape:* ``(V, 3), (F, 3)``.

    Triangles are searched by their centroids, in groups of similar size: none is nearer than its centroid less its
    radius.
    """

    def __init__(self, vertices: FloatArray, faces: IntArray) -> None:
        #: *Shape:* ``(F, 3, 3)``.
        self.corners = vertices[faces]
        centres = self.corners.mean(1)
        self.centroids = cKDTree(centres)
        radii = np.linalg.norm(self.corners - centres[:, None], axis=2).max(1)
        groups = np.array_split(np.argsort(radii), min(N_GROUPS, len(faces)))
        self._groups = [(faces, cKDTree(centres[faces]), radii[faces[-1]]) for faces in groups]

    def __call__(self, points: FloatArray) -> IntArray:
        """Closest triangle to each point. *Shape:* ``(n, 3) -> (n,)``."""
        face = np.asarray(self.centroids.query(points)[1], dtype=np.int64)
        nearest = closest_on_triangles(points, self.corners[face])[1]
        for faces, tree, radius in self._groups:
            rows, k = np.arange(len(points)), FIRST_CANDIDATES
            while len(rows):
                k, crowded = min(k, len(faces)), []
                for some in np.array_split(rows, len(rows) * k // PAIRS_AT_ONCE + 1):
                    reach = nearest[some] + radius
                    apart, places = tree.query(points[some], np.arange(1, k + 1), distance_upper_bound=reach.max())
                    row, column = np.nonzero(apart <= reach[:, None])
                    candidates, distances = faces[places[row, column]], np.full(apart.shape, np.inf)
                    distances[row, column] = closest_on_triangles(points[some[row]], self.corners[candidates])[1]
                    best = distances.argmin(1)[:, None]
                    least = np.take_along_axis(distances, best, 1)[:, 0]
                    closer = np.flatnonzero(least < nearest[some])
                    face[some[closer]] = faces[places[closer, best[closer, 0]]]
                    nearest[some[closer]] = least[closer]
                    crowded.append(some[apart[:, -1] <= reach])  # perhaps there are more
                rows = np.concatenate(crowded) if k < len(faces) else rows[:0]
                k *= 4
        return face


def closest_on_triangles(points: FloatArray, corners: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Barycentric coordinates of the closest points on triangles, and the distances.

    *Shape:* ``(..., 3), (..., 3, 3) -> (..., 3), (...)``.
    """
    a = corners[..., 0, :]
    first, second, to_point = corners[..., 1, :] - a, corners[..., 2, :] - a, points - a
    along, across = dot(first, to_point), dot(second, to_point)
    ff, ss, fs = dot(first, first), dot(second, second), dot(first, second)
    determinant = ff * ss - fs**2
    tiny = np.finfo(np.float64).tiny
    per_area = 1 / np.maximum(determinant, tiny)
    v, w = (ss * along - fs * across) * per_area, (ff * across - fs * along) * per_area
    inside = (v >= 0) & (w >= 0) & (v + w <= 1) & (determinant > FLAT_FACE * ff * ss)
    # Otherwise it is on a side: the nearest of three.
    zero, third = np.zeros_like(v), second - first
    on_first, on_second, on_third = (
        np.clip(numerator / np.maximum(whole, tiny), 0, 1)
        for numerator, whole in ((along, ff), (across, ss), (dot(third, to_point - first), dot(third, third)))
    )
    pairs = (on_first, zero), (zero, on_second), (1 - on_third, on_third)
    sides = np.stack([np.stack(pair, -1) for pair in pairs], -2)  # (..., 3, 2)
    gaps = to_point[..., None, :] - sides @ np.stack([first, second], -2)
    nearest = dot(gaps, gaps).argmin(-1)[..., None, None]
    at = np.where(inside[..., None], np.stack([v, w], -1), np.take_along_axis(sides, nearest, -2)[..., 0, :])
    gap = to_point - at[..., :1] * first - at[..., 1:] * second
    return np.maximum(np.concatenate([1 - at.sum(-1, keepdims=True), at], -1), 0), np.sqrt(dot(gap, gap))


def dot(a: FloatArray, b: FloatArray) -> FloatArray:
    """Inner products, faster than sums along an axis of length three. *Shape:* ``(..., 3)``."""
    products: FloatArray = np.einsum("...i,...i->...", a, b)
    return products
