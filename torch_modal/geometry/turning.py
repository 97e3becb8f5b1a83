"""Directions that are carried along by a surface."""

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]


def surface_frames(normals: FloatArray, sides: FloatArray) -> FloatArray:
    """Right-handed frames of a normal and a direction along the surface.

    Args:
        normals: Unit normals. *Shape:* ``(n, 3)``.
        sides: Directions that are taken along, of any length, not along the normal. *Shape:* ``(n, 3)``.

    Returns:
        The axes are columns: the normal, the side made perpendicular to it, and their cross product; where the side is
        along the normal, the second is any perpendicular. *Shape:* ``(n, 3, 3)``.
    """
    along = sides - np.einsum("ij,ij->i", sides, normals)[:, None] * normals
    length = np.linalg.norm(along, axis=1, keepdims=True)
    usable = length > 1e-9 * np.maximum(np.linalg.norm(sides, axis=1, keepdims=True), np.finfo(np.float64).tiny)
    other = np.cross(normals, np.eye(3)[np.abs(normals).argmin(axis=1)])
    other /= np.maximum(np.linalg.norm(other, axis=1, keepdims=True), 1e-12)
    second = np.where(usable, along / np.where(usable, length, 1.0), other)
    return np.stack([normals, second, np.cross(normals, second)], axis=2)


def turn(vectors: FloatArray, before: FloatArray, after: FloatArray) -> FloatArray:
    """Turn vectors as the frames under them turn: ``R v`` with ``R = after before^T``.

    Where a frame stays, bit for bit, so does the vector.

    Args:
        vectors: *Shape:* ``(n, 3)``.
        before: Frames where the vectors belong. *Shape:* ``(n, 3, 3)``.
        after: Frames where they go. *Shape:* ``(n, 3, 3)``.

    Returns:
        *Shape:* ``(n, 3)``.
    """
    turned = np.einsum("nij,nkj,nk->ni", after, before, vectors)
    return np.where((before == after).all(axis=(1, 2))[:, None], vectors, turned)
