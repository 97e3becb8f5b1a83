"""Maps between two coarse shapes, from their spectra or from landmarks.

A map gives each vertex of the first shape one of the second, ``(n_first,)``. Rows of eigenfunctions are compared:
near-isometric shapes have the same ones up to a small orthogonal matrix, the functional map (Ovsjanikov et al. 2012).
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
"""Beside the patterns of signs."""
_STEP = 3

# How much an error of the way there and back, in lengths of a surface of area one, weighs against right area.
_ROUND_TRIP = 3.0
# A triangle whose image is longer than so many times its own length, and a bit, is torn.
_TORN = (2.5, 0.03)
# At least so much of the area counts, even if more than the rest of it falls together.
_LEAST_COUNTED = 0.3


class Map(NamedTuple):
    """A map and how good it looks."""

    vertices: IntArray
    """*Shape:* ``(n_first,)``."""
    score: float
    """Right maps of one subject reach 0.7 and more, wrong ones hardly; see `rate`."""
    mirrored_score: float = -np.inf
    """The same if the target were mirrored; known of those that `spectral_maps` finds."""


def nearest_rows(queries: FloatArray, rows: FloatArray) -> IntArray:
    """Index of the nearest row. Dense: trees are no faster in fifty dimensions. *Shape:* ``(n, k), (m, k) -> (n,)``."""
    queries, rows = queries.astype(np.float32), rows.astype(np.float32)
    half = 0.5 * (rows * rows).sum(1)
    return np.concatenate(
        [(part @ rows.T - half).argmax(1) for part in np.array_split(queries, len(queries) // 2048 + 1)]
    )


def zoom_out(first: SpectralShape, second: SpectralShape, vertices: IntArray, start: int, stop: int) -> IntArray:
    """Refine a map by more and more eigenfunctions (ZoomOut, Melzi et al. 2019).

    Args:
        first: *n_first vertices.*
        second: *n_second vertices.*
        vertices: The map. *Shape:* ``(n_first,)``.
        start: Eigenfunctions at first.
        stop: And at last.
    """
    stop = min(stop, first.functions.shape[1], second.functions.shape[1])
    for k in [*range(min(start, stop), stop, _STEP), stop]:
        functional = functional_map(first, second, vertices, k)
        vertices = nearest_rows(first.functions[:, :k], second.functions[:, :k] @ functional.T)
    return vertices


def functional_map(first: SpectralShape, second: SpectralShape, vertices: IntArray, k: int) -> FloatArray:
    """Functions on the second, pulled back to the first, in both bases. *Shape:* ``(k, k)``."""
    return first.functions[:, :k].T @ (first.mass[:, None] * second.functions[vertices, :k])


def rate(first: SpectralShape, second: SpectralShape, vertices: IntArray, k: int) -> float:
    """Area that keeps its orientation, of the worse direction, minus thrice the mean error of the way there and back.

    Mirrored maps turn all area over, and so lose.
    """
    return rates(first, second, vertices, k)[0]


def rates(first: SpectralShape, second: SpectralShape, vertices: IntArray, k: int) -> tuple[float, float]:
    """The same, and what it would be if the second shape were mirrored."""
    k = min(k, first.functions.shape[1], second.functions.shape[1])
    functional = functional_map(first, second, vertices, k)
    back = nearest_rows(second.functions[:, :k] @ functional.T, first.functions[:, :k])
    kept = _oriented_area(first, second, vertices), _oriented_area(second, first, back)
    away = np.linalg.norm(first.coarse.vertices[back[vertices]] - first.coarse.vertices, axis=1).mean()
    return float(min(kept) - _ROUND_TRIP * away), float(-max(kept) - _ROUND_TRIP * away)


def _oriented_area(first: SpectralShape, second: SpectralShape, vertices: IntArray) -> float:
    """Part of the first's area whose image is whole and looks outwards, minus what looks inwards."""
    faces = first.coarse.faces
    image = second.coarse.vertices[vertices][faces]
    area_vectors = np.cross(image[:, 1] - image[:, 0], image[:, 2] - image[:, 0])
    normals = second.coarse.vertex_normals[vertices][faces].mean(1)
    own = first.coarse.vertices[faces]
    before, after = (np.linalg.norm(x - np.roll(x, 1, axis=1), axis=2).max(1) for x in (own, image))
    whole = after < _TORN[0] * before + _TORN[1]
    sign = np.sign(np.einsum("fi,fi->f", area_vectors, normals))
    # Where the other mesh is coarser, faces fall together into points and edges, which says nothing.
    counted = first.coarse.face_areas[sign != 0].sum()
    total = max(counted, _LEAST_COUNTED * first.coarse.area)
    return float((first.coarse.face_areas * whole * sign).sum() / total)


def landmark_map(first: SpectralShape, second: SpectralShape, pairs: IntArray) -> Map:
    """The map that geodesic distances to landmarks give, refined.

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
    keep: int = 4,
    tick: Callable[[], None] = lambda: None,
) -> list[Map]:
    """The best maps that spectra alone give, best first; the last is the best one of the mirrored target.

    Eigenfunctions have no sign: all patterns of signs of the lowest are starts, beside wave kernel signatures and the
    rigid placements by principal axes. Each is refined a little, and the best to the end.

    Args:
        first: The first shape.
        second: The second.
        n_signs: How many eigenfunctions have their signs tried: ``2**n_signs`` starts.
        keep: How many are refined to the end.
        tick: Called after each start.
    """
    coarse = []
    for vertices, k in _starts(first, second, n_signs):
        vertices = zoom_out(first, second, vertices, k, COARSE_FUNCTIONS)
        coarse.append(Map(vertices, *rates(first, second, vertices, COARSE_FUNCTIONS)))
        tick()
    coarse.sort(key=lambda found: -found.score)
    fine = []
    for found in [*coarse[:keep], max(coarse, key=lambda found: found.mirrored_score)]:
        vertices = zoom_out(first, second, found.vertices, COARSE_FUNCTIONS, FINE_FUNCTIONS)
        fine.append(Map(vertices, *rates(first, second, vertices, FINE_FUNCTIONS)))
    return [*sorted(fine[:-1], key=lambda found: -found.score), fine[-1]]


def _starts(first: SpectralShape, second: SpectralShape, n_signs: int) -> Iterator[tuple[IntArray, int]]:
    """Rough maps, and how many eigenfunctions they are good for."""
    k = n_signs + 1
    for signs in itertools.product([1.0, -1.0], repeat=n_signs):
        yield nearest_rows(first.functions[:, :k], second.functions[:, :k] * [1.0, *signs]), k
    yield nearest_rows(first.wave_kernel_signatures(), second.wave_kernel_signatures()), 6
    for points, normals in _placements(first, second):
        here, there = points, second.coarse.vertices - _centroid(second)
        yield nearest_rows(np.hstack([here, 0.1 * normals]), np.hstack([there, 0.1 * second.coarse.vertex_normals])), 12


def _placements(first: SpectralShape, second: SpectralShape) -> Iterator[tuple[FloatArray, FloatArray]]:
    """The first shape about its centroid, as it lies and turned by its principal axes; positions and normals."""
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
