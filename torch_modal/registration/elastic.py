"""As-rigid-as-possible or as-similar-as-possible deformation of a surface towards target positions."""

from typing import NamedTuple

import numpy as np
from scipy import sparse

from torch_modal.arrays import FloatArray
from torch_modal.geometry.connectivity import half_cotangents
from torch_modal.geometry.sparse import SparseSolver, graph_laplacian
from torch_modal.registration.surface import MeshSurface

# Bounds of cotangent weights: those of obtuse triangles are negative, those of slivers huge.
_WEIGHTS = (0.05, 10.0)
# Smoothing of rotations over neighbours resists bending (Levi and Gotsman 2015).
_SMOOTHING, _SMOOTHING_ROUNDS = 0.5, 2
# Smoothing rounds and bounds of local scales.
_SCALE_ROUNDS, _SCALES = 30, (0.3, 3.0)


class PointTargets(NamedTuple):
    """Target positions of points of the surface, with weights: ``sum_m weight_m |points_m x - targets_m|^2``."""

    points: sparse.csr_matrix
    """*Shape:* ``(m, V)``."""
    targets: FloatArray
    """*Shape:* ``(m, 3)``."""
    weights: FloatArray
    """*Shape:* ``(m,)``."""


class ElasticSurface:
    r"""Minimises :math:`\sum_{ij} w_{ij} |x_i - x_j - \bar R_{ij} (r_i - r_j)|^2` plus pulls, by local-global steps.

    As-rigid-as-possible surface modeling (Sorkine and Alexa 2007) with smoothed rotations.

    Args:
        rest: The rest shape.
        stretchable: Whether smooth local scaling is allowed.
    """

    def __init__(self, rest: MeshSurface, *, stretchable: bool = False) -> None:
        self.rest, self.stretchable = rest, stretchable
        n, edges = len(rest.vertices), rest.edges
        opposite = half_cotangents(rest.vertices, rest.connectivity)
        weights: FloatArray = np.clip(np.bincount(rest.connectivity.sides, opposite, minlength=len(edges)), *_WEIGHTS)
        self.laplacian = graph_laplacian(edges, weights, n)
        self._i, self._j = np.concatenate([edges, edges[:, ::-1]]).T
        self._weights = np.tile(weights, 2)
        self._sides = rest.vertices[self._i] - rest.vertices[self._j]
        around = np.bincount(self._i, self._weights, minlength=n)
        self.stiffness = float(around.mean())
        """Mean weight around a vertex, the unit of the weights of pulls."""
        adjacency = sparse.csr_matrix((self._weights, (self._i, self._j)), shape=(n, n))
        self._mean = sparse.diags(1 / np.maximum(around, 1e-12)) @ adjacency
        self._gather = sparse.csr_matrix(
            (np.ones(len(self._i)), (self._i, np.arange(len(self._i)))), shape=(n, len(self._i))
        )

    def local_frames(self, x: FloatArray) -> FloatArray:
        """Local rotation, with scale if stretchable, from rest to ``x``. *Shape:* ``(V, 3, 3)``."""
        now = x[self._i] - x[self._j]
        products = self._weights[:, None, None] * now[:, :, None] * self._sides[:, None, :]
        covariance = self._gather @ products.reshape(-1, 9)
        for _ in range(_SMOOTHING_ROUNDS):
            covariance = (1 - _SMOOTHING) * covariance + _SMOOTHING * (self._mean @ covariance)
        u, _, vh = np.linalg.svd(covariance.reshape(-1, 3, 3))
        u[:, :, 2] *= np.linalg.det(u @ vh)[:, None]
        rotations = u @ vh
        if not self.stretchable:
            return rotations
        return rotations * self._scales(now)[:, None, None]

    def _scales(self, now: FloatArray) -> FloatArray:
        """Smoothed ratios of edge lengths to rest lengths. *Shape:* ``(V,)``."""
        squares = [self._weights * (sides**2).sum(1) for sides in (now, self._sides)]
        both = np.stack([np.bincount(self._i, s, minlength=len(self.rest.vertices)) for s in squares], axis=1)
        for _ in range(_SCALE_ROUNDS):
            both = 0.5 * both + 0.5 * (self._mean @ both)
        return np.clip(np.sqrt(both[:, 0] / np.maximum(both[:, 1], 1e-30)), *_SCALES)

    def follow(self, x: FloatArray, pulls: list[PointTargets], rounds: int = 2) -> FloatArray:
        """Alternate local steps (rotations) and global steps (positions). *Shape:* ``(V, 3)``."""
        matrix, pulled = self.laplacian, np.zeros_like(x)
        for pull in pulls:
            weighted = pull.points.T @ sparse.diags(pull.weights)
            matrix = matrix + weighted @ pull.points
            pulled += weighted @ pull.targets
        solver = SparseSolver(matrix)
        for _ in range(rounds):
            frames = self.local_frames(x)
            wanted = 0.5 * np.einsum("eij,ej->ei", frames[self._i] + frames[self._j], self._sides)
            x = solver.solve(self._gather @ (self._weights[:, None] * wanted) + pulled)
        return x
