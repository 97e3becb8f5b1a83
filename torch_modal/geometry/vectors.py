"""Vector operations with components first, which gives long contiguous rows; normals of vertices."""

from typing import TypeVar

import torch
from torch import Tensor

from torch_modal.arrays import FloatArray, IntArray

Array = TypeVar("Array", Tensor, FloatArray)


def cross(a: Tensor, b: Tensor) -> Tensor:
    """Cross product with components first, at half the cost of ``torch.linalg.cross`` there. *Shape:* ``(3, ...)``."""
    (ax, ay, az), (bx, by, bz) = a, b
    return torch.stack([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx])


def pick(rows: Tensor, index: Tensor) -> Tensor:
    """``rows[..., index]`` by ``gather``, three times as fast on a CPU. *Shape:* ``(..., V), (m,)``."""
    return rows.gather(-1, index.expand(*rows.shape[:-1], -1))


def norm(vectors: Tensor) -> Tensor:
    """Euclidean length, with derivative 0 at 0. *Shape:* ``(3, ...) -> (...)``."""
    return root((vectors * vectors).sum(0))


def root(squared: Tensor) -> Tensor:
    """Root of a squared length, with derivative 0 where that vanishes: the root of a constant, and not NaN."""
    return torch.where(squared > tiny(squared), squared, tiny(squared)).sqrt()


def tiny(like: Tensor) -> float:
    """Smallest squared length with a direction; its inverse does not overflow."""
    return torch.finfo(like.dtype).tiny ** 0.5


def inverse(x: Tensor, zero: Tensor) -> Tensor:
    """``1 / x``, and 0 with zero derivatives where ``zero`` is true."""
    return torch.where(zero, 0, 1 / torch.where(zero, 1, x))


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
    summed = torch.zeros_like(rows).index_add(-1, faces.T.flatten(), torch.cat([doubled] * 3, -1))
    return torch.nn.functional.normalize(summed, dim=0, eps=torch.finfo(x.dtype).tiny ** 0.5).movedim(0, -1)
