"""Which vertices of a carrier a point follows, and how much."""

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from torch_modal.arrays import BoolArray, FloatArray, IntArray
from torch_modal.geometry.closest import ClosestFaces, closest_on_triangles

# Triangles that are looked at for each point beside the nearest: those with the nearest centroids.
CANDIDATES = 8

# Triangles farther than the nearest by this part of its distance have no influence.
WIDTH = 1.0

# Of points that are on the surface but for this part of the diagonal, the nearest triangle alone decides.
ON_SURFACE = 1e-9

# Points that are bound at a time.
CHUNK = 65_536


def binding(
    points: FloatArray, vertices: FloatArray, faces: IntArray, anchors: IntArray | None = None
) -> sparse.csr_matrix:
    """Weights of the vertices that each point follows: none is negative, and those of a point add up to one.

    They are barycentric coordinates of the closest points on the nearest triangles, which fade out with the distance
    beyond the nearest one, so that weights are continuous around the surface. Triangles that are near in space but not
    along the surface, such as those of the next finger, have none.

    Args:
        points: *Shape:* ``(P, 3)``.
        vertices: Of the carrier. *Shape:* ``(V, 3)``.
        faces: *Shape:* ``(F, 3)``.
        anchors: A vertex of the carrier around which each point is known to be; -1 where none is known. *Shape:*
            ``(P,)``.

    Returns:
        *Shape:* ``(P, V)``.
    """
    surface = ClosestFaces(vertices, faces)
    extent = float(np.linalg.norm(np.ptp(vertices[np.unique(faces)], axis=0)))
    touching = _touching(faces, len(vertices))
    at_vertex = None if anchors is None else _faces_at(faces, len(vertices))
    found = []
    for first in range(0, len(points), CHUNK):
        own = points[first : first + CHUNK]
        candidates = surface.centroids.query(own, k=np.arange(1, min(CANDIDATES, len(faces)) + 1))[1]
        # The centroid of a long triangle may be far from its closest point.
        free = np.arange(len(own)) if anchors is None else np.flatnonzero(anchors[first : first + CHUNK] < 0)
        nearest = surface(own[free])
        missed = ~(candidates[free] == nearest[:, None]).any(1)
        candidates[free[missed], -1] = nearest[missed]
        if anchors is not None and at_vertex is not None:
            around = at_vertex[anchors[first : first + CHUNK]]
            widest = max(around.shape[1], candidates.shape[1])
            known = around[:, :1] >= 0
            around, candidates = (_widened(rows, widest) for rows in (around, candidates))
            candidates = np.where(known, around, candidates)
        barycentric, distance = closest_on_triangles(own[:, None], surface.corners[candidates])
        distance[candidates < 0] = np.inf
        best = distance.argmin(1)[:, None]
        least = np.take_along_axis(distance, best, 1)
        share = np.maximum(1 - (distance - least) / (WIDTH * least + ON_SURFACE * extent), 0) ** 2
        row, column = np.nonzero(share)
        closest = np.take_along_axis(candidates, best, 1)
        apart = ~_stored(touching, closest[row, 0] * len(faces) + candidates[row, column])
        share[row[apart], column[apart]] = 0
        weights = barycentric * (share / share.sum(1, keepdims=True))[..., None]
        row, column = np.nonzero(share)
        index = faces[candidates[row, column]].reshape(-1)
        part = (weights[row, column].reshape(-1), (np.repeat(row, 3), index))
        found.append(sparse.csr_matrix(part, shape=(len(own), len(vertices))))
        found[-1].eliminate_zeros()
    return sparse.vstack(found, format="csr") if found else sparse.csr_matrix((0, len(vertices)))


def _widened(rows: IntArray, n: int) -> IntArray:
    """Rows of this length, filled with -1."""
    return np.pad(rows, ((0, 0), (0, n - rows.shape[1])), constant_values=-1)


def _incidence(faces: IntArray, n_vertices: int) -> sparse.csr_matrix:
    """Which faces are at which vertices. *Shape:* ``(V, F)``."""
    face = np.repeat(np.arange(len(faces)), 3)
    found = sparse.csr_matrix((np.ones(len(face), dtype=np.int32), (faces.reshape(-1), face)), (n_vertices, len(faces)))
    found.sum_duplicates()
    return found


def _faces_at(faces: IntArray, n_vertices: int) -> IntArray:
    """The faces at each vertex, and -1 after them; a further row, for no vertex, has none. *Shape:* ``(V + 1, n)``."""
    incidence = _incidence(faces, n_vertices)
    counts = np.append(np.diff(incidence.indptr), 0)
    found = np.full((n_vertices + 1, counts.max(initial=1)), -1)
    found[np.arange(found.shape[1]) < counts[:, None]] = incidence.indices
    return found


def _touching(faces: IntArray, n_vertices: int) -> NDArray[np.int64]:
    """Pairs of triangles that meet at a vertex, or both meet a third, as sorted keys ``i F + j``."""
    of_vertex = _incidence(faces, n_vertices)
    once = of_vertex.T @ of_vertex
    twice = (once @ once).tocoo()
    return np.sort(twice.row.astype(np.int64) * len(faces) + twice.col)


def _stored(keys: NDArray[np.int64], wanted: NDArray[np.int64]) -> BoolArray:
    """Whether keys are among others, which are sorted. *Shape:* ``(m,), (n,) -> (n,)``."""
    return np.asarray(keys[np.searchsorted(keys, wanted).clip(max=len(keys) - 1)] == wanted)
