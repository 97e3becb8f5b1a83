"""Loading of Warp's kernels, and their launch on torch tensors.

Arguments are written into commands that Warp has recorded, through the layout of its ctypes structures. Its documented
calls take 47 microseconds for a kernel of 13 arrays, which is 13 % of an in-between; setup.py bounds the version.
"""

import ctypes
import importlib
import math
import os
import sys
import tempfile
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import cache
from typing import Any, Literal

import torch
from torch import Tensor

from torch_modal.progress import ProgressReport

Module = Literal[
    "references",
    "shell",
    "modal",
    "steps",
    "steps_adjoint",
    "rotations",
    "rotations_adjoint",
    "adjoints",
    "crossings",
]
PACKAGE = "torch_modal.backends.warp.kernels"
IN_BETWEENS: tuple[Module, ...] = ("rotations", "references", "shell", "modal", "steps")
"""The modules for in-betweens without gradients."""
NO_DRIVER = b"Warp CUDA warning: Could not find or load the NVIDIA CUDA driver"
"""What Warp says where there is no GPU, with no setting that turns it off: in every run, it looks like an error."""
MOST_ENTRIES = 2**31 - 1
"""Kernels index with 32 bits: no array of theirs, and no launch, may be longer."""


@cache
def kernels(name: Module) -> Any:
    """A module of the kernels, compiled by the first who asks on a machine, and kept by Warp."""
    import warp as wp

    module = importlib.import_module(f"{PACKAGE}.{name}")
    _load(wp, module.__name__)
    return module


def _load(wp: Any, module: str) -> None:
    """Compile a module and those below it, several at a time, or take them from Warp's cache."""
    before, wp.config.log_level = wp.config.log_level, wp.LOG_ERROR
    try:
        with _without_line(NO_DRIVER):
            wp.init()
        with ProgressReport(1, "compiling kernels (once for this machine)", unit="module"):
            wp.load_module(module, device="cpu", recursive=True, max_workers=os.cpu_count())
    finally:
        wp.config.log_level = before


def load_kernels() -> None:
    """Load those of in-betweens, so that nobody waits for it later."""
    import warp as wp

    for name in IN_BETWEENS:
        importlib.import_module(f"{PACKAGE}.{name}")
    _load(wp, PACKAGE)
    for name in IN_BETWEENS:
        kernels(name)


@contextmanager
def _without_line(start: bytes) -> Iterator[None]:
    """Standard error of the process without the lines that begin so; all else follows at the end.

    Native code writes to the file descriptor, where no setting of Python's reaches.
    """
    try:
        sys.stderr.flush()
        before = os.dup(2)
    except (AttributeError, OSError, ValueError):  # there is none
        yield
        return
    with os.fdopen(before, "wb") as whole, tempfile.TemporaryFile() as caught:
        os.dup2(caught.fileno(), 2)
        try:
            yield
            sys.stderr.flush()
        finally:
            os.dup2(before, 2)
            caught.seek(0)
            whole.writelines(line for line in caught if not line.startswith(start))


class _Commands(threading.local):
    """The commands that this thread has recorded."""

    def __init__(self) -> None:
        self.known: dict[tuple[Any, ...], _Command] = {}


_COMMANDS = _Commands()


@cache
def _kinds(kernel: Any) -> list[tuple[int, torch.dtype] | None]:
    """Width and dtype of each array argument of a kernel; None for integers."""
    import warp as wp

    types = [argument.type for argument in kernel.adj.args]
    entries = [one.dtype if isinstance(one, wp.array) else None for one in types]
    numbers = [getattr(entry, "_wp_scalar_type_", entry) for entry in entries]
    pairs = zip(entries, numbers, strict=True)
    return [None if e is None else (getattr(e, "_length_", 1), wp.dtype_to_torch(own)) for e, own in pairs]


@cache
def _array() -> Any:
    """Warp's ctypes structure of an array: address, address of the gradient, dimensions, shape, strides in bytes."""
    import warp as wp

    return type(wp.from_torch(torch.zeros(1), return_ctype=True))


def _slot(kind: tuple[int, torch.dtype] | None, memory: Any, offset: int = 0) -> tuple[Any, ...]:
    """The entry of :func:`_kinds`, and the memory of an argument: address and length of an array, or an integer."""
    if kind is None:
        return 0, None, None, ctypes.c_int32.from_buffer(memory, offset)
    places = offset + _array().data.offset, offset + _array().shape.offset
    return *kind, ctypes.c_uint64.from_buffer(memory, places[0]), ctypes.c_int32.from_buffer(memory, places[1])


class _Command:
    """A recorded launch, whose arguments are overwritten in place."""

    def __init__(self, kernel: Any, dim: tuple[int, ...], device: torch.device, adjoint: bool) -> None:
        import warp as wp

        kinds = _kinds(kernel)

        def blank() -> list[Any]:
            return [0 if k is None else _array()(0, 0, 1, (0,), (k[0] * k[1].itemsize,)) for k in kinds]

        recorded = wp.launch(
            kernel,
            dim,
            blank(),
            adj_inputs=blank() if adjoint else [],
            adjoint=adjoint,
            device=str(device),
            record_cmd=True,
        )
        bounds, *values = recorded.params
        self.run: Callable[[Any], None]
        if device.type != "cpu":
            self.run = recorded.launch
            self.slots = [_slot(*both) for both in zip(kinds * (1 + adjoint), values, strict=True)]
            return
        # Warp would pack the arguments at each launch, which takes longer than a small kernel.
        fields = [(f"_{i}", type(value)) for i, value in enumerate(values[: len(kinds)])]
        packed = type("Arguments", (ctypes.Structure,), {"_fields_": fields})
        given = [packed(*values[i : i + len(kinds)]) for i in range(0, len(values), len(kinds))]
        hook = recorded.hooks.backward if adjoint else recorded.hooks.forward
        arguments = [ctypes.byref(part) for part in (bounds, *given)]
        self.run = lambda stream: hook(*arguments)
        offsets = [getattr(packed, name).offset for name, _ in fields]
        self.slots = [_slot(kind, part, at) for part in given for kind, at in zip(kinds, offsets, strict=True)]
        self.kept = recorded  # and with it the module

    def __call__(self, values: Sequence[Any], stream: Any) -> None:
        for (width, dtype, address, number), value in zip(self.slots, values, strict=True):
            if not width:
                number.value = value or 0
            elif value is None:
                address.value = number.value = 0
            else:
                number.value = _length(value, width, dtype)
                address.value = value.data_ptr()
        self.run(stream)


def _length(value: Tensor, width: int, dtype: torch.dtype) -> int:
    """Number of entries of an array of vectors of a width.

    Raises:
        ValueError: A kernel would read other numbers than those of the tensor.
    """
    if value.dtype is not dtype or not value.is_contiguous():
        raise ValueError(f"a kernel needs a contiguous tensor of {dtype}; got {value.dtype}, strides {value.stride()}")
    length = value.numel() // width
    if length > MOST_ENTRIES:
        raise ValueError(
            f"a tensor of shape {tuple(value.shape)} has {length} entries, and a kernel counts to {MOST_ENTRIES}: "
            "pass fewer samples at a time"
        )
    return length


_CPU = torch.device("cpu")

# Sizes of batches come and go: commands that are made for them are kept up to this many.
_MOST_COMMANDS = 1000


def launch(kernel: Any, dim: tuple[int, ...], given: Sequence[Any], adjoints: Sequence[Any] = ()) -> None:
    """Run a kernel, or its adjoint, on the tensors' device and torch's stream.

    Args:
        kernel: Of :func:`kernels`.
        dim: Number of samples; and of what each has, where a sample may have several threads, whose number is then the
            kernel's last argument. Each takes the first of what is left, then every so many-th. On a CPU there is one.
        given: What it takes but for that, a tensor first; tensors are contiguous and of the types that it declares.
        adjoints: Gradients of each, where the adjoint is wanted; None for what has none.

    Raises:
        ValueError: A tensor is not contiguous, of another type, or has more entries than 32 bits count.
    """
    if 0 in dim:
        return
    device = given[0].device
    if len(dim) == 2:
        threads = 1 if device == _CPU else dim[1]
        dim, given, adjoints = (dim[0] * threads,), [*given, threads], [*adjoints, None] if adjoints else ()
        if dim[0] > MOST_ENTRIES:
            raise ValueError(f"{dim[0]} threads are more than a kernel counts, {MOST_ENTRIES}: pass fewer samples")
    key, known = (kernel, dim, device, bool(adjoints)), _COMMANDS.known
    command = known.get(key)
    if command is None:
        if len(known) == _MOST_COMMANDS:
            known.clear()
        command = known[key] = _Command(kernel, dim, device, bool(adjoints))
    command([*given, *adjoints] if adjoints else given, _stream(device))


def _stream(device: torch.device) -> Any:
    """Torch's own, of a GPU."""
    if device == _CPU:  # faster than comparing its type
        return None
    import warp as wp

    return wp.stream_from_torch(torch.cuda.current_stream(device))


def zeros(like: Tensor, *shapes: tuple[int, ...]) -> tuple[Tensor, ...]:
    """Tensors of zeros, one after the other in memory."""
    sizes = [math.prod(shape) for shape in shapes]
    parts = like.new_zeros(sum(sizes)).split(sizes)
    return tuple(part.view(shape) for part, shape in zip(parts, shapes, strict=True))
