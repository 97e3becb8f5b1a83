"""Symmetric operators on displacements that couple pairs of vertices and do not see translations.

Such an operator is known from one 3 x 3 block for each pair: the rest follows by symmetry, and because every row of
blocks sums to zero. The second-order term of an energy is one.
"""

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor, nn

from torch_modal.energy.energy import Energy, Linearised
from torch_modal.geometry.vectors import pick


class PairBlocks(nn.Module):
    """Blocks of given pairs of vertices, added up where pairs are the same.

    Args:
        pairs: In either order, as often as they come. *Shape:* ``(N, 2)``.
        n_vertices: Of the shapes, extended.
    """

    pairs: Tensor
    places: Tensor

    def __init__(self, pairs: Tensor, n_vertices: int) -> None:
        super().__init__()
        first, second = pairs.cpu().numpy().T
        keys, places = np.unique(
            np.minimum(first, second) * n_vertices + np.maximum(first, second), return_inverse=True
        )
        self.register_buffer("pairs", torch.from_numpy(np.stack(np.divmod(keys, n_vertices), 1)), persistent=False)
        # Blocks that come in descending order are kept beside the others, and transposed at the end.
        both = torch.from_numpy(places.reshape(-1) + len(keys) * (first > second))
        self.register_buffer("places", both, persistent=False)

    def forward(self, blocks: Tensor) -> Tensor:
        """The block of each pair, smaller vertex first. *Shape:* ``(3, 3, B, N) -> (3, 3, B, P)``."""
        n = len(self.pairs)
        scattered = blocks.new_zeros(*blocks.shape[:-1], 2 * n).index_add(-1, self.places, blocks)
        ascending, descending = scattered.split(n, -1)
        return ascending + descending.transpose(0, 1)

    def push(self, blocks: Tensor, field: Tensor) -> Tensor:
        """The operator on displacements. *Shape:* ``(3, 3, B, P), (3, B, V) -> (3, B, V)``."""
        start, end = self.pairs.unbind(1)
        across = pick(field, end) - pick(field, start)
        out = torch.zeros_like(field).index_add(-1, start, (blocks * across).sum(1))
        return out.index_add(-1, end, -(blocks * across[:, None]).sum(0))


class Curvature(PairBlocks):
    r"""The term :math:`\sum_q E'(q)\, \nabla^2 q` over all measures ``q``, and the curvature beyond its bound.

    Args:
        energy: The energy.
    """

    def __init__(self, energy: Energy) -> None:
        super().__init__(torch.cat([part.pairs for part in energy.parts]), energy.n_extended)

    def of(self, energy: Energy, at: Sequence[Linearised]) -> Tensor:
        """The blocks at given shapes. *Shape:* ``(3, 3, B, P)``."""
        parts = zip(energy.parts, at, strict=True)
        each = (part.term.blocks(one.edge_vectors, one.slope, one.beyond) for part, one in parts)
        return self(torch.cat([block for blocks in each for block in blocks], -1))
