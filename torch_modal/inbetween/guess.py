"""Where the minimisation starts: local rotations, as far as the modal space lets them."""

import torch
from torch import Tensor, nn

from torch_modal.energy.term import Mesh
from torch_modal.geometry.local_rotations import LocalRotations, weights_per_length
from torch_modal.geometry.vectors import pick

# Directions that move no edge (coincident key-frames) get no amplitude.
RIDGE = 1e-9


class Guess(nn.Module):
    r"""The amplitudes of :math:`\min_a \sum_e |e(a) - \bar e|^2 / l_e`, with edges from :class:`LocalRotations`.

    Args:
        mesh: The coarse mesh.
        columns: Directions of the space. *Shape:* ``(n, V, 3)``.
        references: Two shapes near the key-frames. *Shape:* ``(2, V, 3)``.
    """

    edges: Tensor
    edge_columns: Tensor
    gram: Tensor
    per_length: Tensor

    def __init__(self, mesh: Mesh, columns: Tensor, references: Tensor) -> None:
        super().__init__()
        self.rotations = LocalRotations(mesh.connectivity, references)
        self.register_buffer("edges", mesh.edges, persistent=False)
        vectors = self._vectors(columns).permute(2, 0, 1).flatten(0, 1).contiguous()
        self.register_buffer("edge_columns", vectors, persistent=False)
        self.register_buffer("per_length", weights_per_length(mesh.connectivity, references), persistent=False)
        weights = self.per_length.repeat_interleave(3)[:, None]
        self.register_buffer("gram", vectors.mT @ (vectors * weights), persistent=False)

    def forward(self, shapes: Tensor, weights: Tensor, extra: Tensor) -> Tensor:
        """The amplitudes; linear interpolation has zeros.

        Args:
            shapes: Key-frames. *Shape:* ``(B, K, V, 3)``.
            weights: *Shape:* ``(B, K)``.
            extra: One more direction, of each sample's own. *Shape:* ``(B, V, 3)``.

        Returns:
            NaN where key-frames are not finite. *Shape:* ``(B, n + 1)``.
        """
        straight = self._vectors(torch.einsum("bk,bkvi->bvi", weights, shapes))
        own = self._vectors(extra)
        columns = self.edge_columns
        missing = self.rotations(shapes, weights) - straight
        per_length = self.per_length
        missing, weighted, own = (x.permute(1, 2, 0).flatten(1) for x in (missing * per_length, own * per_length, own))
        border = weighted @ columns
        upper = torch.cat([self.gram.expand(len(weights), -1, -1), border[..., None]], -1)
        lower = torch.cat([border, (weighted * own).sum(-1, True)], -1)
        gram = torch.cat([upper, lower[:, None]], 1)
        right = torch.cat([missing @ columns, (missing * own).sum(-1, True)], -1)
        ridge = RIDGE * gram.diagonal(dim1=-2, dim2=-1).mean(-1)[:, None, None]
        factor, _ = torch.linalg.cholesky_ex(gram + ridge * torch.eye(gram.shape[-1]).to(gram))
        return torch.cholesky_solve(right[..., None], factor).squeeze(-1)

    def _vectors(self, x: Tensor) -> Tensor:
        """Edge vectors, components first. *Shape:* ``(B, V, 3) -> (3, B, E)``."""
        rows = x.movedim(-1, 0).contiguous()
        start, end = self.edges.unbind(1)
        return pick(rows, end) - pick(rows, start)
