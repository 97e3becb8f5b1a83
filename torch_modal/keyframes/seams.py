"""Vertices that exporters split along seams of texture coordinates and normals, joined."""

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from torch_modal.arrays import ArrayLike
from torch_modal.geometry.connectivity import merge_seams
from torch_modal.keyframes.check import check_arrays


class WeldedKeyframes(NamedTuple):
    """Key-frames without duplicate vertices along seams."""

    keyframes: Tensor
    """*Shape:* ``(K, W, 3)``."""
    faces: Tensor
    """Indices of the W vertices, int64. *Shape:* ``(F, 3)``."""
    vertex_of: Tensor
    """Welded vertex of each of the V vertices. *Shape:* ``(V,)``."""

    @property
    def n_merged(self) -> int:
        """Number of removed vertices."""
        return len(self.vertex_of) - self.keyframes.shape[1]

    def scatter(self, shapes: Tensor) -> Tensor:
        """Positions of all V vertices; duplicates coincide exactly.

        *Shape:* ``(..., W, 3) -> (..., V, 3)``.
        """
        return shapes.index_select(-2, self.vertex_of.to(shapes.device))


def weld_seams(keyframes: ArrayLike, faces: ArrayLike) -> WeldedKeyframes:
    """Join the vertices that exporters split along seams of texture coordinates and normals.

    Otherwise the surface would tear there. Boundary vertices that coincide in all key-frames become one, with the
    position of the first. Faces that become degenerate are removed.

    Args:
        keyframes: Vertex positions, as for :func:`torch_modal.check_keyframes`. *Shape:* ``(K, V, 3)``.
        faces: Vertex indices. *Shape:* ``(F, 3)``.

    Returns:
        The welded key-frames; unchanged if nothing was split.

    Raises:
        MeshError: The arrays cannot be key-frames.
    """
    positions, shapes, indices = check_arrays(keyframes, faces)
    vertex_of = merge_seams(shapes, indices)
    n_welded = vertex_of.max() + 1
    if n_welded == len(vertex_of):
        return WeldedKeyframes(positions, torch.from_numpy(indices), torch.arange(n_welded))
    first = torch.from_numpy(np.unique(vertex_of, return_index=True)[1]).to(positions.device)
    joined = vertex_of[indices]
    whole = (joined != np.roll(joined, 1, axis=1)).all(axis=1)
    return WeldedKeyframes(
        positions.index_select(1, first),
        torch.from_numpy(joined[whole]).to(positions.device),
        torch.from_numpy(vertex_of).to(positions.device),
    )
