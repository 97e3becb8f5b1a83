"""As-rigid-as-possible fit of a template to a target."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from scipy import sparse
from scipy.spatial import cKDTree

from torch_modal.arrays import BoolArray, FloatArray, IntArray
from torch_modal.registration.elastic import ElasticSurface, PointTargets
from torch_modal.registration.spectrum import SpectralShape
from torch_modal.registration.surface import Closest, MeshSurface

WORKING_DIAGONAL = 100.0
"""Diagonal of the target; the reaches below are percentages of it."""


class Stage(NamedTuple):
    """Steps with constant parameters."""

    weight: float
    """Weight of closest points relative to the stiffness."""
    reach: float
    """Largest distance of closest points, in percent of the diagonal."""
    steps: int


COARSE_STAGES = (Stage(0.05, 6, 4), Stage(0.2, 5, 6), Stage(0.5, 4, 6), Stage(2.0, 3, 4))
FINE_STAGES = (Stage(0.3, 4, 3), Stage(1.0, 3, 3), Stage(3.0, 3, 3))

_ALIKE = 0.4  # smallest cosine between the normals of closest points
_LANDMARK_WEIGHT = 5.0
MAP_WEIGHTS = (0.02, 0.1)
_MAP_ROUNDS = 40
_MAP_SHARE = 0.05  # weight of the map relative to closest points
_RELEASED, _CAUGHT = Stage(0.3, 5, 4), Stage(0.5, 5, 3)  # without flipped faces, then with them
_REST = 1e-5  # fixes pieces without a counterpart
_ON_EDGE = 1e-6


class Gate:
    """Accepts closest points near the image of a map, by geodesic distance: touching fingers do not mix.

    Args:
        target: The target's coarse shape.
        radius: Largest geodesic distance, for a surface of unit area.
    """

    def __init__(self, target: SpectralShape, radius: float = 0.12) -> None:
        self._near = target.neighbourhoods(radius)
        self._tree = cKDTree(target.positions)

    def coarse(self, points: FloatArray) -> IntArray:
        """Nearest coarse vertices of points on the target. *Shape:* ``(n, 3) -> (n,)``."""
        return self._tree.query(points)[1].astype(np.int64)

    def open(self, images: IntArray, coarse: IntArray) -> BoolArray:
        """Whether pairs of coarse vertices are within the radius. *Shape:* ``(n,), (n,) -> (n,)``."""
        return self._near[images, coarse]


class TemplateFit:
    """Iterative fit of a template to a target.

    Args:
        template: The rest shape, in the target's scale.
        target: The target, with a diagonal of 100.
        back: The target or a coarse copy, whose vertices are matched to the template.
        gate: Accepts or rejects closest points.
        images: Coarse vertex of the target for each template vertex. *Shape:* ``(V,)``.
        landmarks: Points of the template and their target positions.
        stretchable: Whether parts may grow and shrink.
        tick: Called after each step.
    """

    def __init__(
        self,
        template: MeshSurface,
        target: MeshSurface,
        back: MeshSurface,
        gate: Gate,
        images: IntArray,
        landmarks: tuple[sparse.csr_matrix, FloatArray] | None = None,
        *,
        stretchable: bool = False,
        tick: Callable[[], None] = lambda: None,
    ) -> None:
        self.template, self.target, self.back, self.tick = template, target, back, tick
        self.elastic = ElasticSurface(template, stretchable=stretchable)
        self._gate, self._images = gate, images
        self._share = template.vertex_areas / template.vertex_areas.mean()
        self._back_share = back.vertex_areas / back.vertex_areas.mean() * (len(images) / len(back.vertices))
        self._back_coarse = gate.coarse(back.vertices)
        self._fixed: list[PointTargets] = []
        self._map: list[PointTargets] = []
        if landmarks is not None:
            self._fixed = [self._pull(*landmarks, np.full(len(landmarks[1]), _LANDMARK_WEIGHT))]

    def _pull(self, points: sparse.csr_matrix, places: FloatArray, weights: FloatArray) -> PointTargets:
        return PointTargets(points, places, self.elastic.stiffness * weights)

    def follow_map(self, x: FloatArray, places: FloatArray) -> FloatArray:
        """Fit to the positions of a map, which keep a small weight in later steps. *Shape:* ``(V, 3), (V, 3)``."""
        everywhere, ones = sparse.identity(len(x), format="csr"), np.ones(len(x))
        for weight in MAP_WEIGHTS:
            x = self.elastic.follow(x, [self._pull(everywhere, places, weight * ones), *self._fixed], _MAP_ROUNDS)
            self.tick()
        self._map = [self._pull(everywhere, places, _MAP_SHARE * ones)]
        return x

    def run(self, x: FloatArray, stages: Sequence[Stage], releases: int) -> FloatArray:
        """Run all stages, then release flipped regions several times. *Shape:* ``(V, 3)``."""
        for stage in stages:
            x = self._steps(x, stage)
        self._map = []
        for _ in range(releases):
            flipped = self._flipped(x)
            if flipped.any():
                x = self._steps(self._steps(x, _RELEASED, flipped), _CAUGHT)
        return x

    def _steps(self, x: FloatArray, stage: Stage, released: BoolArray | None = None) -> FloatArray:
        everywhere = sparse.identity(len(x), format="csr")
        for _ in range(stage.steps):
            shape = self.template.moved(x)
            pulls = [self._forth(shape, stage, released), self._and_back(shape, stage, released), *self._fixed]
            pulls += [pull._replace(weights=pull.weights * stage.weight) for pull in self._map]
            pulls.append(self._pull(everywhere, x, np.full(len(x), _REST)))
            x = self.elastic.follow(x, pulls)
            self.tick()
        return x

    def _forth(self, shape: MeshSurface, stage: Stage, released: BoolArray | None) -> PointTargets:
        """Pull template vertices to closest points on the target."""
        closest = self.target.closest(shape.vertices)
        places, normals = closest.points.copy(), self.target.face_normals[closest.faces]
        used = np.einsum("vi,vi->v", shape.vertex_normals, normals) > _ALIKE
        used &= self._gate.open(self._images, self._gate.coarse(places))
        # If another sheet is closer, take the nearest vertex with a similar normal.
        hidden = np.flatnonzero(~used)
        beside = self.target.nearest_alike(shape.vertices[hidden], shape.vertex_normals[hidden])
        places[hidden] = self.target.vertices[beside]
        used[hidden] = np.einsum("vi,vi->v", shape.vertex_normals[hidden], self.target.vertex_normals[beside]) > _ALIKE
        used[hidden] &= self._gate.open(self._images[hidden], self._gate.coarse(places[hidden]))
        used &= np.linalg.norm(places - shape.vertices, axis=1) < stage.reach
        used &= shape.on_boundary | ~on_open_edge(self.target, closest)
        if released is not None:
            used &= ~released
        kept = np.flatnonzero(used)
        points = sparse.identity(len(used), format="csr")[kept]
        return self._pull(points, places[kept], stage.weight * self._share[kept])

    def _and_back(self, shape: MeshSurface, stage: Stage, released: BoolArray | None) -> PointTargets:
        """Pull the closest points on the template to the target's vertices."""
        closest = shape.closest(self.back.vertices)
        corners = shape.faces[closest.faces]
        used = np.einsum("vi,vi->v", self.back.vertex_normals, shape.face_normals[closest.faces]) > _ALIKE
        used &= closest.distances < stage.reach
        used &= self.back.on_boundary | ~on_open_edge(shape, closest)
        used &= self._gate.open(self._images[corners[:, 0]], self._back_coarse)
        if released is not None:
            used &= ~released[corners].any(1)
        kept = np.flatnonzero(used)
        points = shape.rows(closest)[kept]
        return self._pull(points, self.back.vertices[kept], stage.weight * self._back_share[kept])

    def _flipped(self, x: FloatArray) -> BoolArray:
        """Vertices of flipped faces and their neighbours."""
        shape = self.template.moved(x)
        bad = np.zeros(len(x), dtype=bool)
        bad[shape.faces[self.target.looks_away(x[shape.faces].mean(1), shape.face_normals)]] = True
        spread = bad.copy()
        i, j = shape.edges.T
        spread[i[bad[j]]] = spread[j[bad[i]]] = True
        return spread


def on_open_edge(surface: MeshSurface, closest: Closest) -> BoolArray:
    """Whether closest points are on the boundary, where the true counterpart may be missing. *Shape:* ``(n,)``."""
    if not surface.open_sides.any():
        return np.zeros(len(closest.faces), dtype=bool)
    return np.logical_or.reduce((surface.barycentric(closest) < _ON_EDGE) & surface.open_sides[closest.faces], axis=1)
