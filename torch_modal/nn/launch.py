"""Whether there are kernels, and how torch runs them: what NVIDIA Warp needs to be told."""

import importlib.util
import os
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, nullcontext
from functools import cache
from typing import Any, Literal

import torch
from torch import Tensor

from torch_modal.extras import require_installed
from torch_modal.progress import ProgressReport

Backend = Literal["auto", "torch", "warp"]


@cache
def kernels() -> Any:
    """The module of the kernels, compiled for this machine by the first who asks, and kept on disk by Warp."""
    import warp as wp

    before, wp.config.log_level = wp.config.log_level, wp.LOG_ERROR
    try:
        with nullcontext() if torch.cuda.is_available() else _silent():
            wp.init()
        from torch_modal.nn import kernels as module

        with ProgressReport(1, "kernels, which are compiled once", unit="module"):
            wp.load_module(module, device="cpu")
    finally:
        wp.config.log_level = before
    return module


@contextmanager
def _silent() -> Iterator[None]:
    """Nothing on standard error: there Warp's C code says that there is no CUDA driver, whatever it is told."""
    kept, nowhere = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(nowhere, 2)
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)
        os.close(nowhere)


@cache
def _works() -> bool:
    if importlib.util.find_spec("warp") is None:
        return False
    try:
        kernels()
    except Exception as error:  # whatever keeps Warp from compiling: torch does the same, only slower
        warnings.warn(f"Warp is installed, but its kernels cannot be used, so torch is: {error}", stacklevel=2)
        return False
    return True


def has_kernels(backend: Backend) -> bool:
    """Whether kernels are used.

    Raises:
        MissingPackageError: ``"warp"`` is asked for and not installed.
    """
    if backend == "warp":
        require_installed(("warp",), "warp", "backend='warp'")
    return backend != "torch" and _works()


def traced(x: Tensor) -> bool:
    """Whether a tensor only stands for one (torch.compile, export, fake tensors), so that no kernel can have it."""
    return torch.compiler.is_compiling() or type(x) not in (Tensor, torch.nn.Parameter)


def _arrays(kernel: Any, given: Sequence[Any]) -> list[Any]:
    """Tensors as flat arrays of the types that a kernel declares; what is no tensor stays."""
    import warp as wp

    found = []
    for argument, value in zip(kernel.adj.args, given, strict=True):
        if isinstance(value, Tensor):
            inner = getattr(argument.type.dtype, "_length_", 1)
            flat = value.detach().view(-1, inner) if inner > 1 else value.detach().view(-1)
            value = wp.from_torch(flat, dtype=argument.type.dtype, return_ctype=True)
        found.append(value)
    return found


def launch(kernel: Any, dim: tuple[int, ...], given: Sequence[Any], adjoints: Sequence[Any] | None = None) -> None:
    """Run a kernel, or its adjoint, on the tensors' device and torch's stream.

    Args:
        kernel: Of :func:`kernels`.
        dim: Number of threads.
        given: What it takes, tensors contiguous.
        adjoints: Gradients of each, where the adjoint is wanted; None for what has none.
    """
    import warp as wp

    device = next(value.device for value in given if isinstance(value, Tensor))
    stream = wp.stream_from_torch(torch.cuda.current_stream(device)) if device.type == "cuda" else None
    with wp.ScopedStream(stream):
        wp.launch(
            kernel,
            dim=dim,
            inputs=_arrays(kernel, given),
            adj_inputs=[] if adjoints is None else _arrays(kernel, adjoints),
            adjoint=adjoints is not None,
            device=str(device),
        )


Shapes = dict[int, tuple[int, ...]]
"""Of the arguments of a kernel that are its output, by their places."""


def recorded(kernel: Any, dim: tuple[int, ...], shapes: Shapes, *given: Any) -> tuple[Tensor, ...]:
    """Run a kernel whose outputs start as zeros and are added to, so that autograd can go back through it.

    Args:
        kernel: Of :func:`kernels`.
        dim: Number of threads.
        shapes: Of the outputs.
        given: What it takes, tensors contiguous; anything in the places of the outputs.

    Returns:
        The outputs.
    """
    return _Recorded.apply(kernel, dim, shapes, *given)


class _Recorded(torch.autograd.Function):
    """With the adjoint that Warp derives."""

    @staticmethod
    def forward(ctx: Any, kernel: Any, dim: tuple[int, ...], shapes: Shapes, *given: Any) -> tuple[Tensor, ...]:
        like = next(value for value in given if isinstance(value, Tensor) and value.is_floating_point())
        outputs = {place: like.new_zeros(shape) for place, shape in shapes.items()}
        whole = [outputs.get(place, value) for place, value in enumerate(given)]
        launch(kernel, dim, whole)
        ctx.kernel, ctx.dim, ctx.places, ctx.whole = kernel, dim, list(shapes), whole
        return tuple(outputs.values())

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Any, ...]:
        received = dict(zip(ctx.places, (grad.contiguous() for grad in grads), strict=True))
        adjoints: list[Any] = []
        for place, value in enumerate(ctx.whole):
            if place in received:
                adjoints.append(received[place].clone())
            elif isinstance(value, Tensor) and value.is_floating_point():
                adjoints.append(torch.zeros_like(value))
            else:
                adjoints.append(None)
        launch(ctx.kernel, ctx.dim, ctx.whole, adjoints)
        return (None,) * 3 + tuple(None if place in received else own for place, own in enumerate(adjoints))


def pulled_back(run: Any, given: Sequence[Tensor], to_output: Tensor, needed: Sequence[bool]) -> tuple[Any, ...]:
    """Gradients of a function of tensors in those that need one."""
    if torch.is_grad_enabled():  # gradients of gradients, or a transform of torch.func
        return torch.func.vjp(run, *given)[1](to_output)
    with torch.enable_grad():
        leaves = [value.detach().requires_grad_(need) for value, need in zip(given, needed, strict=True)]
        wanted = [leaf for leaf, need in zip(leaves, needed, strict=True) if need]
        found = iter(torch.autograd.grad(run(*leaves), wanted, to_output, allow_unused=True))
    return tuple(next(found) if need else None for need in needed)
