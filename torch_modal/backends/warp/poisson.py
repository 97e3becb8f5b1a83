"""The right-hand side of a Poisson system by a Warp kernel."""

from typing import Any

import torch
from torch import Tensor

from torch_modal.autograd import applied, flattened, traced
from torch_modal.backends.warp.launch import kernels, launch
from torch_modal.geometry.poisson import Poisson


class WarpPoisson(Poisson):
    """:class:`~torch_modal.geometry.poisson.Poisson` that sums up edge vectors in one kernel, in float64."""

    ends: Tensor

    def __init__(self, *args: Any) -> None:
        super().__init__(*args)
        self.register_buffer("ends", self.edges.int(), persistent=False)

    def forward(self, wanted: Tensor, near: Tensor) -> Tensor:
        """As in the base class, of one batch. *Shape:* ``(3, B, E), (3, B, V)``."""
        if traced(near):
            return super().forward(wanted, near)
        right = applied(_Pulls, self.ends, self.weights, wanted.movedim(0, -1), near.shape[-1])
        return self.placed(right.movedim(-1, 0), near)


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
        ctx.ends, ctx.weights, _, ctx.n = inputs

    @staticmethod
    def jvp(ctx: Any, *tangents: Tensor) -> Tensor:
        return _Pulls.apply(ctx.ends, ctx.weights, tangents[2], ctx.n)

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
