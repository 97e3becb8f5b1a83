"""In-betweens compared with the shapes that they start from, so that none is returned that is worse.

A minimisation on a coarse mesh, in a space of modes, can end in a shape that is wrong on the fine mesh: modes of loose
pieces, limbs that the coarse mesh does not see. The energy of Eq. 5 cannot judge that, because a few degenerate faces
dominate it. What is compared here is bounded for each element, and evaluated on a part of the elements.
"""

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor, nn

from torch_modal import trees
from torch_modal.autograd import traced, transformed
from torch_modal.backends.warp.launch import kernels, launch
from torch_modal.energy.energy import Energy
from torch_modal.energy.measures import collapsed, dihedral_angle, wrap_angle
from torch_modal.energy.shell import DIAGONAL
from torch_modal.energy.terms import N_SHELL_TERMS, Mesh
from torch_modal.geometry.vectors import cross, inverse, norm

# Elements of each kind that are looked at, spread evenly: the sum is then known to a few percent.
MOST_ELEMENTS = 1024

# Bound on the weight l^2 / A of a hinge with a needle; an equilateral hinge has 1.15.
LARGEST_WEIGHT = 8.0

# A shape falls back if it has more distortion than its start by this factor. Below it, the volume error, which is not
# measured and which the starts have more of, and the choice of elements decide more than the shapes do.
SLACK = 1.2

# The same for shapes of a smooth path, where a change from one to the other would be seen as a jump in time.
SLACK_OF_PATHS = 3.0

# At a key-frame all shapes are the same, to so many roundings of a coordinate.
ROUNDINGS = 30.0


class Distortion(nn.Module):
    r"""Stretching and bending of Eq. 5 against both key-frames, with a bounded contribution of each element.

    .. math:: \sum_e \alpha\, |l_e - \bar l_e| \min(|l_e - \bar l_e| / \bar l_e,\, 1)
        + \sum_h \beta \min(\bar l_h^2 / \bar A_h,\, 8)\, (\theta_h - \bar\theta_h)^2

    The key-frames have the weights ``1 - t`` and ``t``. Further terms of the energy count in full.

    Args:
        mesh: The mesh.
        further: Terms beyond Eq. 5.
        fused: Whether kernels compute it.
    """

    edges: Tensor
    edge: Tensor
    hinges: Tensor
    hinge: Tensor
    record: Tensor
    record_hinge: Tensor

    def __init__(self, mesh: Mesh, further: Energy | None, fused: bool) -> None:
        super().__init__()
        self.fused = fused
        interior = torch.tensor(mesh.connectivity.counts == 2)
        n_edges, n_hinges = len(interior), int(interior.sum())
        edge = torch.linspace(0, n_edges - 1, min(n_edges, MOST_ELEMENTS), dtype=torch.float64).round().long()
        has_hinge = interior[edge]
        hinge = interior.cumsum(0)[edge] - 1
        record = torch.cat([mesh.edges[edge], torch.full((len(edge), 2), -1)], 1)
        record[has_hinge] = mesh.hinges[hinge[has_hinge]]
        buffers = {
            "edge": edge,
            "edges": mesh.edges[edge].T.contiguous(),
            "hinge": hinge[has_hinge],
            "hinges": mesh.hinges[hinge[has_hinge]].T.contiguous(),
            "record": record.int(),
            "record_edge": edge.int(),
            "record_hinge": hinge.clamp_min(0).int(),
        }
        for name, values in buffers.items():
            self.register_buffer(name, values, persistent=False)
        #: How many elements each one stands for.
        self.shares = n_edges / len(edge), n_hinges / max(len(self.hinge), 1)
        self.further = further

    def forward(
        self,
        shapes: Sequence[Tensor],
        ends: Sequence[Tensor],
        which: Tensor | None,
        t: Tensor,
        stiffness: Sequence[Tensor],
        anchors: Tensor | None = None,
    ) -> Tensor:
        """The distortion of S shapes of each sample.

        Args:
            shapes: *Shape of each:* ``(B, V, 3)``.
            ends: The key-frames. *Shape of each:* ``(P, V, 3)``.
            which: The pair that each sample lies between; each its own where None. *Shape:* ``(B,)``.
            t: *Shape:* ``(B,)``.
            stiffness: Of each term. *Shape of each:* ``(B, M)`` or ``(B, 1)``.
            anchors: Of further terms. *Shape:* ``(B, P, 3)``.

        Returns:
            *Shape:* ``(S, B)``.
        """
        kernels_serve = self.fused and not (traced(t) or any(transformed(x) for x in (*shapes, *ends, t, *stiffness)))
        both = self._by_kernels if kernels_serve else self._by_torch
        total = both(shapes, ends, which, t, stiffness)
        if self.further is not None:
            rests = trees.picked([self.further.rest_of(end) for end in ends], which)
            reference = self.further.between(rests[0], rests[1], t, stiffness[N_SHELL_TERMS:])
            fixed = None if anchors is None else anchors.movedim(-1, 0)
            each = [self.further.extend(x.movedim(-1, 0).contiguous(), fixed) for x in shapes]
            total = total + torch.stack([self.further.value(x, reference) for x in each])
        return total

    def rounding(self, stiffness: Sequence[Tensor], like: Tensor) -> Tensor:
        """The distortion that rounding of positions alone explains. *Shape:* ``(B,)``."""
        off = ROUNDINGS * torch.finfo(like.dtype).eps * DIAGONAL
        return self.shares[0] * len(self.edge) * stiffness[0].detach().mean(-1) * off**2

    def _by_torch(
        self,
        shapes: Sequence[Tensor],
        ends: Sequence[Tensor],
        which: Tensor | None,
        t: Tensor,
        stiffness: Sequence[Tensor],
    ) -> Tensor:
        def measures(x: Tensor) -> tuple[Tensor, Tensor, Tensor]:
            edge_vectors = _edge_vectors(x, self.hinges)
            return norm(_edge_vectors(x, self.edges)[0]), dihedral_angle(edge_vectors), _weights(edge_vectors)

        found = [measures(x) for x in shapes]
        lengths, angles = (torch.stack([each[i] for each in found]) for i in (0, 1))
        alpha, beta = (
            values if values.shape[-1] == 1 else values[:, own]
            for values, own in zip(stiffness[:2], (self.edge, self.hinge), strict=True)
        )
        total: Any = 0.0
        for end, pull in zip(ends, (1 - t, t), strict=True):
            length, angle, weight = trees.picked(measures(end), which)
            off = (lengths - length).abs()
            stretching = (alpha * off * (off / length).clamp_max(1)).sum(-1)
            bending = (beta * weight * wrap_angle(angles - angle) ** 2).sum(-1)
            total = total + pull * (self.shares[0] * stretching + self.shares[1] * bending)
        return total  # type: ignore[no-any-return]

    def _by_kernels(
        self,
        shapes: Sequence[Tensor],
        ends: Sequence[Tensor],
        which: Tensor | None,
        t: Tensor,
        stiffness: Sequence[Tensor],
    ) -> Tensor:
        b, n = shapes[0].shape[:2]
        x = torch.stack([*shapes]).double()
        index = torch.arange(b, device=t.device) if which is None else which
        alpha, beta = (values.double().contiguous() for values in stiffness[:2])
        out = x.new_zeros(len(shapes), b, 2)
        given = [x, len(shapes), *(end.double().contiguous() for end in ends), index.int(), t.double().contiguous()]
        given += [self.record, self.record_edge, self.record_hinge, alpha, beta, alpha.shape[-1], beta.shape[-1], n]
        launch(kernels("distortion").distortion, (b, len(self.record)), [*given, out])
        return (self.shares[0] * out[..., 0] + self.shares[1] * out[..., 1]).to(t)


def no_worse(
    x: Tensor,
    starts: Sequence[Tensor],
    distortion: Tensor,
    rounding: Tensor | float = 0.0,
    slack: float = SLACK,
) -> tuple[Tensor, Tensor]:
    """Shapes, and where one is worse than what it started from, the best of its starts.

    Args:
        x: *Shape:* ``(B, V, 3)``.
        starts: *Shape of each:* ``(B, V, 3)``.
        distortion: Of ``x`` and of the starts. *Shape:* ``(1 + S, B)``.
        rounding: Distortions that are no larger are equal. *Shape:* ``(B,)``.
        slack: How many times as much distortion as its start a shape may have.

    Returns:
        The shapes, *shape* ``(B, V, 3)``; where a start was taken, *shape* ``(B,)``, bool.
    """
    found, *others = distortion
    lowest, best = torch.stack(others).nan_to_num(torch.inf).min(0)
    worse = ~(found <= slack * lowest + rounding) & lowest.isfinite()
    # What need not be looked at need not be copied, either. A graph has no numbers to look at.
    if not (traced(worse) or transformed(worse)) and not bool(worse.any()):
        return x, worse
    for i, start in enumerate(starts):
        x = torch.where((worse & (best == i))[:, None, None], start, x)
    return x, worse


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
