"""Normals of shapes."""

from typing import TypeVar

import torch
from torch import Tensor

from torch_modal.arrays import FloatArray, IntArray
from torch_modal.geometry.vectors import cross, pick

Array = TypeVar("Array", Tensor, FloatArray)


def vertex_normals(x: Array, faces: Tensor | IntArray) -> Array:
    """Unit vertex normals: area-weighted means of the normals of incident faces.

    Args:
        x: Vertex positions, a tensor or an array. *Shape:* ``(..., V, 3)``.
        faces: Vertex indices. *Shape:* ``(F, 3)``.

    Returns:
        Zero for vertices without faces or with cancelling ones; of the type of ``x``. *Shape:* ``(..., V, 3)``.
    """
    if not isinstance(x, Tensor):
        return vertex_normals(torch.tensor(x), torch.tensor(faces)).numpy()
    faces = torch.as_tensor(faces, dtype=torch.int64, device=x.device)
    rows = x.movedim(-1, 0).contiguous()
    a, b, c = (pick(rows, corner) for corner in faces.unbind(1))
    doubled = cross(b - a, c - a)
    # Scaled against underflow of squared areas.
    largest = doubled.detach().abs().amax((0, -1), keepdim=True)
    doubled = doubled / torch.where(largest > 0, largest, 1)
    summed = torch.zeros_like(rows).index_add(-1, faces.T.flatten(), torch.cat([doubled] * 3, -1))
    return torch.nn.functional.normalize(summed, dim=0, eps=torch.finfo(x.dtype).tiny ** 0.5).movedim(0, -1)
