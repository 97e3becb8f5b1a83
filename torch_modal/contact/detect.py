"""Search for contacts: vertices that must stay in front of faces. NumPy and SciPy only.

A contact pairs a vertex with a face where parts pass through each other, or nearly touch next to such a place. It never
pairs a vertex with a face that it was behind in a known shape: a self-intersection of a key-frame stays as it is there.
"""

from functools import cached_property

import numpy as np
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from torch_modal.arrays import AnyArray
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


class Search(Crossings):
    """Search for active contacts between parts of a connectivity, with the key-frames as its known shapes."""

    @cached_property
    def known_surfaces(self) -> list[Surface]:
        """Surfaces of the known shapes."""
        return [Surface(x, self.mesh) for x in self.known]

    def __call__(self, x: FloatArray, watched: BoolArray) -> tuple[IntArray, IntArray, int]:
        """Vertices and faces that face each other, and the number of far pairs; none where nothing intersects.

        Vertices next to the intersections are added to ``watched``. *Shape:* ``(V, 3), (V,) -> (n,), (n,)``.
        """
        pairs = self.far_pairs(x)
        if not len(pairs):
            return np.zeros(0, np.int64), np.zeros(0, np.int64), 0
        corners = np.zeros(len(x), dtype=bool)
        corners[self.mesh.faces[pairs.reshape(-1)]] = True
        before = self.known_inside
        surface = Surface(x, self.mesh)
        winds = self.encloses(surface, self.within(corners, DEEP) | (watched & before))
        inside = self.select_connected(winds & ~before, corners)
        watched |= self.grow(np.flatnonzero(corners), 2) | self.grow(np.flatnonzero(inside))
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
        corners, edge = self.mesh.faces, self.lengths.data.mean()
        reach, near = DEEPEST_CONTACT * self.diagonal, WATCHED_WITHIN * self.diagonal
        some = np.flatnonzero(seeds[corners].any(1))
        tree = cKDTree(surface.face_centres[some])
        within = inside | stuck
        parts = [np.zeros((2, 0), np.int64)]
        for chosen, radius, n in ((seeds & ~within, near + 1.5 * edge, _NEAREST), (within, reach, 4 * _NEAREST)):
            queried, n = np.flatnonzero(chosen), min(n, len(some))
            distance, faces = tree.query(surface.vertices[queried], n, distance_upper_bound=radius)
            there = np.isfinite(distance.reshape(-1))
            parts.append(np.stack([np.repeat(queried, n)[there], some[faces.reshape(-1)[there]]]))
        v, f = np.concatenate(parts, 1)
        v, f = _select(dot(surface.vertex_normals[v], surface.face_normals[f]) < FACING, v, f)
        v, f = _select(~(corners[f] == v[:, None]).any(1), v, f)
        height = _heights(surface, v, f)
        keep = (height < near) & (height > -reach) & ((height > -_BEHIND * edge) | within[v])
        v, f, height = _select(keep, v, f, height)
        distance = _distances(surface, v, f)
        v, f, distance = _select(np.abs(height) > _STRAIGHT * distance - 1e-9 * reach, v, f, distance)
        for known in self.known_surfaces:
            behind = _heights(known, v, f) <= -1e-3 * edge
            behind[behind] = _distances(known, v[behind], f[behind]) <= 1.5 * reach
            v, f, distance = _select(~behind | stuck[v], v, f, distance)
        unit = _TIE * self.diagonal
        first = _nearest_faces(v, f, distance / unit, _heights(surface, v, f) / unit)
        v, f = v[first], f[first]
        # Folds are inside, too, where they are in a key-frame.
        keep = np.ones(len(v), dtype=bool)
        keep[stuck[v]] = self.are_far_apart(v[stuck[v]], corners[f[stuck[v]]])
        return v[keep], f[keep]

    def depth(self, x: FloatArray, pairs: IntArray) -> FloatArray:
        """Penetration depth of vertices where parts pass through each other; 0 elsewhere.

        It is the distance to the nearest face that faces them, other than of the patch that went in with them.

        *Shape:* ``(V, 3), (P, 2) -> (V,)``, with the pairs of faces that cross.
        """
        faces, inside = self.mesh.faces, np.flatnonzero(self.inside(x, pairs))
        if not len(inside):
            return np.zeros(len(x))
        patch = np.full(len(x), -1)
        patch[inside] = connected_components(self.adjacency[inside][:, inside], directed=False)[1]
        # The patch of each face that is inside as a whole.
        of_face = np.where((patch[faces] == patch[faces[:, :1]]).all(1), patch[faces[:, 0]], -1)
        surface = Surface(x, self.mesh)
        n = min(_NEAREST, len(faces))
        v = np.repeat(inside, n)
        f: IntArray = np.asarray(cKDTree(surface.face_centres).query(x[inside], n)[1]).reshape(-1)
        facing = dot(surface.vertex_normals[v], surface.face_normals[f]) < FACING
        v, f = _select(facing & (of_face[f] != patch[v]), v, f)
        v, f = _select(_heights(surface, v, f) < 0, v, f)
        least = np.full(len(x), np.inf)
        np.minimum.at(least, v, _distances(surface, v, f))
        return np.where(np.isfinite(least), least, 0.0)


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


def _select(keep: BoolArray, *arrays: AnyArray) -> list[AnyArray]:
    return [array[keep] for array in arrays]
