"""Connectivity of triangle meshes: edges, hinges, boundaries, neighbours. NumPy and SciPy only."""

from functools import cached_property

import numpy as np
from scipy import sparse
from scipy.sparse.csgraph import breadth_first_order, connected_components, dijkstra, minimum_spanning_tree
from scipy.spatial import cKDTree

from torch_modal.arrays import FloatArray, IntArray

SEAM_WIDTH = 1e-7
"""Part of the bounding-box diagonal within which vertices coincide: the rounding of float32 and of seven digits."""


class Connectivity:
    """Edges, hinges and neighbours of a triangle mesh, from one sort of its half-edges, called sides here.

    Side ``c F + f`` runs from corner ``c`` of face ``f`` to the next, so arrays of all ``3F`` sides are three
    concatenated arrays of ``F``. All arrays are shared and read-only; ``torch.tensor(...)`` makes a writable copy.

    Args:
        faces: Vertex indices. *Shape:* ``(F, 3)``.
        n_vertices: Number of vertices, V; by default the largest index plus one.

    Attributes:
        faces: A copy. *Shape:* ``(F, 3)``.
        n_vertices: V.
        used: Referenced vertices, ascending. *Shape:* ``(·,)``.
        start: The vertex at which each side starts. *Shape:* ``(3F,)``.
        end: The vertex at which it ends. *Shape:* ``(3F,)``.
        opposite: The vertex opposite to it. *Shape:* ``(3F,)``.
        signs: +1 for a side from the smaller vertex to the larger, otherwise -1. *Shape:* ``(3F,)``.
        sides: The edge of each side. *Shape:* ``(3F,)``.
        edges: Each edge once, the smaller vertex first, sorted. *Shape:* ``(E, 2)``.
        counts: Number of faces at each edge. *Shape:* ``(E,)``.
        hinge_sides: The two sides of each edge of exactly two faces, in the order of the edges. *Shape:* ``(H, 2)``.
        hinges: These edges with the two vertices opposite to them. Rows are ``(i, j, k, l)``: the edge ``ij`` and the
            tips ``k`` and ``l`` of its two triangles. Where the winding is consistent, the triangles are ``(i, j, k)``
            and ``(j, i, l)``. *Shape:* ``(H, 4)``.
        boundary_edges: Edges of exactly one face. *Shape:* ``(·, 2)``.
        boundary_chain: Boundary of the surface as a chain: the sum of all directed edges, with multiplicity. With
            consistent winding these are the edges of one face, in its direction. *Shape:* ``(·, 2)``.
        adjacent_sides: Pairs of sides of the same edge; at non-manifold edges each with the next. *Shape:* ``(n, 2)``.
        face_neighbours: Faces of these, the smaller first. *Shape:* ``(n, 2)``.
    """

    def __init__(self, faces: IntArray, n_vertices: int | None = None) -> None:
        self.faces: IntArray = np.array(faces, dtype=np.int64).reshape(-1, 3)
        self.n_vertices = int(self.faces.max(initial=-1)) + 1 if n_vertices is None else n_vertices
        self.used: IntArray = np.flatnonzero(np.bincount(self.faces.reshape(-1), minlength=self.n_vertices))
        self.start: IntArray = self.faces.T.reshape(-1)
        self.end: IntArray = self.faces[:, [1, 2, 0]].T.reshape(-1)
        self.opposite: IntArray = self.faces[:, [2, 0, 1]].T.reshape(-1)
        self.signs: FloatArray = np.where(self.start < self.end, 1.0, -1.0)

        width = max(self.n_vertices - 1, 0).bit_length()
        key = np.minimum(self.start, self.end) << width | np.maximum(self.start, self.end)
        order = np.argsort(key, kind="stable")
        key = key[order]
        first = np.flatnonzero(np.diff(key, prepend=-1))  # of the sides of each edge
        self.edges: IntArray = np.stack([key[first] >> width, key[first] & (1 << width) - 1], axis=1)
        self.counts: IntArray = np.diff(first, append=len(order))
        self.sides: IntArray = np.empty(len(order), dtype=np.int64)
        self.sides[order] = np.repeat(np.arange(len(first)), self.counts)

        one, two = pair = np.stack([order[first[self.counts == 2] + i] for i in (0, 1)])
        self.hinge_sides: IntArray = pair.T
        self.hinges: IntArray = np.stack([self.start[one], self.end[one], self.opposite[one], self.opposite[two]], 1)
        self.boundary_edges: IntArray = self.edges[self.counts == 1]
        net = np.bincount(self.sides, self.signs, minlength=len(self.edges)).astype(np.int64)
        oriented = np.where((net > 0)[:, None], self.edges, self.edges[:, ::-1])
        self.boundary_chain: IntArray = np.repeat(oriented, np.abs(net), axis=0)
        same = np.flatnonzero(np.diff(key) == 0)
        self.adjacent_sides: IntArray = np.stack([order[same], order[same + 1]], axis=1)
        self.face_neighbours: IntArray = np.sort(self.adjacent_sides % max(len(self.faces), 1), axis=1)
        for array in vars(self).values():
            if isinstance(array, np.ndarray):
                array.flags.writeable = False

    def __reduce__(self) -> tuple[object, ...]:
        """Pickles the faces alone: the rest is faster to compute than to read."""
        return Connectivity, (self.faces, self.n_vertices)

    @cached_property
    def vertex_pieces(self) -> IntArray:
        """Connected component of each vertex, including unreferenced ones. *Shape:* ``(V,)``."""
        return label_pieces(self.edges, self.n_vertices)


def label_pieces(pairs: IntArray, n: int) -> IntArray:
    """Connected component of each of ``n`` nodes, numbered by first nodes. *Shape:* ``(m, 2) -> (n,)``."""
    graph = sparse.coo_matrix((np.ones(len(pairs), dtype=bool), (pairs[:, 0], pairs[:, 1])), shape=(n, n))
    return connected_components(graph, directed=False)[1].astype(np.int64)


def merge_seams(shapes: FloatArray, faces: IntArray) -> IntArray:
    """Merge vertices along seams, where files for rendering repeat them for texture coordinates or normals.

    Two vertices are merged if both lie on a boundary and coincide in every shape. Surfaces that merely touch stay
    separate: closed ones have no boundary, and open ones part in some shape.

    Merged vertices are numbered by first vertices. *Shape:* ``(K, V, 3), (F, 3) -> (V,)``.
    """
    n = shapes.shape[1]
    boundary = np.unique(Connectivity(faces).boundary_edges)
    if not len(boundary):
        return np.arange(n)
    used = np.unique(faces)
    tolerance = SEAM_WIDTH * float(np.linalg.norm(np.ptp(shapes[:, used], axis=1), axis=1).min())
    pairs = boundary[cKDTree(shapes[0, boundary]).query_pairs(tolerance, output_type="ndarray")]
    distance = np.linalg.norm(shapes[:, pairs[:, 0]] - shapes[:, pairs[:, 1]], axis=2).max(axis=0, initial=0.0)
    return label_pieces(pairs[distance <= tolerance], n)


def spanning_forest(n: int, pairs: IntArray, costs: FloatArray) -> tuple[IntArray, IntArray]:
    """Minimum spanning forest of a graph of n nodes, from its edges and their positive costs.

    The smaller node of an edge is the first. *Shape:* ``(m, 2), (m,)``.

    Returns:
        The parent of each node, itself for a root; its connected component. *Shape:* ``(n,)`` each.
    """
    graph = sparse.coo_matrix((costs, pairs.T), shape=(n, n)).tocsr()
    if graph.nnz < len(pairs):  # costs of duplicate edges were summed: the cheapest counts
        order = np.argsort(costs, kind="stable")
        order = order[np.unique(pairs[order] @ [n, 1], return_index=True)[1]]
        graph = sparse.coo_matrix((costs[order], pairs[order].T), shape=(n, n)).tocsr()
    tree = minimum_spanning_tree(graph).tocoo()
    piece = connected_components(tree, directed=False)[1].astype(np.int64)
    # An extra node above all roots: one traversal visits all trees.
    roots = np.unique(piece, return_index=True)[1]
    ends = np.append(tree.row, np.full(len(roots), n)), np.append(tree.col, roots)
    whole = sparse.coo_matrix((np.ones(len(ends[0])), ends), shape=(n + 1, n + 1)).tocsr()
    parents = breadth_first_order(whole, n, directed=False)[1][:n]
    return np.where(parents == n, np.arange(n), parents).astype(np.int64), piece


def half_cotangents(vertices: FloatArray, mesh: Connectivity) -> FloatArray:
    """Half the cotangent of the angle opposite to each side, finite on slivers. *Shape:* ``(3F,)``."""
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
    areas: FloatArray = np.sqrt((uy * vz - uz * vy) ** 2 + (uz * vx - ux * vz) ** 2 + (ux * vy - uy * vx) ** 2)
    return areas


def vertex_areas(vertices: FloatArray, faces: IntArray) -> FloatArray:
    """A third of the area of the incident faces of each vertex. *Shape:* ``(V,)``."""
    summed = np.bincount(faces.reshape(-1), np.repeat(double_areas(vertices, faces) / 6, 3), minlength=len(vertices))
    return summed.astype(np.float64)  # integers if there are no faces


def neighbour_means(mesh: Connectivity) -> sparse.csr_matrix:
    """Means over a vertex and its neighbours. *Shape:* ``(V, V)``."""
    n = mesh.n_vertices
    ends = mesh.edges.T.reshape(-1), mesh.edges[:, ::-1].T.reshape(-1)
    around = sparse.csr_matrix((np.ones(len(ends[0])), ends), shape=(n, n)) + sparse.identity(n)
    return sparse.diags(1 / np.asarray(around.sum(axis=1)).reshape(-1)) @ around


def edge_graph(vertices: FloatArray, edges: IntArray) -> sparse.csr_matrix:
    """Lengths of edges, none zero, between their ends. *Shape:* ``(V, 3), (E, 2) -> (V, V)``."""
    lengths = np.linalg.norm(vertices[edges[:, 0]] - vertices[edges[:, 1]], axis=1)
    half = sparse.coo_matrix((np.maximum(lengths, 1e-12 * lengths.max(initial=0)), edges.T), (len(vertices),) * 2)
    return (half + half.T).tocsr()


def farthest_apart(graph: sparse.csr_matrix, among: IntArray, n: int) -> tuple[IntArray, FloatArray]:
    """Vertices far from each other along a graph, fewer where no more can be reached, and the distances from each.

    Each is the one farthest from those before; the first is the farthest from some vertex. *Shape:* ``(V, V), (m,) ->
    (k,), (k, V)``.
    """
    chosen: list[int] = []
    nearest, rows = dijkstra(graph, indices=among[0]), []
    while len(chosen) < n:
        reachable = np.where(np.isfinite(nearest[among]), nearest[among], 0)
        if chosen and not reachable.max() > 0:
            break
        chosen.append(int(among[reachable.argmax()]))
        rows.append(dijkstra(graph, indices=chosen[-1]))
        nearest = np.min(rows, axis=0)
    return np.array(chosen), np.stack(rows)
