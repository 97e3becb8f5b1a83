"""Connectivity of triangle meshes: edges, hinges, boundaries, neighbours. NumPy and SciPy only."""

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.csgraph import breadth_first_order, connected_components, minimum_spanning_tree

IntArray = NDArray[np.int64]


def _half_edges(faces: IntArray) -> tuple[IntArray, IntArray]:
    """All directed edges ``(3F, 2)`` of the faces and the vertex opposite to each ``(3F,)``."""
    directed = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    opposite = np.concatenate([faces[:, 2], faces[:, 0], faces[:, 1]])
    return directed, opposite


def unique_edges(faces: IntArray) -> tuple[IntArray, IntArray]:
    """Undirected edges, each once, and how many faces share each.

    Args:
        faces: Vertex indices. *Shape:* ``(F, 3)``.

    Returns:
        Edges with the smaller index first, sorted, *shape* ``(E, 2)``; number of faces, *shape* ``(E,)``.
    """
    directed, _ = _half_edges(faces)
    return np.unique(np.sort(directed, axis=1), axis=0, return_counts=True)


def hinges(faces: IntArray) -> IntArray:
    """Interior edges with the two vertices opposite to them.

    An edge of one face has no dihedral angle, an edge of three or more has no single one: neither gives a hinge.

    Args:
        faces: Vertex indices. *Shape:* ``(F, 3)``.

    Returns:
        Rows ``(i, j, k, l)``: the edge ``ij`` and the opposite vertices ``k`` and ``l`` of its two triangles. Where
        the winding is consistent, the triangles are ``(i, j, k)`` and ``(j, i, l)``. *Shape:* ``(H, 4)``.
    """
    directed, opposite = _half_edges(faces)
    edge_ids, counts = np.unique(np.sort(directed, axis=1), axis=0, return_inverse=True, return_counts=True)[1:]
    order = np.argsort(edge_ids.reshape(-1), kind="stable")
    order = order[(counts == 2)[edge_ids.reshape(-1)[order]]].reshape(-1, 2)
    first, second = order[:, 0], order[:, 1]
    return np.concatenate([directed[first], opposite[first, None], opposite[second, None]], axis=1)


def boundary_edges(faces: IntArray) -> IntArray:
    """Edges of exactly one face. *Shape:* ``(·, 2)``."""
    edges, counts = unique_edges(faces)
    return edges[counts == 1]


def boundary_chain(faces: IntArray) -> IntArray:
    """Directed edges that are left when opposite ones cancel: the boundary of an open surface.

    Where the winding is consistent, these are the edges of one face, in its direction. An edge that two faces run
    along in the same direction, or a third face shares, is left as often as it does not cancel. *Shape:* ``(·, 2)``.
    """
    directed, _ = _half_edges(faces)
    edges, ids = np.unique(np.sort(directed, axis=1), axis=0, return_inverse=True)
    forward = directed[:, 0] < directed[:, 1]
    net = np.bincount(ids.reshape(-1), np.where(forward, 1, -1), minlength=len(edges)).astype(np.int64)
    oriented = np.where((net > 0)[:, None], edges, edges[:, ::-1])
    return np.repeat(oriented, np.abs(net), axis=0)


def edge_index(edges: IntArray, i: IntArray, j: IntArray) -> IntArray:
    """Which of the sorted edges of `unique_edges` joins ``i`` and ``j``. *Shape:* ``(n,), (n,) -> (n,)``."""
    n = int(edges.max()) + 1
    keys = edges[:, 0] * n + edges[:, 1]
    return np.searchsorted(keys, np.minimum(i, j) * n + np.maximum(i, j)).astype(np.int64)


def face_neighbours(faces: IntArray) -> IntArray:
    """Pairs of faces at one edge; where there are three or more, each with the next. *Shape:* ``(n, 2)``."""
    directed, _ = _half_edges(faces)
    edge = np.unique(np.sort(directed, axis=1), axis=0, return_inverse=True)[1].reshape(-1)
    order = np.argsort(edge, kind="stable")
    same = np.diff(edge[order]) == 0
    return np.sort(np.stack([order[:-1][same], order[1:][same]], axis=1) % len(faces), axis=1)


def vertex_pieces(edges: IntArray, n: int) -> IntArray:
    """Which connected piece each of ``n`` vertices belongs to; one without an edge is a piece. *Shape:* ``(n,)``."""
    graph = sparse.coo_matrix((np.ones(len(edges)), (edges[:, 0], edges[:, 1])), shape=(n, n))
    return connected_components(graph, directed=False)[1].astype(np.int64)


def spanning_forest(n: int, pairs: IntArray, costs: NDArray[np.float64]) -> tuple[IntArray, IntArray]:
    """The cheapest connections that hold all together.

    Args:
        n: Number of nodes.
        pairs: Connections, the smaller node first. *Shape:* ``(m, 2)``.
        costs: Above zero. *Shape:* ``(m,)``.

    Returns:
        The parent of each node, its own for a root; the connected piece of each. *Shape:* ``(n,)`` each.
    """
    # Two nodes may be connected twice: entries of a sparse matrix would add up.
    order = np.lexsort((costs, pairs[:, 1], pairs[:, 0]))
    first = np.unique(pairs[order], axis=0, return_index=True)[1]
    rows, columns = pairs[order][first].T
    tree = minimum_spanning_tree(sparse.coo_matrix((costs[order][first], (rows, columns)), shape=(n, n)).tocsr())
    _, piece = connected_components(tree, directed=False)
    parents = np.arange(n)
    for root in np.unique(piece, return_index=True)[1]:
        found, before = breadth_first_order(tree, root, directed=False)
        parents[found[1:]] = before[found[1:]]
    return parents.astype(np.int64), piece.astype(np.int64)


def face_index(faces: IntArray, i: IntArray, j: IntArray, k: IntArray) -> tuple[IntArray, NDArray[np.float64]]:
    """Which face has the corners ``i, j, k``, and +1 or -1 for their order in it. *Shape:* ``(n,)`` each."""
    n = int(faces.max()) + 1
    sorted_corners = np.sort(faces, axis=1)
    keys = (sorted_corners[:, 0] * n + sorted_corners[:, 1]) * n + sorted_corners[:, 2]
    order = np.argsort(keys)
    a, b, c = np.sort(np.stack([i, j, k]), axis=0)
    index = order[np.searchsorted(keys, (a * n + b) * n + c, sorter=order)]
    corners = faces[index]
    place = (corners == i[:, None]).argmax(1)
    follows = np.take_along_axis(corners, ((place + 1) % 3)[:, None], axis=1)[:, 0] == j
    return index, np.where(follows, 1.0, -1.0)


def vertex_areas(vertices: NDArray[np.float64], faces: IntArray) -> NDArray[np.float64]:
    """A third of the area of the faces around each vertex. *Shape:* ``(V,)``."""
    corners = vertices[faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = 0.5 * np.linalg.norm(normals, axis=1)
    areas = np.zeros(len(vertices))
    np.add.at(areas, faces.reshape(-1), np.repeat(area / 3, 3))
    return areas
