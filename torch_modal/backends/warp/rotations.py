"""Local rotations by Warp kernels, tested against those in torch."""

from typing import Any

import torch
from torch import Tensor

from torch_modal.autograd import applied, flattened, pushed, recorded, traced, transformed
from torch_modal.backends.warp.launch import kernels, launch
from torch_modal.geometry.local_rotations import LocalRotations, Trajectory


class WarpRotations(LocalRotations):
    """:class:`~torch_modal.geometry.local_rotations.LocalRotations` whose edges come from kernels, in float64."""

    def __init__(self, *args: Any) -> None:
        super().__init__(*args)
        parent = self.ancestors[0]
        depth, above = (parent != torch.arange(len(parent))).long(), parent
        while bool((above != above[above]).any()):
            depth, above = depth + depth[above], above[above]
        of_faces = {
            "face": self.faces,
            "order": torch.argsort(depth, stable=True),
            "parent": parent,
            "piece_of": self.piece,
            "edge_of": self.sides.unflatten(0, (3, -1)).T,
        }
        for name, values in of_faces.items():
            self.register_buffer(f"_{name}", values.int().contiguous(), persistent=False)
        self.register_buffer("_signs", self.side_signs.unflatten(0, (3, -1)).T.contiguous(), persistent=False)

    def turns(self, first: Tensor, second: Tensor) -> Tensor:
        """As the other's."""
        found = self._turned(first.contiguous(), second.contiguous())
        return (self.sign(*found[:2])[..., None] * found[0]).movedim(-1, 0)

    def _turned(self, first: Tensor, second: Tensor) -> tuple[Tensor, ...]:
        """Quaternions, twice both areas and sizes of all triangles. *Shape:* ``(B, F, 4), (B, F), (B, F, 12)``."""
        (b, n), n_faces = first.shape[:2], len(self.faces)
        found = tuple(first.new_empty(shape) for shape in ((b, n_faces, 4), (b, n_faces), (b, n_faces, 12)))
        launch(kernels("rotations").turns, (b, n_faces), [first, second, self._face, n, *found])
        return found

    def sign(self, quaternions: Tensor, areas: Tensor) -> Tensor:
        """The sign of the quaternion of each triangle. *Shape:* ``(B, F)``."""
        module, b = kernels("rotations"), len(areas)
        if areas.device.type != "cpu" or traced(areas) or transformed(areas):  # the walk down the tree is one thread's
            return self._sign_votes(quaternions.movedim(-1, 0), areas)
        n_pieces = self.n_pieces
        quaternions, weights = quaternions.double().contiguous(), areas.double()
        sign, vote = torch.empty_like(weights), weights.new_zeros(b, n_pieces)
        given = [quaternions, weights, self._order, self._parent, self._piece_of, n_pieces, sign, vote]
        launch(module.sign_votes, (b,), given)
        return sign.to(areas)

    def sums(self, turns: tuple[Tensor, ...], sign: Tensor, t: Tensor) -> Tensor:
        """Sides by area, summed on the edges, and areas, where the senses are known. *Shape:* ``(B, E, 4)``."""
        n_edges = self.n_edges
        total = t.new_zeros(len(t), n_edges, 4)
        given = [*turns, t, self._edge_of, self._signs.double(), sign, n_edges, total]
        launch(kernels("rotations").part_turned, (len(t), len(self.faces)), given)
        return total

    def from_sums(self, to_total: Tensor, sign: Tensor, first: Tensor, second: Tensor, t: Tensor) -> list[Tensor]:
        """Gradients in both shapes and the times, of that in the sums."""
        found = [torch.zeros_like(value) for value in (first, second, t)]
        given = [first, second, t, self._face, self._edge_of, self._signs.double(), sign, first.shape[1]]
        given += [self.n_edges, to_total, *found]
        launch(kernels("rotations_adjoint").from_turned, (len(sign), len(self.faces)), given)
        return found

    def along(self, trajectory: Trajectory, which: Tensor, t: Tensor) -> Tensor:
        """As the other's."""
        if traced(t):
            return super().along(trajectory, which, t)
        packed = torch.cat([*trajectory, torch.ones_like(trajectory.size[:1])])
        return applied(_OnTrajectory, self, packed.movedim(0, -1).double(), which, t.double())[0].to(trajectory.size)

    def trajectory_oracle(self, packed: Tensor, which: Tensor, t: Tensor) -> Tensor:
        """Edges on a packed trajectory, by torch. *Shape:* ``(P, F, 31)``."""
        return super().along(Trajectory._make(packed.movedim(-1, 0).split([3, 3, 3, 3, 6, 6, 6, 1])[:-1]), which, t)

    def trajectory_sums(self, which: Tensor, packed: Tensor, t: Tensor) -> Tensor:
        """Sides on courses by area, summed on the edges, and areas. *Shape:* ``(B, E, 4)``."""
        total = t.new_zeros(len(t), self.n_edges, 4)
        launch(
            kernels("rotations").trajectory_edges,
            (len(t), len(self.faces)),
            self._on_trajectory(packed, which, t, total),
        )
        return total

    def from_trajectory_sums(self, to_total: Tensor, total: Tensor, which: Tensor, *given: Tensor) -> list[Tensor]:
        """Gradients in courses and times, of that in the sums, both of which are spoilt."""
        found = [torch.zeros_like(value) for value in given]
        adjoints = [found[0], None, found[1], *[None] * 3, to_total]
        taken = self._on_trajectory(given[0], which, given[1], total)
        launch(kernels("adjoints").trajectory_edges, (len(which), len(self.faces)), taken, adjoints)
        return found

    def _on_trajectory(self, packed: Tensor, which: Tensor, t: Tensor, total: Tensor) -> list[Any]:
        return [packed, which.int(), t, self._edge_of, self._signs.double(), self.n_edges, total]


def _means(total: Tensor) -> Tensor:
    """Weighted sums over their weights. *Shape:* ``(B, E, 4) -> (3, B, E)``."""
    sums, weights = total.movedim(-1, 0).split([3, 1])  # no view in the end, of which forward mode has no tangent
    return sums / weights.clamp_min(torch.finfo(total.dtype).tiny)


def _to_sums(total: Tensor, to_means: Tensor) -> Tensor:
    """Back through :func:`_means`. *Shape:* ``(B, E, 4), (3, B, E) -> (B, E, 4)``."""
    sums, weights = total.split([3, 1], -1)
    tiny = torch.finfo(total.dtype).tiny
    to_sums = to_means.movedim(0, -1) / weights.clamp_min(tiny)
    to_weights = (sums * to_sums).sum(-1, keepdim=True) / weights.clamp_min(tiny)
    return torch.cat([to_sums, torch.where(weights >= tiny, -to_weights, 0)], -1)


class _OnTrajectory(torch.autograd.Function):
    """Edges, and the sums that backward needs."""

    @staticmethod
    def forward(fused: WarpRotations, packed: Tensor, which: Tensor, t: Tensor) -> tuple[Tensor, Tensor]:
        total = fused.trajectory_sums(which, packed.detach().contiguous(), t.detach().contiguous())
        return _means(total), total

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: tuple[Tensor, Tensor]) -> None:
        ctx.fused, *given = inputs
        ctx.mark_non_differentiable(output[1])
        ctx.save_for_backward(output[1], *given)
        ctx.save_for_forward(output[1], *given)

    @staticmethod
    def jvp(ctx: Any, *tangents: Tensor | None) -> tuple[Tensor, None]:
        _, packed, which, t = ctx.saved_tensors
        given = packed, t
        return pushed(lambda packed, t: ctx.fused.trajectory_oracle(packed, which, t), given, tangents[1::2]), None

    @staticmethod
    def backward(ctx: Any, to_edges: Tensor, _: Tensor) -> tuple[Tensor | None, ...]:
        total, packed, which, t = ctx.saved_tensors
        if recorded(to_edges, packed, t):
            back = torch.func.vjp(lambda packed, t: ctx.fused.trajectory_oracle(packed, which, t), packed, t)[1]
            to_packed, to_t = back(to_edges)
        else:
            given = packed.detach().contiguous(), t.detach().contiguous()
            to_packed, to_t = ctx.fused.from_trajectory_sums(_to_sums(total, to_edges), total.clone(), which, *given)
        return None, to_packed, None, to_t

    @staticmethod
    def vmap(
        info: Any, in_dims: tuple[Any, ...], fused: WarpRotations, packed: Tensor, which: Tensor, t: Tensor
    ) -> tuple[tuple[Tensor, Tensor], tuple[int, int]]:
        n = info.batch_size
        packed, which, t = (
            x.expand(n, *x.shape) if dim is None else x.movedim(dim, 0)
            for x, dim in zip((packed, which, t), in_dims[1:], strict=True)
        )
        which = which + packed.shape[1] * torch.arange(n, device=which.device)[:, None]
        edges, total = _OnTrajectory.apply(fused, packed.flatten(0, 1), which.flatten(), t.flatten())
        return (edges.unflatten(1, (n, -1)), total.unflatten(0, (n, -1))), (1, 0)


class _Turned(torch.autograd.Function):
    """Edges, and the signs and sums that backward needs."""

    @staticmethod
    def forward(fused: WarpRotations, *given: Tensor) -> tuple[Tensor, ...]:
        first, second, t = (value.detach().contiguous() for value in given)
        turns = fused._turned(first, second)
        sign = fused.sign(*turns[:2])
        total = fused.sums(turns, sign, t)
        return _means(total), sign, total

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: tuple[Tensor, ...]) -> None:
        ctx.fused, *given = inputs
        ctx.mark_non_differentiable(*output[1:])
        ctx.save_for_backward(*output[1:], *given)
        ctx.save_for_forward(*output[1:], *given)

    @staticmethod
    def jvp(ctx: Any, *tangents: Tensor | None) -> tuple[Tensor, None, None]:
        _, _, *given = ctx.saved_tensors
        return pushed(ctx.fused.oracle, given, tangents[1:]), None, None

    @staticmethod
    def backward(ctx: Any, to_edges: Tensor, *_: Tensor) -> tuple[Tensor | None, ...]:
        sign, total, *given = ctx.saved_tensors
        if recorded(to_edges, *given):
            return (None, *torch.func.vjp(ctx.fused.oracle, *given)[1](to_edges))
        given = [value.detach().contiguous() for value in given]
        return (None, *ctx.fused.from_sums(_to_sums(total, to_edges), sign, *given))

    @staticmethod
    def vmap(
        info: Any, in_dims: tuple[Any, ...], fused: WarpRotations, *given: Tensor
    ) -> tuple[tuple[Tensor, ...], tuple[int, ...]]:
        edges, sign, total = _Turned.apply(fused, *flattened(info.batch_size, in_dims[1:], given))
        found = (
            edges.unflatten(1, (info.batch_size, -1)),
            *(x.unflatten(0, (info.batch_size, -1)) for x in (sign, total)),
        )
        return found, (1, 0, 0)
