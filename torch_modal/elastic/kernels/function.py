"""Functions of tensors by kernels, for all that autograd and ``torch.func`` do."""

from collections.abc import Callable
from typing import Any, Protocol

import torch
from torch import Tensor

from torch_modal.autograd import applied, flattened, pushed, recorded, traced


class Operation(Protocol):
    """A function of float64 tensors by kernels. The first dimension of all is that of the samples."""

    n_results: int
    n_differentiable: int
    """How many of the results have gradients; they come first."""

    @property
    def run(self) -> Callable[..., tuple[Tensor, ...]]:
        """The results, of a list and the tensors; what :attr:`back` needs is added to the list, unless it is None."""

    @property
    def back(self) -> Callable[..., tuple[Tensor | None, ...]]:
        """Gradients in the tensors from the list, those in the results, and the tensors; the list may be empty."""

    @property
    def by_torch(self) -> Callable[..., tuple[Tensor, ...]]:
        """The same results by torch: for forward mode, second derivatives, and tensors without data."""


def fused(operation: Operation, *given: Tensor) -> tuple[Tensor, ...]:
    """The results of an operation, of tensors of any dtype."""
    given = tuple(x.double() for x in given)
    if any(map(traced, given)):
        return operation.by_torch(*given)
    keep = torch.is_grad_enabled() and any(x.requires_grad for x in given)
    return tuple(applied(_Fused, operation, [] if keep else None, *given))


def by_torch(operation: Operation, *given: Tensor) -> tuple[Tensor, ...]:
    """Likewise, without kernels."""
    return operation.by_torch(*(x.double() for x in given))


class _Fused(torch.autograd.Function):
    @staticmethod
    def forward(operation: Operation, kept: list[Any] | None, *given: Tensor) -> tuple[Tensor, ...]:
        return operation.run(kept, *(x.detach().contiguous() for x in given))

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: tuple[Tensor, ...]) -> None:
        ctx.operation, ctx.kept, *given = inputs
        ctx.mark_non_differentiable(*output[ctx.operation.n_differentiable :])
        ctx.save_for_backward(*given)
        ctx.save_for_forward(*given)

    @staticmethod
    def jvp(ctx: Any, *tangents: Tensor | None) -> tuple[Tensor | None, ...]:
        n, by_torch = ctx.operation.n_differentiable, ctx.operation.by_torch
        found = pushed(lambda *given: by_torch(*given)[:n], ctx.saved_tensors, tangents[2:])
        return *found, *[None] * (ctx.operation.n_results - n)

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        operation, given = ctx.operation, ctx.saved_tensors
        if recorded(*grads, *given):
            found = torch.func.vjp(operation.by_torch, *given)[1](grads)
        else:
            own = [x.detach().contiguous() for x in given]
            found = operation.back(ctx.kept or [], [x.contiguous() for x in grads], *own)
        return None, None, *found

    @staticmethod
    def vmap(
        info: Any, in_dims: tuple[Any, ...], operation: Operation, kept: list[Any] | None, *given: Tensor
    ) -> tuple[tuple[Tensor, ...], tuple[int, ...]]:
        flat = flattened(info.batch_size, in_dims[2:], given)
        found = _Fused.apply(operation, None if kept is None else [], *flat)
        return tuple(x.unflatten(0, (info.batch_size, -1)) for x in found), (0,) * len(found)
