"""As-rigid-as-possible fit of a template to a target."""

from collections.abc import Sequence

import numpy as np
import torch
from scipy import sparse

from torch_modal.arrays import BoolArray, FloatArray, IntArray
from torch_modal.elastic.backend import choose
from torch_modal.geometry.closest import dot
from torch_modal.geometry.connectivity import half_cotangents
from torch_modal.geometry.sparse import factorize, graph_laplacian
from torch_modal.registration.maps import SpectralShape
from torch_modal.registration.pair import MeshPair
from torch_modal.registration.surface import MeshSurface

# Bounds of cotangent weights, which are negative at obtuse angles and huge at slivers.
_WEIGHTS = (0.05, 10.0)
# Smoothing of rotations over neighbours resists bending (Levi and Gotsman 2015).
_SMOOTHING, _SMOOTHING_ROUNDS = 0.5, 2
# Smoothing rounds and bounds of local scales.
_SCALE_ROUNDS, _SCALES = 30, (0.3, 3.0)


Stage = tuple[float, float, int]
"""Weight of closest points relative to the stiffness, their largest distance in percent of the target's diagonal, and
the number of steps."""
COARSE_STAGES: tuple[Stage, ...] = ((0.05, 6, 4), (0.2, 5, 6), (0.5, 4, 6), (2.0, 3, 4))
FINE_STAGES: tuple[Stage, ...] = ((0.3, 4, 3), (1.0, 3, 3), (3.0, 3, 3))

_RELEASED, _CAUGHT = (0.3, 5, 4), (0.5, 5, 3)  # without flipped faces, then with them

_MAP_WEIGHTS = (0.02, 0.1)
_MAP_ROUNDS = 40
_MAP_SHARE = 0.05  # weight of the map relative to closest points
_OUTLIER = 3.0  # distance to the place of a map, in medians, above which a partial target may lack it
_LANDMARK_WEIGHT = 5.0
_FIXING_WEIGHT = 1e-5  # fixes pieces without a counterpart
_ALIKE = 0.4  # smallest cosine between the normals of closest points
# Functions of fields along the surface, their least stiffness, the stiffness of landmarks and of the distance to the
# surface, and the weight of curvature relative to strain, in square roots of the area.
_SLIDING_FUNCTIONS, _SOFTEST, _FIXED, _CURVATURE_SHARE = 20, 1e-3, 1e3, 0.1


Pull = tuple[sparse.csr_matrix, FloatArray, FloatArray]
"""Points of the surface, target positions and weights: ``sum_m weight_m |points_m x - targets_m|^2``.

*Shape:* ``(m, V), (m, 3), (m,)``.
"""


class ElasticSurface:
    r"""Minimises :math:`\sum_{ij} w_{ij} |x_i - x_j - \bar R_{ij} (r_i - r_j)|^2` plus pulls, by local-global steps.

    As-rigid-as-possible surface modeling (Sorkine and Alexa 2007) with smoothed rotations; if stretchable, also with
    smooth local scales.
    """

    def __init__(self, rest: MeshSurface, *, stretchable: bool = False) -> None:
        self.stretchable, n, edges = stretchable, len(rest.vertices), rest.edges
        self._best_rotations = choose("auto").best_rotations
        opposite = half_cotangents(rest.vertices, rest.connectivity)
        weights: FloatArray = np.clip(np.bincount(rest.connectivity.sides, opposite, minlength=len(edges)), *_WEIGHTS)
        self.laplacian = graph_laplacian(edges, weights, n)
        # Pulls of points of faces add no entries, so that one order of elimination serves all steps.
        self._order = np.argsort(factorize(self.laplacian + sparse.identity(n)).perm_c)
        self._i, self._j = np.concatenate([edges, edges[:, ::-1]]).T
        self._weights = np.tile(weights, 2)
        self._sides = rest.vertices[self._i] - rest.vertices[self._j]
        around = np.bincount(self._i, self._weights, minlength=n)
        self.stiffness = float(around.mean())
        """Mean weight around a vertex, the unit of the weights of pulls."""
        adjacency = sparse.csr_matrix((self._weights, (self._i, self._j)), shape=(n, n))
        self.neighbour_mean = sparse.diags(1 / np.maximum(around, 1e-12)) @ adjacency
        m = len(self._i)
        self._gather = sparse.csr_matrix((np.ones(m), (self._i, np.arange(m))), shape=(n, m))

    @torch.no_grad()
    def local_frames(self, x: FloatArray) -> FloatArray:
        """Local rotation, with scale if stretchable, from rest to ``x``. *Shape:* ``(V, 3, 3)``."""
        sides = x[self._i] - x[self._j]
        products = self._weights[:, None, None] * sides[:, :, None] * self._sides[:, None, :]
        covariance = self._gather @ products.reshape(-1, 9)
        for _ in range(_SMOOTHING_ROUNDS):
            covariance = (1 - _SMOOTHING) * covariance + _SMOOTHING * (self.neighbour_mean @ covariance)
        rotations = self._best_rotations(torch.from_numpy(covariance).unflatten(1, (3, 3))).numpy()
        if not self.stretchable:
            return rotations
        # Smoothed ratios of edge lengths to rest lengths.
        squares = self._gather @ np.stack([self._weights * dot(s, s) for s in (sides, self._sides)], axis=1)
        for _ in range(_SCALE_ROUNDS):
            squares = 0.5 * squares + 0.5 * (self.neighbour_mean @ squares)
        scales = np.clip(np.sqrt(squares[:, 0] / np.maximum(squares[:, 1], 1e-30)), *_SCALES)
        return rotations * scales[:, None, None]

    def follow(self, x: FloatArray, pulls: Sequence[Pull], rounds: int = 2) -> FloatArray:
        """Alternate local steps (rotations) and global steps (positions). *Shape:* ``(V, 3)``."""
        matrix, pulled = self.laplacian, np.zeros_like(x)
        for points, targets, weights in pulls:
            weighted = points.T @ sparse.diags(weights)
            matrix = matrix + weighted @ points
            pulled += weighted @ targets
        order = self._order
        factors = factorize(matrix[order][:, order], "NATURAL")
        for _ in range(rounds):
            frames = self.local_frames(x)
            wanted = 0.5 * np.einsum("eij,ej->ei", frames[self._i] + frames[self._j], self._sides)
            right = self._gather @ (self._weights[:, None] * wanted) + pulled
            x = np.empty_like(x)
            x[order] = factors.solve(right[order])
        return x


class TemplateFit:
    """Iterative fit of a template to the target of two meshes.

    Args:
        meshes: Has the target, its coarse shape and the landmarks.
        template: The rest shape, in the target's scale.
        back: The target or a coarse copy, whose vertices are matched to the template.
        images: Vertex of the target's coarse shape for each template vertex; closest points must be near, so that
            touching fingers do not mix. *Shape:* ``(V,)``.
        counted: The vertices whose images count, as a mask. *Shape:* ``(V,)``.
    """

    def __init__(
        self, meshes: MeshPair, template: MeshSurface, back: MeshSurface, images: IntArray, counted: BoolArray | None
    ) -> None:
        self.template, self.target, self.back, self.progress = template, meshes.target, back, meshes.progress
        self.elastic = ElasticSurface(template, stretchable=not meshes.same_subject)
        self._coarse, self._images, self._partial = meshes.second, images, meshes.partial
        # What the target lacks is mapped to the edge of the hole.
        self._counted = template.on_boundary | ~meshes.second.placed.on_boundary[images]
        self._counted &= True if counted is None else counted
        if not self._counted.any():
            self._counted[:] = True
        self._everywhere = sparse.identity(len(images), format="csr")
        self._share = template.vertex_areas / template.vertex_areas.mean()
        self._back_share = back.vertex_areas / back.vertex_areas.mean() * (len(images) / len(back.vertices))
        here, there = meshes.marks
        self._landmarks = self._pull(template.rows(template.closest(here)), there, _LANDMARK_WEIGHT)

    def _pull(self, points: sparse.csr_matrix, places: FloatArray, weights: FloatArray | float) -> Pull:
        return points, places, self.elastic.stiffness * np.broadcast_to(weights, len(places))

    def run(
        self, x: FloatArray, stages: Sequence[Stage], releases: int, places: FloatArray | None = None
    ) -> FloatArray:
        """Follow the places of a map, then closest points in all stages; then release flipped regions several times.

        The places keep a small weight in the stages. *Shape:* ``(V, 3), (V, 3)``.
        """
        if places is not None:
            for k, weight in enumerate(_MAP_WEIGHTS):
                pull = self._to_map(x, places, weight, rigid=k == 0)
                x = self.elastic.follow(x, [pull, self._landmarks], _MAP_ROUNDS)
        none = np.zeros(len(x), dtype=bool)
        for stage in stages:
            x = self._step(x, stage, none, places)
        for _ in range(releases):
            shape, flipped = self.template.with_vertices(x), none.copy()
            flipped[shape.faces[self.target.looks_away(shape.face_centres, shape.face_normals)]] = True
            if flipped.any():
                released = flipped | (self.elastic.neighbour_mean @ flipped > 0)
                x = self._step(self._step(x, _RELEASED, released), _CAUGHT, none)
        return x

    def _step(self, x: FloatArray, stage: Stage, released: BoolArray, places: FloatArray | None = None) -> FloatArray:
        """Follow closest points in both directions, but for released vertices."""
        weight, reach, n_steps = stage
        for _ in range(n_steps):
            shape = self.template.with_vertices(x)
            pulls = [self._to_target(shape, weight, reach, released), self._from_target(shape, weight, reach, released)]
            if places is not None:
                pulls.append(self._to_map(x, places, _MAP_SHARE * weight))
            pulls += [self._landmarks, self._pull(self._everywhere, x, _FIXING_WEIGHT)]
            x = self.elastic.follow(x, pulls)
            self.progress.update()
        return x

    def _to_map(self, x: FloatArray, places: FloatArray, weight: float, rigid: bool = False) -> Pull:
        """Pull template vertices to their places by the map, unless the target may lack these."""
        counted = self._counted
        if self._partial and not rigid:
            distances = np.linalg.norm(places - x, axis=1)
            counted = counted & (distances <= _OUTLIER * np.median(distances[counted]))
        rows = np.flatnonzero(counted)
        return self._pull(self._everywhere[rows], places[rows], weight)

    def _to_target(self, shape: MeshSurface, weight: float, reach: float, released: BoolArray) -> Pull:
        """Pull template vertices to closest points on the target."""
        closest = self.target.closest(shape.vertices)
        places, normals = closest.points.copy(), shape.vertex_normals
        used = dot(normals, self.target.face_normals[closest.faces]) > _ALIKE
        used &= self._coarse.is_near(self._images, places)
        # If another sheet is closer, take the nearest vertex with a similar normal.
        hidden = np.flatnonzero(~used)
        alike = self.target.nearest_alike(shape.vertices[hidden], normals[hidden])
        places[hidden] = self.target.vertices[alike]
        used[hidden] = dot(normals[hidden], self.target.vertex_normals[alike]) > _ALIKE
        used[hidden] &= self._coarse.is_near(self._images[hidden], places[hidden])
        used &= np.linalg.norm(places - shape.vertices, axis=1) < reach
        used &= (shape.on_boundary | ~self.target.on_open_edge(closest)) & self._counted & ~released
        rows = np.flatnonzero(used)
        return self._pull(self._everywhere[rows], places[rows], weight * self._share[rows])

    def _from_target(self, shape: MeshSurface, weight: float, reach: float, released: BoolArray) -> Pull:
        """Pull the closest points on the template to the target's vertices."""
        closest = shape.closest(self.back.vertices)
        used = dot(self.back.vertex_normals, shape.face_normals[closest.faces]) > _ALIKE
        used &= self._coarse.is_near(self._images[shape.faces[closest.faces, 0]], self.back.vertices)
        used &= (self.back.on_boundary | ~shape.on_open_edge(closest)) & (closest.distances < reach)
        used &= ~released[shape.faces[closest.faces]].any(1)
        rows = np.flatnonzero(used)
        return self._pull(shape.rows(closest)[rows], self.back.vertices[rows], weight * self._back_share[rows])


def sliding_freedom(shape: SpectralShape, fixed: IntArray) -> float:
    """Displacement along the surface by random errors of strain and curvature, in square roots of the area.

    Median over the vertices of the standard deviation, for least squares over smooth fields. It is large where
    displacements along the surface hardly change lengths (approximate Killing fields, Ben-Chen et al. 2010) and
    curvature. *Shape:* ``(m,)``, the coarse vertices at landmarks.
    """
    surface, functions = shape.coarse, shape.functions[:, :_SLIDING_FUNCTIONS]
    (i, j), faces, k = surface.edges.T, surface.faces, functions.shape[1]
    sides = surface.vertices[i] - surface.vertices[j]
    areas: FloatArray = np.bincount(surface.connectivity.sides, np.tile(surface.face_areas, 3), minlength=len(i)) / 3
    slopes = surface.gradients(shape.curvature()[:, None])[:, 0]

    def rows(weights: FloatArray, values: FloatArray, directions: FloatArray) -> FloatArray:
        return (np.sqrt(weights)[:, None, None] * values[:, :, None] * directions[:, None]).reshape(-1, 3 * k)

    summands = [
        rows(areas, functions[i] - functions[j], sides / np.maximum(dot(sides, sides), 1e-12)[:, None]),
        rows(surface.face_areas, functions[faces].mean(1), _CURVATURE_SHARE * slopes),
        rows(_FIXED * surface.vertex_areas, functions, surface.vertex_normals),
        rows(np.full(3 * len(fixed), _FIXED), functions[fixed].repeat(3, axis=0), np.tile(np.eye(3), (len(fixed), 1))),
    ]
    matrix = np.concatenate([*summands, np.sqrt(_SOFTEST) * np.eye(3 * k)])
    covariance = np.linalg.inv(matrix.T @ matrix).reshape(k, 3, k, 3).trace(axis1=1, axis2=3)
    return float(np.sqrt(np.median(dot(functions @ covariance, functions))))
