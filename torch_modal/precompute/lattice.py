"""A surface filled with a lattice of cubes, each cut into six tetrahedra: deterministic, and never at a loss."""

import itertools

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from torch_modal.precompute.surface import DIAGONAL, Surface
from torch_modal.precompute.tetrahedra import Tetrahedra, TetrahedralizationError, without_debris

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

SAMPLES = 4
"""Samples of the inside along the edge of a cube."""
LEAST_INSIDE = 0.02
"""Tetrahedra with less of them inside are left out, or count as this much where the surface runs through them."""
MAX_SAMPLES = 4_000_000


def lattice(surface: Surface, edge_length_fac: float) -> Tetrahedra:
    """Cubes around a surface, cut into tetrahedra that count with the fraction of them that is inside.

    Needs no closed surface and no consistent one: what is inside follows from the normals of all faces together.
    Parts closer together than a cube are fused. The same surface always gives the same tetrahedra.

    Args:
        surface: What to fill.
        edge_length_fac: Edge of a cube as a fraction of the bounding-box diagonal.

    Raises:
        TetrahedralizationError: The lattice would be too fine, or nothing is inside.
    """
    cell = edge_length_fac * DIAGONAL
    low = surface.points.min(axis=0) - 1.5 * cell
    counts = np.ceil((surface.points.max(axis=0) + 1.5 * cell - low) / cell).astype(np.int64)
    if counts.prod() * SAMPLES**3 > MAX_SAMPLES:
        raise TetrahedralizationError(
            f"a lattice with cubes of {cell:g} % of the diagonal needs {counts.prod()} of them; give a larger "
            "edge_length_fac"
        )
    points, normals = _sampled(surface, cell / SAMPLES)
    indicator = _indicator(points, normals, low, cell / SAMPLES, counts * SAMPLES)

    corner = np.stack(np.meshgrid(*(np.arange(c) for c in counts), indexing="ij"), axis=-1).reshape(-1, 3)
    touched = np.zeros(counts, dtype=bool)
    touched[tuple(((points - low) / cell).astype(np.int64).T)] = True
    steps = _paths()
    # Points spread over each tetrahedron: from its corners a third of the way to the centroid, and the centroid.
    spread = np.concatenate([np.eye(4) * 2 / 3 + 1 / 12, np.full((1, 4), 0.25)])
    offsets = np.einsum("qa,pai->pqi", spread, steps.astype(np.float64))
    places = (corner[:, None, None] + offsets) * SAMPLES - 0.5
    inside = map_coordinates(indicator, places.reshape(-1, 3).T, order=1, mode="nearest")
    inside = np.clip(inside.reshape(len(corner), len(steps), -1).mean(axis=2), 0.0, 1.0)

    kept = (inside >= LEAST_INSIDE) | touched.reshape(-1, 1)
    number = np.array([(counts[1] + 1) * (counts[2] + 1), counts[2] + 1, 1])
    tets = ((corner[:, None, None] + steps) @ number)[kept]
    used, compact = np.unique(tets, return_inverse=True)
    grid = np.stack(np.unravel_index(used, tuple(counts + 1)), axis=1)
    filled = Tetrahedra(low + cell * grid, compact.reshape(-1, 4), np.maximum(inside[kept], LEAST_INSIDE))
    return without_debris(filled)


def _paths() -> IntArray:
    """Corners of the six tetrahedra of a cube, with positive volumes. *Shape:* ``(6, 4, 3)``.

    Each is a path from the corner (0, 0, 0) to (1, 1, 1), so that neighbouring cubes cut their common side alike.
    """
    paths = []
    for order in itertools.permutations(range(3)):
        path = np.zeros((4, 3), dtype=np.int64)
        for i, axis in enumerate(order):
            path[i + 1 :, axis] += 1
        odd = np.linalg.det(np.diff(path, axis=0)) < 0
        paths.append(path[[1, 0, 2, 3]] if odd else path)
    return np.stack(paths)


def _sampled(surface: Surface, spacing: float) -> tuple[FloatArray, FloatArray]:
    """Points over all faces, about ``spacing`` apart, and their shares of the area times the normal."""
    corners = surface.points[surface.faces]
    sides = corners - np.roll(corners, 1, axis=1)
    n_cuts = np.maximum(np.ceil(np.linalg.norm(sides, axis=2).max(axis=1) / spacing), 1).astype(np.int64)
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]) / 2
    points, shares = [], []
    for n in np.unique(n_cuts):
        chosen = n_cuts == n
        # Centroids of the n² congruent parts of a triangle.
        up = np.array([(3 * i + 1, 3 * j + 1) for i in range(n) for j in range(n - i)])
        down = np.array([(3 * i + 2, 3 * j + 2) for i in range(n - 1) for j in range(n - 1 - i)]).reshape(-1, 2)
        uv = np.concatenate([up, down]) / (3 * n)
        weights = np.concatenate([1 - uv.sum(axis=1, keepdims=True), uv], axis=1)
        points.append(np.einsum("qa,fai->fqi", weights, corners[chosen]).reshape(-1, 3))
        shares.append(np.repeat(normals[chosen] / n**2, n**2, axis=0))
    return np.concatenate(points), np.concatenate(shares)


def _indicator(
    points: FloatArray, normals: FloatArray, low: FloatArray, spacing: float, counts: IntArray
) -> FloatArray:
    """One inside, zero outside, on the centres of a grid.

    Its gradient is minus the normal on the surface, so it solves a Poisson equation with the divergence of the
    normals: by Fourier transform, once. On an open surface it closes the holes smoothly.
    """
    # Shares of the normals at the grid, linear between its points.
    places = (points - low) / spacing - 0.5
    base = np.floor(places).astype(np.int64)
    part = places - base
    size = int(counts.prod())
    field = np.zeros((3, size))
    for step in itertools.product((0, 1), repeat=3):
        weight = np.where(step, part, 1 - part).prod(axis=1)
        index = np.ravel_multi_index(tuple((base + step).T), tuple(counts), mode="clip")
        for axis in range(3):
            field[axis] += np.bincount(index, weight * normals[:, axis], minlength=size)

    waves = [2 * np.pi * np.fft.fftfreq(n) for n in counts[:2]] + [2 * np.pi * np.fft.rfftfreq(counts[2])]
    k = np.meshgrid(*waves, indexing="ij")
    squared = sum(axis**2 for axis in k)
    squared[0, 0, 0] = 1.0
    transformed = sum(1j * k[axis] * np.fft.rfftn(field[axis].reshape(counts)) for axis in range(3)) / squared
    transformed[0, 0, 0] = 0.0
    solution = np.fft.irfftn(transformed, s=tuple(counts), axes=(0, 1, 2)) / spacing**2
    rim = np.ones(counts, dtype=bool)
    rim[1:-1, 1:-1, 1:-1] = False
    return solution - solution[rim].mean()
