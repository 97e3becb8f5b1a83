"""Where a surface comes near to itself: outside, where limbs touch, and inside, where it is thin."""

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from torch_modal.geometry.connectivity import vertex_areas
from torch_modal.precompute.surface import DIAGONAL, Surface

FloatArray = NDArray[np.float64]

NEAR = 0.03
"""Gaps up to this width count as near, in bounding-box diagonals."""
OPPOSED = -0.3
"""Cosine between the normals of a point and of the one across, up to which that is another side."""
SEEN_POINTS = 2000
"""About as many points of the surface are looked at, of larger ones every second, third and so on."""


def self_proximity(surface: Surface) -> float:
    """Fraction of the area that has an opposing part of the surface near in front of it.

    From such a pose tetrahedra cannot be carried well: they fuse what touches.
    """
    # Half-way to the opposing side that side becomes nearer than the own one.
    return _opposed_part(surface, np.array([1 / 16, 1 / 8, 1 / 4, 1 / 2]) * NEAR * DIAGONAL)


def thin_part(surface: Surface, width: float) -> float:
    """Fraction of the area under which the body is thinner than a width, in bounding-box diagonals."""
    return _opposed_part(surface, -np.array([1 / 16, 1 / 8, 1 / 4, 1 / 2]) * width * DIAGONAL)


def _opposed_part(surface: Surface, distances: FloatArray) -> float:
    """Fraction of the area from which a way along the normal leads to where another side is nearer."""
    step = max(len(surface.points) // SEEN_POINTS, 1)
    points, normals = surface.points[::step], surface.normals[::step]
    tree = cKDTree(points)
    opposed = np.zeros(len(points), dtype=bool)
    for distance in distances:
        nearest = tree.query(points + distance * normals)[1]
        opposed |= np.einsum("vi,vi->v", normals, normals[nearest]) < OPPOSED
    areas = vertex_areas(surface.points, surface.faces)[::step]
    return float(areas[opposed].sum() / areas.sum())
