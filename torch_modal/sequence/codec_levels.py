"""Shapes as whole numbers from coarse to fine: each vertex less what a smooth surface through coarser ones tells of it.

Vertices are sorted into levels by connectivity alone: each level leaves a maximal independent set of its graph to the
coarser ones. A level is predicted by the surface through all coarser vertices whose Laplacian is least, in the least
squares (least-squares meshes; Sorkine and Cohen-Or 2004), and what is left is rounded to steps. Where another shape of
the same mesh is known, its guide, the Laplacian should be that of the guide, turned as each vertex's neighbourhood has
turned (Laplacian surface editing; Sorkine et al. 2004), so that bends cost no more than straight limbs. Prediction is
closed-loop: what is predicted from has been rounded already.

Predictions are sums of floating-point numbers, which machines round differently. That is linear and tiny, and the
finished shape is put on a much finer grid, of which the writer made sure that no vertex lies near a boundary.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.linalg import SuperLU

from torch_modal.geometry.sparse import factorize

LEAST = 30
"""Vertices of the coarsest level, about."""
NARROWER = 0.6
"""The step of a level over that of the next finer one: what is coarse is a part of all that is predicted from it."""
NARROWEST = 0.05
TURNS = 3
"""Rounds of turning the guide's neighbourhoods, and solving."""
DEAD = 0.17
"""Of a step: how much further from the half a number must be to be rounded away from zero."""

IntArray = NDArray[np.int64]
FloatArray = NDArray[np.float64]


class Level(NamedTuple):
    """Vertices that are predicted at the same time."""

    vertices: IntArray
    known: IntArray
    """Those before them."""
    unknown: IntArray
    """Themselves, and those after them."""


class Levels:
    """The levels of a mesh.

    Args:
        faces: *Shape:* ``(F, 3)``.
        n_vertices: V.
    """

    def __init__(self, faces: IntArray, n_vertices: int) -> None:
        i, j = faces.reshape(-1), faces[:, [1, 2, 0]].reshape(-1)
        links = sparse.coo_matrix((np.ones(len(i)), (i, j)), (n_vertices, n_vertices))
        #: Which vertices are neighbours, ones and zeros.
        self.links = ((links + links.T) > 0).astype(np.float64).tocsr()
        self.links.setdiag(0)
        self.links.eliminate_zeros()
        self.links.sort_indices()
        degrees = np.asarray(self.links.sum(1)).reshape(-1)
        self._mean = sparse.diags(1 / np.maximum(degrees, 1)) @ self.links
        eye = sparse.eye(n_vertices)
        laplacian = (eye - self._mean).tocsr()
        self._back = laplacian.T.tocsr()
        # Vertices without coarser ones in their piece would be undetermined.
        self._normal = (self._back @ laplacian + 1e-9 * eye).tocsr()
        self._ends = self.links.tocoo()
        known = np.zeros(n_vertices, dtype=bool)
        self.levels: list[Level] = []
        for vertices in _sorted_out(self.links):
            self.levels.append(Level(vertices, np.flatnonzero(known), np.flatnonzero(~known)))
            known[vertices] = True
        self._factors: dict[int, tuple[SuperLU, sparse.csr_matrix, sparse.csr_matrix]] = {}

    def steps(self, step: float) -> list[float]:
        """Of all levels, from that of the finest."""
        n = len(self.levels)
        return [step * max(NARROWER ** (n - 1 - i), NARROWEST) for i in range(n)]

    def rounded(self, x: FloatArray, step: float, guide: FloatArray | None) -> tuple[list[IntArray], FloatArray]:
        """Whole numbers of each level, and the shape that they make. *Shape:* ``(V, 3)``."""
        numbers = []
        found = np.zeros_like(x)
        surface = guide
        for i, (level, width) in enumerate(zip(self.levels, self.steps(step), strict=True)):
            surface = self._surface(i, found, guide, surface)
            left = (x[level.vertices] - surface[level.vertices]) / width
            whole = np.sign(left) * np.floor(np.abs(left) + 0.5 - DEAD)
            numbers.append(whole.astype(np.int64))
            found[level.vertices] = surface[level.vertices] + width * whole
        return numbers, found

    def shape(self, numbers: list[IntArray], step: float, guide: FloatArray | None) -> FloatArray:
        """The shape of whole numbers: the second result of :meth:`rounded`."""
        found = np.zeros((self.links.shape[0], 3))
        surface = guide
        for i, (level, width) in enumerate(zip(self.levels, self.steps(step), strict=True)):
            surface = self._surface(i, found, guide, surface)
            found[level.vertices] = surface[level.vertices] + width * numbers[i]
        return found

    def _surface(self, i: int, found: FloatArray, guide: FloatArray | None, before: FloatArray | None) -> FloatArray:
        """The smooth surface through what is known before a level. *Shape:* ``(V, 3)``."""
        if guide is None and i == 0:
            return np.zeros_like(found)
        if i == 0:
            assert guide is not None
            return guide
        if guide is None or before is None:
            return self._solved(i, found, np.zeros_like(found))
        surface = before
        for _ in range(TURNS):
            turns = self._turns(guide, surface)
            first, second = self._ends.row, self._ends.col
            # Each edge of the guide is turned by the mean of its ends.
            sides = np.einsum("eij,ej->ei", turns[first] + turns[second], guide[first] - guide[second])
            delta = np.zeros_like(guide)
            np.add.at(delta, first, 0.5 * self._mean.data[:, None] * sides)
            surface = self._solved(i, found, self._back @ delta)
        return surface

    def _solved(self, i: int, found: FloatArray, right: FloatArray) -> FloatArray:
        level = self.levels[i]
        if i not in self._factors:
            rows = self._normal[level.unknown]
            inner = rows[:, level.unknown].tocsr()
            self._factors[i] = factorize(inner), inner, rows[:, level.known].tocsr()
        factor, inner, outer = self._factors[i]
        wanted = right[level.unknown] - outer @ found[level.known]
        solved = factor.solve(wanted)
        solved += factor.solve(wanted - inner @ solved)  # refined: machines then differ by rounding alone
        surface = found.copy()
        surface[level.unknown] = solved
        return surface

    def _turns(self, guide: FloatArray, x: FloatArray) -> FloatArray:
        """How the surroundings of each vertex have turned, best fit. *Shape:* ``(V, 3, 3)``."""
        first, second = self._ends.row, self._ends.col
        products = (x[first] - x[second])[:, :, None] * (guide[first] - guide[second])[:, None, :]
        n = len(x)
        moment = np.zeros((n, 9))
        np.add.at(moment, first, products.reshape(-1, 9))
        moment = (moment + self.links @ moment).reshape(n, 3, 3)
        u, _, vh = np.linalg.svd(moment)
        u[:, :, 2] *= np.sign(np.linalg.det(u @ vh))[:, None]
        return u @ vh


def _sorted_out(links: sparse.csr_matrix) -> list[IntArray]:
    """Vertices of each level, the coarsest first."""
    graph, places = links, np.arange(links.shape[0])
    found: list[IntArray] = []
    while len(places) > LEAST:
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
    """A maximal set of vertices without neighbours among them, in their order."""
    starts, ends = graph.indptr.tolist(), graph.indices
    free = np.ones(graph.shape[0], dtype=bool)
    kept = []
    for vertex in range(graph.shape[0]):
        if free[vertex]:
            kept.append(vertex)
            free[ends[starts[vertex] : starts[vertex + 1]]] = False
    return np.asarray(kept, dtype=np.int64)
