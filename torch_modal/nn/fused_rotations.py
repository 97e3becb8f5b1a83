"""Local rotations by kernels of NVIDIA Warp, where that is installed; torch's are what they are tested against."""

from functools import partial
from typing import Any

import torch
from torch import Tensor

from torch_modal.geometry.functions import applied, traced
from torch_modal.geometry.local_rotations import Course, LocalRotations
from torch_modal.nn.adjoint import flattened
from torch_modal.nn.launch import kernels, launch, pulled_back, recorded


class FusedRotations(LocalRotations):
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
        self._n_pieces = int(self.piece.max()) + 1
        self.register_buffer("_signs", self.side_signs.unflatten(0, (3, -1)).T.contiguous(), persistent=False)

    def forward(self, first: Tensor, second: Tensor, t: Tensor) -> Tensor:
        """As the other's."""
        if traced(first):
            return self.oracle(first, second, t)
        given = [value.double() for value in (first, second, t)]
        return applied(_Turned, self, *given)[0].to(first)

    def oracle(self, first: Tensor, second: Tensor, t: Tensor) -> Tensor:
        """The same by torch."""
        return super().forward(first, second, t)

    def turns(self, first: Tensor, second: Tensor) -> Tensor:
        """As the other's."""
        found = self._turned(first.contiguous(), second.contiguous())
        return (self.sense(*found[:2])[..., None] * found[0]).movedim(-1, 0)

    def _turned(self, first: Tensor, second: Tensor) -> tuple[Tensor, ...]:
        """Quaternions, twice both areas and sizes of all triangles. *Shape:* ``(B, F, 4), (B, F), (B, F, 12)``."""
        (b, n), n_faces = first.shape[:2], len(self.faces)
        found = tuple(first.new_empty(shape) for shape in ((b, n_faces, 4), (b, n_faces), (b, n_faces, 12)))
        launch(kernels("rotations").turns, (b, n_faces), [first, second, self._face, n, *found])
        return found

    def sense(self, quaternions: Tensor, areas: Tensor) -> Tensor:
        """The sign of the quaternion of each triangle. *Shape:* ``(B, F)``."""
        module, b = kernels("rotations"), len(areas)
        if areas.device.type != "cpu":  # the walk down the tree is one thread's
            return self._senses(quaternions.movedim(-1, 0), areas)
        n_pieces = self._n_pieces
        sign, vote = torch.empty_like(areas), areas.new_zeros(b, n_pieces)
        given = [quaternions, areas, self._order, self._parent, self._piece_of, n_pieces, sign, vote]
        launch(module.senses, (b,), given)
        return sign

    def sums(self, turns: tuple[Tensor, ...], sense: Tensor, t: Tensor) -> Tensor:
        """Sides by area, summed on the edges, and areas, where the senses are known. *Shape:* ``(B, E, 4)``."""
        n_edges = self.n_edges
        total = t.new_zeros(len(t), n_edges, 4)
        given = [*turns, t, self._edge_of, self._signs.double(), sense, n_edges, total]
        launch(kernels("rotations").part_turned, (len(t), len(self.faces)), given)
        return total

    def pull_back(self, to_total: Tensor, total: Tensor, sense: Tensor, *given: Tensor) -> list[Tensor]:
        """Gradients in both shapes and the times, of that in the sums, which are spoilt."""
        found = [torch.zeros_like(value) for value in given]
        adjoints = [*found, *[None] * 6, to_total]
        first, second, t = given
        taken = self._given(sense, first, second, t, total)
        launch(kernels("rotations").turned_edges, (len(sense), len(self.faces)), taken, adjoints)
        return found

    def _given(self, sense: Tensor, first: Tensor, second: Tensor, t: Tensor, total: Tensor) -> list[Any]:
        signs, n, n_edges = self._signs.double(), first.shape[1], self.n_edges
        return [first, second, t, self._face, self._edge_of, signs, sense, n, n_edges, total]

    def along(self, course: Course, which: Tensor, t: Tensor) -> Tensor:
        """As the other's."""
        if traced(t):
            return super().along(course, which, t)
        packed = torch.cat([part if part.dim() > 2 else part[None] for part in course])
        edges = applied(_OnCourse, self, packed.movedim(0, -1).double(), which, t.double())
        return edges.to(course.unit)

    def course_oracle(self, packed: Tensor, which: Tensor, t: Tensor) -> Tensor:
        """Edges on a packed course, by torch. *Shape:* ``(P, F, 31)``."""
        parts = packed.movedim(-1, 0).split([3, 3, 3, 3, 6, 6, 6, 1])
        return super().along(Course._make([*parts[:-1], parts[-1][0]]), which, t)

    def course_edges(self, which: Tensor, packed: Tensor, t: Tensor) -> Tensor:
        """The same by kernels. *Shape:* ``(3, B, E)``."""
        b, n_edges = len(t), self.n_edges
        given = [packed, which.int(), t, self._edge_of, self._signs.double(), n_edges, None]
        return _means(*recorded(kernels("rotations").course_edges, (b, len(self.faces)), {6: (b, n_edges, 4)}, *given))


def _means(total: Tensor) -> Tensor:
    """Weighted sums over their weights. *Shape:* ``(B, E, 4) -> (3, B, E)``."""
    return (total[..., :3] / total[..., 3:].clamp_min(torch.finfo(total.dtype).tiny)).movedim(-1, 0)


class _OnCourse(torch.autograd.Function):
    @staticmethod
    def forward(fused: FusedRotations, packed: Tensor, which: Tensor, t: Tensor) -> Tensor:
        return fused.course_edges(which, packed.detach().contiguous(), t.detach().contiguous())

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
        ctx.fused, *given = inputs
        ctx.save_for_backward(*given)

    @staticmethod
    def backward(ctx: Any, to_edges: Tensor) -> tuple[Tensor | None, ...]:
        packed, which, t = ctx.saved_tensors
        if torch.is_grad_enabled():
            given, run = [packed, t], lambda packed, t: ctx.fused.course_oracle(packed, which, t)
        else:
            given, run = [packed.contiguous(), t.contiguous()], partial(ctx.fused.course_edges, which)
        to_packed, to_t = pulled_back(run, given, to_edges, [ctx.needs_input_grad[1], ctx.needs_input_grad[3]])
        return None, to_packed, None, to_t

    @staticmethod
    def vmap(
        info: Any, in_dims: tuple[Any, ...], fused: FusedRotations, packed: Tensor, which: Tensor, t: Tensor
    ) -> tuple[Tensor, int]:
        n = info.batch_size
        packed, which, t = (
            x.expand(n, *x.shape) if dim is None else x.movedim(dim, 0)
            for x, dim in zip((packed, which, t), in_dims[1:], strict=True)
        )
        which = which + packed.shape[1] * torch.arange(n, device=which.device)[:, None]
        out = _OnCourse.apply(fused, packed.flatten(0, 1), which.flatten(), t.flatten())
        return out.unflatten(1, (n, -1)), 1


class _Turned(torch.autograd.Function):
    """Edges, and what the way back needs: the senses and the sums."""

    @staticmethod
    def forward(fused: FusedRotations, *given: Tensor) -> tuple[Tensor, ...]:
        first, second, t = (value.detach().contiguous() for value in given)
        turns = fused._turned(first, second)
        sense = fused.sense(*turns[:2])
        total = fused.sums(turns, sense, t)
        return _means(total), sense, total

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: tuple[Tensor, ...]) -> None:
        ctx.fused, *given = inputs
        ctx.mark_non_differentiable(*output[1:])
        ctx.save_for_backward(*output[1:], *given)

    @staticmethod
    def backward(ctx: Any, to_edges: Tensor, *_: Tensor) -> tuple[Tensor | None, ...]:
        sense, total, *given = ctx.saved_tensors
        if torch.is_grad_enabled():
            return (None, *pulled_back(ctx.fused.oracle, given, to_edges, ctx.needs_input_grad[1:]))
        (to_total,) = pulled_back(_means, [total], to_edges, [True])
        given = [value.detach().contiguous() for value in given]
        return (None, *ctx.fused.pull_back(to_total.contiguous(), total.clone(), sense, *given))

    @staticmethod
    def vmap(
        info: Any, in_dims: tuple[Any, ...], fused: FusedRotations, *given: Tensor
    ) -> tuple[tuple[Tensor, ...], tuple[int, ...]]:
        edges, sense, total = _Turned.apply(fused, *flattened(info.batch_size, in_dims[1:], given))
        found = (
            edges.unflatten(1, (info.batch_size, -1)),
            *(x.unflatten(0, (info.batch_size, -1)) for x in (sense, total)),
        )
        return found, (1, 0, 0)
