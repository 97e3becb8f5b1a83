"""Rotations of more than a full turn: triangles follow the rotations of clusters, each relative to the one before."""

import numpy as np
import torch
from torch import Tensor, nn

from torch_modal.arrays import FloatArray, IntArray
from torch_modal.geometry.connectivity import traversal
from torch_modal.geometry.rotations import arc, conjugate, mean, product
from torch_modal.geometry.vectors import pick

# Rotation of the triangles of a cluster relative to its root, in radians. Above half a turn, the direction is unknown.
WIDEST = 2 * np.pi / 3

# Clusters are needed where more than this part of the area of a piece turns by more than this angle, in radians, from
# its mean. Half a turn would be a full one from side to side; the rest is noise. Of fists, 1 % turns by half a turn.
BEYOND = np.radians(200)
PART_BEYOND = 0.05


class Clusters(nn.Module):
    r"""Fractions of rotations that go beyond a full turn.

    A triangle of the cluster ``c`` turns by :math:`T_c(t)\, (R_c^T R)^t` with the rotation :math:`R_c` of the root of
    the cluster, and a cluster by :math:`T_c(t) = T_p(t)\, (R_p^T R_c)^t` with its parent ``p``. No power is one of a
    rotation of half a turn or more.

    Args:
        turns: Quaternions of the triangles, of any signs, from the first of K shapes to each. *Shape:* ``(4, K, F)``.
        areas: Of the triangles. *Shape:* ``(F,)``.
        ancestors: Those of the triangles in a spanning forest, by 1, 2, 4, ... generations; a root is its own parent.
            *Shape:* ``(J, F)``.
        piece: The tree of each triangle. *Shape:* ``(F,)``.
    """

    cluster: Tensor
    roots: Tensor
    ancestors: Tensor

    def __init__(self, quaternions: Tensor, areas: Tensor, ancestors: Tensor, piece: Tensor) -> None:
        super().__init__()
        # From the middle of each piece, so that as much turns one way as the other.
        order = np.lexsort((_from_mean(quaternions, areas, ancestors, piece), piece))
        middles = order[np.unique(piece[order], return_index=True)[1]]
        cluster, roots, parent = _clusters(quaternions.movedim(-1, 0).numpy(), middles, ancestors[0].numpy())
        # One more cluster, which does not turn, is the parent of those without.
        generations = [np.append(parent, len(parent))]
        while (generations[-1] != len(parent)).any():
            generations.append(generations[-1][generations[-1]])
        self.register_buffer("cluster", torch.from_numpy(cluster), persistent=False)
        self.register_buffer("roots", torch.from_numpy(roots), persistent=False)
        #: By 1, 2, 4, ... generations. *Shape:* ``(J, C + 1)``.
        self.register_buffer("ancestors", torch.from_numpy(np.stack(generations)), persistent=False)

    def forward(self, quaternions: Tensor, weights: Tensor) -> Tensor:
        """The weighted means of K rotations. *Shape:* ``(4, B, K, F), (B, K, 1) -> (4, B, F)``."""
        roots = pick(quaternions, self.roots)
        still = torch.zeros_like(roots[..., :1])
        still[0] = 1
        roots = torch.cat([roots, still], -1)
        followed = mean(self._between(pick(roots, self.ancestors[0]), roots), weights)
        for ancestors in self.ancestors:
            followed = product(pick(followed, ancestors), followed)
        relative = mean(self._between(pick(roots, self.cluster), quaternions), weights)
        return product(pick(followed, self.cluster), relative)

    @staticmethod
    def _between(start: Tensor, end: Tensor) -> Tensor:
        """The way from one rotation to another, the short way round."""
        between = product(conjugate(start), end)
        return torch.where(between[0] < 0, -between, between)


def beyond_a_turn(quaternions: Tensor, areas: Tensor, ancestors: Tensor, piece: Tensor) -> bool:
    """True where parts of a piece turn by more than a full turn from each other. Arguments as for :class:`Clusters`."""
    areas, off = areas.double(), _from_mean(quaternions, areas, ancestors, piece)
    beyond = torch.bincount(piece, areas * (off > BEYOND)) > PART_BEYOND * torch.bincount(piece, areas)
    return bool(beyond.any())


def _from_mean(quaternions: Tensor, areas: Tensor, ancestors: Tensor, piece: Tensor) -> Tensor:
    """Largest angles, of any two shapes, from the mean of the piece, added up along the tree. *Shape:* ``(F,)``."""
    step = product(conjugate(pick(quaternions, ancestors[0])), quaternions)
    winding = 2 * arc(torch.where(step[0] < 0, -step, step))
    for generation in ancestors:
        winding = winding + pick(winding, generation)
    total = torch.bincount(piece, areas)
    means = winding.new_zeros(*winding.shape[:2], len(total)).index_add(-1, piece, areas * winding) / total
    off = winding - pick(means, piece)
    later = [(off[:, i:] - off[:, i - 1 : i]).norm(dim=0).amax(0) for i in range(1, off.shape[1])]
    return torch.stack(later).amax(0)


def _clusters(quaternions: FloatArray, middles: IntArray, parents: IntArray) -> tuple[IntArray, IntArray, IntArray]:
    """The cluster of each triangle, ``(F,)``; the root of each cluster, and its parent, C where none, ``(C,)`` each."""
    n = len(parents)
    order, before = traversal(np.arange(n), parents, middles, n)
    cluster = np.empty(n, dtype=np.int64)
    roots: list[int] = []
    above: list[int] = []
    for f in order:
        cluster_of_f = -1 if before[f] == n else cluster[before[f]]
        if cluster_of_f < 0 or _half_spread(quaternions[f], quaternions[roots[cluster_of_f]]) > WIDEST / 2:
            above.append(cluster_of_f)
            cluster_of_f = len(roots)
            roots.append(f)
        cluster[f] = cluster_of_f
    parent = np.array(above)
    return cluster, np.array(roots, dtype=np.int64), np.where(parent < 0, len(roots), parent)


def _half_spread(one: FloatArray, other: FloatArray) -> float:
    """Bound on half the angle between triangles, from any shape to any: the largest two from the first shape, added."""
    return float(np.sort(np.arccos(np.abs((one * other).sum(0)).clip(max=1)))[-2:].sum())
