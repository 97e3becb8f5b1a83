"""Bodies of a surface: groups of its connected pieces that are far from each other."""

import numpy as np
import torch
from scipy.spatial import cKDTree

from torch_modal.arrays import FloatArray
from torch_modal.geometry.connectivity import Connectivity, double_areas

# A surface of more groups than that is one body, as so many solvers would take too long.
MOST_BODIES = 16

# Area in any shape, over the square of the largest diagonal, below which a group is no body of its own.
LEAST_AREA = 1e-6


def bodies(shapes: FloatArray, mesh: Connectivity) -> list[tuple[torch.Tensor | slice, Connectivity]]:
    """Vertices and connectivity of each body; what belongs to none goes with the nearest. *Shape:* ``(K, V, 3)``.

    Groups of pieces are one body if, in any shape, the distance of their bounding boxes is at most the mean of the
    diagonals.
    """
    group = np.unique(mesh.vertex_pieces[mesh.used], return_inverse=True)[1].reshape(-1)
    order, i = np.argsort(group, kind="stable"), 0
    corners = np.concatenate([shapes, -shapes], 2)[:, mesh.used[order]]
    box = np.minimum.reduceat(corners, np.flatnonzero(np.diff(group[order], prepend=-1)), 1)  # (K, n, 6)
    while i < min(box.shape[1], MOST_BODIES + 1):
        gaps = np.maximum(*np.split(box + np.roll(box[:, i, None], 3, 2), 2, 2)).clip(0)
        diagonals = np.linalg.norm(box[..., :3] + box[..., 3:], axis=2)
        near = (2 * np.linalg.norm(gaps, axis=2) <= diagonals + diagonals[:, i, None]).any(0)
        i += 1
        if near.sum() > 1:  # they are one group from now on, the first
            group, i = np.where(near, 0, np.cumsum(~near))[group], 0
            box = np.concatenate([box[:, near].min(1, keepdims=True), box[:, ~near]], 1)
    if not 1 < i <= MOST_BODIES:
        return [(slice(None), mesh)]
    body = np.full(mesh.n_vertices, -1)
    body[mesh.used] = group
    areas = [np.bincount(body[mesh.faces[:, 0]], double_areas(x, mesh.faces), i) for x in shapes]
    proper = np.min(areas, 0) > LEAST_AREA * diagonals.max(0) ** 2
    body = np.append(np.where(proper, np.cumsum(proper) - 1, -1), -1)[body]
    if proper.sum() < 2:
        return [(slice(None), mesh)]
    body[body < 0] = body[body >= 0][cKDTree(shapes[0, body >= 0]).query(shapes[0, body < 0])[1]]
    each = [(np.flatnonzero(body == k), mesh.faces[body[mesh.faces[:, 0]] == k]) for k in range(body.max() + 1)]
    return [(torch.from_numpy(rows), Connectivity(np.searchsorted(rows, faces), len(rows))) for rows, faces in each]
