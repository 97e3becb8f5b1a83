"""Measures of shapes that tests compare, and coarser shapes."""

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from torch_modal.geometry.connectivity import Connectivity
from torch_modal.geometry.decimation import decimate
from torch_modal.geometry.rigid import RigidMotion, best_fit
from torch_modal.geometry.rotations import exp, log


def largest(x: Tensor) -> float:
    """Largest absolute number."""
    return float(x.abs().max())


def diagonal(x: Tensor) -> float:
    """Diagonal of the bounding box, of the largest of several shapes."""
    return float((x.amax(-2) - x.amin(-2)).norm(dim=-1).max())


def apart(x: Tensor, y: Tensor) -> float:
    """Largest distance of vertices over the diagonal."""
    return float((x - y).norm(dim=-1).max()) / diagonal(y)


def edge_lengths(x: Tensor, faces: Tensor | np.ndarray) -> Tensor:
    """Lengths of all edges. *Shape:* ``(..., V, 3) -> (..., E)``."""
    i, j = torch.tensor(Connectivity(np.asarray(faces)).edges).T
    return (x[..., i, :] - x[..., j, :]).norm(dim=-1)


def edge_error(x: Tensor, truth: Tensor, faces: Tensor | np.ndarray) -> float:
    """Mean relative error of edge lengths."""
    found, wanted = (edge_lengths(y, faces) for y in (x, truth))
    return float(((found - wanted).abs() / wanted).mean())


def fraction(motion: RigidMotion, t: Tensor) -> RigidMotion:
    """Motion at the time ``t`` of the geodesic from rest to a motion. *Shape:* ``(...,)``."""
    rotation = exp(t[..., None] * log(motion.rotation))
    return RigidMotion(rotation, motion.source, torch.lerp(motion.source, motion.target, t[..., None]))


def rigid_blend(x: Tensor, y: Tensor, t: Tensor, weights: Tensor) -> Tensor:
    """Linear interpolation of aligned shapes, on the geodesic of the rigid motion between them.

    *Shape:* ``(..., V, 3), (..., V, 3), (...,), (V,)``.
    """
    back = best_fit(y, x, weights)
    return fraction(back.inverse(), t).apply(torch.lerp(x, back.apply(y), t[..., None, None]))


def coarsened(shapes: Tensor, faces: Tensor, n_faces: int) -> tuple[Tensor, Tensor]:
    """Some of the vertices of all shapes, and faces of them. *Shape:* ``(K, V, 3), (F, 3) -> (K, V', 3), (F', 3)``."""
    points, coarse, _ = decimate(shapes[0].numpy(), faces.numpy(), n_faces)
    corners = cKDTree(shapes[0].numpy()).query(points)[1][coarse]
    corners = corners[(corners != np.roll(corners, 1, axis=1)).all(1)]  # a vertex may be the nearest one twice
    kept, own = np.unique(corners, return_inverse=True)
    return shapes[:, kept], torch.from_numpy(own.reshape(-1, 3))
