"""Rigid motions between shapes: best fit, and detection of mirrored shapes."""

from typing import NamedTuple

import torch
from torch import Tensor

from torch_modal.autograd import is_traced, is_transformed
from torch_modal.geometry.rotations import exp
from torch_modal.geometry.vectors import pick

# Required gain of a reflection, in mean cosine between normals: mirrored poses of one body have at least 0.44, poses of
# thin plates at most 0.2.
MIRRORED_GAIN = 0.3


class RigidMotion(NamedTuple):
    """``x -> (x - source) rotation^T + target``: a rotation about a centroid and a translation of it."""

    rotation: Tensor
    """*Shape:* ``(..., 3, 3)``."""
    source: Tensor
    """Centroid before. *Shape:* ``(..., 3)``."""
    target: Tensor
    """Centroid after. *Shape:* ``(..., 3)``."""

    def apply(self, x: Tensor) -> Tensor:
        """Move a shape. *Shape:* ``(..., V, 3) -> (..., V, 3)``."""
        return (x - self.source[..., None, :]) @ self.rotation.mT + self.target[..., None, :]

    def inverse(self) -> "RigidMotion":
        """Inverse motion."""
        return RigidMotion(self.rotation.mT, self.target, self.source)


def infinitesimal_motions(x: Tensor) -> Tensor:
    """Fields of translations along the axes and of rotations about them. *Shape:* ``(V, 3) -> (6, V, 3)``."""
    axes = torch.eye(3).to(x)[:, None].expand(3, *x.shape)
    return torch.cat([axes, torch.linalg.cross(axes, x.expand(3, *x.shape))])


def centroid(x: Tensor, weights: Tensor) -> Tensor:
    """Weighted mean of the vertices. *Shape:* ``(..., V, 3), (V,) -> (..., 3)``."""
    return weights @ x / weights.sum()


def best_rotation(covariance: Tensor) -> Tensor:
    """The rotation ``R`` that maximises ``tr(R^T A)``, differentiable to second order.

    For ``A = sum_v w_v y_v x_v^T`` it aligns ``x`` with ``y``; of a matrix of positive determinant it is the nearest
    rotation (polar decomposition).

    The value comes from the singular value decomposition. Its derivative divides by differences of singular values and
    fails on symmetric shapes, where the rotation itself is smooth. Derivatives come instead from two Newton steps at
    the solution, each of which makes them exact to a higher order.

    *Shape:* ``(..., 3, 3) -> (..., 3, 3)``, determinant one; NaN where the covariance is not finite.
    """
    known = covariance.detach()
    u, _, vh = torch.linalg.svd(known.nan_to_num(0, 0, 0))  # raises on a NaN anywhere in a batch
    rotation = u @ vh
    beyond = torch.linalg.det(rotation)[..., None, None] - 1
    rotation = rotation + beyond * u[..., 2:] @ vh[..., 2:, :] + (0 * known).sum((-2, -1), keepdim=True)
    if not torch.is_grad_enabled() and (is_traced(covariance) or not is_transformed(covariance)):
        return rotation
    eye = torch.eye(3, dtype=covariance.dtype, device=covariance.device)
    for _ in range(2):
        p = rotation.mT @ covariance
        skew = p.mT - p
        torque = torch.stack([skew[..., 1, 2], skew[..., 2, 0], skew[..., 0, 1]], -1)
        trace = p.diagonal(dim1=-2, dim2=-1).sum(-1)[..., None, None]
        # Collinear, collapsed or inverted shapes leave a rotation undetermined: a floor above rounding fixes it.
        floor = torch.where(trace.abs() > torch.finfo(p.dtype).tiny, 64 * torch.finfo(p.dtype).eps * trace.abs(), 1)
        hessian = (trace + floor.detach()) * eye - 0.5 * (p + p.mT)
        # Never singular: `solve_ex` avoids a synchronisation of the GPU.
        rotation = rotation @ exp(torch.linalg.solve_ex(hessian, torque).result)
    return rotation


def best_fit(x: Tensor, y: Tensor, weights: Tensor | None = None) -> RigidMotion:
    """The rigid motion that best aligns ``x`` with ``y`` (weighted Kabsch).

    Args:
        x: Vertex positions. *Shape:* ``(..., V, 3)``.
        y: Vertex positions. *Shape:* ``(..., V, 3)``.
        weights: Weight of each vertex, for example its area; by default, all have the same. *Shape:* ``(V,)``.
    """
    weights = x.new_ones(x.shape[-2]) if weights is None else weights
    source, target = centroid(x, weights), centroid(y, weights)
    centred_x = x - source[..., None, :]
    centred_y = (y - target[..., None, :]) * weights[:, None]
    return RigidMotion(best_rotation(centred_y.mT @ centred_x), source, target)


def align(x: Tensor, y: Tensor, weights: Tensor | None = None) -> Tensor:
    """Move shapes rigidly onto others, by the rotation and translation of least squared distance (Kabsch).

    Gradients, also second ones, reach both shapes. Reflections are left out.

    Args:
        x: Shapes to move. *Shape:* ``(..., V, 3)``.
        y: Where they go, the same vertices. Leading dimensions broadcast. *Shape:* ``(..., V, 3)``.
        weights: Weight of each vertex, such as its area; zero leaves it out. Equal by default. *Shape:* ``(V,)``.

    Returns:
        The moved shapes. *Shape:* ``(..., V, 3)``.

    Raises:
        ValueError: The shapes do not have the same vertices or dtype, or the weights do not fit.
    """
    if x.dim() < 2 or x.shape[-2:] != (x.shape[-2], 3) or x.shape[-2:] != y.shape[-2:] or x.dtype != y.dtype:
        got = ", ".join(f"{tuple(shape.shape)} of {shape.dtype}" for shape in (x, y))
        raise ValueError(f"x and y must be (..., V, 3) of equal V and dtype; got {got}")
    if weights is not None and weights.shape != x.shape[-2:-1]:
        raise ValueError(f"weights must have shape ({x.shape[-2]},), one for each vertex; got {tuple(weights.shape)}")
    return best_fit(x, y, None if weights is None else weights.to(x)).apply(x)


@torch.no_grad()
def looks_mirrored(first: Tensor, second: Tensor, faces: Tensor) -> Tensor:
    """Test whether normals agree clearly better after a reflection than after a rotation.

    For bodies with signed volumes of different sign: the volume of a thin plate also changes its sign if its sheets
    intersect slightly. *Shape:* ``(B, V, 3), (B, V, 3), (F, 3) -> (B,)``, bool.
    """
    a, b, c = torch.stack([first, second])[:, :, faces].unbind(-2)  # (2, B, F, 3)
    centres, normals = (a + b + c) / 3, torch.linalg.cross(b - a, c - a)
    areas = normals.norm(dim=-1)
    weights = areas.prod(0).sqrt()[..., None]
    total = weights.sum((1, 2))
    centres = centres - (weights * centres).sum(2, keepdim=True) / total[:, None, None]
    unit = normals / torch.where(areas > 0, areas, 1)[..., None]
    covariance, alike = ((weights * x).mT @ y for x, y in (centres, unit))
    # A reflection M flips normals, and -M is the best rotation of the negative covariance.
    gain = ((best_rotation(-covariance) - best_rotation(covariance)) * alike).sum((1, 2))
    return gain > MIRRORED_GAIN * total


def volumes_of(x: Tensor, faces: Tensor) -> Tensor:
    """Volumes of closed shapes: heights of their faces over a plane, times areas in it.

    *Shape:* ``(..., V, 3), (F, 3) -> (...)``.
    """
    corners, (x, y, z) = faces.T.long(), x.mT.contiguous().unbind(-2)
    (xa, xb, xc), (ya, yb, yc), (za, zb, zc) = ([pick(row, corner) for corner in corners] for row in (x, y, z))
    return ((za + zb + zc) * ((xb - xa) * (yc - ya) - (xc - xa) * (yb - ya))).sum(-1) / 6
