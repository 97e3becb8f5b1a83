"""Detection of mirrored shapes."""

import torch
from torch import Tensor

# Required gain of a reflection, in mean cosine between normals: mirrored poses of one body have at least 0.44, poses of
# thin plates at most 0.2.
CLEARLY = 0.3


def looks_mirrored(first: Tensor, second: Tensor, faces: Tensor) -> Tensor:
    """Whether normals agree clearly better after a reflection than after a rotation.

    For bodies with signed volumes of different sign: the volume of a thin plate also changes its sign if its sheets
    intersect slightly.

    Args:
        first: *Shape:* ``(B, V, 3)``.
        second: *Shape:* ``(B, V, 3)``.
        faces: Vertex indices. *Shape:* ``(F, 3)``.

    Returns:
        *Shape:* ``(B,)``, bool.
    """
    centres, normals, areas = zip(*(_measured(x.detach(), faces) for x in (first, second)), strict=True)
    weights = (areas[0] * areas[1]).sqrt()
    total = weights.sum(1)
    centred = [c - (weights[..., None] * c).sum(1, keepdim=True) / total[:, None, None] for c in centres]
    covariance, alike = ((weights[..., None] * a).mT @ b for a, b in (centred, normals))
    u, _, vh = torch.linalg.svd(covariance)
    # The best rotation and reflection differ only in the sign of the last singular vector. A reflection also flips the
    # normals, so the cosines differ by twice their common part.
    common = ((u[..., :2].mT @ alike) * vh[:, :2]).sum((1, 2))
    return -2 * common > CLEARLY * total


def _measured(x: Tensor, faces: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Centroids, unit normals and areas of faces. *Shape:* ``(B, F, 3), (B, F, 3), (B, F)``."""
    a, b, c = (x[:, corner] for corner in faces.unbind(1))
    normals = torch.linalg.cross(b - a, c - a)
    lengths = torch.linalg.vector_norm(normals, dim=-1)
    safe = torch.where(lengths > 0, lengths, 1)
    return (a + b + c) / 3, normals / safe[..., None], lengths
