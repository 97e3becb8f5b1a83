"""A shape between two key-frames by local rotations, with every vertex free: what the modes then improve."""

import numpy as np
import torch
from torch import Tensor, nn

from torch_modal.geometry import connectivity
from torch_modal.geometry.local_rotations import LocalRotations
from torch_modal.geometry.sparse import SparseSolver, graph_laplacian
from torch_modal.geometry.vectors import pick


class RotationBlend(nn.Module):
    r"""Vertices of :math:`\min_x \sum_e |e(x) - \bar e|^2 / l_e`, with edges from :class:`LocalRotations`.

    The weights are those of references, so that one factorisation serves all shapes
    (:class:`~torch_modal.geometry.sparse.SparseSolver`, on the CPU). Each piece of the surface keeps the centroid of
    linear interpolation; vertices that no face uses are pieces of their own.

    Args:
        faces: Vertex indices. *Shape:* ``(F, 3)``.
        edges: Those of :func:`~torch_modal.geometry.connectivity.unique_edges`. *Shape:* ``(E, 2)``.
        references: Two shapes near the key-frames. *Shape:* ``(2, V, 3)``.
    """

    edges: Tensor
    vertex_piece: Tensor
    shares: Tensor
    free: Tensor

    def __init__(self, faces: Tensor, edges: Tensor, references: Tensor) -> None:
        super().__init__()
        n = references.shape[-2]
        self.rotations = LocalRotations(faces, edges, references)
        self.register_buffer("edges", edges.clone(), persistent=False)
        piece = connectivity.vertex_pieces(edges.cpu().numpy(), n)
        self.register_buffer("vertex_piece", torch.from_numpy(piece), persistent=False)
        self.register_buffer("shares", (1 / torch.bincount(self.vertex_piece).to(references))[piece], persistent=False)
        # One vertex of each piece is held, and the piece placed afterwards.
        free = torch.ones(n, dtype=torch.bool)
        free[np.unique(piece, return_index=True)[1]] = False
        self.register_buffer("free", free, persistent=False)
        self._made: tuple[Tensor, SparseSolver] | None = None

    @property
    def solver(self) -> SparseSolver:
        """The Laplacian's inverse, of what the buffers say now: others may stand in for them, as in functional_call."""
        weights = self.rotations.per_length
        if self._made is None or not (weights is self._made[0] or torch.equal(weights, self._made[0])):
            edges, values = self.edges.cpu().numpy(), weights.double().cpu().numpy()
            laplacian = graph_laplacian(edges, values, len(self.free))
            self._made = weights, SparseSolver(laplacian, torch.nonzero(self.free).flatten().cpu().numpy())
        return self._made[1]

    def forward(self, first: Tensor, second: Tensor, t: Tensor) -> Tensor:
        """The shape at the time ``t``. *Shape:* ``(B, V, 3), (B, V, 3), (B,) -> (B, V, 3)``."""
        pulls = self.rotations(first, second, t) * self.rotations.per_length
        both = torch.cat([-pulls, pulls], -1)
        right = both.new_zeros(*both.shape[:-1], len(self.free)).index_add(-1, self.edges.T.flatten(), both)
        x = self.solver(right.movedim(0, -1))
        return x + self._centroids(torch.lerp(first, second, t[:, None, None]) - x)

    def _centroids(self, x: Tensor) -> Tensor:
        """The mean over the piece of each vertex. *Shape:* ``(B, V, 3)``."""
        rows = (x * self.shares[:, None]).movedim(-1, 0).contiguous()
        sums = torch.zeros_like(rows).index_add(-1, self.vertex_piece, rows)
        return pick(sums, self.vertex_piece).movedim(0, -1)
