"""Fewer faces by edge collapses: fast-simplification in the size that its thresholds are for, one call at a time."""

import threading
from typing import NamedTuple

import fast_simplification
import numpy as np
from numpy.typing import NDArray

from torch_modal.geometry.connectivity import IntArray

FloatArray = NDArray[np.float64]

# It keeps its mesh in static memory, and has absolute thresholds.
_NOT_THREAD_SAFE = threading.Lock()
_WORKING_DIAGONAL = 100.0
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
    centre = vertices.mean(0)
    factor = _WORKING_DIAGONAL / np.linalg.norm(np.ptp(np.stack([x[faces] for x in vertices.T]), axis=(1, 2)))
    with _NOT_THREAD_SAFE:
        points, triangles, collapses = fast_simplification.simplify(
            np.ascontiguousarray((vertices - centre) * factor),
            np.ascontiguousarray(faces, dtype=np.int32),
            target_count=n_faces,
            agg=_AGGRESSIVENESS,
            return_collapses=True,
        )
    return Decimation(points.astype(np.float64) / factor + centre, triangles.astype(np.int64), collapses)
