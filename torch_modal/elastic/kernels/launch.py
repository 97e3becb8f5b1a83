"""Loading of Warp's kernels, their constants, and their launch on torch tensors, by what Warp documents."""

import importlib
import inspect
import os
import sys
import tempfile
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import cache
from itertools import chain
from typing import Any, Literal, NamedTuple

import torch
from torch import Tensor

from torch_modal.elastic import bend, stretch, volume
from torch_modal.progress import ProgressReport

Module = Literal[
    "steps",
    "rotations",
    "rotations_adjoint",
    "procrustes",
    "crossings",
]
PACKAGE = "torch_modal.elastic.kernels"
IN_BETWEENS: tuple[Module, ...] = ("procrustes", "rotations", "steps")
"""The modules for in-betweens without gradients."""
NO_DRIVER = b"Warp CUDA warning: Could not find or load the NVIDIA CUDA driver"
"""What Warp says where there is no GPU, with no setting that turns it off: in every run, it looks like an error."""
MOST_ENTRIES = 2**31 - 1
"""Kernels index with 32 bits: no array of theirs, and no launch, may be longer."""
_LOADING = threading.RLock()
_MADE: dict[tuple[Any, ...], Any] = {}


@cache
def kernels(name: Module) -> Any:
    """A module of the kernels. The first launch on a machine's kind of device compiles it, and Warp keeps it."""
    return importlib.import_module(f"{PACKAGE}.{name}")


def make_once(make: Callable[..., Any], *arguments: Any) -> Any:
    """Kernels of one module that a function makes, compiled likewise, once for all threads."""
    key = make, *arguments
    if key not in _MADE:
        with _LOADING:
            if key not in _MADE:
                _MADE[key] = make(*arguments)
    return _MADE[key]


def of_elements(kind: Literal["convex", "forward", "backward", "curving"], *arguments: Any) -> Any:
    """Kernels of a module that one or two terms have, or elements of so many edge vectors."""
    return make_once(getattr(importlib.import_module(f"{PACKAGE}.elements"), kind), *arguments)


def load_kernels() -> None:
    """Load the kernels of in-betweens without gradients for the CPU, so that the first call does not wait for them."""
    with _LOADING:
        elements, *_ = (importlib.import_module(f"{PACKAGE}.{name}") for name in ("elements", *IN_BETWEENS))
        shell_functions = bend.kernel_functions(), stretch.kernel_functions()
        for functions in (*shell_functions, volume.kernel_functions()):
            elements.forward(functions)
        elements.convex(*shell_functions)
        volume.kernels()
        importlib.import_module("torch_modal.elastic.distortion").kernels()
        _load(PACKAGE, torch.device("cpu"))


@cache
def _load(module: Any, device: torch.device) -> None:
    """Compile a module and those below it, several at a time, or take them from Warp's cache."""
    import warp as wp

    with _LOADING, _quietly():
        with _without_line(NO_DRIVER):
            wp.init()
        with ProgressReport(1, "compiling kernels (once for this machine)", unit="module"):
            wp.load_module(module, device=str(device), recursive=True, max_workers=os.cpu_count())


@contextmanager
def _quietly() -> Iterator[None]:
    """Warp without its messages while it compiles, such as that ``wp.grad`` is not differentiated."""
    import warp as wp

    before, wp.config.log_level = wp.config.log_level, wp.LOG_ERROR
    try:
        yield
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
        values: Its fields: tensors of int32 or float64 on the CPU, the entries of arrays in their last dimension, and
            numbers.
    """

    def __init__(self, module: str, struct: str, **values: Tensor | int) -> None:
        self.module, self.struct, self.values = module, struct, values
        self._made: dict[torch.device, Any] = {}

    def on(self, device: torch.device) -> Any:
        """The struct on a device."""
        if device not in self._made:
            import warp as wp

            struct = getattr(importlib.import_module(f"{PACKAGE}.{self.module}"), self.struct)()
            for name, value in self.values.items():
                if isinstance(value, Tensor):
                    entry: Any = wp.dtype_from_torch(value.dtype)
                    entry = wp.types.vector(length=value.shape[1], dtype=entry) if value.dim() == 2 else entry
                    setattr(struct, name, wp.array(value.numpy(), dtype=entry, device=wp.device_from_torch(device)))
                else:
                    setattr(struct, name, value)
            return self._made.setdefault(device, struct)  # one for all threads: a struct owns its arrays
        return self._made[device]

    def __getstate__(self) -> dict[str, Any]:
        return self.__dict__ | {"_made": {}}


class Entry(NamedTuple):
    """Entries of an array that a kernel takes."""

    width: int
    """Numbers in each."""
    dtype: torch.dtype
    """Type of the numbers."""
    n_bytes: int


@cache
def _entries(kernel: Any) -> list[Entry | None]:
    """Entries of each argument that is an array; None for others."""
    import warp as wp

    entries: list[Entry | None] = []
    for argument in inspect.get_annotations(kernel.func).values():
        if not wp.types.is_array(argument):
            entries.append(None)
        elif wp.types.type_is_struct(argument.dtype):  # structs in arrays are of float64 alone
            n_bytes = wp.types.type_size_in_bytes(argument.dtype)
            entries.append(Entry(n_bytes // 8, torch.float64, n_bytes))
        else:
            sample = wp.to_torch(wp.empty(1, dtype=argument.dtype, device="cpu"))
            entries.append(Entry(sample.numel(), sample.dtype, sample.numel() * sample.element_size()))
    return entries


def launch(
    kernel: Any,
    dim: tuple[int, ...],
    arguments: Sequence[Any],
    adjoints: Sequence[Any] = (),
) -> None:
    """Run a kernel, or its adjoint, on the tensors' device and torch's stream.

    Args:
        kernel: Of :func:`kernels`.
        dim: Number of samples; and of what each has, where a sample may have several threads, whose number is then the
            kernel's last argument. Each takes the first of what is left, then every so many-th. On a CPU there is one.
        arguments: Its arguments but for that: :class:`Constants`, contiguous tensors, None for no array, and numbers.
        adjoints: Gradients of each, where the adjoint is wanted; None for what has none.

    Raises:
        RuntimeError: A tensor is not contiguous, or of another type than the kernel's.
        ValueError: A tensor has more entries, or there are more threads, than 32 bits count.
    """
    if 0 in dim:
        return
    device = next(x.device for x in arguments if isinstance(x, Tensor))
    n_threads = dim[0]
    if len(dim) == 2:
        arguments = [*arguments, 1 if device.type == "cpu" else dim[1]]
        n_threads *= arguments[-1]
    if n_threads > MOST_ENTRIES:
        raise ValueError(f"{n_threads} threads are more than a kernel counts, {MOST_ENTRIES}: pass fewer samples")
    key = kernel, device, len(adjoints) > 0
    command = _COMMANDS.known.get(key)
    if command is None:
        command = _COMMANDS.known[key] = _Command(*key, arguments)
    command(n_threads, arguments, adjoints)


class _Command:
    """A launch that Warp has recorded, repeated with other arguments in a fraction of the time of a new one.

    Its descriptions of arrays are written anew each time: they do not hold the tensors.
    """

    def __init__(self, kernel: Any, device: torch.device, back: bool, arguments: Sequence[Any]) -> None:
        import warp as wp

        _load(kernel.module, device)
        self.device, self.n_threads, entries = device, 1, _entries(kernel)
        pairs = list(zip(entries, arguments, strict=True))
        self.others = {i: x for i, (entry, x) in enumerate(pairs) if entry is None}
        self.arrays = [
            [(i, array := wp.from_torch(torch.zeros(1), return_ctype=True), array.shape, *entry[:2])
             for i, entry in enumerate(entries) if entry]
            for _ in range(1 + back)
        ]  # fmt: skip
        for i, array, *_ in chain(*self.arrays):
            entry: Any = entries[i]
            array.data, array.strides[0] = 0, entry.n_bytes
        values = [x.on(device) if isinstance(x, Constants) else x for x in arguments]
        first, *adjoint = (
            [dict((i, a) for i, a, *_ in own).get(i, x) for i, x in enumerate(values)] for own in self.arrays
        )
        own = wp.device_from_torch(device)
        self.recorded = wp.launch(
            kernel, 1, first, adj_inputs=[*chain(*adjoint)], device=own, adjoint=back, record_cmd=True
        )
        for number, arrays in enumerate(self.arrays):
            for i, array, *_ in arrays:
                self.recorded.set_param_at_index_from_ctype(i, array, adjoint=number > 0)

    def __call__(self, n_threads: int, arguments: Sequence[Any], adjoints: Sequence[Any]) -> None:
        for i, before in self.others.items():
            x = arguments[i]
            if x is before:
                continue
            self.others[i] = x
            if isinstance(x, Constants):
                self.recorded.set_param_at_index(i, x.on(self.device))
            else:
                self.recorded.set_param_at_index_from_ctype(i, x)
        for arrays, tensors in zip(self.arrays, (arguments, adjoints), strict=False):
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
        if self.device.type == "cpu":
            self.recorded.launch()
        else:
            import warp as wp

            self.recorded.launch(wp.stream_from_torch(torch.cuda.current_stream(self.device)))


class _Commands(threading.local):
    """The commands of a thread."""

    def __init__(self) -> None:
        self.known: dict[tuple[Any, torch.device, bool], _Command] = {}


_COMMANDS = _Commands()
