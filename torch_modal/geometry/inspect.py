"""Defects of meshes and repairs. NumPy and SciPy only.

Nothing here raises or warns; see `keyframes/check.py`.
"""

import numpy as np

from torch_modal.arrays import BoolArray, FloatArray, IntArray
from torch_modal.geometry.connectivity import Connectivity, double_areas, label_pieces

FLATNESS = 1e-6
"""Extent across a plane, over the largest, up to which a surface is flat."""
OPEN = 0.08
"""Part of its area that holes have (:func:`open_part`) above which a surface is open, rather than a body with holes."""


def degenerate_faces(faces: IntArray) -> BoolArray:
    """Faces that use a vertex twice. *Shape:* ``(F,)``."""
    a, b, c = faces.T
    return (a == b) | (b == c) | (c == a)


def find_repeated_faces(faces: IntArray) -> BoolArray:
    """Faces with the same vertices as an earlier face, in any order. *Shape:* ``(F,)``."""
    repeated, corners = np.zeros(len(faces), dtype=bool), np.sort(faces, axis=1).T
    order = np.lexsort(corners)  # stable: among equal faces the earliest comes first
    repeated[order[1:]] = (corners[:, order[1:]] == corners[:, order[:-1]]).all(axis=0)
    return repeated


def consistent_winding(mesh: Connectivity) -> tuple[IntArray, IntArray, IntArray]:
    """Flip the fewest faces so that adjacent faces have opposite directions along their edge.

    The graph has two nodes for each face, as it is and flipped. Edges join equal nodes of consistent neighbours and
    different nodes of inconsistent ones. An orientable component gives two components of this graph, a non-orientable
    one gives one. Edges of three or more faces are ignored.

    Returns:
        The faces, *shape* ``(F, 3)``; the indices of those that are flipped, and of those that stay because their
        component is not orientable (a Moebius strip).
    """
    faces, n_faces = mesh.faces, len(mesh.faces)
    one, two = mesh.hinge_sides.T % n_faces
    signs = mesh.signs[mesh.hinge_sides]
    crossed = (signs[:, 0] == signs[:, 1]) * n_faces
    if not crossed.any():
        return faces, np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64)
    pairs = np.stack([np.append(one, one + n_faces), np.append(two + crossed, two + n_faces - crossed)], axis=1)
    label = label_pieces(pairs, 2 * n_faces)
    as_is, flipped = label[:n_faces], label[n_faces:]
    non_orientable = as_is == flipped

    # Choose the copy with more unchanged faces; on a tie, the one with the first face.
    size = np.bincount(as_is, minlength=label.max() + 1)
    fewer, equal = size[as_is] < size[flipped], size[as_is] == size[flipped]
    flip = ~non_orientable & (fewer | (equal & (as_is > flipped)))
    repaired = np.where(flip[:, None], faces[:, ::-1], faces)
    return repaired, np.flatnonzero(flip), np.flatnonzero(non_orientable)


def diagonals(keyframes: FloatArray) -> FloatArray:
    """Bounding-box diagonal of each shape. *Shape:* ``(K, V, 3)`` to ``(K,)``."""
    extent = np.ptp(keyframes, axis=1)
    largest = extent.max(axis=1)
    # Scaled by the largest extent, against overflow.
    return largest * np.linalg.norm(extent / np.where(largest > 0, largest, 1)[:, None], axis=1)


def fatness(points: FloatArray, faces: IntArray) -> FloatArray:
    """Altitude of faces over their longest side, 0.87 of equilateral ones. *Shape:* ``(V, 3), (F, 3) -> (F,)``."""
    a, b, c = points[faces.T]
    longest = np.maximum.reduce([np.einsum("fi,fi->f", side, side) for side in (b - a, c - b, a - c)])
    altitudes: FloatArray = double_areas(points, faces) / np.maximum(longest, np.finfo(np.float64).tiny)
    return altitudes


def principal_extents(points: FloatArray) -> FloatArray:
    """Extents along the principal axes, descending. *Shape:* ``(V, 3) -> (3,)``."""
    centred = points - points.mean(axis=0)
    scale = np.abs(centred).max() or 1.0
    extents: FloatArray = np.ptp(centred @ np.linalg.eigh((centred / scale).T @ (centred / scale))[1], axis=0)
    return np.sort(extents)[::-1]


def is_flat(points: FloatArray) -> bool:
    """True for points in a plane. *Shape:* ``(V, 3)``."""
    extents = principal_extents(points)
    return bool(extents[2] <= FLATNESS * extents[0])


def open_part(points: FloatArray, mesh: Connectivity) -> float:
    """Area of round holes as long as all boundaries, relative to the area of the surface. *Shape:* ``(V, 3)``."""
    start, end = points[mesh.boundary_edges.T]
    length = np.linalg.norm(end - start, axis=1).sum()
    return float(length**2 / (2 * np.pi * double_areas(points, mesh.faces).sum()))


def volume_of(vertices: FloatArray, faces: IntArray, used: IntArray | None = None) -> float:
    """Enclosed volume of a closed mesh, positive for outward normals.

    With the vertices that faces use, it is about their mean: then it does not depend on the place of a mesh with holes.
    """
    if used is not None:
        vertices = vertices - vertices[used].mean(0)
    a, b, c = vertices[faces[:, 0]], vertices[faces[:, 1]], vertices[faces[:, 2]]
    return float(np.einsum("fi,fi->", a, np.cross(b, c)) / 6)
