"""Self-proximity of a surface: gaps between parts in front of it, thickness behind it."""

from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from torch_modal.arrays import FloatArray, IntArray
from torch_modal.geometry.canonical import CANONICAL_SIZE
from torch_modal.geometry.connectivity import vertex_areas
from torch_modal.precompute.parallel import closest_in
from torch_modal.precompute.surface import CanonicalSurface, SurfaceSamples, sampled

NEAR = 0.03
"""Largest gap that counts as proximity, in bounding-box diagonals."""
OPPOSED = -0.3
"""Largest cosine between the normals of opposing points."""
SEEN_POINTS = 2000
"""Approximate number of points tested for proximity; larger surfaces are subsampled."""
MOST = 0.06
"""Largest measured thickness or gap, in bounding-box diagonals."""
N_SAMPLES = 5000
"""Minimum number of samples for thickness and gap."""
SEEN_SAMPLES = 10_000
"""Approximate number of samples at which they are measured."""
MOST_SHRINKINGS = 10
TOUCHING = 0.015
"""Distance below which points are in contact, in bounding-box diagonals."""
CELL = 0.005
"""Cell size of the subsampling for contact, in bounding-box diagonals."""


def self_proximity(surface: CanonicalSurface) -> float:
    """Fraction of the area with an opposing part of the surface close in front of it.

    Tetrahedra fuse parts in contact, so such a pose is a poor rest pose.
    """
    step = max(len(surface.points) // SEEN_POINTS, 1)
    points, normals = surface.points[::step], surface.normals[::step]
    tree = cKDTree(points)
    opposed = np.zeros(len(points), dtype=bool)
    for part in (1 / 16, 1 / 8, 1 / 4, 1 / 2):  # beyond half the gap, the opposing side is nearer than the point itself
        nearest = closest_in(tree, points + part * NEAR * CANONICAL_SIZE * normals)[1]
        opposed |= np.einsum("vi,vi->v", normals, normals[nearest]) < OPPOSED
    areas = vertex_areas(surface.points, surface.faces)[::step]
    return float(areas[opposed].sum() / areas.sum())


def separation(rest: CanonicalSurface, posed: CanonicalSurface) -> float:
    """Separation in one pose of parts in contact in another, in bounding-box diagonals.

    Root mean square over the surface of half the largest growth of a point's distance to its neighbours in space.
    Tetrahedra of the first pose join both parts, so they cannot follow a separation.

    Args:
        rest: The surface in the first pose.
        posed: The surface in the other pose.
    """
    cells = np.floor(rest.points / (CELL * CANONICAL_SIZE)).astype(np.int64)
    cells -= cells.min(axis=0)
    _, chosen, cell = np.unique(np.ravel_multi_index(tuple(cells.T), cells.max(axis=0) + 1), True, True)
    areas = np.bincount(cell.reshape(-1), vertex_areas(rest.points, rest.faces))
    # The diagonal, the unit of length here, depends on the pose; the area hardly does.
    before, after = rest.points[chosen], posed.points[chosen] * np.sqrt(rest.area / posed.area)
    one, other = cKDTree(before).query_pairs(TOUCHING * CANONICAL_SIZE, output_type="ndarray").T
    growth = np.linalg.norm(after[one] - after[other], axis=1) - np.linalg.norm(before[one] - before[other], axis=1)
    largest = np.zeros(len(chosen))
    for point in (one, other):
        np.maximum.at(largest, point, growth)
    return float(np.sqrt(np.average((largest / 2) ** 2, weights=areas))) / CANONICAL_SIZE


class Clearance(NamedTuple):
    """Thickness and gap at each face; infinite above `MOST`.

    Attributes:
        thickness: Thickness of the body behind the face. *Shape:* ``(F,)``.
        gap: Distance to the opposing part in front of the face. *Shape:* ``(F,)``.
    """

    thickness: FloatArray
    gap: FloatArray


def clearances(surface: CanonicalSurface) -> Clearance:
    """Diameters of the largest empty balls tangent to the surface at samples (shrinking balls)."""
    spacing = np.sqrt(surface.area / N_SAMPLES)
    samples = sampled(surface, np.full(len(surface.faces), spacing))
    seen = np.arange(0, len(samples.points), max(len(samples.points) // SEEN_SAMPLES, 1))
    found = []
    for side in (-1.0, 1.0):
        radii = _opposed_radius(samples, side, seen, MOST * CANONICAL_SIZE / 2)
        smallest = np.full(len(surface.faces), np.inf)
        np.minimum.at(smallest, samples.faces[seen], 2 * radii)
        found.append(smallest)
    return Clearance(*found)


def _opposed_radius(samples: SurfaceSamples, side: float, seen: IntArray, most: float) -> FloatArray:
    """Radii of the balls tangent to the surface at samples and at an opposing side.

    Balls shrink until they are empty (Ma, Bae and Choi 2012) or touch a side that is not opposing, as in a corner.

    Args:
        samples: Samples of a surface.
        side: 1 in front of the surface, -1 behind it.
        seen: Indices of the queried samples. *Shape:* ``(S,)``.
        most: Largest radius; larger ones are infinite.

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
