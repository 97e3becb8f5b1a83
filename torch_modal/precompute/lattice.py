"""A surface filled with a lattice of cubes, each cut into six tetrahedra: deterministic, and never at a loss."""

import itertools
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates
from scipy.spatial import cKDTree

from torch_modal.geometry.connectivity import connected_pieces
from torch_modal.precompute.surface import DIAGONAL, Surface
from torch_modal.precompute.tetrahedra import Tetrahedra, TetrahedralizationError, tet_volumes, without_debris

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

SAMPLES = 4
"""Samples of the inside along the edge of a cube."""
LEAST_INSIDE = 0.02
"""Tetrahedra with less of them inside are left out, or count as this much where the surface runs through them."""
MAX_SAMPLES = 4_000_000
REACH = 0.7
"""How far vertices are moved onto the surface, in cubes."""
LEAST_VOLUME = 0.05
"""Of a tetrahedron whose vertices were moved, in its volume before; else they go back."""
MOST_RETREATS = 8
FITTED_INSIDE = 0.4
"""Tetrahedra with less of them inside are left out once vertices lie on the surface."""
SPREAD = np.concatenate([np.eye(4) * 2 / 3 + 1 / 12, np.full((1, 4), 0.25)])
"""Points of a tetrahedron: from its corners a third of the way to the centroid, and the centroid."""


class Indicator(NamedTuple):
    """One inside a surface, zero outside, on the centres of a grid.

    Attributes:
        values: *Shape:* ``(X, Y, Z)``.
        low: Corner of the grid.
        spacing: Of its points.
    """

    values: FloatArray
    low: FloatArray
    spacing: float

    def inside(self, corners: FloatArray) -> FloatArray:
        """Which part of tetrahedra is inside. *Shape:* ``(T, 4, 3) -> (T,)``."""
        values = self.at(np.einsum("qa,tai->tqi", SPREAD, corners).reshape(-1, 3))
        return np.clip(values.reshape(len(corners), -1).mean(axis=1), 0.0, 1.0)

    def at(self, points: FloatArray) -> FloatArray:
        """Linear between the points of the grid. *Shape:* ``(P, 3) -> (P,)``."""
        places = (points - self.low) / self.spacing - 0.5
        return map_coordinates(self.values, places.T, order=1, mode="nearest")


def lattice(surface: Surface, edge_length_fac: float) -> Tetrahedra:
    """Cubes around a surface, cut into tetrahedra, with the outer vertices moved onto it where that is near.

    Tetrahedra count with the fraction of them that is inside. Needs no closed surface and no consistent one: what is
    inside follows from the normals of all faces together. Parts closer together than a cube are fused. The same surface
    always gives the same tetrahedra.

    Args:
        surface: What to fill.
        edge_length_fac: Edge of a cube as a fraction of the bounding-box diagonal.

    Raises:
        TetrahedralizationError: The lattice would be too fine, or nothing is inside.
    """
    cell = edge_length_fac * DIAGONAL
    low, counts = _box(surface, cell)
    if is_too_fine(surface, edge_length_fac):
        raise TetrahedralizationError(
            f"a lattice with cubes of {cell:g} % of the diagonal needs {counts.prod()} of them; give a larger "
            "edge_length_fac"
        )
    points, normals = _sampled(surface, cell / SAMPLES)
    values = _indicator(points, normals, low, cell / SAMPLES, counts * SAMPLES)
    indicator = Indicator(values, low, cell / SAMPLES)

    corner = np.stack(np.meshgrid(*(np.arange(c) for c in counts), indexing="ij"), axis=-1).reshape(-1, 3)
    touched = np.zeros(counts, dtype=bool)
    touched[tuple(((points - low) / cell).astype(np.int64).T)] = True
    steps = _paths()
    corners = low + cell * (corner[:, None, None] + steps).astype(np.float64)
    inside = indicator.inside(corners.reshape(-1, 4, 3)).reshape(len(corner), len(steps))
    kept = (inside >= LEAST_INSIDE) | touched.reshape(-1, 1)
    number = np.array([(counts[1] + 1) * (counts[2] + 1), counts[2] + 1, 1])
    tets = ((corner[:, None, None] + steps) @ number)[kept]
    used, compact = np.unique(tets, return_inverse=True)
    grid = np.stack(np.unravel_index(used, tuple(counts + 1)), axis=1)
    filled = Tetrahedra(low + cell * grid, compact.reshape(-1, 4), np.maximum(inside[kept], LEAST_INSIDE))
    return _fitted(without_debris(filled), points, normals, indicator, cell)


def is_too_fine(surface: Surface, edge_length_fac: float) -> bool:
    """Whether a lattice with such cubes would have too many of them."""
    return bool(_box(surface, edge_length_fac * DIAGONAL)[1].prod() * SAMPLES**3 > MAX_SAMPLES)


def _box(surface: Surface, cell: float) -> tuple[FloatArray, IntArray]:
    """Lowest corner of the cubes, and their numbers along the axes."""
    low = surface.points.min(axis=0) - 1.5 * cell
    return low, np.ceil((surface.points.max(axis=0) + 1.5 * cell - low) / cell).astype(np.int64)


def _fitted(
    filled: Tetrahedra, points: FloatArray, normals: FloatArray, indicator: Indicator, cell: float
) -> Tetrahedra:
    """The outer vertices moved onto the surface, along its normals, and without what is outside then.

    Modes are then those of tetrahedra that follow the surface. What is thinner than a cube may fall into pieces or get
    lost: then everything stays as it was.
    """
    rim = np.unique(filled.tets[np.asarray(filled.inside) < 1 - LEAST_INSIDE])
    distance, nearest = cKDTree(points).query(filled.vertices[rim], distance_upper_bound=REACH * cell)
    rim, nearest = rim[np.isfinite(distance)], nearest[np.isfinite(distance)]
    normal = normals[nearest] / np.maximum(np.linalg.norm(normals[nearest], axis=1, keepdims=True), 1e-300)
    height = np.einsum("vi,vi->v", filled.vertices[rim] - points[nearest], normal)
    vertices = filled.vertices.copy()
    vertices[rim] -= height[:, None] * normal
    least, retreated = LEAST_VOLUME * cell**3 / 6, np.zeros(len(vertices), dtype=bool)
    for retreat in range(MOST_RETREATS):
        bad = np.unique(filled.tets[tet_volumes(Tetrahedra(vertices, filled.tets)) < least])
        # Half the way back at first; as no vertex is out of its cube's reach then, all the way is always right.
        part = 1.0 if retreat >= MOST_RETREATS // 2 else 0.5
        vertices[bad] += part * (filled.vertices[bad] - vertices[bad])
        retreated[bad] = True
    retreated &= indicator.at(vertices) < 0.5
    inside = indicator.inside(vertices[filled.tets])
    kept = inside >= FITTED_INSIDE
    # The indicator rises over a cube's fraction. Of a tetrahedron with no corner outside, all is inside.
    placed = indicator.at(vertices) >= 0.5
    placed[rim[(vertices[rim] != filled.vertices[rim]).any(axis=1)]] = True
    placed[retreated] = False
    inside[placed[filled.tets].all(axis=1)] = 1.0
    used, compact = np.unique(filled.tets[kept], return_inverse=True)
    fitted = without_debris(Tetrahedra(vertices[used], compact.reshape(-1, 4), inside[kept]))
    if len(fitted.tets) == 0 or _n_pieces(fitted) != _n_pieces(filled):
        return filled
    is_covered = cKDTree(fitted.vertices).query(points, distance_upper_bound=1.5 * cell)[0] < np.inf
    return fitted if is_covered.all() else filled


def _n_pieces(tetrahedra: Tetrahedra) -> int:
    pairs = tetrahedra.tets[:, [0, 1, 0, 2, 0, 3]].reshape(-1, 2)
    return int(connected_pieces(pairs, len(tetrahedra.vertices)).max()) + 1


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
