"""A shape between two key-frames by local rotations of all triangles; the base of the modal space."""

from functools import cached_property
from typing import Any

import torch
from torch import Tensor, nn

from torch_modal.autograd import applied, flattened, lasting, traced
from torch_modal.backends.warp.launch import kernels, launch
from torch_modal.backends.warp.rotations import FusedRotations
from torch_modal.geometry.connectivity import Connectivity
from torch_modal.geometry.local_rotations import LocalRotations, Trajectory, weights_per_length
from torch_modal.geometry.poisson import Poisson
from torch_modal.geometry.vectors import pick


class RotationBlend(nn.Module):
    r"""Vertices of :math:`\min_x \sum_e |e(x) - \bar e|^2 / l_e`, with edges from :class:`LocalRotations`.

    The weights are those of references, so that one factorisation serves all shapes. Each piece of the surface keeps
    the centroid of linear interpolation; vertices that no face uses are pieces of their own.

    Args:
        mesh: The connectivity.
        references: Shapes near the key-frames, as for :class:`LocalRotations`. *Shape:* ``(K, V, 3)``.
        fused: Whether the edges come from kernels.
        poisson: The system, where others share it. Default: that of the mean edge lengths of the references.
    """

    ends: Tensor

    def __init__(
        self, mesh: Connectivity, references: Tensor, fused: bool = False, poisson: Poisson | None = None
    ) -> None:
        super().__init__()
        self.rotations = (FusedRotations if fused else LocalRotations)(mesh, references)
        if poisson is None:
            poisson = Poisson(mesh, weights_per_length(mesh, references))
        self.poisson = poisson
        self.fused = fused
        self.register_buffer("ends", self.poisson.edges.int(), persistent=False)

    def forward(self, first: Tensor, second: Tensor, t: Tensor, straight: Tensor | None = None) -> Tensor:
        """The shape at the time ``t``.

        Args:
            first: *Shape:* ``(B, V, 3)``.
            second: *Shape:* ``(B, V, 3)``.
            t: *Shape:* ``(B,)``.
            straight: What linear interpolation gives, where it is known. *Shape:* ``(B, V, 3)``.
        """
        near = torch.lerp(first, second, t[:, None, None]) if straight is None else straight
        return self._reached(self.rotations(first, second, t), near)

    def along(self, trajectory: Trajectory, which: Tensor, straight: Tensor, t: Tensor) -> Tensor:
        """The shape at the time ``t`` of a trajectory.

        Args:
            trajectory: Of :meth:`LocalRotations.trajectory`.
            which: Of which pair of shapes. *Shape:* ``(B,)``.
            straight: Shapes whose pieces have their centroids where they are wanted. *Shape:* ``(B, V, 3)``.
            t: *Shape:* ``(B,)``.
        """
        return self._reached(self.rotations.along(trajectory, which, t), straight)

    def bent_along(self, trajectory: Trajectory, straight: Tensor, t: Tensor, bending: Tensor) -> Tensor:
        """The same of one pair of shapes, whose triangles also bend, see :meth:`LocalRotations.bent_along`."""
        return self._reached(self.rotations.bent_along(trajectory, t, bending), straight)

    def _reached(self, edges: Tensor, near: Tensor) -> Tensor:
        rows = near.movedim(-1, 0)
        if not self.fused or traced(near):
            return self.poisson(edges, rows).movedim(0, -1)
        right = applied(_Pulls, self.ends, self.poisson.weights, edges.movedim(0, -1), near.shape[1])
        return self.poisson.placed(right.movedim(-1, 0), rows).movedim(0, -1)


class Blends:
    """The blends of pairs of shapes. One Poisson system serves all, so that velocities go on where two of them meet.

    So does the tree of the first pair, wherever turns have the same senses by every tree: where neighbours have the
    same one by this. Other pairs have one of their own.

    Args:
        mesh: The connectivity.
        shapes: All of them, float64 on the CPU. *Shape:* ``(K, V, 3)``.
        first: The pair whose tree others share, if they can.
        fused: Whether the edges come from kernels.
    """

    def __init__(self, mesh: Connectivity, shapes: Tensor, first: tuple[int, int], fused: bool = False) -> None:
        self.mesh, self.shapes, self.fused = mesh, shapes, fused
        self._pair = first

    @cached_property
    @lasting
    def first(self) -> RotationBlend:
        """That of the first pair."""
        others = [k for k in range(len(self.shapes)) if k not in self._pair]
        return RotationBlend(self.mesh, self.shapes[[*self._pair, *others]], self.fused)

    @lasting
    def of(self, i: int, j: int) -> RotationBlend:
        """The blend of two of the shapes."""
        if (i, j) == self._pair or self._is_plain(i, j):
            return self.first
        return RotationBlend(self.mesh, self.shapes[[i, j]], self.fused, self.first.poisson)

    def _is_plain(self, i: int, j: int) -> bool:
        """Whether neighbours have the same quaternion sign by the first tree, and so by every other."""
        rotations = self.first.rotations
        pair = self.shapes[[i, j]].to(rotations.piece.device)
        turns = rotations.turns(pair[:1], pair[1:])[:, 0]
        one, other = torch.tensor(self.mesh.face_neighbours, device=turns.device).unbind(1)
        return bool(((pick(turns, one) * pick(turns, other)).sum(0) >= 0).all())


class _Pulls(torch.autograd.Function):
    """Each edge times its weight, taken from its start and given to its end. *Shape:* ``(B, E, 3) -> (B, V, 3)``."""

    @staticmethod
    def forward(ends: Tensor, weights: Tensor, wanted: Tensor, n: int) -> Tensor:
        own = wanted.detach().double().contiguous()
        out = own.new_zeros(len(own), n, 3)
        launch(kernels("rotations").pulls, (len(own), len(ends)), [own, weights.double(), ends, n, out])
        return out.to(wanted)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
        ctx.ends, ctx.weights = inputs[:2]

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        start, end = ctx.ends.unbind(1)
        across = grads[0].index_select(-2, end) - grads[0].index_select(-2, start)
        return None, None, ctx.weights.to(across)[:, None] * across, None

    @staticmethod
    def vmap(
        info: Any, in_dims: tuple[Any, ...], ends: Tensor, weights: Tensor, wanted: Tensor, n: int
    ) -> tuple[Tensor, int]:
        (flat,) = flattened(info.batch_size, in_dims[2:3], (wanted,))
        return _Pulls.apply(ends, weights, flat, n).unflatten(0, (info.batch_size, -1)), 0
