"""Dihedral angles of single elements, components first."""

import math

import torch
from torch import Tensor

from torch_modal.geometry.vectors import cross, norm, tiny

# Altitude of a triangle over its edge below which the triangle has no normal worth the name.
COLLAPSED = 1e-6


def dihedral_angle(edge_vectors: Tensor) -> Tensor:
    """Signed angle between the normals of the two triangles of a hinge, 0 where flat, in ``(-pi, pi]``.

    With the edge ``e``, ``n1 = e x a`` and ``n2 = b x e``, the sine is ``(n1 x n2).e/|e| = -|e| n1.b`` and the cosine
    ``n1.n2``, both up to the factor ``|n1||n2|``.

    Args:
        edge_vectors: ``e = x_j - x_i``, ``a = x_k - x_i`` and ``b = x_l - x_i`` of a row of
            :attr:`~torch_modal.geometry.connectivity.Connectivity.hinges`, components second. *Shape:* ``(3, 3, ...)``.
    """
    e, a, b = edge_vectors
    n1 = cross(e, a)
    n2 = cross(b, e)
    sine = -norm(e) * (n1 * b).sum(0)
    cosine = (n1 * n2).sum(0)
    # atan2(0, 0) has a NaN gradient; a hinge with a collapsed triangle is flat by convention.
    flat = collapsed(e, n1) | collapsed(e, n2)
    return torch.atan2(torch.where(flat, 0, sine), torch.where(flat, 1, cosine))


def collapsed(edge: Tensor, normal: Tensor) -> Tensor:
    """Whether a triangle on this edge has no altitude. *Shape:* ``(3, ...), (3, ...) -> (...)``."""
    bound = max(COLLAPSED, 100 * torch.finfo(edge.dtype).eps)
    base = (edge * edge).sum(0)
    return (normal * normal).sum(0) <= (bound * base) ** 2 + tiny(edge)


def wrap_angle(angle: Tensor) -> Tensor:
    """The same angle in ``[-pi, pi)``, with derivative one."""
    return angle - 2 * math.pi * torch.floor(angle.detach() / (2 * math.pi) + 0.5)
