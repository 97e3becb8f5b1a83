"""Functions of tensors by kernels, for all that autograd and ``torch.func`` do."""

from collections.abc import Callable
from typing import Any, Generic, TypeVar

import torch
from torch import Tensor

from torch_modal.autograd import (
    Context,
    InDims,
    VmapInfo,
    Vmapped,
    apply_merged,
    apply_transpose,
    is_double_backward,
    is_traced,
    needs_function,
)

Kept = TypeVar("Kept")


class Operation(Generic[Kept]):
    """A function of float64 tensors by kernels. The first dimension of all tensors counts the samples."""

    run: Callable[..., tuple[Tensor, ...]]
    """The results, of a list and the tensors; what :attr:`back` needs is added to the list, unless it is None."""
    back: Callable[..., tuple[Tensor | None, ...]]
    """Gradients in the tensors from the list, those in the results, and the tensors; the list may be empty."""
    by_torch: Callable[..., tuple[Tensor, ...]]
    """Results by torch instead of kernels: for forward mode, second derivatives, and tensors without data."""

    def __call__(self, *tensors: Tensor) -> tuple[Tensor, ...]:
        """The results for tensors of any dtype."""
        if not needs_function(*tensors):
            with torch.no_grad():
                return self.run(None, *(x.detach().double().contiguous() for x in tensors))
        tensors = tuple(x.double() for x in tensors)
        if any(map(is_traced, tensors)):
            return self.by_torch(*tensors)
        return tuple(_Fused.apply(self, [] if any(x.requires_grad for x in tensors) else None, *tensors))


class _Fused(torch.autograd.Function):
    @staticmethod
    def forward(operation: Operation[Kept], kept: list[Kept] | None, *tensors: Tensor) -> tuple[Tensor, ...]:
        return operation.run(kept, *(x.detach().contiguous() for x in tensors))

    @staticmethod
    def setup_context(ctx: Context, inputs: tuple[Any, ...], output: tuple[Tensor, ...]) -> None:
        ctx.operation, ctx.kept, *tensors = inputs
        ctx.save_for_backward(*tensors)
        ctx.save_for_forward(*tensors)

    @staticmethod
    def jvp(ctx: Context, *tangents: Tensor | None) -> tuple[Tensor | None, ...]:
        results, back = torch.func.vjp(ctx.operation.by_torch, *ctx.saved_tensors)[:2]
        return apply_transpose(back, tuple(map(torch.zeros_like, results)), ctx.saved_tensors, tangents[2:])

    @staticmethod
    def backward(ctx: Context, *grads: Tensor) -> tuple[Tensor | None, ...]:
        operation, tensors = ctx.operation, ctx.saved_tensors
        if is_double_backward(*grads, *tensors):
            gradients = torch.func.vjp(operation.by_torch, *tensors)[1](grads)
        else:
            detached = [x.detach().contiguous() for x in tensors]
            gradients = operation.back(ctx.kept or [], [x.contiguous() for x in grads], *detached)
        return None, None, *gradients

    @staticmethod
    def vmap(
        info: VmapInfo, in_dims: InDims, operation: Operation[Kept], kept: list[Kept] | None, *x: Tensor
    ) -> Vmapped:
        return apply_merged(_Fused, (operation, None if kept is None else []), info, in_dims, x)
