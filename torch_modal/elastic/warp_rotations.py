"""Local rotations by Warp kernels, tested against those in torch."""

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from torch_modal.autograd import plain, traced
from torch_modal.elastic.kernels.function import fused
from torch_modal.elastic.kernels.launch import Constants, kernels, launch
from torch_modal.geometry.connectivity import Connectivity
from torch_modal.geometry.local_rotations import LocalRotations, Trajectory
from torch_modal.geometry.poisson import Poisson


class WarpRotations(LocalRotations):
    """:class:`~torch_modal.geometry.local_rotations.LocalRotations` by kernels, in float64.

    Pulls of edge vectors between two shapes, and edge vectors on trajectories, come from kernels; of more shapes, the
    signs of rotations do.
    """

    shares: Tensor

    def __init__(self, mesh: Connectivity, references: Tensor) -> None:
        super().__init__(mesh, references)
        parent = self.ancestors[0]
        depth, above = (parent != torch.arange(len(parent))).long(), parent
        while bool((above != above[above]).any()):
            depth, above = depth + depth[above], above[above]
        total = references.new_zeros(self.n_edges).index_add(0, self.sides, self.areas.repeat(3))
        shares = self.areas.repeat(3) / total[self.sides].clamp_min(torch.finfo(total.dtype).tiny)
        integers = {
            "faces": self.faces,
            "sides": self.sides.view(3, -1).T,
            "order": torch.argsort(depth, stable=True),
            "parent": parent,
            "piece": self.piece,
        }
        #: Parts of the sides in their edge vectors. *Shape:* ``(F, 3)``.
        self.register_buffer("shares", shares.view(3, -1).T.contiguous(), persistent=False)
        #: The surface as the first argument of kernels.
        self.constants = Constants(
            "rotations",
            "FaceTables",
            **{name: x.int().contiguous() for name, x in integers.items()},
            signs=self.side_signs.view(3, -1).T.double().contiguous(),
            n_vertices=references.shape[1],
            n_edges=self.n_edges,
            n_pieces=self.n_pieces,
        )

    def pulls(self, shapes: Tensor, weights: Tensor, poisson: Poisson) -> Tensor:
        """Overrides the base class."""
        if self.clusters is not None or weights.shape[1] != 2:
            return super().pulls(shapes, weights, poisson)
        return fused(_Turned(self, poisson), shapes, weights)[0].to(shapes)

    def turns(self, first: Tensor, second: Tensor) -> Tensor:
        """Overrides the base class."""
        found = self.turned(torch.stack([first, second], 1).double())
        return (self.sign(*found[:2])[..., None] * found[0]).movedim(-1, 0).to(first)

    def turned(self, shapes: Tensor) -> tuple[Tensor, ...]:
        """Quaternions, twice both areas, frames and sizes. *Shape:* ``(B, F, 4), (B, F), (B, F, 12)``."""
        b, n_faces = len(shapes), len(self.faces)
        found = tuple(shapes.new_empty(shape) for shape in ((b, n_faces, 4), (b, n_faces), (b, n_faces, 12)))
        launch(kernels("rotations").turns, (b, n_faces), [self.constants, shapes, *found])
        return found

    def sign(self, quaternions: Tensor, areas: Tensor) -> Tensor:
        """Overrides the base class."""
        # The walk down the tree is one thread's.
        if areas.device.type != "cpu" or not plain(areas):
            return super().sign(quaternions, areas)
        given, weights = quaternions.double().contiguous(), areas.double().contiguous()
        sign, vote = torch.empty_like(weights), weights.new_zeros(len(weights), self.n_pieces)
        launch(kernels("rotations").sign_votes, (len(weights),), [self.constants, given, weights, sign, vote])
        return sign.to(areas)

    def along(self, trajectory: Trajectory, which: Tensor, t: Tensor) -> Tensor:
        """Overrides the base class."""
        if traced(t):
            return super().along(trajectory, which, t)
        packed = torch.cat(list(trajectory)).movedim(0, -1)
        operation = _OnTrajectory(self, len(packed))
        return fused(operation, packed, which, t)[0].movedim(-1, 0).to(trajectory.size)


class _Turned:
    """Pulls of the edge vectors between two shapes. *Shape:* ``(B, 2, V, 3), (B, 2) -> (B, V, 3)``."""

    n_results = n_differentiable = 1

    def __init__(self, rotations: WarpRotations, poisson: Poisson) -> None:
        self.rotations, self.poisson = rotations, poisson

    def run(self, kept: list[Any] | None, shapes: Tensor, weights: Tensor) -> tuple[Tensor, ...]:
        """See :class:`~torch_modal.elastic.kernels.function.Operation`."""
        own, pulls = self.rotations, torch.zeros_like(shapes[:, 0])
        quaternions, areas, packed = own.turned(shapes)
        sign = own.sign(quaternions, areas)
        given = [own.constants, quaternions, sign, packed, weights, own.shares.double(), self.poisson.weights.double()]
        launch(kernels("rotations").part_turned, (len(shapes), len(own.faces)), [*given, pulls])
        if kept is not None:
            kept.append(sign)
        return (pulls,)

    def back(
        self, kept: list[Any], grads: Sequence[Tensor], shapes: Tensor, weights: Tensor
    ) -> tuple[Tensor | None, ...]:
        """See :class:`~torch_modal.elastic.kernels.function.Operation`."""
        own = self.rotations
        sign = kept[0] if kept else own.sign(*own.turned(shapes)[:2])
        found = torch.zeros_like(shapes), torch.zeros_like(weights)
        given = [own.constants, shapes, weights, sign, own.shares.double(), self.poisson.weights.double()]
        launch(kernels("rotations_adjoint").from_turned, (len(shapes), len(own.faces)), [*given, grads[0], *found])
        return found

    def by_torch(self, shapes: Tensor, weights: Tensor) -> tuple[Tensor, ...]:
        """See :class:`~torch_modal.elastic.kernels.function.Operation`."""
        return (LocalRotations.pulls(self.rotations, shapes, weights, self.poisson),)


class _OnTrajectory:
    """Edge vectors on packed trajectories. *Shape:* ``(P, F, 30), (B,), (B,) -> (B, E, 3)``.

    Args:
        rotations: The rotations.
        n_pairs: Number of trajectories, P: ``vmap`` passes several batches as one.
    """

    n_results = n_differentiable = 1

    def __init__(self, rotations: WarpRotations, n_pairs: int) -> None:
        self.rotations, self.n_pairs = rotations, n_pairs

    def run(self, kept: list[Any] | None, packed: Tensor, which: Tensor, t: Tensor) -> tuple[Tensor, ...]:
        """See :class:`~torch_modal.elastic.kernels.function.Operation`."""
        own, total = self.rotations, t.new_zeros(len(t), self.rotations.n_edges, 4)
        given = [own.constants, packed, self._index(packed, which), t, total]
        launch(kernels("rotations").trajectory_edges, (len(t), len(own.faces)), given)
        if kept is not None:
            kept.append(total)
        sums, areas = total.split([3, 1], -1)
        return (sums / areas.clamp_min(torch.finfo(total.dtype).tiny),)

    def back(
        self, kept: list[Any], grads: Sequence[Tensor], packed: Tensor, which: Tensor, t: Tensor
    ) -> tuple[Tensor | None, ...]:
        """See :class:`~torch_modal.elastic.kernels.function.Operation`."""
        if not kept:
            self.run(kept, packed, which, t)
        own, total, tiny = self.rotations, kept[0], torch.finfo(t.dtype).tiny
        sums, areas = total.split([3, 1], -1)
        to_sums = grads[0] / areas.clamp_min(tiny)
        to_areas = -(sums * to_sums).sum(-1, keepdim=True) / areas.clamp_min(tiny)
        to_total = torch.cat([to_sums, torch.where(areas >= tiny, to_areas, 0)], -1)
        to_packed, to_t = torch.zeros_like(packed), torch.zeros_like(t)
        given = [own.constants, packed, self._index(packed, which), t, total.clone()]
        adjoints = [None, to_packed, None, to_t, to_total]
        launch(kernels("rotations_adjoint").trajectory_edges, (len(t), len(own.faces)), given, adjoints)
        return to_packed, None, to_t

    def by_torch(self, packed: Tensor, which: Tensor, t: Tensor) -> tuple[Tensor, ...]:
        """See :class:`~torch_modal.elastic.kernels.function.Operation`."""
        trajectory = Trajectory._make(packed.movedim(-1, 0).split([3, 3, 3, 3, 6, 6, 6]))
        return (LocalRotations.along(self.rotations, trajectory, which.long(), t).movedim(0, -1),)

    def _index(self, packed: Tensor, which: Tensor) -> Tensor:
        n = len(packed) // max(self.n_pairs, 1)
        first = self.n_pairs * torch.arange(n, device=which.device)
        return (which.view(n, -1) + first[:, None]).flatten().int() if n > 1 else which.int()
