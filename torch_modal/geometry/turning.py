"""Directions that are carried along by a surface."""

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]


def turn(vectors: FloatArray, before: FloatArray, after: FloatArray) -> FloatArray:
    r"""Turn vectors as the surface under them turns: by the smallest rotation of one normal on to the other.

    With :math:`w = n \times n'` of unit normals, Rodrigues' formula is
    :math:`R v = v + w \times v + w \times (w \times v) / (1 + n \cdot n')`.
    Where the normal stays, bit for bit, so does the vector.

    Args:
        vectors: *Shape:* ``(n, 3)``.
        before: Unit normals of the surface where the vectors belong. *Shape:* ``(n, 3)``.
        after: Unit normals of the surface where they go. *Shape:* ``(n, 3)``.

    Returns:
        *Shape:* ``(n, 3)``. At half a turn, which has no axis, the negative vectors.
    """
    axis = np.cross(before, after)
    cosine = np.einsum("ij,ij->i", before, after)[:, None]
    once = np.cross(axis, vectors)
    turned = vectors + once + np.cross(axis, once) / np.maximum(1 + cosine, 1e-12)
    return np.where(cosine < -1 + 1e-9, -vectors, turned)
