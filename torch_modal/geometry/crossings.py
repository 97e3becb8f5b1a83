"""Which triangles of a surface pass through each other, and which vertices lie inside. NumPy and SciPy only.

Pairs come from the tree of boxes and the exact predicates of ``libigl``, as do winding numbers. It is the extra
``contact`` and is imported when it is first needed.
"""

from collections.abc import Callable
from functools import cached_property

import numpy as np
from scipy import sparse
from scipy.sparse.csgraph import connected_components, dijkstra

from torch_modal import extras
from torch_modal.arrays import BoolArray, FloatArray, IntArray
from torch_modal.geometry.closest import dot
from torch_modal.geometry.connectivity import Connectivity, edge_graph
from torch_modal.geometry.inspect import volume_of
from torch_modal.geometry.surface import Surface

RINGS_OF_CROSSINGS = 2
"""Pairs within so many rings of a crossing of a key-frame belong to it: it grows and shrinks with every rounding."""
FAR_APART = 0.06
"""Part of the diagonal, along the surface; nearer crossings are folds, not two parts that meet."""
SOURCES_AT_ONCE = 256
"""Vertices from which distances along the surface are searched at a time, to bound memory."""
_OFFSET = 1e-4
"""Offset along the normal, over the diagonal, at which winding numbers of vertices are taken: on the surface they are
1/2."""


def require_contact() -> None:
    """Refuse work with contact where the extra is not installed, before any of it is done.

    Raises:
        MissingPackageError: It names what is missing.
    """
    extras.require("igl", "contact", "contact")


class Crossings:
    """Finds crossing triangles of shapes of one connectivity.

    Args:
        mesh: The connectivity.
        known: Shapes whose own crossings are tolerated. *Shape:* ``(K, V, 3)``.
        like: The shape whose lengths say what is far along the surface. Default: the first of ``known``.
        search: Finds what :meth:`pairs` does, in any order, and may find more. *Shape:* ``(V, 3) -> (P, 2)``.
            Default: by ``libigl``.
    """

    def __init__(
        self,
        mesh: Connectivity,
        known: FloatArray,
        like: FloatArray | None = None,
        search: Callable[[FloatArray], IntArray] | None = None,
    ) -> None:
        self.mesh, self.known, self._search = mesh, known, search
        self.like = known[0] if like is None else like
        self.diagonal = float(np.linalg.norm(np.ptp(self.like[mesh.used], axis=0)))

    # ------------------------------------------------------------------------------------------------- once for a mesh
    @cached_property
    def lengths(self) -> sparse.csr_matrix:
        """Edge lengths as a graph. *Shape:* ``(V, V)``."""
        return edge_graph(self.like, self.mesh.edges)

    @cached_property
    def adjacency(self) -> sparse.csr_matrix:
        """True between vertices that an edge joins. *Shape:* ``(V, V)``."""
        return self.lengths.astype(bool)

    @cached_property
    def pairs_of_known(self) -> list[IntArray]:
        """Pairs that cross in each of the known shapes. *Shape of each:* ``(P, 2)``."""
        return [self.pairs(x) for x in self.known]

    @cached_property
    def known_pairs(self) -> IntArray:
        """Pairs that cross in any of the known shapes. *Shape:* ``(P, 2)``."""
        return np.unique(np.concatenate([*self.pairs_of_known, np.zeros((0, 2), np.int64)]), axis=0)

    @cached_property
    def _around_known(self) -> sparse.csr_matrix:
        """True where a pair of faces lies within :data:`RINGS_OF_CROSSINGS` of a known one. *Shape:* ``(F, F)``."""
        n, (one, other) = len(self.mesh.faces), self.known_pairs.T
        ends = self.mesh.faces.reshape(-1), np.repeat(np.arange(n), 3)
        incidence = sparse.csr_matrix((np.ones(3 * n, dtype=bool), ends), (self.mesh.n_vertices, n))
        touching = incidence.T @ incidence  # faces that share a vertex
        near = sparse.csr_matrix((np.ones(len(one), dtype=bool), (one, other)), (n, n))
        near = near + near.T
        for _ in range(RINGS_OF_CROSSINGS):
            near = touching @ near @ touching
        return near

    @cached_property
    def known_inside(self) -> BoolArray:
        """Vertices that lie inside the surface in any of the known shapes. *Shape:* ``(V,)``."""
        inside, mesh = np.zeros(self.mesh.n_vertices, dtype=bool), self.mesh
        one_piece = len(np.unique(mesh.vertex_pieces[mesh.faces])) == 1 and len(mesh.boundary_edges) == 0
        for x, pairs in zip(self.known, self.pairs_of_known, strict=True):
            # One closed piece that does not cross itself has nothing inside.
            if len(pairs) or not one_piece:
                inside |= self.encloses(Surface(x, self.mesh), np.ones(len(x), dtype=bool))
        return inside

    # ----------------------------------------------------------------------------------------------------- of one shape
    def pairs(self, x: FloatArray) -> IntArray:
        """Pairs of triangles that share no vertex and cross, the smaller number first, sorted.

        By :func:`triangles_cross`: those that only touch, or lie in one plane, do not cross. A shape that is not finite
        has none. *Shape:* ``(V, 3) -> (P, 2)``.
        """
        if not np.isfinite(x).all():
            return np.zeros((0, 2), np.int64)
        if self._search is None:
            predicates = extras.require("igl.predicates", "contact", "contact")
            pairs = predicates.find_self_intersections(np.ascontiguousarray(x), self.mesh.faces.copy())[1]
        else:
            pairs = self._search(x)
        pairs = np.sort(pairs, axis=1)
        one, other = self.mesh.faces[pairs].transpose(1, 0, 2)
        apart = ~(one[:, :, None] == other[:, None]).any((1, 2))
        pairs = pairs[apart][triangles_cross(x[one[apart]], x[other[apart]])]
        return pairs[np.lexsort(pairs.T[::-1])]

    def far_pairs(self, x: FloatArray) -> IntArray:
        """The :meth:`pairs` that are far, by :meth:`is_far`. *Shape:* ``(V, 3) -> (P, 2)``."""
        pairs = self.pairs(x)
        return pairs[self.is_far(pairs)]

    def reach(self, x: FloatArray, pairs: IntArray) -> float:
        """Largest reach of triangles of given pairs through each other, along a normal. *Shape:* ``(P, 2)``."""
        surface, least = Surface(x, self.mesh), np.full(len(pairs), np.inf)
        for moving, other in (pairs.T, pairs.T[::-1]):
            arms = x[self.mesh.faces[moving]] - x[self.mesh.faces[other, :1]]
            height = dot(arms, surface.face_normals[other][:, None])
            least = np.minimum(least, np.minimum(height.max(1), -height.min(1)))
        return float(least.max(initial=0.0))

    def is_new(self, pairs: IntArray) -> BoolArray:
        """Which pairs cross in none of the known shapes. *Shape:* ``(P, 2) -> (P,)``."""
        n = len(self.mesh.faces)
        code, known = (p[:, 0] * n + p[:, 1] for p in (pairs, self.known_pairs))
        return ~np.isin(code, known)

    def is_far(self, pairs: IntArray) -> BoolArray:
        """Which pairs are two parts that went through each other.

        They are more than :data:`RINGS_OF_CROSSINGS` from each pair that crosses in a known shape, and their triangles
        more than :data:`FAR_APART` of the diagonal apart along the surface. *Shape:* ``(P, 2) -> (P,)``.
        """
        far = self.is_new(pairs)
        if len(pairs) and len(self.known_pairs):
            far &= ~np.asarray(self._around_known[pairs[:, 0], pairs[:, 1]]).reshape(-1)
        one, other = self.mesh.faces[pairs[far]].transpose(1, 0, 2)
        far[far] = np.all([self.are_far_apart(corner, other) for corner in one.T], axis=0)
        return far

    def are_far_apart(self, vertices: IntArray, faces: IntArray) -> BoolArray:
        """True for a vertex and a face more than :data:`FAR_APART` apart on the surface. *Shape:* ``(n,), (n, 3)``."""
        sources, which = np.unique(vertices, return_inverse=True)
        far = np.ones(len(vertices), dtype=bool)
        for start in range(0, len(sources), SOURCES_AT_ONCE):
            some = sources[start : start + SOURCES_AT_ONCE]
            reached = dijkstra(self.lengths, indices=some, limit=FAR_APART * self.diagonal)
            rows = np.flatnonzero(which // SOURCES_AT_ONCE == start // SOURCES_AT_ONCE)
            far[rows] = np.isinf(reached[which[rows, None] - start, faces[rows]]).all(1)
        return far

    def within(self, vertices: BoolArray, distance: float) -> BoolArray:
        """Vertices within a part of the diagonal of given ones, along the surface. *Shape:* ``(V,) -> (V,)``."""
        if not vertices.any():
            return vertices
        limit = distance * self.diagonal
        reached = dijkstra(self.lengths, indices=np.flatnonzero(vertices), min_only=True, limit=limit)
        return np.asarray(np.isfinite(reached))

    def inside(self, x: FloatArray, pairs: IntArray) -> BoolArray:
        """Vertices that are inside since parts went through each other.

        They are inside by winding number, were not so in any known shape, and hang together with the given pairs of
        faces, which cross far from each other. *Shape:* ``(V, 3), (P, 2) -> (V,)``.
        """
        corners = np.zeros(self.mesh.n_vertices, dtype=bool)
        corners[self.mesh.faces[pairs.reshape(-1)]] = True
        inside = self.encloses(Surface(x, self.mesh), np.full(len(x), len(pairs) > 0))
        return self.select_connected(inside & ~self.known_inside, corners)

    def encloses(self, surface: Surface, asked: BoolArray) -> BoolArray:
        """Around which of some vertices a shape winds: around a point just outside. *Shape:* ``(V,) -> (V,)``."""
        queried, inside = np.flatnonzero(asked), np.zeros(len(asked), dtype=bool)
        if len(queried):
            x, faces = surface.vertices, self.mesh.faces
            points = x[queried] + _OFFSET * self.diagonal * surface.vertex_normals[queried]
            # About 1 inside, about 0 outside.
            igl = extras.require("igl", "contact", "contact")
            number = igl.fast_winding_number(*(np.ascontiguousarray(a) for a in (x, faces, points)))
            is_inside_out = volume_of(x - x.mean(0), faces) < 0
            inside[queried] = (-number if is_inside_out else number) > 0.5
        return inside

    def select_connected(self, vertices: BoolArray, seeds: BoolArray) -> BoolArray:
        """Vertices that hang together with others, or with the ring around them. *Shape:* ``(V,), (V,) -> (V,)``."""
        members, kept = np.flatnonzero(vertices), np.zeros(len(vertices), dtype=bool)
        if len(members) and seeds.any():
            label = connected_components(self.adjacency[members][:, members], directed=False)[1]
            kept[members[np.isin(label, np.unique(label[self.grow(np.flatnonzero(seeds))[members]]))]] = True
        return kept

    def grow(self, vertices: IntArray, rings: int = 1) -> BoolArray:
        """A set of vertices and the rings around it. *Shape:* ``(n,) -> (V,)``."""
        chosen = np.zeros(self.mesh.n_vertices, dtype=bool)
        chosen[vertices] = True
        for _ in range(rings):
            chosen |= self.adjacency @ chosen
        return chosen


def triangles_cross(one: FloatArray, other: FloatArray) -> BoolArray:
    """Exact intersection test of pairs of triangles.

    Two triangles intersect if each has vertices strictly on both sides of the other's plane, and their segments on the
    line of the planes overlap in more than a point (Guigue and Devillers 2003). Touching and coplanar triangles do not.
    Signs of determinants are exact. *Shape:* ``(n, 3, 3), (n, 3, 3) -> (n,)``.

    Raises:
        MissingPackageError: ``libigl`` is not installed.
    """
    sides = _sides(one, other), _sides(other, one)
    crossing: BoolArray = np.all([(side > 0).any(1) & (side < 0).any(1) for side in sides], axis=0)
    some = np.flatnonzero(crossing)
    first, first_above = _lone_first(one[some], sides[0][some])
    second, second_above = _lone_first(other[some], sides[1][some])
    # Flips the other triangle so that each lone vertex is above its plane.
    second[~first_above, 1:] = second[~first_above, :0:-1]
    first[~second_above, 1:] = first[~second_above, :0:-1]
    p, q, r = first.transpose(1, 0, 2)
    a, b, c = second.transpose(1, 0, 2)
    crossing[some] = (_above(p, q, a, b) < 0) & (_above(p, r, c, a) < 0)
    return crossing


def _sides(points: FloatArray, planes: FloatArray) -> FloatArray:
    """Side of a triangle's plane for three points: 1 above, -1 below, 0 in it. *Shape:* ``(n, 3)``."""
    a, b, c = (planes[:, i] for i in range(3))
    return np.stack([_above(a, b, c, points[:, i]) for i in range(3)], 1)


def _above(a: FloatArray, b: FloatArray, c: FloatArray, d: FloatArray) -> FloatArray:
    """The exact sign of ``(b - a) x (c - a) . (d - a)``. *Shape of each:* ``(n, 3)``."""
    orient = extras.require("igl.predicates", "contact", "contact").orient3d
    sign: FloatArray = -orient(*(np.ascontiguousarray(x) for x in (a, b, c, d)))
    return sign


def _lone_first(corners: FloatArray, side: FloatArray) -> tuple[FloatArray, BoolArray]:
    """Corners rotated so that the one alone on its side comes first, and whether it is above."""
    above = (side > 0).sum(1) == 1
    lone = np.where(above, (side > 0).argmax(1), (side < 0).argmax(1))
    corner_order = (lone[:, None] + np.arange(3)) % 3
    return np.take_along_axis(corners, corner_order[..., None], 1), above
