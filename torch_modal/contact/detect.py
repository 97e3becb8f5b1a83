"""Search for contacts: which vertices must stay in front of which faces. NumPy and SciPy only.

A contact pairs a vertex with a face where parts went through each other, or nearly touch beside such a place. It never
pairs a vertex with a face that it was behind in a known shape: what touches or crosses itself there stays as it is.
"""

from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from torch_modal.geometry.crossings import BoolArray, Crossings, FloatArray, IntArray, Surface
from torch_modal.geometry.triangle_pairs import dot

# Lengths are parts of the diagonal.
REACH = 0.06
"""How deep a vertex may be to be pushed out."""
NEAR = 0.015
"""How far in front of a face a vertex is watched, beside a place where parts went through each other."""
FACING = -0.1
"""Most cosine between the normals of a vertex and of a face that face each other."""
DEEP = 0.12
"""Distance along the surface, from a crossing, within which penetrating vertices are searched."""
SPREAD = 0.05
"""How far along the surface from where a key-frame passes through itself the same depth is tolerated."""
LENIENT = 0.06
"""Part of the time between two key-frames over which what crosses in one of them is pushed out of a shape alone."""
_STRAIGHT = 0.7
"""Least part of the distance that lies along the face's normal; less is beside the face, not before it."""
_BEHIND = 0.02
"""Of the mean edge length: how far behind a face a vertex that is not inside may lie, which is rounding of a fold."""
_TIE = 1e-6
"""Lengths that differ by less than this part of them are equal but for rounding."""
_NEAREST = 64
"""Faces, by their centres, among which the nearest to a vertex is looked for; four times as many from inside."""


class FoundContacts(NamedTuple):
    """Vertices and faces that face each other in one shape."""

    vertices: IntArray
    """*Shape:* ``(n,)``."""
    faces: IntArray
    """*Shape:* ``(n,)``."""
    slack: FloatArray
    """How deep they may be beside each known shape; 0 where nothing passes through itself. *Shape:* ``(n, K)``."""
    far: IntArray
    """Pairs of triangles that went through each other. *Shape:* ``(P, 2)``."""
    watched: BoolArray
    """Vertices beside places where they do, or did in an earlier search. *Shape:* ``(V,)``."""


class Search:
    """Search for active contacts.

    Args:
        crossings: Of the connectivity, with the key-frames as its known shapes.
    """

    def __init__(self, crossings: Crossings) -> None:
        self.crossings = crossings
        i, j = crossings.mesh.edges.T
        self._edge = float(np.linalg.norm(crossings.like[i] - crossings.like[j], axis=1).mean())
        self._known = [Surface(crossings, x) for x in crossings.known]

    def __call__(self, x: FloatArray, watched: BoolArray | None = None) -> FoundContacts:
        """The active contacts of a shape.

        Args:
            x: *Shape:* ``(V, 3)``.
            watched: Of earlier searches: what was pushed apart is watched on. *Shape:* ``(V,)``.
        """
        crossings = self.crossings
        pairs = crossings.far_pairs(x)
        seeds = np.zeros(len(x), dtype=bool) if watched is None else watched.copy()
        none = np.zeros(0, np.int64)
        if not len(pairs) and not seeds.any():
            return FoundContacts(none, none, np.zeros((0, len(self._known))), pairs, seeds)
        corners = np.zeros(len(x), dtype=bool)
        corners[crossings.mesh.faces[pairs.reshape(-1)]] = True
        before = crossings.known_inside
        surface = Surface(crossings, x)
        winds = crossings.winds(surface, crossings.within(corners, DEEP) | (seeds & before))
        inside = crossings.hanging(winds & ~before, corners)
        seeds |= crossings.grown(np.flatnonzero(corners), 2) | crossings.grown(np.flatnonzero(inside))
        # What was inside in a key-frame is not to go in elsewhere.
        stuck = winds & before & seeds
        return FoundContacts(*self.opposite(surface, seeds, inside, stuck), pairs, seeds)

    def tolerance(self, slack: FloatArray, t: float) -> FloatArray:
        """How much of what crosses in both key-frames is tolerated between them: all at their times, nothing later.

        Args:
            slack: Depths in the key-frames. *Shape:* ``(..., 2)``.
            t: The time, from 0 to 1.

        Returns:
            From 0 to 1; 0 where there is no depth. *Shape:* ``(..., 2)``.
        """
        part = np.clip(1 - np.array([t, 1 - t]) / LENIENT, 0, 1)
        return (slack > 0) * part  # type: ignore[no-any-return]

    def n_left(self, pairs: IntArray, t: float) -> int:
        """How many pairs of faces are not beside what is tolerated. *Shape:* ``(P, 2)``."""
        if not len(pairs) or not self._known:
            return len(pairs)
        slack = self.tolerated[self.crossings.mesh.faces[pairs]].max((1, 2))
        return int((self.tolerance(slack, t) <= 0).all(1).sum())

    @cached_property
    def tolerated(self) -> FloatArray:
        """How deep each known shape passes through itself around each vertex. *Shape:* ``(V, K)``."""
        crossings = self.crossings
        found = np.zeros((crossings.mesh.n_vertices, len(crossings.known)))
        alone = Search(Crossings(crossings.mesh, crossings.known[:0], crossings.like))
        for k, (x, pairs) in enumerate(zip(crossings.known, crossings.pairs_of_known, strict=True)):
            deep = alone.depth(x, pairs[crossings.far_apart(pairs)])
            own = np.flatnonzero(deep)
            patch = connected_components(crossings.adjacency[own][:, own], directed=False)[1]
            for number in np.unique(patch):
                mine = np.zeros(len(x), dtype=bool)
                mine[own[patch == number]] = True
                around = crossings.within(mine, SPREAD)
                found[around, k] = np.maximum(found[around, k], deep[mine].max())
        return found

    def opposite(
        self, surface: Surface, seeds: BoolArray, inside: BoolArray, stuck: BoolArray
    ) -> tuple[IntArray, IntArray, FloatArray]:
        """The nearest face before which, or of what is inside, behind which each vertex lies.

        Args:
            surface: The shape.
            seeds: Requested vertices, and corners of faces that may be found. *Shape:* ``(V,)``.
            inside: Vertices that are inside the surface, and were not in any known shape. *Shape:* ``(V,)``.
            stuck: Vertices that are inside the surface, and were in a known shape. *Shape:* ``(V,)``.

        Returns:
            Vertices, faces and slack of :class:`FoundContacts`.
        """
        crossings, corners = self.crossings, self.crossings.mesh.faces
        reach, near = REACH * crossings.diagonal, NEAR * crossings.diagonal
        some = np.flatnonzero(seeds[corners].any(1))
        tree = cKDTree(surface.centres[some])
        within = inside | stuck
        parts = []
        for chosen, radius in ((seeds & ~within, near + 1.5 * self._edge), (within, reach)):
            own = np.flatnonzero(chosen)
            if len(own):
                n = min(_NEAREST if chosen is not within else 4 * _NEAREST, len(some))
                distance, found = tree.query(surface.x[own], n, distance_upper_bound=radius)
                there = np.isfinite(distance.reshape(-1))
                parts.append((np.repeat(own, n)[there], some[found.reshape(-1)[there]]))
        if not parts:
            none = np.zeros(0, np.int64)
            return none, none, np.zeros((0, len(self._known)))
        v, f = (np.concatenate(part) for part in zip(*parts, strict=True))
        v, f = _kept(dot(surface.vertex_normals[v], surface.normals[f]) < FACING, v, f)
        v, f = _kept(~(corners[f] == v[:, None]).any(1), v, f)
        height = _heights(surface, v, f)
        keep = (height < near) & (height > -reach) & ((height > -_BEHIND * self._edge) | within[v])
        v, f, height = _kept(keep, v, f, height)
        distance = _distances(surface, v, f)
        v, f, distance = _kept(np.abs(height) > _STRAIGHT * distance - 1e-9 * reach, v, f, distance)
        slack: list[FloatArray] = []
        for known in self._known:
            side = _heights(known, v, f)
            behind = side <= -1e-3 * self._edge
            behind[behind] = _distances(known, v[behind], f[behind]) <= 1.5 * reach
            keep = ~behind | stuck[v]
            slack = [part[keep] for part in slack] + [np.where(behind, -side, 0.0)[keep]]
            v, f, distance = _kept(keep, v, f, distance)
        first = _nearest_faces(v, f, distance, _heights(surface, v, f))
        v, f, both = v[first], f[first], np.stack(slack, 1)[first] if slack else np.zeros((len(first), 0))
        # What is in a part also lies behind its far side, deeper than it went in.
        own = np.maximum(self.tolerated[v], self.tolerated[corners[f]].max(1))
        both = np.where(own > 0, own, both)
        # Folds are inside, too, where they are in a key-frame.
        keep = np.ones(len(v), dtype=bool)
        keep[stuck[v]] = crossings.separated(v[stuck[v]], corners[f[stuck[v]]])
        return v[keep], f[keep], both[keep]

    def depth(self, x: FloatArray, pairs: IntArray) -> FloatArray:
        """How deep vertices are inside where parts went through each other; 0 elsewhere.

        That is the distance to the nearest face that faces them, other than of the patch that went in with them.

        Args:
            x: *Shape:* ``(V, 3)``.
            pairs: Faces that cross. *Shape:* ``(P, 2)``.

        Returns:
            *Shape:* ``(V,)``.
        """
        crossings, faces = self.crossings, self.crossings.mesh.faces
        deep = np.zeros(len(x))
        own = np.flatnonzero(crossings.inside(x, pairs))
        if not len(own):
            return deep
        patch = np.full(len(x), -1)
        patch[own] = connected_components(crossings.adjacency[own][:, own], directed=False)[1]
        # The patch of each face that is inside as a whole.
        of_face = np.where((patch[faces] == patch[faces[:, :1]]).all(1), patch[faces[:, 0]], -1)
        surface = Surface(crossings, x)
        n = min(_NEAREST, len(faces))
        near = np.asarray(cKDTree(surface.centres).query(x[own], n)[1]).reshape(-1)
        v: Any = np.repeat(own, n)
        f: Any = near
        facing = dot(surface.vertex_normals[v], surface.normals[f]) < FACING
        v, f = _kept(facing & (of_face[f] != patch[v]), v, f)
        v, f = _kept(_heights(surface, v, f) < 0, v, f)
        least = np.full(len(x), np.inf)
        np.minimum.at(least, v, _distances(surface, v, f))
        found = np.isfinite(least)
        deep[found] = least[found]
        return deep


def _heights(surface: Surface, v: IntArray, f: IntArray) -> FloatArray:
    """Of vertices over the planes of faces. *Shape:* ``(n,), (n,) -> (n,)``."""
    return dot(surface.x[v] - surface.x[surface.faces[f, 0]], surface.normals[f])


def _distances(surface: Surface, v: IntArray, f: IntArray) -> FloatArray:
    """From vertices to faces. *Shape:* ``(n,), (n,) -> (n,)``."""
    offset = surface.x[v] - nearest_on_triangles(surface.x[v], surface.x[surface.faces[f]])
    return np.sqrt(dot(offset, offset))  # type: ignore[no-any-return]


def _nearest_faces(v: IntArray, f: IntArray, distance: FloatArray, height: FloatArray) -> IntArray:
    """Which pairs are those of each vertex with its nearest face.

    Faces around the nearest point share it, and rounding would choose among them: the one whose plane is farthest is
    taken, and of those in one plane the first.

    Args:
        v: Vertices. *Shape:* ``(n,)``.
        f: Faces. *Shape:* ``(n,)``.
        distance: From the face. *Shape:* ``(n,)``.
        height: Over its plane. *Shape:* ``(n,)``.
    """
    chosen = np.arange(len(v))
    for lengths, sign in ((distance, 1), (np.abs(height), -1)):
        least = np.full(v.max(initial=0) + 1, np.inf)
        values = sign * lengths[chosen]
        np.minimum.at(least, v[chosen], values)
        near = least[v[chosen]]
        chosen = chosen[values <= near + _TIE * np.abs(near)]
    order = chosen[np.lexsort((f[chosen], v[chosen]))]
    return order[np.flatnonzero(np.diff(v[order], prepend=-1))]


def _kept(keep: BoolArray, *arrays: Any) -> list[Any]:
    return [array[keep] for array in arrays]


def nearest_on_triangles(points: FloatArray, corners: FloatArray) -> FloatArray:
    """The nearest point of each triangle to a point of its own. *Shape:* ``(n, 3), (n, 3, 3) -> (n, 3)``.

    The foot on the plane where it lies within the triangle, otherwise the nearest of those on the three sides.
    """
    a, b, c = corners.transpose(1, 0, 2)
    u, v, w = b - a, c - a, points - a
    uu, uv, vv, uw, vw = dot(u, u), dot(u, v), dot(v, v), dot(u, w), dot(v, w)
    determinant = uu * vv - uv * uv
    flat = determinant <= 1e-300
    scale = np.where(flat, 1, determinant)
    s, t = (vv * uw - uv * vw) / scale, (uu * vw - uv * uw) / scale
    best = a + s[:, None] * u + t[:, None] * v
    outside = np.flatnonzero((s < 0) | (t < 0) | (s + t > 1) | flat)
    least = np.full(len(outside), np.inf)
    p = points[outside]
    for start, end in ((a, b), (b, c), (c, a)):
        from_, along = start[outside], end[outside] - start[outside]
        squared = dot(along, along)
        share = np.clip(dot(p - from_, along) / np.where(squared > 0, squared, 1), 0, 1)
        foot = from_ + share[:, None] * along
        distance = dot(p - foot, p - foot)
        nearer = distance < least
        best[outside[nearer]], least[nearer] = foot[nearer], distance[nearer]
    return best
