"""Edge-collapse decimation by fast-simplification, in canonical coordinates.

Sorted faces make the collapses independent of the axes and of the order of the faces.
"""

import threading

import fast_simplification
import numpy as np

from torch_modal.arrays import FloatArray, IntArray
from torch_modal.geometry.canonical import CANONICAL_SIZE, in_order, to_canonical

# The library keeps its mesh in static memory.
_NOT_THREAD_SAFE = threading.Lock()
_AGGRESSIVENESS = 7.0

# Where this many times the wanted faces are left, the vertices are shifted a little, and the collapses start anew: in
# exactly flat parts that lie obliquely, the optimal positions are rounding errors, and nothing collapses.
_STUCK = 1.5
_SHIFT = 1e-5 * CANONICAL_SIZE


def decimate(vertices: FloatArray, faces: IntArray, n_faces: int) -> tuple[FloatArray, IntArray, IntArray]:
    """Collapse edges down to a number of faces.

    Args:
        vertices: In any units. *Shape:* ``(V, 3)``.
        faces: Vertex indices. *Shape:* ``(F, 3)``.
        n_faces: Target number of faces; more remain if edges cannot be collapsed.

    Returns:
        Positions that minimise the quadrics, not linear in the input, *shape* ``(V', 3)``; faces, which may be
        degenerate or repeated, *shape* ``(F', 3)``; the collapses in order, the vertex that remains and the one that
        does not, *shape* ``(n, 2)``.
    """
    points, axes, centre, scale = to_canonical(vertices, faces)
    order, sorted_faces = in_order(points, faces)
    sorted_points, sorted_faces = points[order], sorted_faces.astype(np.int32)

    def simplify(points: FloatArray) -> tuple[FloatArray, IntArray, IntArray]:
        with _NOT_THREAD_SAFE:
            result: tuple[FloatArray, IntArray, IntArray] = fast_simplification.simplify(
                points, sorted_faces, target_count=n_faces, agg=_AGGRESSIVENESS, return_collapses=True
            )
        return result

    points, triangles, collapses = simplify(sorted_points)
    if len(triangles) > _STUCK * n_faces:
        shifts = _SHIFT * np.random.default_rng(0).standard_normal(sorted_points.shape)
        shifted = simplify(sorted_points + shifts)
        if len(shifted[1]) <= _STUCK * n_faces:
            points, triangles, collapses = shifted
    positions = points.astype(np.float64) @ axes / scale + centre
    return positions, triangles.astype(np.int64), order[collapses].reshape(-1, 2)
