"""The second-order term of Eq. 5 in the amplitudes of an affine space.

The term is a symmetric operator on vertex displacements that couples neighbours only and does not see translations.
So it is known from one 3 x 3 matrix for each edge, the block between its two ends: the rest follows by symmetry, and
because every row of blocks sums to zero.
"""

import numpy as np
import torch
from torch import Tensor, nn

from torch_modal.energy.shell import Measures, ShellEnergy, dihedral_hessian, length_hessian
from torch_modal.geometry import connectivity
from torch_modal.geometry.vectors import pick

# Neighbours that one row of blocks holds; a vertex of more has several rows. Coarse vertices have six on average.
_NEIGHBOURS = 8

# The second-order term of a batch passes through an array of this many bytes at a time.
_CHUNK_BYTES = 2**26


class Curvature(nn.Module):
    r"""The term :math:`\sum_q E'(q)\, \nabla^2 q` over all lengths, angles and the volume ``q``, in the amplitudes.

    The volume of an open surface is closed with cones to its centroid, which counts as one more vertex.

    Args:
        shell: The energy.
        columns: Directions of the space. *Shape:* ``(n, V, 3)``.
    """

    edges: Tensor
    shell_edges: Tensor
    hinge_blocks: Tensor
    sides: Tensor
    side_signs: Tensor
    opposite: Tensor
    slots: Tensor
    row_columns: Tensor
    slot_columns: Tensor

    def __init__(self, shell: ShellEnergy, columns: Tensor) -> None:
        super().__init__()
        faces = shell.faces.cpu().numpy()
        centre = columns.shape[1]
        cone = np.array([[j, i, centre] for i, j in connectivity.boundary_chain(faces)]).reshape(-1, 3)
        closed = np.concatenate([faces, cone]).astype(np.int64)
        edges, _ = connectivity.unique_edges(closed)
        self.register_buffer("edges", torch.from_numpy(edges))
        self.register_buffer("shell_edges", _index(edges, shell.edges.cpu().numpy()))

        # A block that joins the ends in descending order is kept beside the others, and transposed at the end.
        i, j, k, m = shell.hinges.cpu().numpy().T
        pairs = np.stack([np.stack(pair) for pair in ((i, j), (k, i), (k, j), (m, i), (m, j))])
        places = [_index(edges, pair.T) + len(edges) * torch.from_numpy(pair[0] > pair[1]) for pair in pairs]
        self.register_buffer("hinge_blocks", torch.stack(places))
        start, end = closed.T.reshape(-1), closed[:, [1, 2, 0]].T.reshape(-1)
        self.register_buffer("sides", _index(edges, np.stack([start, end], 1)))
        self.register_buffer("side_signs", torch.from_numpy(np.where(start < end, 1.0, -1.0)).to(columns))
        self.register_buffer("opposite", torch.from_numpy(closed[:, [2, 0, 1]].T.reshape(-1).copy()))

        rows = self._with_centre(shell, columns.movedim(-1, 0)).permute(2, 0, 1)
        owners, slots, filled = _rows_of_blocks(edges)
        ends = torch.from_numpy(np.concatenate([edges[:, 1], edges[:, 0]]))
        across = rows[ends[slots]] - rows[owners][:, None]
        self.register_buffer("slots", slots)
        self.register_buffer("row_columns", rows[owners].flatten(0, 1).contiguous())
        self.register_buffer("slot_columns", (across * filled[..., None, None]).flatten(1, 2).contiguous())

    @staticmethod
    def _with_centre(shell: ShellEnergy, rows: Tensor) -> Tensor:
        """The vertices and their centroid. *Shape:* ``(3, ..., V) -> (3, ..., V + 1)``."""
        return torch.cat([rows, pick(rows, shell.used).mean(-1, keepdim=True)], -1)

    def forward(
        self, shell: ShellEnergy, columns: Tensor, rows: Tensor, slope: Measures, extra: Tensor | None
    ) -> Tensor:
        """The term for shapes with given slopes. *Shape:* ``(B, n, n)``.

        Args:
            shell: The energy that the term belongs to.
            columns: The directions, vertices first. *Shape:* ``(V, 3, n)``.
            rows: The shapes. *Shape:* ``(3, B, V)``.
            slope: Derivative of the energy in each measure.
            extra: One more column, of each sample's own. *Shape:* ``(B, V, 3)``.
        """
        blocks = self.blocks(shell, rows, slope)
        chunk = max(1, _CHUNK_BYTES // (self.row_columns.numel() * self.row_columns.element_size()))
        inner = torch.cat([self._sandwich(part) for part in blocks.split(chunk, 2)])
        if extra is None:
            return inner
        own = extra.movedim(-1, 0)
        pushed = self.push(shell, blocks, own)
        border = pushed.permute(1, 2, 0).flatten(1) @ columns.flatten(0, 1)
        upper = torch.cat([inner, border[..., None]], -1)
        lower = torch.cat([border, (own * pushed).sum((0, -1))[:, None]], -1)
        return torch.cat([upper, lower[:, None]], 1)

    def blocks(self, shell: ShellEnergy, rows: Tensor, slope: Measures) -> Tensor:
        """The block between both ends of each edge, by row and column. *Shape:* ``(3, 3, B, E)``."""
        on_hinges = slope.angle * dihedral_hessian(shell.hinge_spokes(rows))
        n_edges = len(self.edges)
        scattered = on_hinges.new_zeros(*on_hinges.shape[1:-1], 2 * n_edges).index_add(
            -1, self.hinge_blocks.flatten(), torch.cat(on_hinges.unbind(), -1)
        )
        ascending, descending = scattered.split(n_edges, -1)
        stretch = -slope.length * length_hessian(shell.edge_vectors(rows))
        blocks = (ascending + descending.transpose(0, 1)).index_add(-1, self.shell_edges, stretch)

        # p.(q x r) has the block -[r] between p and q.
        centred = self._with_centre(shell, rows)
        centred = centred - centred[..., -1:]
        pulls = pick(centred, self.opposite) * (self.side_signs * slope.volume[:, None] / 6)
        x, y, z = torch.zeros_like(blocks[0]).index_add(-1, self.sides, pulls)
        zero = torch.zeros_like(x)
        return blocks + torch.stack([zero, z, -y, -z, zero, x, y, -x, zero]).unflatten(0, (3, 3))

    def _sandwich(self, blocks: Tensor) -> Tensor:
        """Through the columns on both sides. *Shape:* ``(3, 3, B, E) -> (B, n, n)``."""
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

    def push(self, shell: ShellEnergy, blocks: Tensor, field: Tensor) -> Tensor:
        """The operator on a displacement of each sample. *Shape:* ``(3, B, V) -> (3, B, V)``."""
        start, end = self.edges.unbind(1)
        field = self._with_centre(shell, field)
        across = pick(field, end) - pick(field, start)
        out = torch.zeros_like(field).index_add(-1, start, (blocks * across).sum(1))
        out = out.index_add(-1, end, -(blocks * across[:, None]).sum(0))
        # What the centroid receives is shared by the vertices that it is the mean of.
        share = (out[..., -1:] / len(shell.used)).expand(-1, -1, len(shell.used))
        return out[..., :-1].index_add(-1, shell.used, share.contiguous())


def _index(edges: np.ndarray, pairs: np.ndarray) -> Tensor:
    return torch.from_numpy(connectivity.edge_index(edges, pairs[:, 0], pairs[:, 1]))


def _rows_of_blocks(edges: np.ndarray) -> tuple[Tensor, Tensor, Tensor]:
    """Neighbours of all vertices in rows of equal width.

    Returns:
        The vertex that each row belongs to, *shape* ``(R,)``; which of the edges, in both directions, fill it, and
        whether they do. *Shape:* ``(R, W)``.
    """
    start = np.concatenate([edges[:, 0], edges[:, 1]])
    order = np.argsort(start, kind="stable")
    vertices, first, degree = np.unique(start[order], return_index=True, return_counts=True)
    n_rows = -(-degree // _NEIGHBOURS)
    owner = np.repeat(np.arange(len(vertices)), n_rows)
    within = np.arange(len(owner)) - np.repeat(np.cumsum(n_rows) - n_rows, n_rows)
    place = within[:, None] * _NEIGHBOURS + np.arange(_NEIGHBOURS)
    filled = place < degree[owner][:, None]
    slots = order[first[owner][:, None] + np.where(filled, place, 0)]
    return torch.from_numpy(vertices[owner]), torch.from_numpy(slots), torch.from_numpy(filled)
