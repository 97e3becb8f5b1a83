"""Triangle-triangle intersection: a conservative test and an exact one. NumPy and libigl."""

import numpy as np

from torch_modal import extras
from torch_modal.arrays import BoolArray, FloatArray
from torch_modal.geometry.closest import dot

MARGIN = 1e-12
"""Relative to the cubed largest length in a determinant; above its rounding error."""


def cross(a: FloatArray, b: FloatArray) -> FloatArray:
    """Cross product, ten times as fast as ``np.cross`` for few vectors. *Shape:* ``(n, 3)`` each."""
    product = np.empty_like(a)
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        product[:, i] = a[:, j] * b[:, k] - a[:, k] * b[:, j]
    return product


def triangles_cross(one: FloatArray, other: FloatArray) -> BoolArray:
    """Exact intersection test of pairs of triangles.

    Two triangles intersect if each has vertices strictly on both sides of the other's plane, and their segments on the
    line of the planes overlap in more than a point (Guigue and Devillers 2003). Touching and coplanar triangles do not.
    Signs of determinants are exact. *Shape:* ``(n, 3, 3), (n, 3, 3) -> (n,)``.

    Raises:
        MissingPackageError: ``libigl`` is not installed.
    """
    crossing = (pierce_nearly(one, other) | pierce_nearly(other, one)).astype(bool)
    some = np.flatnonzero(crossing)
    crossing[some] = _cross_exactly(one[some], other[some])
    return crossing


def pierce_nearly(edges_of: FloatArray, through: FloatArray) -> BoolArray:
    """True where an edge of a triangle meets another within the margin. *Shape:* ``(n, 3, 3), (n, 3, 3) -> (n,)``."""
    first = through[:, 0]
    normal = cross(through[:, 1] - first, through[:, 2] - first)
    height = dot(edges_of - first[:, None], normal[:, None])
    reach = np.abs(np.concatenate([edges_of, through], 1) - first[:, None]).max((1, 2))
    margin = MARGIN * reach**3
    above, below = height > -margin[:, None], height < margin[:, None]
    pierced = np.zeros(len(edges_of), dtype=bool)
    for i, j in ((0, 1), (1, 2), (2, 0)):
        at = np.flatnonzero(((above[:, i] & below[:, j]) | (below[:, i] & above[:, j])) & ~pierced)
        start, end = edges_of[at, i], edges_of[at, j]
        rays = through[at] - start[:, None]
        sides = np.stack([dot(cross(rays[:, k], rays[:, (k + 1) % 3]), end - start) for k in range(3)])
        pierced[at[(sides > -margin[at]).all(0) | (sides < margin[at]).all(0)]] = True
    return pierced


def _cross_exactly(one: FloatArray, other: FloatArray) -> BoolArray:
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
