"""Between two shapes by local rotations: every triangle turns at constant speed."""

from typing import NamedTuple

import torch
from torch import Tensor, nn

from torch_modal.geometry.connectivity import Connectivity, spanning_forest
from torch_modal.geometry.vectors import cross, norm, pick

# The tree along which turns are compared avoids slivers, whose normals mean little: one with an altitude of this part
# of its longest side counts like a turn of one radian against its neighbour.
SLIVER = 0.02

# Edges without a length count like one of this part of the mean.
SHORTEST = 1e-9

# Below this square of the sine of half a turn, series are exact to rounding, and they have derivatives at no turn.
SMALL_TURN = 1e-8


class _Triangles(NamedTuple):
    """The triangles of a batch of shapes: a frame on each, and its sides in that. Components come first."""

    along: Tensor
    """Unit vector along the first side. *Shape:* ``(3, B, F)``."""
    across: Tensor
    """Unit vector in the plane, across it. *Shape:* ``(3, B, F)``."""
    normal: Tensor
    """Unit normal. *Shape:* ``(3, B, F)``."""
    sides: Tensor
    """Coordinates along and across of the side from the first corner to the second, and from there to the third.

    *Shape:* ``(2, 2, B, F)``.
    """
    areas: Tensor
    """Twice the areas. *Shape:* ``(B, F)``."""

    @property
    def slenderness(self) -> Tensor:
        """Altitude over longest side. *Shape:* ``(B, F)``."""
        first, second = self.sides
        squared = torch.stack([side.square().sum(0) for side in (first, second, first + second)]).amax(0)
        return self.areas / squared

    @classmethod
    def of(cls, x: Tensor, faces: Tensor) -> "_Triangles":
        rows = x.movedim(-1, 0).contiguous()
        p, q, r = (pick(rows, corner) for corner in faces.unbind(1))
        first, second = q - p, r - q
        normal = cross(first, second)
        length, areas = norm(first), norm(normal)
        along, normal = first / length, normal / areas
        sides = torch.stack([length, torch.zeros_like(length), (second * along).sum(0), areas / length])
        return cls(along, cross(normal, along), normal, sides.unflatten(0, (2, 2)), areas)


class LocalRotations(nn.Module):
    r"""Edge vectors between two shapes whose triangles turn at constant speed.

    Between the key-frames a triangle turns by ``R`` and is sheared by the rest. At the time ``t`` its sides are
    :math:`R^t\, ((1-t) S_a + t R^T S_b)`; an edge takes the mean of its triangles by area. Where linear interpolation
    shrinks what turns, this does not. ``R`` alone does not tell a turn of 200 degrees from one of -160. But neighbours
    turn alike: the signs of quaternions are passed on along a spanning tree, which tells up to a full turn.

    Args:
        faces: Vertex indices. *Shape:* ``(F, 3)``.
        edges: Those of the faces. *Shape:* ``(E, 2)``.
        references: Two shapes near the key-frames, for the tree and the weights. *Shape:* ``(2, V, 3)``.
        mesh: The connectivity of the faces, where it is known.
    """

    faces: Tensor
    sides: Tensor
    side_signs: Tensor
    ancestors: Tensor
    piece: Tensor
    per_length: Tensor

    def __init__(self, faces: Tensor, edges: Tensor, references: Tensor, mesh: Connectivity | None = None) -> None:
        super().__init__()
        mesh = Connectivity(faces.cpu().numpy()) if mesh is None else mesh
        first, second = edges.unbind(1)
        lengths = (references[:, second] - references[:, first]).norm(dim=-1).mean(0)
        a, b = (_Triangles.of(x[None], faces) for x in references)
        parents, piece = self._tree(a, b, mesh)
        ancestors = [parents]
        while 2 ** len(ancestors) < len(parents):
            ancestors.append(ancestors[-1][ancestors[-1]])
        self.register_buffer("faces", faces.clone(), persistent=False)
        self.register_buffer("sides", torch.tensor(mesh.sides), persistent=False)
        self.register_buffer("side_signs", torch.tensor(mesh.signs).to(references), persistent=False)
        #: By 1, 2, 4, ... generations, as many as any tree needs. *Shape:* ``(J, F)``.
        self.register_buffer("ancestors", torch.stack(ancestors), persistent=False)
        self.register_buffer("piece", piece, persistent=False)
        #: The weight of each edge where edge vectors are fitted. *Shape:* ``(E,)``.
        self.register_buffer("per_length", 1 / lengths.clamp_min(SHORTEST * lengths.mean()), persistent=False)

    @staticmethod
    def _tree(a: _Triangles, b: _Triangles, mesh: Connectivity) -> tuple[Tensor, Tensor]:
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
        a, b = (_Triangles.of(x, self.faces) for x in (first, second))
        areas, t = a.areas + b.areas, t[:, None]
        (x1, y1), (x2, y2) = torch.lerp(a.sides, b.sides, t)
        quaternions = _turn_between(a, b)
        signs = self._senses(quaternions.detach(), areas.detach())
        turn = _power(signs * quaternions, t)
        sides = [_rotate(turn, x * a.along + y * a.across) for x, y in ((x1, y1), (x2, y2))]
        wanted = torch.cat([*sides, -sides[0] - sides[1]], -1) * (areas.repeat(1, 3) * self.side_signs)
        n_edges = len(self.per_length)
        summed = wanted.new_zeros(*wanted.shape[:-1], n_edges).index_add(-1, self.sides, wanted)
        total = areas.new_zeros(len(areas), n_edges).index_add(-1, self.sides, areas.repeat(1, 3))
        return summed / total.clamp_min(torch.finfo(total.dtype).tiny)

    def _senses(self, quaternions: Tensor, areas: Tensor) -> Tensor:
        """A sign for each quaternion. *Shape:* ``(4, B, F), (B, F) -> (B, F)``."""
        signs = torch.where((quaternions * pick(quaternions, self.ancestors[0])).sum(0) < 0, -1.0, 1.0).to(areas)
        for ancestors in self.ancestors:
            signs = signs * pick(signs, ancestors)
        # Of both senses of a whole piece, the one in which most of it turns by less than half a turn.
        vote = torch.zeros_like(areas).index_add(1, self.piece, areas * signs * quaternions[0])
        return torch.where(pick(vote, self.piece) < 0, -signs, signs)


def _turn_between(a: _Triangles, b: _Triangles) -> Tensor:
    """Quaternions, real part first, of the rotations between the frames of triangles. *Shape:* ``(4, B, F)``."""
    rotation = b.along[:, None] * a.along + b.across[:, None] * a.across + b.normal[:, None] * a.normal
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = rotation
    # Four times the quaternion's products with itself. The row of its largest entry is far from zero.
    w, x, y, z = 1 + xx + yy + zz, 1 + xx - yy - zz, 1 - xx + yy - zz, 1 - xx - yy + zz
    wx, wy, wz, xy2, xz2, yz2 = zy - yz, xz - zx, yx - xy, xy + yx, xz + zx, yz + zy
    products = torch.stack([w, wx, wy, wz, wx, x, xy2, xz2, wy, xy2, y, yz2, wz, xz2, yz2, z]).unflatten(0, (4, 4))
    largest = torch.stack([w, x, y, z]).argmax(0)
    row = products.gather(0, largest.expand(1, 4, *largest.shape)).squeeze(0)
    return 0.5 * row / row.gather(0, largest[None]).clamp_min(torch.finfo(row.dtype).eps).sqrt()


def _power(quaternions: Tensor, t: Tensor) -> Tensor:
    """Rotations of the same axes by the part ``t`` of the angle. *Shape:* ``(4, B, F), (B, 1) -> (4, B, F)``."""
    real, imaginary = quaternions[0], quaternions[1:]
    squared = imaginary.square().sum(0)
    small = (squared < SMALL_TURN) & (real > 0)
    sine = torch.where(small, 1, squared.clamp_min(torch.finfo(squared.dtype).tiny)).sqrt()
    half = t * torch.atan2(sine, real)
    scale = torch.where(small, t + t * (1 - t * t) / 6 * squared, half.sin() / sine)
    cosine = torch.where(small, 1 - 0.5 * t * t * squared, half.cos())
    return torch.cat([cosine[None], scale * imaginary])


def _rotate(quaternions: Tensor, v: Tensor) -> Tensor:
    """*Shape:* ``(4, ...), (3, ...) -> (3, ...)``."""
    imaginary = quaternions[1:]
    twice = 2 * cross(imaginary, v)
    return v + quaternions[0] * twice + cross(imaginary, twice)
