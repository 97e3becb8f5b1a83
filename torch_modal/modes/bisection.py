"""Conforming bisection of tetrahedra cut from cubes."""

import itertools
from collections.abc import Callable

import numpy as np

from torch_modal.arrays import BoolArray, FloatArray, IntArray
from torch_modal.modes.tetrahedra import EDGES, Tetrahedra, orient

CUBE_UNITS = 256
"""Integer coordinates along the edge of a cube, so that edges can be bisected eight times."""
_ORDERS = np.array(list(itertools.permutations(range(3))))
"""Orders of the axes, each a path from the lowest corner of a cube to the highest. *Shape:* ``(6, 3)``."""
_PATHS = np.array([[np.isin(range(3), order[:step]) for step in range(4)] for order in _ORDERS]).astype(np.int64)
"""Their corners, six tetrahedra: adjacent cubes cut their common face in the same way. *Shape:* ``(6, 4, 3)``."""
_SECOND_HALF = np.array([(0, 1, 2, 3), (1, 1, 2, 3), (1, 2, 2, 3), (1, 2, 3, 3)])
"""Corners of the second half by the end of the bisected edge; the midpoint replaces the one at its place."""


def bisect(
    cubes: IntArray, points: FloatArray, wanted: FloatArray, is_inside: Callable[[FloatArray], BoolArray], most: int
) -> tuple[Tetrahedra, IntArray]:
    """Cut cubes into tetrahedra and bisect them until none is larger than the target size at the points it contains.

    Each cube is cut into six tetrahedra, the paths along its edges from its lowest corner to its highest (Kuhn 1960).
    A tetrahedron is bisected at the edge given by Maubach (1995), together with all that share this edge, so the mesh
    stays conforming. The tetrahedra have only the shapes of the first three bisections.

    Args:
        cubes: Non-negative integer coordinates of the lowest corners. *Shape:* ``(C, 3)``.
        points: Surface samples inside the cubes. *Shape:* ``(P, 3)``.
        wanted: Target size of tetrahedra at each sample, in cube edges. *Shape:* ``(P,)``.
        is_inside: Whether points are inside. *Shape:* ``(n, 3) -> (n,)``. Tetrahedra without
            samples are removed if neither their corners nor their centroids are inside.
        most: Approximate limit of the number of tetrahedra; the largest relative to their target size come first.

    Returns:
        Tetrahedra of positive volume, in cube edges; the one that contains each point, *Shape:* ``(P,)``.
    """
    mesh = _Mesh(cubes, points)
    while True:
        mesh.drop(is_inside)
        # Edge lengths of cubes with six times the volume.
        sizes, ratio = 2.0 ** (-mesh.halvings / 3), np.zeros(len(mesh.tets))
        np.maximum.at(ratio, mesh.owner, sizes[mesh.owner] / wanted)
        chosen = ratio > 1.0
        if not chosen.any() or len(mesh.tets) >= most:
            break
        # Halves have 0.79 of the size. The largest come first, as the number is limited.
        mesh.halve(chosen & (ratio > 0.8 * ratio.max()))
    used, tets = np.unique(mesh.tets, return_inverse=True)
    return orient(Tetrahedra(mesh.coordinates(used), tets.reshape(-1, 4))), mesh.owner


class _Mesh:
    """Tetrahedra as rows of vertex keys.

    Keys are linear in the integer coordinates, so the key of an edge's midpoint is the mean of the keys of its ends.
    """

    def __init__(self, cubes: IntArray, points: FloatArray) -> None:
        counts = cubes.max(axis=0) + 1
        sides = (counts + 1) * CUBE_UNITS
        self.stride = np.array([sides[1] * sides[2], sides[2], 1])
        self.tets: IntArray = (CUBE_UNITS * (cubes[:, None, None] + _PATHS) @ self.stride).reshape(-1, 4)
        self.halvings = np.zeros(len(self.tets), dtype=np.int64)
        self.inner = np.zeros(len(self.tets), dtype=bool)
        self.vertices: IntArray = np.unique(self.tets)
        # The tetrahedron of a point follows from the order of its coordinates within the cube.
        cube = points.astype(np.int64)
        order = np.argsort(-(points - cube), axis=1, kind="stable")
        self.points = points
        number, place = np.zeros((3, 3, 3), dtype=np.int64), np.full(counts, -1)
        number[tuple(_ORDERS.T)], place[tuple(cubes.T)] = np.arange(6), np.arange(len(cubes))
        self.owner = place[tuple(cube.T)] * 6 + number[tuple(order.T)]

    def coordinates(self, keys: IntArray) -> FloatArray:
        """Positions of vertices, in cube edges. *Shape:* ``(...) -> (..., 3)``."""
        x, rest = np.divmod(keys, self.stride[0])
        return np.stack([x, *np.divmod(rest, self.stride[1])], axis=-1) / CUBE_UNITS

    def drop(self, is_inside: Callable[[FloatArray], BoolArray]) -> None:
        """Remove tetrahedra outside."""
        touched = np.zeros(len(self.tets), dtype=bool)
        touched[self.owner] = True
        unsure = np.flatnonzero(~touched & ~self.inner)
        corners, index = np.unique(self.tets[unsure], return_inverse=True)
        inside = is_inside(self.coordinates(corners))[index.reshape(-1, 4)].any(axis=1)
        unsure = unsure[inside | is_inside(self.coordinates(self.tets[unsure]).mean(axis=1))]
        self.inner[unsure] = True
        kept = touched | self.inner
        self.owner = (np.cumsum(kept) - 1)[self.owner]
        self.tets, self.halvings, self.inner = self.tets[kept], self.halvings[kept], self.inner[kept]

    def halve(self, chosen: BoolArray) -> None:
        """Bisect the chosen tetrahedra and all that conformity requires."""
        while chosen.any():
            added = self._halve_alone(chosen)
            changed = np.concatenate([chosen, np.ones(int(chosen.sum()), dtype=bool)])
            chosen = np.zeros(len(self.tets), dtype=bool)
            # Unchanged tetrahedra can only have a hanging vertex, the midpoint of an edge, that is new.
            for those, vertices in ((~changed, added), (changed, self.vertices)):
                if len(vertices):
                    middles = self.tets[those][:, EDGES].sum(axis=2) // 2
                    place = np.minimum(np.searchsorted(vertices, middles), len(vertices) - 1)
                    chosen[those] = (vertices[place] == middles).any(axis=1)

    def _halve_alone(self, chosen: BoolArray) -> IntArray:
        """Bisect the chosen tetrahedra only; return the new vertices."""
        index = np.flatnonzero(chosen)
        old, tag = self.tets[index], 3 - self.halvings[index] % 3
        row = np.arange(len(index))
        middle = (old[:, 0] + old[row, tag]) // 2
        first, second = old.copy(), np.take_along_axis(old, _SECOND_HALF[tag], axis=1)
        first[row, tag] = second[row, tag] = middle
        # Points whose barycentric coordinate of the end is larger lie in the second half.
        place = np.full(len(self.tets), -1)
        place[index] = row
        moved = np.flatnonzero(place[self.owner] >= 0)
        half = place[self.owner[moved]]
        corners = self.coordinates(old[half])
        edges = (corners[:, 1:] - corners[:, :1]).transpose(0, 2, 1)
        shares = np.linalg.solve(edges, (self.points[moved] - corners[:, 0])[..., None])[..., 0]
        far = shares[np.arange(len(half)), tag[half] - 1] > 1 - shares.sum(axis=1)
        self.owner[moved[far]] = len(self.tets) + half[far]

        self.tets[index] = first
        self.tets = np.concatenate([self.tets, second])
        self.halvings[index] += 1
        self.halvings = np.concatenate([self.halvings, self.halvings[index]])
        self.inner = np.concatenate([self.inner, self.inner[index]])
        added = np.unique(middle)
        added = added[~np.isin(added, self.vertices)]
        self.vertices = np.sort(np.concatenate([self.vertices, added]))
        return added
