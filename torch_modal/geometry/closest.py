"""Exact closest points on a surface, by a tree of bounding boxes. NumPy and SciPy only."""

import numpy as np
from scipy.spatial import cKDTree

from torch_modal.arrays import FloatArray, IntArray

# Triangles with less than this part of the area that their sides allow count as segments.
FLAT = 1e-12

# Pairs of a point and a box that are tested together.
CHUNK = 2**18


def leaves(faces: IntArray, shapes: FloatArray) -> IntArray:
    """Faces as leaves of a binary tree, split on each level along the longest axis of their centres.

    Node 1 is the root, node ``i`` has the children ``2 i`` and ``2 i + 1``, and the last ``F`` nodes are the leaves.
    The faces of a node are close in all of the shapes. *Shape:* ``(F, 3), (K, V, 3) -> (F,)``.
    """
    points = np.concatenate(shapes[:, faces].mean(2), 1)
    n = len(points)
    first_nodes = [1 << k for k in range((n - 1).bit_length())]  # of each inner level
    sizes = np.ones(2 * n, np.int64)
    for start in reversed(first_nodes):
        level = np.arange(start, min(2 * start, n))
        sizes[level] = sizes[2 * level] + sizes[2 * level + 1]
    order, nodes = np.arange(n), np.ones(n, np.int64)
    for start in first_nodes:
        # Finished leaves come last.
        level = np.arange(start, min(2 * start, n))
        size = sizes[level]
        firsts, m = np.cumsum(size) - size, int(size.sum())
        inner = points[order[:m]]
        low = np.minimum.reduceat(inner, firsts)
        extent = np.maximum.reduceat(inner, firsts) - low
        axis, node = extent.argmax(1), np.repeat(np.arange(len(level)), size)
        longest = np.maximum(extent[np.arange(len(level)), axis], 1e-300)
        share = (inner[np.arange(m), axis[node]] - low[node, axis[node]]) / longest[node]
        order[:m] = order[:m][np.argsort(2 * node + share)]
        nodes[:m] = np.repeat(np.arange(2 * level[0], 2 * level[-1] + 2), sizes[2 * level[0] : 2 * level[-1] + 2])
    order_of_leaves = np.empty(n, np.int64)
    order_of_leaves[nodes - n] = order
    return order_of_leaves


class ClosestFaces:
    """Exact queries for the closest triangle of a surface, which has one or more. *Shape:* ``(V, 3), (F, 3)``."""

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
            parents = np.arange((first + 1) // 2, first)
            self._low[parents] = np.minimum(self._low[2 * parents], self._low[2 * parents + 1])
            self._high[parents] = np.maximum(self._high[2 * parents], self._high[2 * parents + 1])
            first = (first + 1) // 2

    def __call__(self, points: FloatArray) -> IntArray:
        """Closest triangle to each point. *Shape:* ``(n, 3) -> (n,)``."""
        face = np.asarray(self.centroids.query(points)[1], dtype=np.int64)
        nearest = closest_on_triangles(points, self.corners[face])[1]
        n = len(self.corners)
        left = [(np.arange(len(points)), np.ones(len(points), np.int64))]
        while left:  # depth first, so that few pairs are kept
            row, node = left.pop()
            gap = np.maximum(np.maximum(self._low[node] - points[row], points[row] - self._high[node]), 0)
            near = dot(gap, gap) < nearest[row] ** 2
            row, node = row[near], node[near]
            at, candidates = row[node >= n], self._leaves[node[node >= n] - n]
            distance = closest_on_triangles(points[at], self.corners[candidates])[1]
            nearer = distance < nearest[at]
            np.minimum.at(nearest, at, distance)
            nearer &= distance == nearest[at]
            face[at[nearer]] = candidates[nearer]
            row, node = np.repeat(row[node < n], 2), (2 * node[node < n, None] + np.arange(2)).reshape(-1)
            left += [(row[i : i + CHUNK], node[i : i + CHUNK]) for i in range(0, len(row), CHUNK)]
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
    inside = (v >= 0) & (w >= 0) & (v + w <= 1) & (determinant > FLAT * ff * ss)
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
