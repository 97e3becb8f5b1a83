"""Where a surface comes near to itself: outside, where limbs touch, and inside, where it is thin."""

from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from torch_modal.arrays import FloatArray, IntArray
from torch_modal.geometry.connectivity import vertex_areas
from torch_modal.precompute.parallel import closest_in
from torch_modal.precompute.sampling import SurfaceSamples, sampled
from torch_modal.precompute.surface import DIAGONAL, CanonicalSurface

NEAR = 0.03
"""Gaps up to this width count as near, in bounding-box diagonals."""
OPPOSED = -0.3
"""Cosine between the normals of a point and of the one across, up to which that is another side."""
SEEN_POINTS = 2000
"""About as many points of the surface are looked at, of larger ones every second, third and so on."""
MOST = 0.06
"""Thicknesses and gaps above are not told apart, in bounding-box diagonals."""
N_SAMPLES = 5000
"""At least, where these are measured, and of as many as"""
SEEN_SAMPLES = 10_000
MOST_SHRINKINGS = 10
TOUCHING = 0.015
"""How far apart points of a surface touch each other, for tetrahedra, in bounding-box diagonals."""
CELL = 0.005
"""Of so large cells one point is looked at for that."""


def self_proximity(surface: CanonicalSurface) -> float:
    """Fraction of the area that has an opposing part of the surface near in front of it.

    From such a pose tetrahedra cannot be carried well: they fuse what touches.
    """
    # Half-way to the opposing side that side becomes nearer than the own one.
    return _opposed_part(surface, np.array([1 / 16, 1 / 8, 1 / 4, 1 / 2]) * NEAR * DIAGONAL)


def parting(rest: CanonicalSurface, posed: CanonicalSurface) -> float:
    """How far parts of a surface that touch in one pose are from each other in another, in bounding-box diagonals.

    Root mean square over the surface of half of what the distance of a point to those near it grows by, at most.
    Tetrahedra of the first pose hang on both parts, and cannot follow either.

    Args:
        rest: The surface in the first pose.
        posed: In the other.
    """
    cells = np.floor(rest.points / (CELL * DIAGONAL)).astype(np.int64)
    cells -= cells.min(axis=0)
    _, chosen, cell = np.unique(np.ravel_multi_index(tuple(cells.T), cells.max(axis=0) + 1), True, True)
    areas = np.bincount(cell.reshape(-1), vertex_areas(rest.points, rest.faces))
    # The bounding box, which is the unit here, changes with the pose; the size of the shape hardly does.
    before, after = rest.points[chosen], posed.points[chosen] * np.sqrt(rest.area / posed.area)
    one, other = cKDTree(before).query_pairs(TOUCHING * DIAGONAL, output_type="ndarray").T
    growth = np.linalg.norm(after[one] - after[other], axis=1) - np.linalg.norm(before[one] - before[other], axis=1)
    largest = np.zeros(len(chosen))
    for point in (one, other):
        np.maximum.at(largest, point, growth)
    return float(np.sqrt(np.average((largest / 2) ** 2, weights=areas))) / DIAGONAL


class Clearance(NamedTuple):
    """How near other parts of a surface are, at each face; infinite where they are further than `MOST`.

    Attributes:
        thickness: Of the body below. *Shape:* ``(F,)``.
        gap: In front. *Shape:* ``(F,)``.
    """

    thickness: FloatArray
    gap: FloatArray


def clearances(surface: CanonicalSurface) -> Clearance:
    """Diameters of the balls that touch a surface at samples and at an opposing part of it."""
    spacing = np.sqrt(surface.area / N_SAMPLES)
    samples = sampled(surface, np.full(len(surface.faces), spacing))
    seen = np.arange(0, len(samples.points), max(len(samples.points) // SEEN_SAMPLES, 1))
    found = []
    for side in (-1.0, 1.0):
        radii = _opposed_radius(samples, side, seen, MOST * DIAGONAL / 2)
        smallest = np.full(len(surface.faces), np.inf)
        np.minimum.at(smallest, samples.faces[seen], 2 * radii)
        found.append(smallest)
    return Clearance(*found)


def _opposed_part(surface: CanonicalSurface, distances: FloatArray) -> float:
    """Fraction of the area from which a way along the normal leads to where another side is nearer."""
    step = max(len(surface.points) // SEEN_POINTS, 1)
    points, normals = surface.points[::step], surface.normals[::step]
    tree = cKDTree(points)
    opposed = np.zeros(len(points), dtype=bool)
    for distance in distances:
        nearest = closest_in(tree, points + distance * normals)[1]
        opposed |= np.einsum("vi,vi->v", normals, normals[nearest]) < OPPOSED
    areas = vertex_areas(surface.points, surface.faces)[::step]
    return float(areas[opposed].sum() / areas.sum())


def _opposed_radius(samples: SurfaceSamples, side: float, seen: IntArray, most: float) -> FloatArray:
    """Radii of the balls that touch at samples and at another side.

    They shrink until they are empty (Ma, Bae and Choi 2012), or touch something that is no other side, as in a corner.

    Args:
        samples: Of a surface.
        side: 1 in front of it, -1 behind.
        seen: Where radii are wanted. *Shape:* ``(S,)``.
        most: Larger ones are infinite.

    Returns:
        *Shape:* ``(S,)``.
    """
    found = np.full(len(seen), np.inf)
    left, radius = np.arange(len(seen)), np.full(len(seen), most)
    for _ in range(MOST_SHRINKINGS):
        point, direction = samples.points[seen[left]], side * samples.normals[seen[left]]
        nearest = closest_in(samples.tree, point + radius[:, None] * direction)[1]
        across = samples.points[nearest] - point
        height = np.einsum("vi,vi->v", across, direction)
        smaller = np.einsum("vi,vi->v", across, across) / (2 * np.maximum(height, 1e-300))
        opposed = side * np.einsum("vi,vi->v", direction, samples.normals[nearest]) < OPPOSED
        shrinks = opposed & (height > 0) & (smaller < 0.99 * radius)
        left, radius = left[shrinks], smaller[shrinks]
        found[left] = radius
        if len(left) == 0:
            break
    return found
