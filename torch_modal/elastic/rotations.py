"""Poses of pairs of shapes and local rotations by kernels, tested against torch's."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torch_modal.autograd import is_eager
from torch_modal.elastic.kernels.function import Operation
from torch_modal.elastic.kernels.launch import kernels, launch
from torch_modal.geometry import procrustes
from torch_modal.geometry.connectivity import Connectivity
from torch_modal.geometry.local_rotations import LocalRotations, Trajectory
from torch_modal.geometry.poisson import Poisson


class WarpRotations(LocalRotations):
    """:class:`~torch_modal.geometry.local_rotations.LocalRotations` by kernels, in float64.

    Pulls of edge vectors between two shapes, and edge vectors on trajectories, come from kernels; of more shapes, the
    signs of rotations do.
    """

    shares: Tensor
    triangles: Tensor
    triangle_sides: Tensor
    triangle_signs: Tensor
    order: Tensor
    parents: Tensor
    pieces: Tensor

    def __init__(self, mesh: Connectivity, references: Tensor) -> None:
        super().__init__(mesh, references)
        parent = self.ancestors[0]
        depth = (parent != torch.arange(len(parent))).long()
        for above in self.ancestors:
            depth = depth + depth[above]
        areas, around = self.areas.repeat_interleave(3), self.sides.view(3, -1).T.flatten()
        total = areas.new_zeros(self.n_edges).index_add(0, around, areas)
        #: Parts of the sides of each triangle in their edges. *Shape:* ``(3F,)``.
        self.register_buffer("shares", areas / total[around].clamp_min(torch.finfo(total.dtype).tiny), persistent=False)
        tables = {
            "triangles": self.faces,
            "triangle_sides": around.view(-1, 3),
            "triangle_signs": self.side_signs.view(3, -1).T.contiguous(),
            "order": torch.argsort(depth, stable=True),
            "parents": parent,
            "pieces": self.piece,
        }
        for name, table in tables.items():
            self.register_buffer(name, table.int(), persistent=False)

    def right_hand_side(self, shapes: Tensor, weights: Tensor, poisson: Poisson) -> Tensor:
        """Overrides the base class."""
        if self.beyond_a_turn or weights.shape[1] != 2:
            return super().right_hand_side(shapes, weights, poisson)
        return _RightHandSide(self, poisson)(shapes, weights)[0].to(shapes)

    def signed_quaternions(self, shapes: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Quaternions between two shapes, their signs, frames and stretches, ``(B, F, 4), (B, F), (B, F, 12)``."""
        quaternions, areas, frames = (shapes.new_empty(len(shapes), len(self.faces), n) for n in (4, 1, 12))
        args = [self.triangles, shapes.shape[2], shapes, quaternions, areas, frames]
        launch(kernels("rotations").turns, (len(shapes), len(self.faces)), args)
        return quaternions, self.sign(quaternions, areas[..., 0]), frames

    def sign(self, quaternions: Tensor, areas: Tensor) -> Tensor:
        """Overrides the base class, on a CPU: the walk down the tree is one thread's."""
        if areas.device.type != "cpu" or not is_eager(areas):
            return super().sign(quaternions, areas)
        rows, weights = quaternions.double().contiguous(), areas.double().contiguous()
        sign, vote = torch.ones_like(weights), weights.new_zeros(len(weights), self.n_pieces)
        args = [self.order, self.parents, self.pieces, self.n_pieces, rows, weights, sign, vote]
        launch(kernels("rotations").sign_votes, (len(weights),), args)
        return sign.to(areas)

    def edges_along(self, trajectory: Trajectory, which: Tensor, t: Tensor) -> Tensor:
        """Overrides the base class."""
        packed = torch.cat(list(trajectory)).movedim(0, -1)
        return _OnTrajectory(self, len(packed))(packed, which, t)[0].movedim(-1, 0).to(trajectory.size)


@dataclass(frozen=True, eq=False)
class _RightHandSide(Operation[Tensor]):
    """Pulls of the edge vectors between two shapes. *Shape:* ``(B, 2, V, 3), (B, 2) -> (B, V, 3)``."""

    rotations: WarpRotations
    poisson: Poisson

    def run(self, kept: list[Tensor] | None, shapes: Tensor, weights: Tensor) -> tuple[Tensor, ...]:
        rotations, right = self.rotations, torch.zeros_like(shapes[:, 0])
        quaternions, sign, frames = rotations.signed_quaternions(shapes)
        args = [rotations.triangles, shapes.shape[2], quaternions, sign, frames, weights, self._stiffness(), right]
        launch(kernels("rotations").right_hand_side, (len(shapes), len(rotations.faces)), args)
        if kept is not None:
            kept += [quaternions, sign, frames]
        return (right,)

    def back(self, kept: list[Tensor], grads: Sequence[Tensor], shapes: Tensor, weights: Tensor) -> tuple[Tensor, ...]:
        rotations, module, dim = self.rotations, kernels("rotations"), (len(shapes), len(self.rotations.faces))
        quaternions, sign, frames = kept or rotations.signed_quaternions(shapes)
        to_shapes, to_weights, to_quaternions, to_frames = map(torch.zeros_like, (shapes, weights, quaternions, frames))
        sizes = rotations.triangles, shapes.shape[2]
        values = [*sizes, quaternions, sign, frames, weights, self._stiffness(), torch.empty_like(grads[0])]
        adjoints = [None, None, to_quaternions, None, to_frames, to_weights, None, *grads]
        launch(module.right_hand_side, dim, values, adjoints)
        values = [*sizes, shapes, quaternions, torch.empty_like(sign), frames]
        launch(module.turns, dim, values, [None, None, to_shapes, to_quaternions, None, to_frames])
        return to_shapes, to_weights

    def by_torch(self, shapes: Tensor, weights: Tensor) -> tuple[Tensor, ...]:
        return (LocalRotations.right_hand_side(self.rotations, shapes, weights, self.poisson),)

    def _stiffness(self) -> Tensor:
        """Stiffnesses of the sides of each triangle: its parts of the stiffnesses of edges. *Shape:* ``(F, 3)``."""
        sides = self.rotations.triangle_sides.flatten()
        return self.rotations.shares.double() * self.poisson.weights.double().index_select(0, sides)


@dataclass(frozen=True, eq=False)
class _OnTrajectory(Operation[Tensor]):
    """Edge vectors on packed trajectories. *Shape:* ``(P, F, 30), (B,), (B,) -> (B, E, 3)``."""

    rotations: WarpRotations
    n_pairs: int
    """Number of trajectories, P: ``vmap`` passes several batches as one."""

    def run(self, kept: list[Tensor] | None, packed: Tensor, which: Tensor, t: Tensor) -> tuple[Tensor, ...]:
        total = t.new_zeros(len(t), self.rotations.n_edges, 4)
        args = [*self._arguments(packed, which, t), total]
        launch(kernels("rotations").trajectory_edges, (len(t), len(self.rotations.faces)), args)
        sums, areas = total[..., :3], total[..., 3:].clamp_min(torch.finfo(total.dtype).tiny)
        if kept is not None:
            kept += [sums, areas]
        return (sums / areas,)

    def back(self, kept: list[Tensor], grads: Sequence[Tensor], *tensors: Tensor) -> tuple[Tensor | None, ...]:
        packed, which, t = tensors
        if not kept:
            self.run(kept, packed, which, t)
        sums, areas = kept
        to_sums = grads[0] / areas
        to_total = torch.cat([to_sums, -(sums * to_sums).sum(-1, keepdim=True) / areas], -1)
        to_packed, to_t = torch.zeros_like(packed), torch.zeros_like(t)
        values = [*self._arguments(packed, which, t), torch.empty_like(to_total)]
        adjoints = [None, None, None, to_packed, None, to_t, to_total]
        launch(kernels("rotations").trajectory_edges, (len(t), packed.shape[1]), values, adjoints)
        return to_packed, None, to_t

    def by_torch(self, packed: Tensor, which: Tensor, t: Tensor) -> tuple[Tensor, ...]:
        trajectory = Trajectory._make(packed.movedim(-1, 0).split([3, 3, 3, 3, 6, 6, 6]))
        return (LocalRotations.edges_along(self.rotations, trajectory, which.long(), t).movedim(0, -1),)

    def _arguments(self, packed: Tensor, which: Tensor, t: Tensor) -> list[Tensor | int]:
        """Arguments of the kernel before its result."""
        rotations, first = self.rotations, torch.arange(0, len(packed), max(self.n_pairs, 1), device=which.device)
        index = (which.view(max(len(first), 1), -1) + first[:, None]).flatten().int()
        return [rotations.triangle_sides, rotations.triangle_signs, rotations.n_edges, packed, index, t]


def best_rotations(covariance: Tensor) -> Tensor:
    """:func:`torch_modal.geometry.rigid.best_rotation`, without a gradient, in float64. *Shape:* ``(N, 3, 3)``."""
    rotations = torch.empty_like(covariance)
    launch(kernels("procrustes").best_rotations, (len(rotations),), [covariance, rotations])
    return rotations


def mean_pose(to_reference: Tensor, among: Tensor, weights: Tensor) -> tuple[Tensor, Tensor]:
    """:func:`torch_modal.geometry.procrustes.mean_pose`; of two shapes by a kernel, in float64."""
    if weights.shape[1] != 2:
        return procrustes.mean_pose(to_reference, among, weights)
    rotations, pose = _MeanPose()(to_reference, among, weights)
    return rotations.to(among), pose.to(among)


class _MeanPose(Operation[Tensor]):
    """*Shape:* ``(B, 2, 3, 3), (B, 2, 2, 3, 3), (B, 2) -> (B, 2, 3, 3), (B, 3, 3)``."""

    by_torch = staticmethod(procrustes.mean_pose)

    @staticmethod
    def run(kept: list[Tensor] | None, *tensors: Tensor) -> tuple[Tensor, ...]:
        rotations, pose = torch.empty_like(tensors[0]), torch.empty_like(tensors[0][:, 0])
        launch(kernels("procrustes").mean_pose, (len(pose),), [*tensors, rotations, pose])
        return rotations, pose

    @staticmethod
    def back(kept: list[Tensor], grads: Sequence[Tensor], *tensors: Tensor) -> tuple[Tensor | None, ...]:
        gradients = [torch.zeros_like(x) for x in tensors]
        scratch = [torch.empty_like(x) for x in grads]
        launch(kernels("procrustes").mean_pose, (len(tensors[0]),), [*tensors, *scratch], [*gradients, *grads])
        return tuple(gradients)
