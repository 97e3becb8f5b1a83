"""Search for contacts: vertices that must stay in front of faces. NumPy and SciPy only.

A contact pairs a vertex with a face where parts pass through each other, or nearly touch next to such a place. It never
pairs a vertex with a face that it was behind in a known shape: a self-intersection of a key-frame stays as it is there.
"""

from typing import Any

import numpy as np
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from torch_modal.geometry.closest import closest_on_triangles, dot
from torch_modal.geometry.crossings import BoolArray, Crossings, FloatArray, IntArray
from torch_modal.geometry.surface import Surface

# Lengths are parts of the diagonal.
DEEPEST_CONTACT = 0.06
"""Largest depth of a vertex that is pushed out."""
WATCHED_WITHIN = 0.015
"""Largest distance in front of a face at which a vertex next to an intersection is watched."""
FACING = -0.1
"""Largest cosine between the normals of a vertex and of a face that face each other."""
DEEP = 0.12
"""Distance along the surface, from an intersection, within which penetrating vertices are searched."""
_STRAIGHT = 0.7
"""Least part of the distance that lies along the face's normal; with less, the vertex lies to the side of the face."""
_BEHIND = 0.02
"""Part of the mean edge length: how far behind a face a vertex outside may lie, which is rounding of a fold."""
_TIE = 1e-9
"""Lengths that differ by less than this are equal but for rounding."""
_NEAREST = 64
"""Number of faces, by their centres, among which the nearest is searched; four times as many from inside."""


class Search:
    """Search for active contacts between parts of a connectivity, with the key-frames as its known shapes."""

    def __init__(self, crossings: Crossings) -> None:
        self.crossings = crossings
        i, j = crossings.mesh.edges.T
        self._edge = float(np.linalg.norm(crossings.like[i] - crossings.like[j], axis=1).mean())
        self._known = [Surface(x, crossings.mesh) for x in crossings.known]

    def __call__(self, x: FloatArray, watched: BoolArray) -> tuple[IntArray, IntArray, int]:
        """Vertices and faces that face each other, and the number of far pairs; none where nothing intersects.

        Vertices next to the intersections are added to ``watched``. *Shape:* ``(V, 3), (V,) -> (n,), (n,)``.
        """
        crossings = self.crossings
        pairs = crossings.far_pairs(x)
        if not len(pairs):
            none = np.zeros(0, np.int64)
            return none, none, 0
        corners = np.zeros(len(x), dtype=bool)
        corners[crossings.mesh.faces[pairs.reshape(-1)]] = True
        before = crossings.known_inside
        surface = Surface(x, crossings.mesh)
        winds = crossings.encloses(surface, crossings.within(corners, DEEP) | (watched & before))
        inside = crossings.select_connected(winds & ~before, corners)
        watched |= crossings.grow(np.flatnonzero(corners), 2) | crossings.grow(np.flatnonzero(inside))
        # Vertices inside in a key-frame must not enter elsewhere.
        return *self.opposite(surface, watched, inside, winds & before & watched), len(pairs)

    def opposite(
        self, surface: Surface, seeds: BoolArray, inside: BoolArray, stuck: BoolArray
    ) -> tuple[IntArray, IntArray]:
        """Find the nearest face in front of which each vertex lies, or behind which, if it is inside.

        Args:
            surface: The shape.
            seeds: Requested vertices, and corners of faces that may be found. *Shape:* ``(V,)``.
            inside: Vertices that are inside the surface, and were not in any known shape. *Shape:* ``(V,)``.
            stuck: Those that are, and were. *Shape:* ``(V,)``.

        Returns:
            Vertices and faces. *Shape:* ``(n,), (n,)``.
        """
        crossings, corners = self.crossings, self.crossings.mesh.faces
        reach, near = DEEPEST_CONTACT * crossings.diagonal, WATCHED_WITHIN * crossings.diagonal
        some = np.flatnonzero(seeds[corners].any(1))
        tree = cKDTree(surface.face_centres[some])
        within = inside | stuck
        parts = [np.zeros((2, 0), np.int64)]
        for chosen, radius, n in ((seeds & ~within, near + 1.5 * self._edge, _NEAREST), (within, reach, 4 * _NEAREST)):
            queried, n = np.flatnonzero(chosen), min(n, len(some))
            distance, faces = tree.query(surface.vertices[queried], n, distance_upper_bound=radius)
            there = np.isfinite(distance.reshape(-1))
            parts.append(np.stack([np.repeat(queried, n)[there], some[faces.reshape(-1)[there]]]))
        v, f = np.concatenate(parts, 1)
        v, f = _select(dot(surface.vertex_normals[v], surface.face_normals[f]) < FACING, v, f)
        v, f = _select(~(corners[f] == v[:, None]).any(1), v, f)
        height = _heights(surface, v, f)
        keep = (height < near) & (height > -reach) & ((height > -_BEHIND * self._edge) | within[v])
        v, f, height = _select(keep, v, f, height)
        distance = _distances(surface, v, f)
        v, f, distance = _select(np.abs(height) > _STRAIGHT * distance - 1e-9 * reach, v, f, distance)
        for known in self._known:
            behind = _heights(known, v, f) <= -1e-3 * self._edge
            behind[behind] = _distances(known, v[behind], f[behind]) <= 1.5 * reach
            v, f, distance = _select(~behind | stuck[v], v, f, distance)
        unit = _TIE * crossings.diagonal
        first = _nearest_faces(v, f, distance / unit, _heights(surface, v, f) / unit)
        v, f = v[first], f[first]
        # Folds are inside, too, where they are in a key-frame.
        keep = np.ones(len(v), dtype=bool)
        keep[stuck[v]] = crossings.are_far_apart(v[stuck[v]], corners[f[stuck[v]]])
        return v[keep], f[keep]

    def depth(self, x: FloatArray, pairs: IntArray) -> FloatArray:
        """Penetration depth of vertices where parts pass through each other; 0 elsewhere.

        It is the distance to the nearest face that faces them, other than of the patch that went in with them.

        *Shape:* ``(V, 3), (P, 2) -> (V,)``, with the pairs of faces that cross.
        """
        crossings, faces = self.crossings, self.crossings.mesh.faces
        deep = np.zeros(len(x))
        inside = np.flatnonzero(crossings.inside(x, pairs))
        if not len(inside):
            return deep
        patch = np.full(len(x), -1)
        patch[inside] = connected_components(crossings.adjacency[inside][:, inside], directed=False)[1]
        # The patch of each face that is inside as a whole.
        of_face = np.where((patch[faces] == patch[faces[:, :1]]).all(1), patch[faces[:, 0]], -1)
        surface = Surface(x, crossings.mesh)
        n = min(_NEAREST, len(faces))
        v: Any = np.repeat(inside, n)
        f: Any = np.asarray(cKDTree(surface.face_centres).query(x[inside], n)[1]).reshape(-1)
        facing = dot(surface.vertex_normals[v], surface.face_normals[f]) < FACING
        v, f = _select(facing & (of_face[f] != patch[v]), v, f)
        v, f = _select(_heights(surface, v, f) < 0, v, f)
        least = np.full(len(x), np.inf)
        np.minimum.at(least, v, _distances(surface, v, f))
        is_deep = np.isfinite(least)
        deep[is_deep] = least[is_deep]
        return deep


def _heights(surface: Surface, v: IntArray, f: IntArray) -> FloatArray:
    """Heights of vertices over the planes of faces. *Shape:* ``(n,), (n,) -> (n,)``."""
    return dot(surface.vertices[v] - surface.vertices[surface.faces[f, 0]], surface.face_normals[f])


def _distances(surface: Surface, v: IntArray, f: IntArray) -> FloatArray:
    """Distances of vertices from faces. *Shape:* ``(n,), (n,) -> (n,)``."""
    return closest_on_triangles(surface.vertices[v], surface.vertices[surface.faces[f]])[1]


def _nearest_faces(v: IntArray, f: IntArray, distance: FloatArray, height: FloatArray) -> IntArray:
    """Indices of the pairs of each vertex with its nearest face; of equally near ones, with the farthest plane.

    Lengths are in units in which rounding does not count: faces share nearest points.
    """
    order = np.lexsort((f, -np.abs(height).round(), distance.round(), v))
    return order[np.flatnonzero(np.diff(v[order], prepend=-1))]


def _select(keep: BoolArray, *arrays: Any) -> list[Any]:
    return [array[keep] for array in arrays]
