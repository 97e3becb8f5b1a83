"""Weights of a carrier's vertices for points that follow it."""

import numpy as np
from scipy import sparse

from torch_modal.arrays import FloatArray, IntArray
from torch_modal.geometry.closest import ClosestFaces, closest_on_triangles

CANDIDATES = 8
"""Number of candidate triangles of each point in addition to the nearest: the triangles with the nearest centroids."""
FADE_WIDTH = 1.0
"""Triangles farther than the nearest by this fraction of its distance have no influence."""
ON_SURFACE = 1e-9
"""Fraction of the diagonal within which points are on the surface, and follow the nearest triangle alone."""
POINTS_AT_ONCE = 65_536
"""Number of points that are bound at a time."""


def bind_points(
    points: FloatArray, vertices: FloatArray, faces: IntArray, anchors: IntArray | None = None
) -> sparse.csr_matrix:
    """Non-negative weights of the vertices that each point follows, with sum one.

    They are barycentric coordinates of the closest points on the nearest triangles. The influence of a triangle fades
    out with its distance, so that weights are continuous around the surface. Triangles that are near in space but not
    along the surface, such as on the next finger, have no influence. Anchors are vertices of the carrier known to be
    near a point, or -1. *Shape:* ``(P, 3), (V, 3), (F, 3), (P,) -> (P, V)``.
    """
    surface = ClosestFaces(vertices, faces)
    extent = float(np.linalg.norm(np.ptp(vertices[np.unique(faces)], axis=0)))
    face = np.repeat(np.arange(len(faces)), 3)
    ones = np.ones(len(face), dtype=np.int32)
    of_vertex = sparse.csr_matrix((ones, (faces.reshape(-1), face)), (len(vertices), len(faces)))  # sums duplicates
    # Not zero for triangles that meet at a vertex, or both meet a third.
    touching = (of_vertex.T @ of_vertex) ** 2
    touching.sort_indices()
    n = width = min(CANDIDATES, len(faces))
    if anchors is not None:
        # The faces at each vertex, and -1 after them; the last row, for points without an anchor, has none.
        counts = np.append(np.diff(of_vertex.indptr), 0)
        width = max(n, counts.max())
        at_vertex = np.full((len(counts), width), -1)
        at_vertex[np.arange(width) < counts[:, None]] = of_vertex.indices
    rows_of_weights = [sparse.csr_matrix((0, len(vertices)))]
    for first in range(0, len(points), POINTS_AT_ONCE):
        some = slice(first, first + POINTS_AT_ONCE)
        chunk = points[some]
        candidates = np.full((len(chunk), width), -1) if anchors is None else at_vertex[anchors[some]]
        free = np.flatnonzero(candidates[:, 0] < 0)
        near = surface.centroids.query(chunk[free], k=np.arange(1, n + 1))[1]
        # The centroid of a long triangle may be far from its closest point.
        nearest = surface(chunk[free])
        missed = ~(near == nearest[:, None]).any(1)
        near[missed, -1] = nearest[missed]
        candidates[free, :n] = near
        barycentric, distance = closest_on_triangles(chunk[:, None], surface.corners[candidates])
        distance[candidates < 0] = np.inf
        best = distance.argmin(1)[:, None]
        least = np.take_along_axis(distance, best, 1)
        share = np.maximum(1 - (distance - least) / (FADE_WIDTH * least + ON_SURFACE * extent), 0) ** 2
        row, column = np.nonzero(share)
        closest = np.take_along_axis(candidates, best, 1)[row, 0]
        share[row, column] *= np.asarray(touching[closest, candidates[row, column]])[0] > 0
        weights = barycentric * (share / share.sum(1, keepdims=True))[..., None]
        row, column = np.nonzero(share)
        entries = weights[row, column].reshape(-1), (np.repeat(row, 3), faces[candidates[row, column]].reshape(-1))
        rows_of_weights.append(sparse.csr_matrix(entries, shape=(len(chunk), len(vertices))))
        rows_of_weights[-1].eliminate_zeros()
    return sparse.vstack(rows_of_weights, format="csr")
