"""Normals and cameras of point clouds that come without."""

from typing import NamedTuple

import numpy as np
from scipy import sparse
from scipy.sparse import csgraph
from scipy.spatial import cKDTree

from torch_modal.arrays import FloatArray
from torch_modal.geometry.closest import dot

N_NEIGHBOURS = 12
"""Points that a normal is estimated from."""
VIEW_STEPS, VIEW_STEP, VIEW_DECAY, VIEW_SHARPNESS = 60, 0.3, 0.95, 15.0
"""Steps that find a view, their length, its decay, and how much more the normals count that face it least."""
BEHIND, ONE_SIDED = -0.05, 0.97
"""Cosine from which on normals face a view, and the part of them that does so in a one-sided cloud."""


class Camera(NamedTuple):
    """A camera far away, in a direction from the body, or at a place. *Shape:* ``(3,)`` each."""

    direction: FloatArray
    place: FloatArray | None = None

    def towards(self, points: FloatArray) -> FloatArray:
        """Directions from points to the camera. *Shape:* ``(n, 3)`` or ``(3,)``."""
        if self.place is None:
            return self.direction
        away = self.place - points
        return away / np.linalg.norm(away, axis=1, keepdims=True).clip(np.finfo(np.float64).tiny)

    def picture(self, points: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Coordinates in the picture, at the size of the body, and closeness. *Shape:* ``(n, 2), (n,)``."""
        axes = np.linalg.svd(self.direction[None])[2][1:]
        if self.place is None:
            return points @ axes.T, points @ self.direction
        away = points - self.place
        depth = -(away @ self.direction)
        return away @ axes.T * (np.median(depth) / depth.clip(1e-3))[:, None], -np.linalg.norm(away, axis=1)

    def seen_from(self, rotation: FloatArray, move: FloatArray) -> "Camera":
        """In the coordinates of a body ``x`` that is at ``x rotation^T + move``."""
        return Camera(self.direction @ rotation, None if self.place is None else (self.place - move) @ rotation)


def find_view(normals: FloatArray) -> FloatArray | None:
    """The direction that all normals of a one-sided cloud face; None of a whole one. *Shape:* ``(n, 3) -> (3,)``."""
    view: FloatArray = normals.mean(0)
    for step in VIEW_STEP * VIEW_DECAY ** np.arange(VIEW_STEPS):
        view = view / max(np.linalg.norm(view), np.finfo(np.float64).tiny)
        towards = np.exp(-VIEW_SHARPNESS * (normals @ view)) @ normals  # those that face it least
        view = view + step * towards / np.linalg.norm(towards)
    view = view / np.linalg.norm(view)
    return view if np.mean(normals @ view > BEHIND) > ONE_SIDED else None


def outwardness(points: FloatArray, normals: FloatArray) -> float:
    """Mean cosine between normals and the directions from the centroid; above zero where normals point outward."""
    away = points - points.mean(0)
    return float(dot(normals, away / np.linalg.norm(away, axis=1, keepdims=True).clip(1e-12)).mean())


def estimate_normals(points: FloatArray, towards: FloatArray | None) -> FloatArray:
    """Normals of the planes through the neighbours of each point. *Shape:* ``(n, 3)``, and ``(n, 3)`` or ``(3,)``.

    They face the camera, in the directions given, or else outward: their sides agree along a minimum spanning tree of
    neighbours (Hoppe et al. 1992), and most of them face away from the centroid.
    """
    n, k = len(points), min(N_NEIGHBOURS, len(points))
    around = cKDTree(points).query(points, k)[1]
    centred = points[around] - points[around].mean(1, keepdims=True)
    normals: FloatArray = np.linalg.eigh(np.einsum("nki,nkj->nij", centred, centred))[1][:, :, 0]
    if towards is not None:
        return normals * np.where((normals * towards).sum(1, keepdims=True) < 0, -1, 1)
    one, other = np.repeat(np.arange(n), k - 1), around[:, 1:].ravel()
    turned = 1 - np.abs(dot(normals[one], normals[other])) + 1e-9  # zeros are no edges of a sparse matrix
    tree = csgraph.minimum_spanning_tree(sparse.csr_matrix((turned, (one, other)), shape=(n, n)))
    for piece in range((labels := csgraph.connected_components(tree, directed=False)[1]).max() + 1):
        members = np.flatnonzero(labels == piece)
        order, before = csgraph.breadth_first_order(tree, members[0], directed=False)
        for i in order[1:]:
            if normals[i] @ normals[before[i]] < 0:
                normals[i] *= -1
        if outwardness(points[members], normals[members]) < 0:
            normals[members] *= -1
    return normals
