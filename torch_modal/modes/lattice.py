"""Graded lattice of tetrahedra inside a surface: cubes cut into tetrahedra and bisected where the body is thin.

Deterministic; accepts every surface.
"""

import itertools
import threading
from dataclasses import dataclass

import numpy as np
from scipy.fft import irfftn, next_fast_len, rfftn
from scipy.ndimage import map_coordinates
from scipy.spatial import cKDTree

from torch_modal.arrays import BoolArray, FloatArray, IntArray
from torch_modal.geometry.canonical import CANONICAL_SIZE
from torch_modal.geometry.surface import Surface
from torch_modal.modes.bisection import bisect
from torch_modal.modes.surface import SurfaceSamples, clearances
from torch_modal.modes.tetrahedra import (
    Tetrahedra,
    face_connected_pieces,
    solid_volumes,
    submesh,
    tet_volumes,
    without_debris,
)
from torch_modal.threads import n_threads

VERSION = "whole"
"""Part of the cache key: change it when the algorithm changes."""
COARSER = 1.1
"""Factor by which cubes grow until their number is within the limit."""
GENERIC_ROTATION = np.array([[2.0, -1.0, 2.0], [2.0, 2.0, -1.0], [-1.0, 2.0, 2.0]]) / 3
"""Rotation that aligns no axis with another."""
ROOT = 2.0
"""Edge length of the root cubes, relative to the cubes at the surface."""
ACROSS = 2.0
"""Tetrahedra across the thickness; a gap has one."""
SMALLEST_TETRAHEDRON = 1 / 12
"""Smallest tetrahedron size, relative to the largest at the surface."""
MOST_TETRAHEDRA = 12_000
"""Approximate limit before the fit to the surface; it grows with the volume in units of finer cubes."""
USUAL_CUBE = 0.03
"""Edge length of the cubes to which the limit applies, in sizes."""
MOST_CUBES = 20_000
"""Limit of the number of root cubes."""
SAMPLES_APART = 0.7
"""Spacing of the surface samples, relative to the local tetrahedron size."""
FEWEST_SAMPLES = 5000
GRID_SPACING = 0.5
"""Spacing of the indicator grid, relative to the smallest tetrahedra, unless the number of points is at its limit."""
MOST_POINTS = 600_000
SURELY_INSIDE = 0.9
"""Indicator values below are corrected near the surface; values above occur where closed parts overlap."""
NEARBY = 1.5
"""Range of the correction, in grid spacings."""
RAMP = 0.25
"""Width of the corrected transition, in grid spacings."""
LEAST_INSIDE = 0.02
"""Inside fraction below which tetrahedra are removed; lower bound for those that contain surface samples."""
LARGEST_MOVE = 0.7
"""Largest displacement onto the surface, relative to the smallest incident tetrahedron."""
LEAST_VOLUME = 0.05
"""Smallest volume ratio of moved tetrahedra; otherwise their vertices retreat."""
MOST_RETREATS = 8
FITTED_INSIDE = 0.4
"""Inside fraction below which tetrahedra are removed after the fit to the surface."""
MOST_BRIDGES = 4
LEAST_KEPT = 0.8
"""Volume fraction that the fit must retain; otherwise the body is too thin for it."""
QUADRATURE_POINTS = np.concatenate([np.eye(4) * 2 / 3 + 1 / 12, np.full((1, 4), 0.25)])
"""Barycentric coordinates of the quadrature points of a tetrahedron."""


@dataclass(frozen=True)
class Lattice:
    """The mesher ``"lattice"``: :func:`lattice`, with a rotated grid if the result falls into pieces.

    Tetrahedra around a thin wall along the faces of the cubes share hardly any faces with each other.

    Attributes:
        cube: Edge length of the cubes where nothing is thin, as a fraction of the size of the surface; larger ones are
            taken if there would be too many.

    Raises:
        ValueError: ``cube`` is out of range.
    """

    cube: float = USUAL_CUBE

    def __post_init__(self) -> None:
        if not 0 < self.cube <= 1:
            raise ValueError(f"cube is {self.cube}; give a number above 0, up to 1")

    def key(self) -> dict[str, object]:
        """The edge length and the version."""
        return {"mesher": "lattice", "cube": self.cube, "version": VERSION}

    def fill(self, surface: Surface, stop: threading.Event) -> Tetrahedra:
        """Fill a surface with tetrahedra."""
        tetrahedra = lattice(surface, self.cube)
        if (n_pieces := face_connected_pieces(tetrahedra.tets).max()) <= surface.connectivity.vertex_pieces.max():
            return tetrahedra
        rotated = lattice(Surface(surface.vertices @ GENERIC_ROTATION.T, surface.connectivity), self.cube)
        better = face_connected_pieces(rotated.tets).max() < n_pieces
        return rotated._replace(vertices=rotated.vertices @ GENERIC_ROTATION) if better else tetrahedra


class Indicator:
    """Indicator function of the interior, from the normals of samples of the surface (Poisson reconstruction).

    Its gradient is the inward normal on the surface, so it solves a Poisson equation with the divergence of the
    normals: in trilinear finite elements, by one Fourier transform. Holes of open surfaces are closed smoothly.

    Args:
        samples: Surface samples; their tangent planes correct the indicator near the surface.
        has_sides: Whether a sample is used for that; false at the boundary of an open surface. *Shape:* ``(P,)``.
        low: Lowest corner of the grid.
        spacing: Grid spacing.
        counts: Numbers of grid points. *Shape:* ``(3,)``.
    """

    def __init__(
        self, samples: SurfaceSamples, has_sides: BoolArray, low: FloatArray, spacing: float, counts: IntArray
    ) -> None:
        self.samples, self.has_sides, self.low, self.spacing = samples, has_sides, low, spacing
        places = (samples.points - low) / spacing
        base = np.floor(places).astype(np.int64)
        fraction = np.ascontiguousarray((places - base).T)
        normals = np.ascontiguousarray((samples.normals * samples.areas[:, None]).T)
        index = np.ravel_multi_index(tuple(base.T), tuple(counts))
        size = int(counts.prod())
        divergence = np.zeros(size)
        for step in itertools.product((0, 1), repeat=3):
            share = np.where(np.array(step)[:, None], fraction, 1 - fraction)
            slope = np.where(step, 1.0, -1.0)
            weight = sum(normals[a] * slope[a] * share[a - 1] * share[a - 2] for a in range(3))
            divergence += np.bincount(index + np.ravel_multi_index(step, tuple(counts)), weight, minlength=size)

        waves = [2 * np.pi * np.fft.fftfreq(n) for n in counts[:2]] + [2 * np.pi * np.fft.rfftfreq(counts[2])]
        x, y, z = np.meshgrid(*waves, indexing="ij", sparse=True)
        stiff, mass = [2 - 2 * np.cos(k) for k in (x, y, z)], [(2 + np.cos(k)) / 3 for k in (x, y, z)]
        laplacian = sum(stiff[a] * mass[a - 1] * mass[a - 2] for a in range(3))
        laplacian[0, 0, 0] = 1.0
        transformed = rfftn(divergence.reshape(counts), overwrite_x=True) / laplacian
        transformed[0, 0, 0] = 0.0
        solution = -irfftn(transformed, s=tuple(counts), overwrite_x=True) / spacing**2
        rim = np.ones(counts, dtype=bool)
        rim[1:-1, 1:-1, 1:-1] = False
        #: Values at the grid points. *Shape:* ``(X, Y, Z)``.
        self.values = np.ascontiguousarray(solution - solution[rim].mean())

    def inside(self, corners: FloatArray) -> FloatArray:
        """Inside fraction of tetrahedra. *Shape:* ``(T, 4, 3) -> (T,)``."""
        values = self.at(np.einsum("qa,tai->tqi", QUADRATURE_POINTS, corners).reshape(-1, 3))
        return values.reshape(len(corners), -1).mean(axis=1)

    def at(self, points: FloatArray) -> FloatArray:
        """Trilinear interpolation, with a sharper transition near the surface. *Shape:* ``(P, 3) -> (P,)``."""
        values = map_coordinates(self.values, ((points - self.low) / self.spacing).T, order=1, mode="nearest")
        doubtful = np.flatnonzero(values < SURELY_INSIDE)
        reach = NEARBY * self.spacing
        distance, nearest = self.samples.tree.query(points[doubtful], distance_upper_bound=reach, workers=n_threads())
        # Beyond the boundary of an open surface there is no tangent plane.
        near = np.isfinite(distance) & np.append(self.has_sides, False)[nearest]
        doubtful, nearest = doubtful[near], nearest[near]
        offset = points[doubtful] - self.samples.points[nearest]
        height = np.einsum("vi,vi->v", offset, self.samples.normals[nearest])
        values[doubtful] = 0.5 - height / (RAMP * self.spacing)
        return np.clip(values, 0.0, 1.0)


def lattice(surface: Surface, cube: float) -> Tetrahedra:
    """Fill a surface with a graded lattice of tetrahedra, with the outer vertices moved onto the surface.

    Tetrahedra are bisected where the body or a gap is thin. Each has the fraction of its volume that is inside. The
    surface need not be closed or consistent: the interior follows from the normals of all faces. Parts closer together
    than a tetrahedron are fused. Deterministic. Where nothing is thin, cubes have the edge length ``cube``, in sizes.
    """
    largest = cube * CANONICAL_SIZE
    while True:
        root = ROOT * largest
        low = surface.vertices.min(axis=0) - 1.5 * root
        counts = np.ceil((surface.vertices.max(axis=0) + 1.5 * root - low) / root).astype(np.int64)
        if counts.prod() <= MOST_CUBES:
            break
        largest *= COARSER
    thickness, gap = clearances(surface)
    sizes = np.clip(np.minimum(thickness / ACROSS, gap), SMALLEST_TETRAHEDRON * largest, largest)
    samples = SurfaceSamples(surface, np.minimum(SAMPLES_APART * sizes, (surface.area / FEWEST_SAMPLES) ** 0.5))
    points, wanted = samples.points, sizes[samples.faces]
    spacing = max(GRID_SPACING * wanted.min(), (np.prod(counts * root) / MOST_POINTS) ** (1 / 3))
    grid = [next_fast_len(int(np.ceil(length)) + 1, real=True) for length in counts * root / spacing]
    has_sides = np.asarray(~np.isin(surface.faces[samples.faces], surface.connectivity.boundary_edges).any(axis=1))
    indicator = Indicator(samples, has_sides, low, spacing, np.array(grid))

    def is_inside(places: FloatArray) -> BoolArray:
        return indicator.at(low + root * places) >= 0.5

    corner = np.stack(np.meshgrid(*(np.arange(c) for c in counts), indexing="ij"), axis=-1).reshape(-1, 3)
    cubes = np.zeros(counts, dtype=bool)
    cubes[tuple(((points - low) / root).astype(np.int64).T)] = True
    cubes[tuple(corner[is_inside(corner + 0.5)].T)] = True
    most = int(MOST_TETRAHEDRA * max(1.0, USUAL_CUBE * CANONICAL_SIZE / largest) ** 3)
    cut, owner = bisect(np.argwhere(cubes), (points - low) / root, wanted / root, is_inside, most)
    vertices, tets = low + root * cut.vertices, cut.tets
    inside = indicator.inside(vertices[tets])
    kept = inside >= LEAST_INSIDE
    kept[owner] = True
    kept = _bridge(tets, kept, np.ones(len(kept), dtype=bool))
    filled = submesh(Tetrahedra(vertices, tets, np.maximum(inside, LEAST_INSIDE)), kept)
    return _fit(without_debris(filled), indicator)


def _fit(filled: Tetrahedra, indicator: Indicator) -> Tetrahedra:
    """Move outer vertices onto the surface, unless that splits the mesh, loses volume or uncovers the surface."""
    samples = indicator.samples
    volumes = tet_volumes(filled)
    # At each vertex the edge length of the cube with six times the volume of the smallest incident tetrahedron.
    sizes = np.full(len(filled.vertices), np.inf)
    np.minimum.at(sizes, filled.tets.reshape(-1), np.repeat(np.cbrt(6 * volumes), 4))
    rim = np.unique(filled.tets[np.asarray(filled.inside) < 1 - LEAST_INSIDE])
    distance, nearest = samples.tree.query(filled.vertices[rim], workers=n_threads())
    near = distance < LARGEST_MOVE * sizes[rim]
    rim, nearest = rim[near], nearest[near]
    height = np.einsum("vi,vi->v", filled.vertices[rim] - samples.points[nearest], samples.normals[nearest])
    vertices = filled.vertices.copy()
    vertices[rim] -= height[:, None] * samples.normals[nearest]
    retreated = np.zeros(len(vertices), dtype=bool)
    for retreat in range(MOST_RETREATS):
        bad = np.unique(filled.tets[tet_volumes(Tetrahedra(vertices, filled.tets)) < LEAST_VOLUME * volumes])
        # Half the way back at first, then all the way, which restores the original position.
        retreat_factor = 1.0 if retreat >= MOST_RETREATS // 2 else 0.5
        vertices[bad] += retreat_factor * (filled.vertices[bad] - vertices[bad])
        retreated[bad] = True
    placed = indicator.at(vertices) >= 0.5
    retreated &= ~placed
    inside = indicator.inside(vertices[filled.tets])
    kept = inside >= FITTED_INSIDE
    # A tetrahedron with no corner outside is inside, although the indicator has a transition.
    placed[rim[(vertices[rim] != filled.vertices[rim]).any(axis=1)]] = True
    placed[retreated] = False
    inside[placed[filled.tets].all(axis=1)] = 1.0
    kept = _bridge(filled.tets, kept, inside > 0)
    moved = Tetrahedra(vertices, filled.tets, np.maximum(inside, LEAST_INSIDE))
    fitted = without_debris(submesh(moved, kept))
    if len(fitted.tets) == 0 or face_connected_pieces(fitted.tets).max() != face_connected_pieces(filled.tets).max():
        return filled
    if solid_volumes(fitted).sum() < LEAST_KEPT * solid_volumes(filled).sum():
        return filled
    reach = 1.5 * sizes[filled.tets].max(axis=1).max()
    distance, _ = cKDTree(fitted.vertices).query(samples.points, distance_upper_bound=reach, workers=n_threads())
    return fitted if np.isfinite(distance).all() else filled


def _bridge(tets: IntArray, kept: BoolArray, allowed: BoolArray) -> BoolArray:
    """Keep further tetrahedra that join pieces which share only an edge or a vertex. *Shape:* ``(T,)``."""
    kept = kept.copy()
    for _ in range(MOST_BRIDGES):
        piece = face_connected_pieces(tets[kept])
        lowest, highest = np.full(tets.max() + 1, len(tets)), np.full(tets.max() + 1, -1)
        np.minimum.at(lowest, tets[kept].reshape(-1), np.repeat(piece, 4))
        np.maximum.at(highest, tets[kept].reshape(-1), np.repeat(piece, 4))
        joining = ~kept & allowed & (lowest[tets].min(axis=1) < highest[tets].max(axis=1))
        if not joining.any():
            break
        kept |= joining
    return kept
