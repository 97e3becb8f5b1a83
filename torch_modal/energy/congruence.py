"""Operators of pairs of vertices seen through the columns of a modal space: ``C^T A C``."""

import numpy as np
import torch
from torch import Tensor, nn

from torch_modal.geometry.vectors import pick

# Neighbours that one row of blocks holds; a vertex of more has several rows. Coarse vertices have six on average.
_NEIGHBOURS = 8

# The operators of a batch pass through an array of this many bytes at a time.
_CHUNK_BYTES = 2**26


class Congruence(nn.Module):
    """``C^T A C`` for the operators ``A`` of :class:`torch_modal.energy.assembly.PairBlocks`.

    Args:
        pairs: Pairs of vertices. *Shape:* ``(P, 2)``.
        columns: ``C``, components first, extended. *Shape:* ``(3, n, V)``.
    """

    slots: Tensor
    row_columns: Tensor
    slot_columns: Tensor

    def __init__(self, pairs: Tensor, columns: Tensor) -> None:
        super().__init__()
        numbers = pairs.cpu().numpy()
        owners, slots, filled = _rows_of_blocks(numbers)
        ends = torch.from_numpy(np.concatenate([numbers[:, 1], numbers[:, 0]]))
        rows = columns.permute(2, 0, 1)
        across = rows[ends[slots]] - rows[owners][:, None]
        self.register_buffer("slots", slots, persistent=False)
        self.register_buffer("row_columns", rows[owners].flatten(0, 1).contiguous(), persistent=False)
        slot_columns = (across * filled[..., None, None]).flatten(1, 2).contiguous()
        self.register_buffer("slot_columns", slot_columns, persistent=False)

    def forward(self, blocks: Tensor) -> Tensor:
        """Through the columns on both sides. *Shape:* ``(3, 3, B, P) -> (B, n, n)``."""
        chunk = max(1, _CHUNK_BYTES // max(1, self.row_columns.numel() * self.row_columns.element_size()))
        return torch.cat([self._through(part) for part in blocks.split(chunk, 2)])

    def _through(self, blocks: Tensor) -> Tensor:
        batch, n = blocks.shape[2], self.row_columns.shape[-1]
        both = torch.cat([blocks, blocks.transpose(0, 1)], -1)
        n_rows, width = self.slots.shape
        # Products of tiny matrices are fast in one dense block only, and with all samples side by side.
        left = (
            pick(both, self.slots.flatten())
            .unflatten(-1, self.slots.shape)
            .permute(3, 0, 2, 4, 1)
            .reshape(n_rows, 3 * batch, 3 * width)
        )
        through = (left @ self.slot_columns).view(3 * n_rows, batch * n)
        return (self.row_columns.mT @ through).view(n, batch, n).transpose(0, 1)


def _rows_of_blocks(pairs: np.ndarray) -> tuple[Tensor, Tensor, Tensor]:
    """Neighbours of all vertices in rows of equal width.

    Returns:
        The vertex that each row belongs to, *shape* ``(R,)``; which of the pairs, in both directions, fill it, and
        whether they do. *Shape:* ``(R, W)``.
    """
    start = np.concatenate([pairs[:, 0], pairs[:, 1]])
    order = np.argsort(start, kind="stable")
    vertices, first, degree = np.unique(start[order], return_index=True, return_counts=True)
    n_rows = -(-degree // _NEIGHBOURS)
    owner = np.repeat(np.arange(len(vertices)), n_rows)
    within = np.arange(len(owner)) - np.repeat(np.cumsum(n_rows) - n_rows, n_rows)
    place = within[:, None] * _NEIGHBOURS + np.arange(_NEIGHBOURS)
    filled = place < degree[owner][:, None]
    slots = order[first[owner][:, None] + np.where(filled, place, 0)]
    return torch.from_numpy(vertices[owner]), torch.from_numpy(slots), torch.from_numpy(filled)
