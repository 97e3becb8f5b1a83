"""How far shapes are from two key-frames, bounded for each element."""

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor, nn

from torch_modal import trees
from torch_modal.backends.torch.fine_steps import FurtherTerms
from torch_modal.backends.torch.rests import Rests
from torch_modal.energy.bend import collapsed, dihedral_angle
from torch_modal.energy.energy import Energy
from torch_modal.energy.term import Mesh, periodic_square
from torch_modal.geometry.vectors import cross, inverse, norm

# Elements of each kind that are looked at, spread evenly: the sum is then known to a few percent.
MOST_ELEMENTS = 1024

# Strain of an edge from which on its contribution is linear: of edges that have no length at rest it means nothing.
LARGEST_STRAIN = 4.0

# Bound on the weight l^2 / A of a hinge with a needle; an equilateral hinge has 1.15.
LARGEST_WEIGHT = 8.0

# Strain of edges below which nobody sees a difference.
SLIGHT = 1e-4


class Distortion(nn.Module):
    r"""Stretching and bending of Eq. 5 against both key-frames, with a bounded contribution of each element.

    .. math:: \sum_e \alpha\, |l_e - \bar l_e| \min(|l_e - \bar l_e| / \bar l_e,\, 4)
        + \sum_h \beta \min(\bar l_h^2 / \bar A_h,\, 8)\, f(\theta_h - \bar\theta_h)

    The key-frames have the weights ``1 - t`` and ``t``, or those given. Further terms of the energy count in full.

    Args:
        mesh: The mesh.
        further: Terms beyond Eq. 5.
    """

    edges: Tensor
    edge: Tensor
    hinges: Tensor
    hinge: Tensor
    has_hinge: Tensor

    def __init__(self, mesh: Mesh, further: Energy | None) -> None:
        super().__init__()
        interior = torch.tensor(mesh.connectivity.counts == 2)
        n_edges, n_hinges = len(interior), int(interior.sum())
        edge = torch.linspace(0, n_edges - 1, min(n_edges, MOST_ELEMENTS), dtype=torch.float64).round().long()
        has_hinge = interior[edge]
        hinge = interior.cumsum(0)[edge] - 1
        buffers = {
            "edge": edge,
            "edges": mesh.edges[edge].T.contiguous(),
            "hinge": hinge[has_hinge],
            "has_hinge": has_hinge,
            "hinges": mesh.hinges[hinge[has_hinge]].T.contiguous(),
        }
        for name, values in buffers.items():
            self.register_buffer(name, values, persistent=False)
        #: How many elements each one stands for.
        self.shares = n_edges / len(edge), n_hinges / max(len(self.hinge), 1)
        self.further = further

    def forward(self, shapes: Sequence[Tensor], rests: Rests) -> Tensor:
        """The distortion of S shapes of each sample. *Shape of each:* ``(B, V, 3) -> (S, B)``."""
        total = self.of_shell(shapes, rests)
        if self.further is not None:
            terms = FurtherTerms(self.further, rests.further())
            total = total + torch.stack([terms.value(x) for x in shapes])
        return total

    def of_shell(self, shapes: Sequence[Tensor], rests: Rests) -> Tensor:
        """Stretching and bending. *Shape of each:* ``(B, V, 3) -> (S, B)``."""

        def measures(x: Tensor) -> tuple[Tensor, Tensor, Tensor]:
            edge_vectors = _edge_vectors(x, self.hinges)
            return norm(_edge_vectors(x, self.edges)[0]), dihedral_angle(edge_vectors), _weights(edge_vectors)

        found = [measures(x) for x in shapes]
        lengths, angles = (torch.stack([each[i] for each in found]) for i in (0, 1))
        alpha, beta = (
            values if values.shape[-1] == 1 else values[:, own]
            for values, own in zip(rests.stiffness[:2], (self.edge, self.hinge), strict=True)
        )
        total: Any = 0.0
        for end, pull in zip(rests.shapes, rests.pulls(), strict=True):
            length, angle, weight = trees.picked(measures(end), rests.which)
            off = (lengths - length).abs()
            stretching = (alpha * off * (off / length).clamp_max(LARGEST_STRAIN)).sum(-1)
            bending = (beta * weight * periodic_square(angles - angle)).sum(-1)
            total = total + pull * (self.shares[0] * stretching + self.shares[1] * bending)
        return total  # type: ignore[no-any-return]

    def slight(self, stiffness: Sequence[Tensor], like: Tensor) -> Tensor:
        """The distortion of a shape whose edges are all strained by :data:`SLIGHT`. *Shape:* ``(B,)``."""
        lengths = norm(_edge_vectors(like.detach(), self.edges)[0]).sum(-1)
        return self.shares[0] * stiffness[0].detach().mean(-1) * lengths * SLIGHT**2


def _edge_vectors(x: Tensor, corners: Tensor) -> Tensor:
    """Vectors from the first vertex of each element to the others. *Shape:* ``(B, V, 3) -> (n-1, 3, B, M)``."""
    first, *others = (x.index_select(-2, corner).movedim(-1, 0) for corner in corners)
    return torch.stack([other - first for other in others])


def _weights(edge_vectors: Tensor) -> Tensor:
    """The bounded weights of hinges; 0 where a triangle has collapsed. *Shape:* ``(3, 3, B, H) -> (B, H)``."""
    e, a, b = edge_vectors
    n1, n2 = cross(e, a), cross(b, e)
    weight = 2 * (e * e).sum(0) * inverse(norm(n1) + norm(n2), collapsed(e, n1) | collapsed(e, n2))
    return weight.clamp_max(LARGEST_WEIGHT)
