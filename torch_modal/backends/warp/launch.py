"""Loading of Warp's kernels, their constants, and their launch on torch tensors."""

import importlib
import inspect
import os
import sys
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import cache
from typing import Any, Literal

import torch
from torch import Tensor

from torch_modal.progress import ProgressReport

Module = Literal["shell", "modal", "steps", "rotations", "rotations_adjoint", "adjoints", "crossings"]
PACKAGE = "torch_modal.backends.warp.kernels"
IN_BETWEENS: tuple[Module, ...] = ("rotations", "shell", "modal", "steps")
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


def load_kernels() -> None:
    """Load those of in-betweens, so that nobody waits for it later."""
    import warp as wp

    for name in IN_BETWEENS:
        importlib.import_module(f"{PACKAGE}.{name}")
    _load(wp, PACKAGE)
    for name in IN_BETWEENS:
        kernels(name)


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


class Constants:
    """Constant arrays of kernels as one argument, a ``wp.struct`` of each device on which they run.

    The arrays on a device are copies that belong to Warp. A pointer to a module's tensor would not last: to share it
    with another process moves its memory. Copies of this object, also in other processes, make their own.

    Args:
        module: The module of the kernels.
        maker: Its function that makes the struct on a device, of these values.
        values: Tensors of int32 or float64 on the CPU, and numbers.
    """

    def __init__(self, module: str, maker: str, **values: Tensor | int) -> None:
        self.module, self.maker, self.values = module, maker, values
        self._made: dict[torch.device, Any] = {}

    def on(self, device: torch.device) -> Any:
        """The struct on a device."""
        if device not in self._made:
            maker = getattr(importlib.import_module(f"{PACKAGE}.{self.module}"), self.maker)
            self._made[device] = maker(_device(device), **self.values)
        return self._made[device]

    def __getstate__(self) -> dict[str, Any]:
        return self.__dict__ | {"_made": {}}


@cache
def _device(device: torch.device) -> Any:
    import warp as wp

    return wp.device_from_torch(device)


@cache
def _entries(kernel: Any) -> list[Any]:
    """Type of the entries of each argument; None for one that is no array."""
    return [getattr(one, "dtype", None) for one in inspect.get_annotations(kernel.func).values()]


@cache
def _shape(entry: Any) -> tuple[int, ...]:
    """Shape of an entry of an array."""
    import warp as wp

    return tuple(wp.zeros(1, dtype=entry, device="cpu").numpy().shape[1:])


def launch(
    kernel: Any,
    dim: tuple[int, ...],
    given: Sequence[Any],
    adjoints: Sequence[Any] = (),
    device: torch.device | None = None,
) -> None:
    """Run a kernel, or its adjoint, on the tensors' device and torch's stream.

    Args:
        kernel: Of :func:`kernels`.
        dim: Number of samples; and of what each has, where a sample may have several threads, whose number is then the
            kernel's last argument. Each takes the first of what is left, then every so many-th. On a CPU there is one.
        given: Its arguments but for that: :class:`Constants`, contiguous tensors or :func:`array` of them, None for no
            array, and integers.
        adjoints: Gradients of each, where the adjoint is wanted; None for what has none.
        device: That of the tensors; by default that of the first one.

    Raises:
        RuntimeError: A tensor is not contiguous, or of another type than the kernel's.
        ValueError: A tensor has more entries, or there are more threads, than 32 bits count.
    """
    import warp as wp

    if 0 in dim:
        return
    if device is None:
        device = next(x.device for x in given if isinstance(x, Tensor))
    n_threads = dim[0]
    if len(dim) == 2:
        given = [*given, 1 if device.type == "cpu" else dim[1]]
        n_threads *= given[-1]
    if n_threads > MOST_ENTRIES:
        raise ValueError(f"{n_threads} threads are more than a kernel counts, {MOST_ENTRIES}: pass fewer samples")
    given = [x.on(device) if isinstance(x, Constants) else x for x in given]
    entries = _entries(kernel)
    arguments = [array(x, entry) if isinstance(x, Tensor) else x for x, entry in zip(given, entries, strict=True)]
    back: list[Any] = []
    if adjoints:  # structs and numbers, which have no gradients, stand for themselves
        own = zip(given, [*adjoints, *[None] * (len(given) - len(adjoints))], entries, strict=True)
        back = [(array(y, entry) if isinstance(y, Tensor) else None) if entry else x for x, y, entry in own]
    stream = None if device.type == "cpu" else wp.stream_from_torch(torch.cuda.current_stream(device))
    wp.launch(kernel, n_threads, arguments, (), back, (), _device(device), stream, bool(back))


def array(x: Tensor, entry: Any) -> Any:
    """Warp's description of a tensor. It holds the tensor, and may serve several launches.

    Args:
        x: The tensor, contiguous.
        entry: Type of the entries of the array.
    """
    import warp as wp

    rows = x.view(-1, *_shape(entry))
    if rows.shape[0] > MOST_ENTRIES:
        raise ValueError(
            f"a tensor of shape {tuple(x.shape)} has {rows.shape[0]} entries, and a kernel counts to {MOST_ENTRIES}: "
            "pass fewer samples at a time"
        )
    return wp.from_torch(rows, dtype=entry, requires_grad=False, return_ctype=True)
