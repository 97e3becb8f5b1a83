"""Whether there are kernels, and how torch runs them: what NVIDIA Warp needs to be told."""

import importlib
import importlib.util
import os
import threading
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, nullcontext
from functools import cache
from typing import Any, Literal

import torch
from torch import Tensor

from torch_modal.extras import require_installed, uncollected
from torch_modal.progress import ProgressReport

Backend = Literal["auto", "torch", "warp"]


@cache
def kernels(name: Literal["alignment", "shell", "modal", "steps", "steps_adjoint", "rotations"]) -> Any:
    """A module of :mod:`torch_modal.nn.kernels`, compiled by the first who asks on a machine, and kept by Warp."""
    with uncollected():
        import warp as wp

        module = importlib.import_module(f"torch_modal.nn.kernels.{name}")

    before, wp.config.log_level = wp.config.log_level, wp.LOG_ERROR
    try:
        with nullcontext() if torch.cuda.is_available() else _silent():
            wp.init()
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
        kernels("shell")
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


class _Commands(threading.local):
    """What this thread has launched before, so that only what is new needs to be told to Warp."""

    def __init__(self) -> None:
        self.known: dict[tuple[Any, ...], _Command] = {}


_COMMANDS = _Commands()


@cache
def _sizes(kernel: Any) -> list[tuple[int, int]]:
    """Numbers and bytes in an entry of each array that a kernel takes; none of what is no array."""
    import warp as wp

    types = [argument.type for argument in kernel.adj.args]
    entries = [one.dtype if isinstance(one, wp.array) else None for one in types]
    return [(0, 0) if e is None else (getattr(e, "_length_", 1), wp.types.type_size_in_bytes(e)) for e in entries]


@cache
def _array() -> Any:
    """What Warp hands arrays over in: address, address of the gradient, dimensions, shape, strides in bytes."""
    import warp as wp

    return type(wp.from_torch(torch.zeros(1), return_ctype=True))


class _Command:
    """A launch that Warp has recorded; the next ones only write over what changes, in the places that Warp reads."""

    def __init__(self, kernel: Any, dim: tuple[int, ...], device: torch.device, adjoint: bool) -> None:
        import warp as wp

        def blank() -> list[Any]:
            return [_array()(0, 0, 1, (0,), (size,)) if width else 0 for width, size in _sizes(kernel)]

        adjoints = blank() if adjoint else []
        self.dim = dim
        self.launch = wp.launch(
            kernel, dim, blank(), adj_inputs=adjoints, adjoint=adjoint, device=str(device), record_cmd=True
        )
        self.places = list(zip(_sizes(kernel) * (1 + adjoint), self.launch.params[1:], strict=True))

    def __call__(self, dim: tuple[int, ...], values: Sequence[Any], stream: Any) -> None:
        if self.dim != dim:
            self.launch.set_dim(dim)
            self.dim = dim
        for ((width, size), place), value in zip(self.places, values, strict=True):
            if not width:
                place.value = value or 0
            elif value is None:
                place.data = place.shape[0] = 0
            else:
                assert value.is_contiguous() and width * value.element_size() == size
                place.data, place.shape[0] = value.data_ptr(), value.numel() // width
        self.launch.launch(stream)


def launch(kernel: Any, dim: tuple[int, ...], given: Sequence[Any], adjoints: Sequence[Any] = ()) -> None:
    """Run a kernel, or its adjoint, on the tensors' device and torch's stream.

    Args:
        kernel: Of :func:`kernels`.
        dim: Number of threads.
        given: What it takes, tensors contiguous and of the types that it declares.
        adjoints: Gradients of each, where the adjoint is wanted; None for what has none.
    """
    if 0 in dim:
        return  # Warp would not, either, but has no command to tell of it
    device = next(value.device for value in given if isinstance(value, Tensor))
    key = kernel, device, bool(adjoints)
    command = _COMMANDS.known.get(key)
    if command is None:
        command = _COMMANDS.known[key] = _Command(kernel, dim, device, bool(adjoints))
    command(dim, [*given, *adjoints] if adjoints else given, _stream(device))


def _stream(device: torch.device) -> Any:
    """Torch's own, of a GPU."""
    if device.type != "cuda":
        return None
    import warp as wp

    return wp.stream_from_torch(torch.cuda.current_stream(device))


Shapes = dict[int, tuple[int, ...]]
"""Of the arguments of a kernel that are its output, by their places."""


def recorded(
    kernel: Any, dim: tuple[int, ...], shapes: Shapes, *given: Any, written: tuple[int, ...] = ()
) -> tuple[Tensor, ...]:
    """Run a kernel whose outputs start as zeros and are added to, so that autograd can go back through it.

    Args:
        kernel: Of :func:`kernels`.
        dim: Number of threads.
        shapes: Of the outputs.
        given: What it takes, tensors contiguous; anything in the places of the outputs.
        written: The outputs whose entries are all written, so that it does not matter what they start as.

    Returns:
        The outputs.
    """
    if torch.is_grad_enabled():
        return _Recorded.apply(kernel, dim, shapes, written, *given)
    return tuple(_launched(kernel, dim, shapes, written, given)[0].values())


def _launched(
    kernel: Any, dim: tuple[int, ...], shapes: Shapes, written: tuple[int, ...], given: Sequence[Any]
) -> tuple[dict[int, Tensor], list[Any]]:
    """The outputs by their places, and all arguments."""
    like = next(value for value in given if isinstance(value, Tensor) and value.is_floating_point())
    outputs = {
        place: like.new_empty(shape) if place in written else like.new_zeros(shape) for place, shape in shapes.items()
    }
    whole = [outputs.get(place, value) for place, value in enumerate(given)]
    launch(kernel, dim, whole)
    return outputs, whole


class _Recorded(torch.autograd.Function):
    """With the adjoint that Warp derives."""

    @staticmethod
    def forward(
        ctx: Any, kernel: Any, dim: tuple[int, ...], shapes: Shapes, written: tuple[int, ...], *given: Any
    ) -> tuple[Tensor, ...]:
        outputs, whole = _launched(kernel, dim, shapes, written, given)
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
        return (None,) * 4 + tuple(None if place in received else own for place, own in enumerate(adjoints))


def pulled_back(run: Any, given: Sequence[Tensor], to_output: Any, needed: Sequence[bool]) -> tuple[Any, ...]:
    """Gradients of a function of tensors, of one output or a tuple of them, in those that need one."""
    if torch.is_grad_enabled():  # gradients of gradients, or a transform of torch.func
        return torch.func.vjp(run, *given)[1](to_output)
    with torch.enable_grad():
        leaves = [value.detach().requires_grad_(need) for value, need in zip(given, needed, strict=True)]
        wanted = [leaf for leaf, need in zip(leaves, needed, strict=True) if need]
        outputs = run(*leaves)
        pairs = [(outputs, to_output)] if isinstance(outputs, Tensor) else zip(outputs, to_output, strict=True)
        reached, gradients = zip(*(pair for pair in pairs if pair[0].requires_grad), strict=True)
        found = iter(torch.autograd.grad(reached, wanted, gradients, allow_unused=True))
    return tuple(next(found) if need else None for need in needed)
