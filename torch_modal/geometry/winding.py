"""Whether faces wind the other way round than those of another shape: mirror images."""

import torch
from torch import Tensor

# Of the mean cosine between normals, which a reflection must win. Between poses of one body, one of them mirrored, it
# wins 0.44 and more; between poses of thin plates, 0.2 and less.
CLEARLY = 0.3


def looks_mirrored(first: Tensor, second: Tensor, faces: Tensor) -> Tensor:
    """Whether normals fit clearly better after a reflection than after a rotation.

    Of a body whose signed volume has changed its sign, this says whether it was mirrored; the volume of a thin plate
    also changes its sign where both sheets pass through each other a little.

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
    # The best rotation and the best reflection differ in the sign of the last singular vectors alone. A reflection also
    # turns the normals over, so that the cosines of both differ by twice the part that they have in common.
    common = ((u[..., :2].mT @ alike) * vh[:, :2]).sum((1, 2))
    return -2 * common > CLEARLY * total


def _measured(x: Tensor, faces: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Centroids, unit normals and areas of faces. *Shape:* ``(B, F, 3), (B, F, 3), (B, F)``."""
    a, b, c = (x[:, corner] for corner in faces.unbind(1))
    normals = torch.linalg.cross(b - a, c - a)
    lengths = torch.linalg.vector_norm(normals, dim=-1)
    safe = torch.where(lengths > 0, lengths, 1)
    return (a + b + c) / 3, normals / safe[..., None], lengths
