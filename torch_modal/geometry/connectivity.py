"""Connectivity of triangle meshes: edges, hinges, boundaries, neighbours. NumPy and SciPy only."""

from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.csgraph import breadth_first_order, connected_components, minimum_spanning_tree

from torch_modal.arrays import FloatArray, IntArray


class Connectivity:
    """All that follows from the faces of a mesh, made when it is first asked for, from one sort of their sides.

    Made once for a mesh and handed on to all who need it. The arrays are shared, so they cannot be written to:
    ``torch.tensor(...)`` makes a copy that can be.

    A face has three sides. Side ``c F + f`` runs from corner ``c`` of face ``f`` to the next, so that an array of all
    ``3F`` sides is three arrays of ``F``, one after the other.

    Args:
        faces: Vertex indices. *Shape:* ``(F, 3)``.
        n_vertices: Number of vertices, V; by default those up to the last one that a face uses.
    """

    def __init__(self, faces: IntArray, n_vertices: int | None = None) -> None:
        self.faces: IntArray = _shared(np.array(faces, dtype=np.int64).reshape(-1, 3))
        self.n_vertices = int(self.faces.max(initial=-1)) + 1 if n_vertices is None else n_vertices

    def __reduce__(self) -> tuple[Any, ...]:
        """The faces alone are pickled: the rest is made faster than it is read."""
        return Connectivity, (self.faces, self.n_vertices)

    @cached_property
    def start(self) -> IntArray:
        """The vertex at which each side starts. *Shape:* ``(3F,)``."""
        return _shared(self.faces.T.reshape(-1))

    @cached_property
    def end(self) -> IntArray:
        """The vertex at which each side ends. *Shape:* ``(3F,)``."""
        return _shared(self.faces[:, [1, 2, 0]].T.reshape(-1))

    @cached_property
    def opposite(self) -> IntArray:
        """The corner across each side. *Shape:* ``(3F,)``."""
        return _shared(self.faces[:, [2, 0, 1]].T.reshape(-1))

    @cached_property
    def used(self) -> IntArray:
        """The vertices of all faces, ascending. *Shape:* ``(·,)``."""
        return _shared(np.flatnonzero(np.bincount(self.faces.reshape(-1), minlength=self.n_vertices)))

    @cached_property
    def _runs(self) -> tuple[IntArray, IntArray, IntArray]:
        """Sides in the order of their edges, ``(3F,)``; where each edge starts there, and its packed ends, ``(E,)``."""
        key = np.minimum(self.start, self.end) << self._bits | np.maximum(self.start, self.end)
        bits = len(key).bit_length()
        if 2 * self._bits + bits < 64:  # ends and number in one integer: sorted three times as fast as by argsort
            packed = np.sort(key << bits | np.arange(len(key)))
            order, key = packed & (1 << bits) - 1, packed >> bits
        else:
            order = np.argsort(key, kind="stable")
            key = key[order]
        first = np.flatnonzero(np.diff(key, prepend=-1))
        return order, first, key[first]

    @property
    def _bits(self) -> int:
        return max(self.n_vertices - 1, 0).bit_length()

    @cached_property
    def edges(self) -> IntArray:
        """Each edge once, the smaller vertex first, sorted. *Shape:* ``(E, 2)``."""
        key = self._runs[2]
        return _shared(np.stack([key >> self._bits, key & (1 << self._bits) - 1], axis=1))

    @cached_property
    def counts(self) -> IntArray:
        """How many faces share each edge. *Shape:* ``(E,)``."""
        order, first, _ = self._runs
        return _shared(np.diff(first, append=len(order)))

    @cached_property
    def sides(self) -> IntArray:
        """The edge that each side runs along. *Shape:* ``(3F,)``."""
        sides = np.empty(3 * len(self.faces), dtype=np.int64)
        sides[self._runs[0]] = np.repeat(np.arange(len(self.counts)), self.counts)
        return _shared(sides)

    @cached_property
    def signs(self) -> FloatArray:
        """+1 for a side that runs along its edge from the smaller vertex to the larger, otherwise -1.

        *Shape:* ``(3F,)``.
        """
        return _shared(np.where(self.start < self.end, 1.0, -1.0))

    @cached_property
    def hinge_sides(self) -> IntArray:
        """The two sides at each edge of exactly two faces, in the order of the edges. *Shape:* ``(H, 2)``."""
        order, first, _ = self._runs
        one = first[self.counts == 2]
        return _shared(np.stack([order[one], order[one + 1]], axis=1))

    @cached_property
    def hinges(self) -> IntArray:
        """Interior edges with the two vertices opposite to them.

        An edge of one face has no dihedral angle, an edge of three or more has no single one: neither gives a hinge.
        Rows are ``(i, j, k, l)``: the edge ``ij`` and the opposite vertices ``k`` and ``l`` of its two triangles. Where
        the winding is consistent, the triangles are ``(i, j, k)`` and ``(j, i, l)``. *Shape:* ``(H, 4)``.
        """
        first, second = self.hinge_sides.T
        ends = self.start[first], self.end[first]
        return _shared(np.stack([*ends, self.opposite[first], self.opposite[second]], axis=1))

    @cached_property
    def face_neighbours(self) -> IntArray:
        """Pairs of faces at one edge, the smaller first; where there are three or more, each with the next.

        *Shape:* ``(n, 2)``.
        """
        order = self._runs[0]
        same = np.diff(self.sides[order]) == 0
        return _shared(np.sort(np.stack([order[:-1][same], order[1:][same]], axis=1) % len(self.faces), axis=1))

    @cached_property
    def boundary_edges(self) -> IntArray:
        """Edges of exactly one face. *Shape:* ``(·, 2)``."""
        return _shared(self.edges[self.counts == 1])

    @cached_property
    def boundary_chain(self) -> IntArray:
        """Directed edges that are left when opposite ones cancel: the boundary of an open surface.

        Where the winding is consistent, these are the edges of one face, in its direction. An edge that two faces run
        along in the same direction, or a third face shares, is left as often as it does not cancel.
        *Shape:* ``(·, 2)``.
        """
        net = np.bincount(self.sides, self.signs, minlength=len(self.edges)).astype(np.int64)
        oriented = np.where((net > 0)[:, None], self.edges, self.edges[:, ::-1])
        return _shared(np.repeat(oriented, np.abs(net), axis=0))

    @cached_property
    def vertex_pieces(self) -> IntArray:
        """Which connected piece each vertex belongs to; one of no face is a piece. *Shape:* ``(V,)``."""
        return _shared(connected_pieces(self.edges, self.n_vertices))


def _shared(array: NDArray[Any]) -> NDArray[Any]:
    array.flags.writeable = False
    return array


def connected_pieces(pairs: IntArray, n: int) -> IntArray:
    """Which connected piece each of ``n`` nodes belongs to, numbered by their first nodes. *Shape:* ``(m, 2) -> (n,)``.

    A node without a pair is a piece.
    """
    graph = sparse.coo_matrix((np.ones(len(pairs), dtype=bool), (pairs[:, 0], pairs[:, 1])), shape=(n, n))
    return connected_components(graph, directed=False)[1].astype(np.int64)


def spanning_forest(n: int, pairs: IntArray, costs: FloatArray) -> tuple[IntArray, IntArray]:
    """The cheapest connections that hold all together.

    Args:
        n: Number of nodes.
        pairs: Connections, the smaller node first. *Shape:* ``(m, 2)``.
        costs: Above zero. *Shape:* ``(m,)``.

    Returns:
        The parent of each node, its own for a root; the connected piece of each. *Shape:* ``(n,)`` each.
    """
    graph = sparse.coo_matrix((costs, pairs.T), shape=(n, n)).tocsr()
    if graph.nnz < len(pairs):  # two nodes that are connected twice: costs were added up
        key = pairs[:, 0] * n + pairs[:, 1]
        order = np.lexsort((costs, key))
        order = order[np.flatnonzero(np.diff(key[order], prepend=-1))]
        graph = sparse.coo_matrix((costs[order], pairs[order].T), shape=(n, n)).tocsr()
    tree = minimum_spanning_tree(graph).tocoo()
    piece = connected_components(tree, directed=False)[1].astype(np.int64)
    # One more node above all roots: one walk then sees all pieces.
    roots = np.unique(piece, return_index=True)[1]
    ends = np.append(tree.row, np.full(len(roots), n)), np.append(tree.col, roots)
    whole = sparse.coo_matrix((np.ones(len(ends[0])), ends), shape=(n + 1, n + 1)).tocsr()
    parents = breadth_first_order(whole, n, directed=False)[1][:n]
    return np.where(parents == n, np.arange(n), parents).astype(np.int64), piece


def half_cotangents(vertices: FloatArray, mesh: Connectivity) -> FloatArray:
    """Half the cotangent of the angle across each side, finite on slivers too. *Shape:* ``(3F,)``."""
    tip = vertices[mesh.opposite]
    u, v = vertices[mesh.start] - tip, vertices[mesh.end] - tip
    twice_area = np.linalg.norm(np.cross(u, v), axis=1)
    least = 1e-12 * (u * u).sum(1) + np.finfo(np.float64).tiny
    halves: FloatArray = 0.5 * (u * v).sum(1) / np.maximum(twice_area, least)
    return halves


def double_areas(vertices: FloatArray, faces: IntArray) -> FloatArray:
    """Twice the area of each face. *Shape:* ``(F,)``."""
    a, b, c = (np.stack([x[corner] for x in vertices.T]) for corner in faces.T)
    (ux, uy, uz), (vx, vy, vz) = b - a, c - a
    found: FloatArray = np.sqrt((uy * vz - uz * vy) ** 2 + (uz * vx - ux * vz) ** 2 + (ux * vy - uy * vx) ** 2)
    return found


def vertex_areas(vertices: FloatArray, faces: IntArray) -> FloatArray:
    """A third of the area of the faces around each vertex. *Shape:* ``(V,)``."""
    summed = np.bincount(faces.reshape(-1), np.repeat(double_areas(vertices, faces) / 6, 3), minlength=len(vertices))
    return summed.astype(np.float64)  # of no face at all it is of integers
