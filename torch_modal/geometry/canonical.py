"""Size, axes and order of a surface, independent of the caller's axes and of the order of its faces.

NumPy only.
"""

from collections.abc import Sequence

import numpy as np

from torch_modal.arrays import FloatArray, IntArray

CANONICAL_SIZE = 100.0
"""Size (:func:`size`) at which energies are evaluated, modes computed and meshes decimated."""
QUANTUM = 2.0**-20
"""Quantum of their coordinates, far above the rounding of rotations and sums, which it removes."""
EQUAL_MOMENTS = 1e-6
"""Relative difference of principal moments below which axes are undetermined; likewise skewness and signs."""
GENERIC = np.array([1.0, 0.6180339887, 0.3247179572])
"""A generic direction, which is unlikely to match a symmetry of a shape."""
PREFERENCE = np.array([3.0, 2.0, 1.0])
"""Order of the caller's axes, x first, among axes of equal moments."""


def size(points: FloatArray, faces: IntArray) -> float:
    """``2 sqrt(3)`` times the radius of gyration of a surface: the length of a rod, the box diagonal of a sphere.

    Of a surface without area it is the bounding-box diagonal, which depends on the axes and on the tips of limbs.
    *Shape:* ``(V, 3), (F, 3)``.
    """
    return _moments(points, faces)[2]


def own_order(shapes: Sequence[FloatArray], faces: IntArray) -> list[int]:
    """Indices of shapes in an order that follows from the shapes, by descending size. *Shape of each:* ``(V, 3)``."""
    return sorted(range(len(shapes)), key=lambda i: (-size(shapes[i], faces), shapes[i].tobytes()))


def to_canonical(points: FloatArray, faces: IntArray) -> tuple[FloatArray, FloatArray, FloatArray, float]:
    """A shape in its principal axes, centred, with a size of 100. *Shape:* ``(V, 3), (F, 3)``.

    The signs of the axes follow from the third moments. Undetermined axes and signs, as in symmetric shapes, are close
    to the caller's.

    Returns:
        Rounded coordinates along the axes, ``(V, 3)``; the axes, rows of a rotation, ``(3, 3)``; the centroid,
        ``(3,)``; the scale. ``coordinates @ axes / scale + centroid`` are the points.
    """
    second, centre, length, arms, areas = _moments(points, faces)
    axes = _principal_axes(second)
    along = axes @ arms
    skewness = (along * along * along) @ areas
    is_skewed = np.abs(skewness) > EQUAL_MOMENTS * max(float(np.trace(second)), 0.0) ** 1.5
    axes = axes * np.where(np.where(is_skewed, skewness, axes @ GENERIC) < 0, -1.0, 1.0)[:, None]
    # The axis of least skewness completes a right-handed frame: mirrored shapes stay different.
    last = int(np.abs(skewness).argmin())
    axes[last] = np.cross(axes[last - 2], axes[last - 1])
    scale = CANONICAL_SIZE / length
    along_axes = ((points - centre) * scale) @ axes.T
    return np.round(along_axes / QUANTUM) * QUANTUM, axes, centre, scale


def in_order(points: FloatArray, faces: IntArray) -> tuple[IntArray, IntArray]:
    """A mesh in an order that follows from the positions, stable for equal points. *Shape:* ``(V, 3), (F, 3)``.

    Returns:
        The points in order, *shape* ``(V,)``; the faces, in terms of these, by their vertices from the first one on,
        *shape* ``(F, 3)``.
    """
    # By coordinate: a matrix product may round equal rows differently.
    key = points[:, 0] * GENERIC[0] + points[:, 1] * GENERIC[1] + points[:, 2] * GENERIC[2]
    order = np.argsort(key, kind="stable")
    rank = np.empty_like(order)
    rank[order] = np.arange(len(order))
    a, b, c = rank[faces].T
    b_first, c_first = (b < a) & (b < c), (c < a) & (c < b)
    corners = [np.where(b_first, y, np.where(c_first, z, x)) for x, y, z in ((a, b, c), (b, c, a), (c, a, b))]
    ranks = np.stack(corners, axis=1)
    return order, ranks[np.lexsort(corners[::-1])]


def _moments(points: FloatArray, faces: IntArray) -> tuple[FloatArray, FloatArray, float, FloatArray, FloatArray]:
    """Second moments over the surface, centroid, size, and of the faces centroids, *shape* ``(3, F)``, and areas.

    The first and the last two are in units of the bounding box, against overflow of squares; areas add up to one.
    """
    corners = np.array([[row[corner] for row in points.T] for corner in faces.T])  # rows are long: ten times as fast
    low, high = corners.min(axis=(0, 2)), corners.max(axis=(0, 2))
    longest = float((high - low).max())
    unit = longest if longest > 0 else 1.0
    middle = (low + high) / 2
    corners = (corners - middle[:, None]) / unit
    (ux, uy, uz), (vx, vy, vz) = corners[1] - corners[0], corners[2] - corners[0]
    areas = np.sqrt((uy * vz - uz * vy) ** 2 + (uz * vx - ux * vz) ** 2 + (ux * vy - uy * vx) ** 2)
    if not areas.sum() > 0:
        length = unit * float(np.linalg.norm((high - low) / unit)) if longest > 0 else 1.0
        return np.zeros((3, 3)), middle, length, corners.mean(axis=0), areas
    areas = areas / areas.sum()
    centre = corners.mean(axis=0) @ areas
    corners = corners - centre[:, None]
    arms = corners.mean(axis=0)
    second = (9 * (areas * arms) @ arms.T + sum((areas * corner) @ corner.T for corner in corners)) / 12
    length = unit * float(np.sqrt(12 * np.trace(second)))
    return second, middle + unit * centre, length, arms, areas


def _principal_axes(second: FloatArray) -> FloatArray:
    """Principal axes in rows, by descending moments; of equal moments, close to the caller's. *Shape:* ``(3, 3)``."""
    moments, vectors = np.linalg.eigh(second)
    spans = np.split(vectors.T, np.flatnonzero(np.diff(moments) >= EQUAL_MOMENTS * moments[2]) + 1)
    return np.concatenate([np.linalg.eigh(span * PREFERENCE @ span.T)[1].T @ span for span in spans])[::-1].copy()
