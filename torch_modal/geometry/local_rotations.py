"""Between two shapes by local rotations: every triangle turns at constant speed."""

import torch
from torch import Tensor, nn

from torch_modal.geometry.connectivity import Connectivity, spanning_forest
from torch_modal.geometry.rotations import power, quaternion, rotate
from torch_modal.geometry.triangle_frames import Frames, Sides, edge_means, frames, sides
from torch_modal.geometry.vectors import pick

# The tree along which turns are compared avoids slivers, whose normals mean little: one with an altitude of this part
# of its longest side counts like a turn of one radian against its neighbour.
SLIVER = 0.02

# Edges without a length count like one of this part of the mean.
SHORTEST = 1e-9


class LocalRotations(nn.Module):
    r"""Edge vectors between two shapes whose triangles turn at constant speed.

    Between the key-frames a triangle turns by ``R`` and is sheared by the rest. At the time ``t`` its sides are
    :math:`R^t\, ((1-t) S_a + t R^T S_b)`; an edge takes the mean of its triangles by area. Where linear interpolation
    shrinks what turns, this does not. ``R`` alone does not tell a turn of 200 degrees from one of -160. But neighbours
    turn alike: the signs of quaternions are passed on along a spanning tree, which tells up to a full turn.

    Args:
        mesh: The connectivity.
        references: Two shapes near the key-frames, for the tree and the weights. *Shape:* ``(2, V, 3)``.
    """

    faces: Tensor
    sides: Tensor
    side_signs: Tensor
    ancestors: Tensor
    piece: Tensor
    per_length: Tensor

    def __init__(self, mesh: Connectivity, references: Tensor) -> None:
        super().__init__()
        faces, (first, second) = torch.tensor(mesh.faces), torch.tensor(mesh.edges).unbind(1)
        lengths = (references[:, second] - references[:, first]).norm(dim=-1).mean(0)
        a, b = (_frames(x[None], faces) for x in references)
        parents, piece = self._tree(a, b, mesh)
        ancestors = [parents]
        while 2 ** len(ancestors) < len(parents):
            ancestors.append(ancestors[-1][ancestors[-1]])
        self.register_buffer("faces", faces, persistent=False)
        self.register_buffer("sides", torch.tensor(mesh.sides), persistent=False)
        self.register_buffer("side_signs", torch.tensor(mesh.signs).to(references), persistent=False)
        #: By 1, 2, 4, ... generations, as many as any tree needs. *Shape:* ``(J, F)``.
        self.register_buffer("ancestors", torch.stack(ancestors), persistent=False)
        self.register_buffer("piece", piece, persistent=False)
        #: The weight of each edge where edge vectors are fitted. *Shape:* ``(E,)``.
        self.register_buffer("per_length", 1 / lengths.clamp_min(SHORTEST * lengths.mean()), persistent=False)

    @staticmethod
    def _tree(a: Frames, b: Frames, mesh: Connectivity) -> tuple[Tensor, Tensor]:
        """The parent of each triangle, and its piece. *Shape:* ``(F,)`` each."""
        pairs = torch.tensor(mesh.face_neighbours)
        turns = _turn_between(a, b).squeeze(1)
        slenderness = torch.cat([a.slenderness, b.slenderness]).amin(0)
        alike = (turns[:, pairs[:, 0]] * turns[:, pairs[:, 1]]).sum(0).abs().clamp_max(1)
        costs = 2 * torch.arccos(alike) + SLIVER / slenderness[pairs].amin(-1).clamp_min(SLIVER / 1e3)
        parents, piece = spanning_forest(len(mesh.faces), mesh.face_neighbours, costs.numpy())
        return torch.from_numpy(parents), torch.from_numpy(piece)

    def forward(self, first: Tensor, second: Tensor, t: Tensor) -> Tensor:
        """Edge vectors at the time ``t``, components first. *Shape:* ``(B, V, 3), (B, V, 3), (B,) -> (3, B, E)``."""
        a, b = (_frames(x, self.faces) for x in (first, second))
        areas, t = a.doubled_areas + b.doubled_areas, t[:, None]
        length, along, height = (torch.lerp(p, q, t) for p, q in zip(a[3:], b[3:], strict=True))
        quaternions = _turn_between(a, b)
        signs = self._senses(quaternions.detach(), areas.detach())
        turn = power(signs * quaternions, t)
        wanted = Sides(rotate(turn, length * a.e1), rotate(turn, a.world(along, height)))
        return edge_means(wanted, areas.repeat(1, 3), self.sides, self.side_signs, len(self.per_length))

    def _senses(self, quaternions: Tensor, areas: Tensor) -> Tensor:
        """A sign for each quaternion. *Shape:* ``(4, B, F), (B, F) -> (B, F)``."""
        signs = torch.where((quaternions * pick(quaternions, self.ancestors[0])).sum(0) < 0, -1.0, 1.0).to(areas)
        for ancestors in self.ancestors:
            signs = signs * pick(signs, ancestors)
        # Of both senses of a whole piece, the one in which most of it turns by less than half a turn.
        vote = torch.zeros_like(areas).index_add(1, self.piece, areas * signs * quaternions[0])
        return torch.where(pick(vote, self.piece) < 0, -signs, signs)


def _turn_between(a: Frames, b: Frames) -> Tensor:
    """Quaternions of the rotations between the frames of triangles. *Shape:* ``(4, B, F)``."""
    return quaternion(b.e1[:, None] * a.e1 + b.e2[:, None] * a.e2 + b.normal[:, None] * a.normal)


def _frames(x: Tensor, faces: Tensor) -> Frames:
    """Of a batch of shapes. *Shape:* ``(B, V, 3), (F, 3)``."""
    return frames(sides(x.movedim(-1, 0).contiguous(), faces))
