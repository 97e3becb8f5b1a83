"""Maps between two coarse shapes, from their spectra or from landmarks.

A map gives each vertex of the first shape a vertex of the second, ``(n_first,)``. It follows from rows of
eigenfunctions: those of near-isometric shapes agree up to the functional map (Ovsjanikov et al. 2012).
"""

import itertools
from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np

from torch_modal.arrays import FloatArray, IntArray
from torch_modal.registration.spectrum import SpectralShape

COARSE_FUNCTIONS = 20
FINE_FUNCTIONS = 50
N_OTHER_STARTS = 6
"""Number of initial maps besides the sign patterns."""
N_REFINED = 4
"""Number of fully refined maps."""
_STEP = 3

# Weight of the round-trip error, for a surface of unit area, relative to the oriented area.
_ROUND_TRIP = 3.0
# Relative and absolute stretch above which a triangle counts as torn.
_TORN = (2.5, 0.03)
# Smallest fraction of the area that is the denominator of the score, if many triangles collapse.
_LEAST_COUNTED = 0.3


class Map(NamedTuple):
    """A map and its score."""

    vertices: IntArray
    """*Shape:* ``(n_first,)``."""
    score: float
    """See `rate`; correct maps of one subject have 0.7 or more."""
    mirrored_score: float = -np.inf
    """Score for the mirrored target, from `spectral_maps`."""


def nearest_rows(queries: FloatArray, rows: FloatArray) -> IntArray:
    """Index of the nearest row. Dense: trees are no faster in fifty dimensions. *Shape:* ``(n, k), (m, k) -> (n,)``."""
    queries, rows = queries.astype(np.float32), rows.astype(np.float32)
    half = 0.5 * (rows * rows).sum(1)
    return np.concatenate(
        [(part @ rows.T - half).argmax(1) for part in np.array_split(queries, len(queries) // 2048 + 1)]
    )


def zoom_out(first: SpectralShape, second: SpectralShape, vertices: IntArray, start: int, stop: int) -> IntArray:
    """Refine a map with an increasing number of eigenfunctions (ZoomOut, Melzi et al. 2019).

    Args:
        first: *n_first vertices.*
        second: *n_second vertices.*
        vertices: The map. *Shape:* ``(n_first,)``.
        start: Initial number of eigenfunctions.
        stop: Final number of eigenfunctions.
    """
    stop = min(stop, first.functions.shape[1], second.functions.shape[1])
    for k in [*range(min(start, stop), stop, _STEP), stop]:
        functional = functional_map(first, second, vertices, k)
        vertices = nearest_rows(first.functions[:, :k], second.functions[:, :k] @ functional.T)
    return vertices


def functional_map(first: SpectralShape, second: SpectralShape, vertices: IntArray, k: int) -> FloatArray:
    """Matrix of the pull-back of functions from the second shape to the first. *Shape:* ``(k, k)``."""
    return first.functions[:, :k].T @ (first.mass[:, None] * second.functions[vertices, :k])


def rate(first: SpectralShape, second: SpectralShape, vertices: IntArray, k: int) -> float:
    """Score: oriented area of the worse direction minus three times the mean round-trip error.

    Mirrored maps have negative oriented area.
    """
    return rates(first, second, vertices, k)[0]


def rates(first: SpectralShape, second: SpectralShape, vertices: IntArray, k: int) -> tuple[float, float]:
    """Scores for the second shape and its mirror image."""
    k = min(k, first.functions.shape[1], second.functions.shape[1])
    functional = functional_map(first, second, vertices, k)
    back = nearest_rows(second.functions[:, :k] @ functional.T, first.functions[:, :k])
    kept = _oriented_area(first, second, vertices), _oriented_area(second, first, back)
    away = np.linalg.norm(first.coarse.vertices[back[vertices]] - first.coarse.vertices, axis=1).mean()
    return float(min(kept) - _ROUND_TRIP * away), float(-max(kept) - _ROUND_TRIP * away)


def _oriented_area(first: SpectralShape, second: SpectralShape, vertices: IntArray) -> float:
    """Fraction of the first shape's area with an untorn, outward image minus that with an inward image."""
    faces = first.coarse.faces
    image = second.coarse.vertices[vertices][faces]
    area_vectors = np.cross(image[:, 1] - image[:, 0], image[:, 2] - image[:, 0])
    normals = second.coarse.vertex_normals[vertices][faces].mean(1)
    own = first.coarse.vertices[faces]
    before, after = (np.linalg.norm(x - np.roll(x, 1, axis=1), axis=2).max(1) for x in (own, image))
    whole = after < _TORN[0] * before + _TORN[1]
    sign = np.sign(np.einsum("fi,fi->f", area_vectors, normals))
    # Faces that collapse, because the other mesh is coarser, do not count.
    counted = first.coarse.face_areas[sign != 0].sum()
    total = max(counted, _LEAST_COUNTED * first.coarse.area)
    return float((first.coarse.face_areas * whole * sign).sum() / total)


def landmark_map(first: SpectralShape, second: SpectralShape, pairs: IntArray) -> Map:
    """Refined map from geodesic distances to landmarks.

    Args:
        first: The first shape.
        second: The second.
        pairs: Coarse vertices of both. *Shape:* ``(n, 2)``.
    """
    signatures = []
    for shape, sources in ((first, pairs[:, 0]), (second, pairs[:, 1])):
        distances = shape.geodesics_from(sources)
        signatures.append(distances / distances.max(0))  # proportions differ
    vertices = nearest_rows(*signatures)
    vertices = zoom_out(first, second, vertices, 8, FINE_FUNCTIONS)
    return Map(vertices, rate(first, second, vertices, FINE_FUNCTIONS))


def spectral_maps(
    first: SpectralShape,
    second: SpectralShape,
    n_signs: int = 4,
    tick: Callable[[], None] = lambda: None,
) -> list[Map]:
    """The best maps from spectra, best first; the last is the best map to the mirrored target.

    The initial maps are all sign patterns of the lowest eigenfunctions, wave kernel signatures and rigid alignments of
    principal axes. All are refined with few eigenfunctions, the best with all.

    Args:
        first: The first shape.
        second: The second.
        n_signs: Number of eigenfunctions with both signs: ``2**n_signs`` initial maps.
        tick: Called after each initial map.
    """
    coarse = []
    for vertices, k in _starts(first, second, n_signs):
        vertices = zoom_out(first, second, vertices, k, COARSE_FUNCTIONS)
        coarse.append(Map(vertices, *rates(first, second, vertices, COARSE_FUNCTIONS)))
        tick()
    coarse.sort(key=lambda found: -found.score)
    fine = []
    for found in [*coarse[:N_REFINED], max(coarse, key=lambda found: found.mirrored_score)]:
        vertices = zoom_out(first, second, found.vertices, COARSE_FUNCTIONS, FINE_FUNCTIONS)
        fine.append(Map(vertices, *rates(first, second, vertices, FINE_FUNCTIONS)))
    return [*sorted(fine[:-1], key=lambda found: -found.score), fine[-1]]


def _starts(first: SpectralShape, second: SpectralShape, n_signs: int) -> Iterator[tuple[IntArray, int]]:
    """Initial maps, and the number of eigenfunctions for their refinement."""
    k = n_signs + 1
    for signs in itertools.product([1.0, -1.0], repeat=n_signs):
        yield nearest_rows(first.functions[:, :k], second.functions[:, :k] * [1.0, *signs]), k
    yield nearest_rows(first.wave_kernel_signatures(), second.wave_kernel_signatures()), 6
    for points, normals in _placements(first, second):
        here, there = points, second.coarse.vertices - _centroid(second)
        yield nearest_rows(np.hstack([here, 0.1 * normals]), np.hstack([there, 0.1 * second.coarse.vertex_normals])), 12


def _placements(first: SpectralShape, second: SpectralShape) -> Iterator[tuple[FloatArray, FloatArray]]:
    """Centred positions and normals of the first shape, unrotated and aligned by principal axes."""
    points, normals = first.coarse.vertices - _centroid(first), first.coarse.vertex_normals
    yield points, normals
    axes = []
    for shape in (first, second):
        centred = shape.coarse.vertices - _centroid(shape)
        frame = np.linalg.eigh(centred.T @ (shape.coarse.vertex_areas[:, None] * centred))[1]
        axes.append(frame * [1, 1, np.sign(np.linalg.det(frame))])
    for signs in ([1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]):
        rotation = axes[0] * signs @ axes[1].T
        yield points @ rotation, normals @ rotation


def _centroid(shape: SpectralShape) -> FloatArray:
    weights = shape.coarse.vertex_areas
    return weights @ shape.coarse.vertices / weights.sum()
