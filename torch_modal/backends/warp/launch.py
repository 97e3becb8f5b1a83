"""Loading of Warp's kernels, their constants, and their launch on torch tensors."""

import ctypes
import importlib
import inspect
import os
import sys
import tempfile
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import cache
from typing import Any, Literal

import torch
from torch import Tensor

from torch_modal.energy.term import Mesh
from torch_modal.progress import ProgressReport

Module = Literal[
    "shell",
    "shell_adjoint",
    "modal",
    "quasi_newton",
    "steps",
    "rotations",
    "rotations_adjoint",
    "procrustes",
    "crossings",
]
PACKAGE = "torch_modal.backends.warp.kernels"
IN_BETWEENS: tuple[Module, ...] = ("procrustes", "rotations", "shell", "modal", "quasi_newton", "steps")
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
        struct: The name of the struct there.
        values: Its fields: tensors of int32 or float64 on the CPU, and numbers.
    """

    def __init__(self, module: str, struct: str, **values: Tensor | int) -> None:
        self.module, self.struct, self.values = module, struct, values
        self._made: dict[torch.device, Any] = {}

    def on(self, device: torch.device) -> Any:
        """The struct on a device."""
        if device not in self._made:
            import warp as wp

            struct = getattr(importlib.import_module(f"{PACKAGE}.{self.module}"), self.struct)
            made = struct()
            for name, value in self.values.items():
                if isinstance(value, Tensor):
                    entry = struct.vars[name].type.dtype
                    setattr(made, name, wp.array(value.numpy(), dtype=entry, device=_device(device)))
                else:
                    setattr(made, name, value)
            self._made[device] = made
        return self._made[device]

    def __getstate__(self) -> dict[str, Any]:
        return self.__dict__ | {"_made": {}}


def records(mesh: Mesh) -> Tensor:
    """Vertices of each edge and of the tips of its hinge, -1 where it has none. *Shape:* ``(E, 4)``."""
    record = torch.cat([mesh.edges, torch.full_like(mesh.edges, -1)], 1)
    record[torch.tensor(mesh.connectivity.counts == 2)] = mesh.hinges
    return record


@cache
def _device(device: torch.device) -> Any:
    import warp as wp

    return wp.device_from_torch(device)


@cache
def _entries(kernel: Any) -> list[tuple[int, torch.dtype] | None]:
    """Numbers per entry, and their type, of each argument that is an array; None for others."""
    import warp as wp

    entries = [getattr(one, "dtype", None) for one in inspect.get_annotations(kernel.func).values()]
    numbers = [getattr(entry, "_wp_scalar_type_", entry) for entry in entries]
    pairs = zip(entries, numbers, strict=True)
    return [None if e is None else (getattr(e, "_length_", 1), wp.dtype_to_torch(own)) for e, own in pairs]


def launch(
    kernel: Any,
    dim: tuple[int, ...],
    given: Sequence[Any],
    adjoints: Sequence[Any] = (),
) -> None:
    """Run a kernel, or its adjoint, on the tensors' device and torch's stream.

    Args:
        kernel: Of :func:`kernels`.
        dim: Number of samples; and of what each has, where a sample may have several threads, whose number is then the
            kernel's last argument. Each takes the first of what is left, then every so many-th. On a CPU there is one.
        given: Its arguments but for that: :class:`Constants`, contiguous tensors, None for no array, and integers.
        adjoints: Gradients of each, where the adjoint is wanted; None for what has none.

    Raises:
        RuntimeError: A tensor is not contiguous, or of another type than the kernel's.
        ValueError: A tensor has more entries, or there are more threads, than 32 bits count.
    """
    if 0 in dim:
        return
    device = next(x.device for x in given if isinstance(x, Tensor))
    n_threads = dim[0]
    if len(dim) == 2:
        given = [*given, 1 if device.type == "cpu" else dim[1]]
        n_threads *= given[-1]
    if n_threads > MOST_ENTRIES:
        raise ValueError(f"{n_threads} threads are more than a kernel counts, {MOST_ENTRIES}: pass fewer samples")
    key = kernel, device, len(adjoints) > 0
    command = _COMMANDS.known.get(key)
    if command is None:
        command = _COMMANDS.known[key] = _Command(*key, given)
    command(n_threads, given, adjoints)


class _Command:
    """A launch that Warp has recorded, repeated with other arguments in a fraction of the time of a new one.

    Tensors are written into its descriptions of arrays, which do not hold them. On a CPU, they are those in the struct
    that the compiled function is called with.
    """

    def __init__(self, kernel: Any, device: torch.device, back: bool, given: Sequence[Any]) -> None:
        import warp as wp

        self.device, self.n_threads, entries, own = device, 1, _entries(kernel), _device(device)
        described: Any = type(wp.from_torch(torch.zeros(1), return_ctype=True))
        given = [x.on(device) if isinstance(x, Constants) else x for x in given]

        def nothing() -> list[Any]:
            pairs = zip(entries, given, strict=True)
            return [described(0, 0, 1, (0,), (e[0] * e[1].itemsize,)) if e else x for e, x in pairs]

        adjoints = nothing() if back else []
        self.recorded = wp.launch(
            kernel, 1, inputs=nothing(), adj_inputs=adjoints, device=own, adjoint=back, record_cmd=True
        )
        n = len(entries)
        both = [part for part in (self.recorded.params[1 : 1 + n], self.recorded.params[1 + n :]) if part]
        self.structs = [_struct(part) for part in both]
        self.on_cpu, self.called = device.type == "cpu", [ctypes.byref(struct) for struct in self.structs]
        self.function = self.recorded.hooks.backward if back else self.recorded.hooks.forward
        self.last: dict[int, Any] = {i: None for i, entry in enumerate(entries) if entry is None}
        self.arrays: list[list[tuple[Any, ...]]] = []
        for struct, part in zip(self.structs, both, strict=True):
            own = [getattr(struct, name) for name, _ in struct._fields_] if self.on_cpu else part
            self.arrays.append([(i, own[i], own[i].shape, *entry) for i, entry in enumerate(entries) if entry])

    def __call__(self, n_threads: int, given: Sequence[Any], adjoints: Sequence[Any]) -> None:
        for i, before in self.last.items():
            x = given[i]
            if x is before:
                continue
            self.last[i] = x
            if isinstance(x, Constants) or not self.on_cpu:
                self.recorded.set_param_at_index(i, x.on(self.device) if isinstance(x, Constants) else x)
                x = self.recorded.params[1 + i]
            if self.on_cpu:
                setattr(self.structs[0], f"a{i}", x)
        for arrays, tensors in zip(self.arrays, (given, adjoints), strict=False):
            for i, array, shape, width, dtype in arrays:
                x = tensors[i] if i < len(tensors) else None  # not all have an adjoint
                if x is None:
                    array.data = shape[0] = 0
                    continue
                if x.dtype is not dtype or not x.is_contiguous():
                    raise RuntimeError(
                        f"a kernel needs a contiguous tensor of {dtype}; got {x.dtype}, strides {x.stride()}"
                    )
                shape[0] = length = x.numel() // width
                array.data = x.data_ptr()
                if length > MOST_ENTRIES:
                    raise ValueError(
                        f"a tensor of shape {tuple(x.shape)} has {length} entries, and a kernel counts to "
                        f"{MOST_ENTRIES}: pass fewer samples at a time"
                    )
        if n_threads != self.n_threads:
            self.recorded.set_dim(n_threads)
            self.n_threads = n_threads
        if self.on_cpu:
            self.function(ctypes.byref(self.recorded.bounds), *self.called)
        else:
            import warp as wp

            self.recorded.launch(wp.stream_from_torch(torch.cuda.current_stream(self.device)))


def _struct(arguments: Sequence[Any]) -> Any:
    """The arguments of a function that Warp has compiled for a CPU, as it takes them."""
    fields = [(f"a{i}", type(x)) for i, x in enumerate(arguments)]
    return type("Arguments", (ctypes.Structure,), {"_fields_": fields})(*arguments)


class _Commands(threading.local):
    """The commands of a thread."""

    def __init__(self) -> None:
        self.known: dict[tuple[Any, torch.device, bool], _Command] = {}


_COMMANDS = _Commands()
