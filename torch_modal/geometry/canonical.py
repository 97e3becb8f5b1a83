"""Size, axes and order of a surface that follow from its shape: not from the caller's axes or the order of its faces.

NumPy only.
"""

from typing import NamedTuple

import numpy as np

from torch_modal.arrays import FloatArray, IntArray

SIZE = 100.0
"""The size of shapes as :func:`placed` gives them."""
ROUNDING = 2.0**-20
"""Their coordinates are multiples of this. Rounding errors of a turn or of a sum are far below, so they are lost."""
ALIKE = 1e-6
"""Principal moments closer than this, over the largest, do not determine axes; smaller skewness determines no sign."""
GENERIC = np.array([1.0, 0.6180339887, 0.3247179572])
"""No symmetry of a shape is likely to map points of a plane across this to each other."""


class Placed(NamedTuple):
    """A shape in its own axes, about its centroid, at a size of 100."""

    points: FloatArray
    """Coordinates along the axes, rounded. *Shape:* ``(V, 3)``."""
    axes: FloatArray
    """A rotation whose rows are the axes: ``points @ axes`` has the caller's axes. *Shape:* ``(3, 3)``."""
    centre: FloatArray
    """In the caller's coordinates. *Shape:* ``(3,)``."""
    scale: float
    """Units here for each of the caller's."""


def size(points: FloatArray, faces: IntArray) -> float:
    """``2 sqrt(3)`` times the radius of gyration of a surface: the length of a rod, the box diagonal of a sphere.

    The diagonal of the bounding box itself changes with the axes, and with the tip of every limb.

    Args:
        points: *Shape:* ``(V, 3)``.
        faces: Vertex indices. *Shape:* ``(F, 3)``.

    Returns:
        In the units of the points; of a surface without area, the diagonal of its bounding box.
    """
    return _moments(points, faces)[2]


def placed(points: FloatArray, faces: IntArray) -> Placed:
    """A shape in its principal axes.

    The signs of the axes follow from the third moments. Where moments are equal, or vanish, as in symmetric shapes,
    axes and signs close to the caller's are taken.

    Args:
        points: *Shape:* ``(V, 3)``.
        faces: Vertex indices. *Shape:* ``(F, 3)``.
    """
    second, centre, length, arms, areas = _moments(points, faces)
    axes = _principal_axes(second)
    skewness = areas @ (arms @ axes.T) ** 3
    told = np.abs(skewness) > ALIKE * max(float(np.trace(second)), 0.0) ** 1.5
    axes = axes * np.where(np.where(told, skewness, axes @ GENERIC) < 0, -1.0, 1.0)[:, None]
    # The sign of the axis with the least skewness follows from the others: mirrored shapes are different shapes.
    last = int(np.abs(skewness).argmin())
    axes[last] = np.cross(axes[last - 2], axes[last - 1])
    scale = SIZE / length
    turned = ((points - centre) * scale) @ axes.T
    return Placed(np.round(turned / ROUNDING) * ROUNDING, axes, centre, scale)


def vertex_order(points: FloatArray) -> IntArray:
    """An order of points that follows from where they are; equal ones stay in theirs. *Shape:* ``(V, 3) -> (V,)``."""
    # Coordinate by coordinate: a product of matrices need not round equal rows alike.
    key = points[:, 0] * GENERIC[0] + points[:, 1] * GENERIC[1] + points[:, 2] * GENERIC[2]
    return np.argsort(key, kind="stable")


def ordered_faces(points: FloatArray, faces: IntArray) -> IntArray:
    """The faces in an order, each from a corner, that follow from where the points are. *Shape:* ``(F, 3)``."""
    order = vertex_order(points)
    rank = np.empty_like(order)
    rank[order] = np.arange(len(order))
    ranks = rank[faces]
    first = ranks.argmin(axis=1)[:, None]
    ranks = np.take_along_axis(ranks, (first + np.arange(3)) % 3, axis=1)
    return order[ranks[np.lexsort(ranks.T[::-1])]]


def _moments(points: FloatArray, faces: IntArray) -> tuple[FloatArray, FloatArray, float, FloatArray, FloatArray]:
    """Second moments over the surface, the centroid, the size, then centroids of faces and their parts of the area.

    The first and the last two are relative to the box, whose unit may be far out of the range of squares.
    """
    corners = points[faces]
    flat = corners.reshape(-1, 3)
    low, high = flat.min(axis=0), flat.max(axis=0)
    longest = float((high - low).max())
    unit = longest if longest > 0 else 1.0
    corners = (corners - (low + high) / 2) / unit
    areas = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    if not areas.sum() > 0:
        length = unit * float(np.linalg.norm((high - low) / unit)) if longest > 0 else 1.0
        return np.zeros((3, 3)), (low + high) / 2, length, corners.mean(axis=1), areas
    areas = areas / areas.sum()
    centre = areas @ corners.mean(axis=1)
    corners = corners - centre
    arms = corners.mean(axis=1)
    second = 9 * np.einsum("f,fi,fj->ij", areas, arms, arms) + np.einsum("f,fci,fcj->ij", areas, corners, corners)
    second = second / 12
    length = unit * float(np.sqrt(12 * np.trace(second)))
    return second, (low + high) / 2 + unit * centre, length, arms, areas


def _principal_axes(second: FloatArray) -> FloatArray:
    """Rows, by descending moments. *Shape:* ``(3, 3) -> (3, 3)``."""
    moments, vectors = np.linalg.eigh(second)
    moments, axes = moments[::-1], vectors.T[::-1].copy()
    start = 0
    for end in range(1, 4):
        if end < 3 and moments[end - 1] - moments[end] < ALIKE * moments[0]:
            continue
        if end - start > 1 or moments[0] <= 0:
            axes[start:end] = _nearest_axes(axes[start:end])
        start = end
    return axes


def _nearest_axes(span: FloatArray) -> FloatArray:
    """Orthonormal vectors of the same span, close to the caller's axes. *Shape:* ``(n, 3) -> (n, 3)``."""
    projector, found = span.T @ span, []
    for _ in range(len(span)):
        # Uneven weights, so that rounding never chooses between equals.
        best = int((np.linalg.norm(projector, axis=0) * [1.0, 0.99, 0.98]).argmax())
        found.append(projector[:, best] / np.linalg.norm(projector[:, best]))
        projector = projector - np.outer(found[-1], found[-1] @ projector)
    return np.array(found)
