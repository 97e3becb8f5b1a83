"""Loading of Warp's kernels, and their launch on torch tensors, by what Warp documents."""

import importlib
import inspect
import os
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import cache
from types import ModuleType
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from torch_modal.elastic.term import Formulas
from torch_modal.progress import ProgressReport

if TYPE_CHECKING:
    import warp as wp

PACKAGE = "torch_modal.elastic.kernels"
MOST_ENTRIES = 2**31 - 1
"""Kernels index with 32 bits: no array of theirs, and no launch, may be longer."""
_LOADING = threading.RLock()


@cache
def kernels(name: str) -> ModuleType:
    """A module of the kernels. The first launch on a machine's kind of device compiles it, and Warp keeps it."""
    return importlib.import_module(f"{PACKAGE}.{name}")


@cache
def of_elements(file: str, name: str, *formulas: Formulas | None) -> Any:
    """A kernel, or several, that a function of a file makes from the formulas of one or two terms."""
    with _LOADING:
        return getattr(kernels(file), name)(*formulas)


@cache
def _adjoint(kernel: "wp.Kernel") -> "wp.Kernel":
    """A kernel once more, with the adjoint that Warp generates, in another module."""
    import warp as wp

    return wp.kernel(kernel.func, module=wp.get_module(f"{kernel.module.name}_adjoint"))


def load_kernels(make: Callable[[], None]) -> None:
    """Load the kernels that a function makes, for the CPU."""
    with _LOADING:
        make()
        _load(PACKAGE, torch.device("cpu"))


@cache
def _load(module: "str | wp.Module", device: torch.device) -> None:
    """Compile a module and those below it, several at a time, or take them from Warp's cache."""
    import warp as wp

    with _LOADING, _quietly(), ProgressReport(1, "compiling kernels (once for this machine)", unit="module"):
        wp.load_module(module, device=str(device), recursive=True, max_workers=os.cpu_count())


@contextmanager
def _quietly() -> Iterator[None]:
    """Warp without its messages; native code writes that there is no GPU to the file descriptor, past all settings."""
    import warp as wp

    level, wp.config.log_level = wp.config.log_level, wp.LOG_ERROR
    try:
        descriptor = None if torch.cuda.is_available() else os.dup(2)
    except OSError:  # there is no standard error
        descriptor = None
    try:
        if descriptor is not None:
            with open(os.devnull, "wb") as nowhere:
                os.dup2(nowhere.fileno(), 2)
        wp.init()
    finally:
        if descriptor is not None:
            os.dup2(descriptor, 2)
            os.close(descriptor)
    try:
        yield
    finally:
        wp.config.log_level = level


@cache
def _entries(kernel: "wp.Kernel") -> list[tuple[int, torch.dtype] | None]:
    """Number and type of the numbers in an entry of each argument that is an array; None for others."""
    import warp as wp

    entries: list[tuple[int, torch.dtype] | None] = []
    for argument in inspect.get_annotations(kernel.func).values():
        if not wp.types.is_array(argument):
            entries.append(None)
        elif wp.types.type_is_struct(argument.dtype):  # structs in arrays are of float64 alone
            entries.append((wp.types.type_size_in_bytes(argument.dtype) // 8, torch.float64))
        else:
            sample = wp.to_torch(wp.empty(1, dtype=argument.dtype, device="cpu"))
            entries.append((sample.numel(), sample.dtype))
    return entries


def launch(
    kernel: "wp.Kernel", dim: tuple[int, ...], arguments: Sequence[object], adjoints: Sequence[object] = ()
) -> None:
    """Run a kernel, or its adjoint, on the tensors' device and torch's stream.

    Args:
        kernel: Of :func:`kernels`.
        dim: Number of samples; and of the elements of each, if the kernel's last argument is the number of threads of
            a sample: one on a CPU, one for each element on a GPU.
        arguments: Its other arguments: contiguous tensors, None for no array, and numbers.
        adjoints: Gradients of each for the adjoint; None where an argument has none.

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

    def __init__(self, kernel: "wp.Kernel", device: torch.device, back: bool, arguments: Sequence[object]) -> None:
        import warp as wp

        if back:
            with _LOADING:  # of the whole module, as Warp compiles no kernel for itself
                kernel, *_ = [_adjoint(one) for one in (kernel, *kernel.module.kernels.values())]
        _load(kernel.module, device)
        self.device, self.n_threads, entries = device, 1, _entries(kernel)
        values = [x if entry is None else None for entry, x in zip(entries, arguments, strict=True)]
        self.numbers = {i: x for i, (entry, x) in enumerate(zip(entries, values, strict=True)) if entry is None}
        self.recorded = wp.launch(
            kernel,
            1,
            values,
            adj_inputs=values if back else [],
            device=wp.device_from_torch(device),
            adjoint=back,
            record_cmd=True,
        )
        self.arrays: list[list[Any]] = [[], []]
        for adjoint, arrays in enumerate(self.arrays[: 1 + back]):
            for i, entry in enumerate(entries):
                if entry is not None:
                    array = wp.from_torch(torch.zeros(1), return_ctype=True)
                    array.strides[0] = entry[0] * entry[1].itemsize
                    self.recorded.set_param_at_index_from_ctype(i, array, adjoint=adjoint > 0)
                    arrays.append((i, array, array.shape, *entry))

    def __call__(self, n_threads: int, arguments: Sequence[object], adjoints: Sequence[object]) -> None:
        for i, before in self.numbers.items():
            x = arguments[i]
            if x is not before:
                self.numbers[i] = x
                self.recorded.set_param_at_index_from_ctype(i, x)
        for arrays, tensors in zip(self.arrays, (arguments, adjoints), strict=True):
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
        self.known: dict[tuple[wp.Kernel, torch.device, bool], _Command] = {}


_COMMANDS = _Commands()
