"""Fewer faces by edge collapses: fast-simplification in the size that its thresholds are for, one call at a time.

It collapses in the order of the faces, so they are sorted first: the same shape gives the same collapses, however its
faces are listed and its axes turned.
"""

import threading
from typing import NamedTuple

import fast_simplification
import numpy as np

from torch_modal.arrays import FloatArray, IntArray
from torch_modal.geometry.canonical import ordered_faces, placed, vertex_order

# It keeps its mesh in static memory, and has absolute thresholds.
_NOT_THREAD_SAFE = threading.Lock()
_AGGRESSIVENESS = 7.0


class Decimation(NamedTuple):
    """A mesh of fewer faces, and how it came about."""

    vertices: FloatArray
    """Where the quadrics place them, not linear in the positions before. *Shape:* ``(V', 3)``."""
    faces: IntArray
    """Some may use a vertex twice, or be there twice. *Shape:* ``(F', 3)``."""
    collapses: IntArray
    """In their order: which vertex stays, and which becomes part of it. *Shape:* ``(n, 2)``."""


def decimate(vertices: FloatArray, faces: IntArray, n_faces: int) -> Decimation:
    """Collapse edges until a number of faces is left.

    Args:
        vertices: In any units. *Shape:* ``(V, 3)``.
        faces: Vertex indices. *Shape:* ``(F, 3)``.
        n_faces: How many are wanted. There may remain more: some edges cannot be collapsed.
    """
    shape = placed(vertices, faces)
    order = vertex_order(shape.points)
    rank = np.argsort(order)
    with _NOT_THREAD_SAFE:
        points, triangles, collapses = fast_simplification.simplify(
            np.ascontiguousarray(shape.points[order]),
            np.ascontiguousarray(rank[ordered_faces(shape.points, faces)], dtype=np.int32),
            target_count=n_faces,
            agg=_AGGRESSIVENESS,
            return_collapses=True,
        )
    points = points.astype(np.float64) @ shape.axes / shape.scale + shape.centre
    return Decimation(points, triangles.astype(np.int64), order[collapses].reshape(-1, 2))
