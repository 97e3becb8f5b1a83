"""Key-frames whose vertices were split at seams: one surface for the solve, and back."""

from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from torch_modal.geometry.seams import merge_seams
from torch_modal.keyframes.arrays import as_faces, as_positions


class WeldedKeyframes(NamedTuple):
    """Key-frames without the copies of vertices along seams."""

    keyframes: Tensor
    """*Shape:* ``(K, W, 3)``."""
    faces: Tensor
    """Of the W vertices, int64. *Shape:* ``(F, 3)``."""
    vertex_of: Tensor
    """Which of the W vertices each of the V is. *Shape:* ``(V,)``."""

    @property
    def n_merged(self) -> int:
        """How many vertices were copies."""
        return len(self.vertex_of) - self.keyframes.shape[1]

    def scatter(self, shapes: Tensor) -> Tensor:
        """All V vertices of shapes of the welded surface: copies lie exactly on each other.

        *Shape:* ``(..., W, 3) -> (..., V, 3)``.
        """
        return shapes.index_select(-2, self.vertex_of.to(shapes.device))


def weld_seams(keyframes: Any, faces: Any) -> WeldedKeyframes:
    """Join the vertices that exporters split along seams of texture coordinates and normals.

    A surface that is cut open there would tear. Vertices that are on a boundary, and at the same place in all
    key-frames, become one; the first of them gives its positions. Faces that lose a corner by it are left out.

    Args:
        keyframes: Vertex positions, as for :func:`torch_modal.check_keyframes`. *Shape:* ``(K, V, 3)``.
        faces: Vertex indices. *Shape:* ``(F, 3)``.

    Returns:
        The welded key-frames; where nothing was split, those that came.

    Raises:
        MeshError: They are no arrays of numbers.
    """
    positions = as_positions(keyframes)
    indices = as_faces(faces)
    n = positions.shape[1] if positions.dim() == 3 else 0
    fits = positions.dim() == 3 and indices.ndim == 2 and indices.shape[1:] == (3,) and len(indices)
    # What is wrong with the mesh is said by `check_keyframes`, whichever comes first.
    if fits and indices.min() >= 0 and indices.max() < n and bool(torch.isfinite(positions).all()):
        vertex_of = merge_seams(positions.detach().cpu().double().numpy(), indices)
    else:
        vertex_of = np.arange(n)
    welded = vertex_of.max(initial=-1) + 1
    if welded == n:
        return WeldedKeyframes(positions, torch.from_numpy(indices), torch.arange(n))
    first = torch.from_numpy(np.unique(vertex_of, return_index=True)[1]).to(positions.device)
    joined = vertex_of[indices]
    whole = (joined != np.roll(joined, 1, axis=1)).all(axis=1)
    return WeldedKeyframes(
        positions.index_select(1, first),
        torch.from_numpy(joined[whole]).to(positions.device),
        torch.from_numpy(vertex_of).to(positions.device),
    )
