"""Exact intersection test of pairs of triangles. NumPy and libigl."""

import numpy as np

from torch_modal import extras
from torch_modal.arrays import BoolArray, FloatArray


def triangles_cross(one: FloatArray, other: FloatArray) -> BoolArray:
    """Exact intersection test of pairs of triangles.

    Two triangles intersect if each has vertices strictly on both sides of the other's plane, and their segments on the
    line of the planes overlap in more than a point (Guigue and Devillers 2003). Touching and coplanar triangles do not.
    Signs of determinants are exact. *Shape:* ``(n, 3, 3), (n, 3, 3) -> (n,)``.

    Raises:
        MissingPackageError: ``libigl`` is not installed.
    """
    sides = _sides(one, other), _sides(other, one)
    crossing: BoolArray = np.all([(side > 0).any(1) & (side < 0).any(1) for side in sides], axis=0)
    some = np.flatnonzero(crossing)
    first, first_above = _lone_first(one[some], sides[0][some])
    second, second_above = _lone_first(other[some], sides[1][some])
    # Flips the other triangle so that each lone vertex is above its plane.
    second[~first_above, 1:] = second[~first_above, :0:-1]
    first[~second_above, 1:] = first[~second_above, :0:-1]
    p, q, r = first.transpose(1, 0, 2)
    a, b, c = second.transpose(1, 0, 2)
    crossing[some] = (_above(p, q, a, b) < 0) & (_above(p, r, c, a) < 0)
    return crossing


def _sides(points: FloatArray, planes: FloatArray) -> FloatArray:
    """Side of a triangle's plane for three points: 1 above, -1 below, 0 in it. *Shape:* ``(n, 3)``."""
    a, b, c = (planes[:, i] for i in range(3))
    return np.stack([_above(a, b, c, points[:, i]) for i in range(3)], 1)


def _above(a: FloatArray, b: FloatArray, c: FloatArray, d: FloatArray) -> FloatArray:
    """The exact sign of ``(b - a) x (c - a) . (d - a)``. *Shape of each:* ``(n, 3)``."""
    orient = extras.require("igl.predicates", "contact", "contact").orient3d
    sign: FloatArray = -orient(*(np.ascontiguousarray(x) for x in (a, b, c, d)))
    return sign


def _lone_first(corners: FloatArray, side: FloatArray) -> tuple[FloatArray, BoolArray]:
    """Corners rotated so that the one alone on its side comes first, and whether it is above."""
    above = (side > 0).sum(1) == 1
    lone = np.where(above, (side > 0).argmax(1), (side < 0).argmax(1))
    corner_order = (lone[:, None] + np.arange(3)) % 3
    return np.take_along_axis(corners, corner_order[..., None], 1), above
