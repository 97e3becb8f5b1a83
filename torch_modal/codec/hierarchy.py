"""Shapes as integers from coarse to fine: each vertex relative to a smooth surface through the coarser ones.

Connectivity alone sorts the vertices into levels: each level leaves a maximal independent set of its graph to the
coarser ones. A level is predicted by the surface through all coarser vertices whose Laplacian is least in the least
squares (least-squares meshes; Sorkine and Cohen-Or 2004), and the residual is rounded to steps. Where another shape of
the same mesh is known, its guide, the Laplacian is that of the guide, rotated with each vertex's neighbourhood
(Laplacian surface editing; Sorkine et al. 2004). Predictions use rounded positions only, as the decoder has them.

Predictions are sums of floating-point numbers, which machines round differently. The decoded shape is therefore put on
a much finer grid, chosen so that no vertex lies near a boundary of its cells (:mod:`torch_modal.codec.positions`).

Key-frames are nearly all of a file. Parallelogram prediction with the same range coder takes 1.4 to 15 times as many
bytes for them.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import SuperLU

from torch_modal.arrays import FloatArray, IntArray
from torch_modal.geometry.sparse import factorize

COARSEST = 30
"""Vertices of the coarsest level, about."""
STEP_RATIO = 0.6
"""The step of a level over that of the next finer one: errors of coarse vertices add to all that they predict."""
SMALLEST_RATIO = 0.05
ROTATION_ROUNDS = 3
"""Rounds of fitting the rotations of the guide's neighbourhoods, and solving."""
DEAD_ZONE = 0.17
"""In steps: how far beyond the half a residual must be to be rounded away from zero."""


def whole(steps: FloatArray) -> IntArray:
    """Numbers of steps, rounded with the dead zone."""
    return (np.sign(steps) * np.floor(np.abs(steps) + 0.5 - DEAD_ZONE)).astype(np.int64)


class Level(NamedTuple):
    """Vertices that are predicted at the same time."""

    vertices: IntArray
    coarser: IntArray
    """Vertices of coarser levels."""
    unknown: IntArray
    """Its own vertices, and those of finer levels."""


class VertexHierarchy:
    """The levels of a mesh.

    Args:
        faces: *Shape:* ``(F, 3)``.
        n_vertices: V.
    """

    def __init__(self, faces: IntArray, n_vertices: int) -> None:
        i, j = faces.reshape(-1), faces[:, [1, 2, 0]].reshape(-1)
        links = sparse.coo_matrix((np.ones(len(i)), (i, j)), (n_vertices, n_vertices))
        self._links = ((links + links.T) > 0).astype(np.float64).tocsr()
        self._links.setdiag(0)
        self._links.eliminate_zeros()
        self._links.sort_indices()
        degrees = np.asarray(self._links.sum(1)).reshape(-1)
        self._mean = sparse.diags(1 / np.maximum(degrees, 1)) @ self._links
        eye = sparse.eye(n_vertices)
        laplacian = (eye - self._mean).tocsr()
        self._transposed = laplacian.T.tocsr()
        # Vertices without coarser ones in their piece would be undetermined.
        self._normal = (self._transposed @ laplacian + 1e-9 * eye).tocsr()
        ends = self._links.tocoo()
        self._first, self._second = ends.row, ends.col
        known = np.zeros(n_vertices, dtype=bool)
        self.levels: list[Level] = []
        for vertices in _sorted_into_levels(self._links):
            self.levels.append(Level(vertices, np.flatnonzero(known), np.flatnonzero(~known)))
            known[vertices] = True
        self._factors: dict[int, tuple[SuperLU, sparse.csr_matrix, sparse.csr_matrix]] = {}

    def encode(self, x: FloatArray, step: float, guide: FloatArray | None) -> tuple[list[IntArray], FloatArray]:
        """Integers of each level, and the shape that they decode to.

        Args:
            x: *Shape:* ``(V, 3)``.
            step: Of the finest level.
            guide: A shape that the decoder has already. *Shape:* ``(V, 3)``.
        """
        numbers: list[IntArray] = []

        def rounded(i: int, predicted: FloatArray, width: float) -> IntArray:
            numbers.append(whole((x[self.levels[i].vertices] - predicted) / width))
            return numbers[i]

        return numbers, self._decoded(rounded, step, guide)

    def decode(self, numbers: list[IntArray], step: float, guide: FloatArray | None) -> FloatArray:
        """The shape of the integers. *Shape:* ``(V, 3)``."""
        return self._decoded(lambda i, predicted, width: numbers[i], step, guide)

    def _decoded(
        self, numbers_of: Callable[[int, FloatArray, float], IntArray], step: float, guide: FloatArray | None
    ) -> FloatArray:
        """The shape of integers that are given level by level: by the level, its prediction and its step."""
        found = np.zeros((self._links.shape[0], 3))
        surface = guide
        for i, level in enumerate(self.levels):
            width = step * max(STEP_RATIO ** (len(self.levels) - 1 - i), SMALLEST_RATIO)
            surface = self._surface(i, found, guide, surface)
            predicted = surface[level.vertices]
            found[level.vertices] = predicted + width * numbers_of(i, predicted, width)
        return found

    def _surface(self, i: int, found: FloatArray, guide: FloatArray | None, before: FloatArray | None) -> FloatArray:
        """The smooth surface through the vertices coarser than a level. *Shape:* ``(V, 3)``."""
        if i == 0:
            return np.zeros_like(found) if guide is None else guide
        if guide is None or before is None:
            return self._solved(i, found, np.zeros_like(found))
        surface = before
        for _ in range(ROTATION_ROUNDS):
            rotations = self._rotations(guide, surface)
            # Each edge of the guide is rotated by the mean of its ends.
            means = rotations[self._first] + rotations[self._second]
            edges = np.einsum("eij,ej->ei", means, guide[self._first] - guide[self._second])
            delta = np.zeros_like(guide)
            np.add.at(delta, self._first, 0.5 * self._mean.data[:, None] * edges)
            surface = self._solved(i, found, self._transposed @ delta)
        return surface

    def _solved(self, i: int, found: FloatArray, right: FloatArray) -> FloatArray:
        level = self.levels[i]
        if i not in self._factors:
            rows = self._normal[level.unknown]
            inner = rows[:, level.unknown].tocsr()
            self._factors[i] = factorize(inner), inner, rows[:, level.coarser].tocsr()
        factor, inner, outer = self._factors[i]
        wanted = right[level.unknown] - outer @ found[level.coarser]
        solved = factor.solve(wanted)
        solved += factor.solve(wanted - inner @ solved)  # refined: machines then differ by rounding alone
        surface = found.copy()
        surface[level.unknown] = solved
        return surface

    def _rotations(self, guide: FloatArray, x: FloatArray) -> FloatArray:
        """Best-fit rotation of each vertex's neighbourhood from the guide to a shape. *Shape:* ``(V, 3, 3)``."""
        first, second, n = self._first, self._second, len(x)
        products = (x[first] - x[second])[:, :, None] * (guide[first] - guide[second])[:, None, :]
        moment = np.zeros((n, 9))
        np.add.at(moment, first, products.reshape(-1, 9))
        moment = (moment + self._links @ moment).reshape(n, 3, 3)
        u, _, vh = np.linalg.svd(moment)
        u[:, :, 2] *= np.sign(np.linalg.det(u @ vh))[:, None]
        return u @ vh


def _sorted_into_levels(links: sparse.csr_matrix) -> list[IntArray]:
    """Vertices of each level, the coarsest first."""
    graph, places = links, np.arange(links.shape[0])
    found: list[IntArray] = []
    while len(places) > COARSEST:
        kept = _independent(graph)
        if len(kept) > 0.9 * len(places):
            break
        found.append(places[np.setdiff1d(np.arange(len(places)), kept)])
        graph = (graph @ graph).tocsr()[kept][:, kept]
        graph.setdiag(0)
        graph.eliminate_zeros()
        graph = (graph > 0).astype(np.float64).tocsr()
        places = places[kept]
    return [places, *found[::-1]]


def _independent(graph: sparse.csr_matrix) -> IntArray:
    """A maximal set of vertices without neighbours among them, chosen in their order."""
    starts, ends = graph.indptr.tolist(), graph.indices
    free = np.ones(graph.shape[0], dtype=bool)
    kept = []
    for vertex in range(graph.shape[0]):
        if free[vertex]:
            kept.append(vertex)
            free[ends[starts[vertex] : starts[vertex + 1]]] = False
    return np.asarray(kept, dtype=np.int64)
