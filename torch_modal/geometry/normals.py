"""Normals of shapes."""

import torch
from torch import Tensor


def vertex_normals(x: Tensor, faces: Tensor) -> Tensor:
    """Unit normals: means of those of the faces around each vertex, weighted by area.

    Args:
        x: Vertex positions. *Shape:* ``(B, V, 3)``.
        faces: Vertex indices. *Shape:* ``(F, 3)``.

    Returns:
        Zero where a vertex has no face. *Shape:* ``(B, V, 3)``.
    """
    faces = faces.to(x.device)
    # Vertices first: whole rows are then gathered and summed.
    rows = x.permute(1, 2, 0).contiguous()
    a, b, c = (rows[corner] for corner in faces.unbind(1))
    doubled = torch.linalg.cross(b - a, c - a, dim=1)
    summed = torch.zeros_like(rows).index_add(0, faces.T.flatten(), doubled.repeat(3, 1, 1))
    return torch.nn.functional.normalize(summed, dim=1, eps=torch.finfo(x.dtype).tiny ** 0.5).permute(2, 0, 1)
