"""Seams: where files for rendering hold a vertex several times, once for each texture coordinate or normal."""

import numpy as np
from scipy.spatial import cKDTree

from torch_modal.arrays import FloatArray, IntArray
from torch_modal.geometry.connectivity import Connectivity, connected_pieces

TOLERANCE = 1e-7
"""Part of the bounding-box diagonal: the rounding of float32 and of text with seven digits."""


def merge_seams(shapes: FloatArray, faces: IntArray) -> IntArray:
    """Which vertices are one, because the surface was cut there.

    Two vertices are one if both lie on a boundary and are at the same place in every shape. Surfaces that merely touch
    stay separate: closed ones have no boundary, and open ones part in some shape.

    Args:
        shapes: *Shape:* ``(K, V, 3)``.
        faces: *Shape:* ``(F, 3)``.

    Returns:
        A number for each vertex, the same for those that are one; numbers count from 0 in the order of the first
        vertices. *Shape:* ``(V,)``.
    """
    n = shapes.shape[1]
    boundary = np.unique(Connectivity(faces).boundary_edges)
    if not len(boundary):
        return np.arange(n)
    used = np.unique(faces)
    tolerance = TOLERANCE * float(np.linalg.norm(np.ptp(shapes[:, used], axis=1), axis=1).min())
    pairs = boundary[cKDTree(shapes[0, boundary]).query_pairs(tolerance, output_type="ndarray")]
    distance = np.linalg.norm(shapes[:, pairs[:, 0]] - shapes[:, pairs[:, 1]], axis=2).max(axis=0, initial=0.0)
    return connected_pieces(pairs[distance <= tolerance], n)
