"""Where the minimisation starts: every triangle turned part of the way, as far as the modal space lets it."""

from typing import NamedTuple

import torch
from kornia.geometry.conversions import quaternion_to_rotation_matrix, rotation_matrix_to_quaternion
from torch import Tensor, nn

from torch_modal import mesh
from torch_modal.nn.shell import ShellEnergy, edge_length

# The tree along which turns are compared avoids slivers, whose normals mean little: one with an altitude of this part
# of its longest side counts like a turn of one radian against its neighbour.
SLIVER = 0.02

# Directions that move no edge (coincident key-frames) get no amplitude.
RIDGE = 1e-9


class _Triangles(NamedTuple):
    """The triangles of a batch of shapes."""

    sides: Tensor
    """From each corner to the next, as columns. *Shape:* ``(B, F, 3, 3)``."""
    frames: Tensor
    """Unit vectors as columns: the first side, across it, the normal. *Shape:* ``(B, F, 3, 3)``."""
    areas: Tensor
    """Twice the areas. *Shape:* ``(B, F)``."""

    @classmethod
    def of(cls, x: Tensor, faces: Tensor) -> "_Triangles":
        corners = x[:, faces]
        sides = corners.roll(-1, -2) - corners
        tiny = torch.finfo(x.dtype).tiny ** 0.25
        normal = torch.linalg.cross(sides[..., 0, :], sides[..., 1, :])
        areas = normal.norm(dim=-1)
        normal = normal / areas.clamp_min(tiny)[..., None]
        along = sides[..., 0, :] / sides[..., 0, :].norm(dim=-1, keepdim=True).clamp_min(tiny)
        frames = torch.stack([along, torch.linalg.cross(normal, along), normal], -1)
        return cls(sides.mT, frames, areas)


class LocalRotations(nn.Module):
    r"""Amplitudes whose edges come closest to those of triangles that turn at constant speed.

    Between the key-frames a triangle turns by ``R`` and is sheared by the rest. At the time ``t`` its sides are
    :math:`R^t\, ((1-t) S_a + t R^T S_b)`. An edge takes the mean of its triangles by area, and the amplitudes are those
    of :math:`\min_a \sum_e |e(a) - \bar e|^2 / l_e`. Where linear interpolation shrinks what turns, this does not, so
    that the minimisation starts near its end. ``R`` alone does not tell a turn of 200 degrees from one of -160. But
    neighbours turn alike: the signs of quaternions are passed on along a spanning tree, which tells up to a full turn.

    Args:
        shell: The energy on the coarse mesh.
        edge_columns: Edge vectors in each direction of the space. *Shape:* ``(E, 3, n)``.
        references: Two shapes near the key-frames, for the tree and the weights. *Shape:* ``(2, V, 3)``.
    """

    sides: Tensor
    side_signs: Tensor
    ancestors: Tensor
    piece: Tensor
    per_length: Tensor
    gram: Tensor

    def __init__(self, shell: ShellEnergy, edge_columns: Tensor, references: Tensor) -> None:
        super().__init__()
        start, end = shell.faces.flatten(), shell.faces[:, [1, 2, 0]].flatten()
        sides = mesh.edge_index(*(x.cpu().numpy() for x in (shell.edges, start, end)))
        self.register_buffer("sides", torch.from_numpy(sides))
        self.register_buffer("side_signs", torch.where(start < end, 1.0, -1.0).to(references))
        lengths = edge_length(shell.edge_vectors(references.movedim(-1, 0).contiguous())).mean(0)
        self.register_buffer("per_length", 1 / lengths.clamp_min(RIDGE * lengths.mean()))
        columns = edge_columns.flatten(0, 1)
        self.register_buffer("gram", columns.mT @ (columns * self.per_length.repeat_interleave(3)[:, None]))

        parents, piece = self._tree(_Triangles.of(references, shell.faces), shell.faces)
        ancestors = [parents]
        while 2 ** len(ancestors) < len(parents):
            ancestors.append(ancestors[-1][ancestors[-1]])
        #: By 1, 2, 4, ... generations, as many as any tree needs. *Shape:* ``(J, F)``.
        self.register_buffer("ancestors", torch.stack(ancestors))
        self.register_buffer("piece", piece)

    @staticmethod
    def _tree(triangles: _Triangles, faces: Tensor) -> tuple[Tensor, Tensor]:
        """The parent of each triangle, and its piece. *Shape:* ``(F,)`` each."""
        pairs = torch.from_numpy(mesh.face_neighbours(faces.cpu().numpy()))
        turns = rotation_matrix_to_quaternion(triangles.frames[1] @ triangles.frames[0].mT, 1e-30)
        longest = triangles.sides.norm(dim=-2).amax(-1)
        slenderness = (triangles.areas / longest.square().clamp_min(torch.finfo(longest.dtype).tiny)).amin(0)
        alike = (turns[pairs[:, 0]] * turns[pairs[:, 1]]).sum(-1).abs().clamp_max(1)
        costs = 2 * torch.arccos(alike) + SLIVER / slenderness[pairs].amin(-1).clamp_min(SLIVER / 1e3)
        parents, piece = mesh.spanning_forest(len(faces), pairs.numpy(), costs.numpy())
        return torch.from_numpy(parents), torch.from_numpy(piece)

    def forward(
        self, shell: ShellEnergy, edge_columns: Tensor, first: Tensor, second: Tensor, extra: Tensor, t: Tensor
    ) -> Tensor:
        """The amplitudes; linear interpolation has zeros.

        Args:
            shell: The energy on the coarse mesh.
            edge_columns: As above.
            first: Key-frames at 0. *Shape:* ``(B, V, 3)``.
            second: Key-frames at 1. *Shape:* ``(B, V, 3)``.
            extra: One more direction, of each sample's own. *Shape:* ``(B, V, 3)``.
            t: Times. *Shape:* ``(B,)``.

        Returns:
            NaN where key-frames are not finite. *Shape:* ``(B, n + 1)``.
        """
        straight, own = (
            shell.edge_vectors(x.movedim(-1, 0).contiguous()).movedim(0, -1)
            for x in (torch.lerp(first, second, t[:, None, None]), extra)
        )
        columns = edge_columns.flatten(0, 1)
        missing = self.edges_between(shell, first, second, t) - straight
        missing, weighted = ((x * self.per_length[:, None]).flatten(1) for x in (missing, own))
        border, own = weighted @ columns, own.flatten(1)
        upper = torch.cat([self.gram.expand(len(t), -1, -1), border[..., None]], -1)
        lower = torch.cat([border, (weighted * own).sum(-1, True)], -1)
        gram = torch.cat([upper, lower[:, None]], 1)
        right = torch.cat([missing @ columns, (missing * own).sum(-1, True)], -1)
        ridge = RIDGE * gram.diagonal(dim1=-2, dim2=-1).mean(-1)[:, None, None]
        factor, _ = torch.linalg.cholesky_ex(gram + ridge * torch.eye(gram.shape[-1]).to(gram))
        return torch.cholesky_solve(right[..., None], factor).squeeze(-1)

    def edges_between(self, shell: ShellEnergy, first: Tensor, second: Tensor, t: Tensor) -> Tensor:
        """Edge vectors at the time ``t``. *Shape:* ``(B, V, 3), (B, V, 3), (B,) -> (B, E, 3)``."""
        a, b = (_Triangles.of(x, shell.faces) for x in (first, second))
        areas = a.areas + b.areas
        turn = b.frames @ a.frames.mT
        rest = torch.lerp(a.sides, turn.mT @ b.sides, t[:, None, None, None])
        wanted = self._partly(turn, areas, t) @ rest * areas[..., None, None]
        signed = wanted.mT.flatten(1, 2) * self.side_signs[:, None]
        summed = signed.new_zeros(len(t), len(shell.edges), 3).index_add(1, self.sides, signed)
        total = areas.new_zeros(len(t), len(shell.edges)).index_add(1, self.sides, areas.repeat_interleave(3, 1))
        return summed / total.clamp_min(torch.finfo(total.dtype).tiny)[..., None]

    def _partly(self, turn: Tensor, areas: Tensor, t: Tensor) -> Tensor:
        """The rotations ``R^t``, in the sense in which their neighbours turn. *Shape:* ``(B, F, 3, 3)``."""
        quaternions = rotation_matrix_to_quaternion(turn.flatten(0, 1), 1e-30).unflatten(0, turn.shape[:2])
        parents = quaternions[:, self.ancestors[0]]
        signs = torch.where((quaternions * parents).sum(-1) < 0, -1.0, 1.0).to(areas)
        for ancestors in self.ancestors:
            signs = signs * signs[:, ancestors]
        # Of both senses of a whole piece, the one in which most of it turns by less than half a turn.
        real = signs * quaternions[..., 0]
        vote = torch.zeros_like(areas).index_add(1, self.piece, areas * real)
        signs = torch.where(vote[:, self.piece] < 0, -signs, signs)
        real, imaginary = signs * quaternions[..., 0], signs[..., None] * quaternions[..., 1:]
        sine = imaginary.norm(dim=-1)
        half = t[:, None] * torch.atan2(sine, real)
        scale = half.sin() / sine.clamp_min(torch.finfo(sine.dtype).tiny)
        return quaternion_to_rotation_matrix(torch.cat([half.cos()[..., None], scale[..., None] * imaginary], -1))
