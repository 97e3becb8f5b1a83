"""Work on all cores: functions in Python threads, and batches as chunks of samples, forward and backward.

Kernels take one core of a CPU and release the interpreter's lock; torch's own threads hardly help. Here one thread
computes one chunk at a time, with torch's own threads at one. The chunks do not depend on the number of threads, and so
no bit of the results does.
"""

import os
import threading
import warnings
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_EXCEPTION, Future, ThreadPoolExecutor, wait
from contextlib import AbstractContextManager, contextmanager
from functools import lru_cache, partial
from typing import TypeVar

import torch
from threadpoolctl import OpenBLASController, ThreadpoolController
from torch import Tensor

from torch_modal import trees
from torch_modal.autograd import Context, current_dispatch_mode, is_eager, within_transforms

Result = TypeVar("Result")
Given = TypeVar("Given")

# Vertices of a chunk: at most, but for rounding; and at least, as each takes some milliseconds whatever its size.
MOST_VERTICES = 40_000
LEAST_VERTICES = 8_000

# Pools of threads that stay, of the numbers of threads that were set last: one for torch's, others for bounded memory.
N_POOLS = 4


class StoppedError(Exception):
    """Raised in threads that are cancelled by another failure or Ctrl-C; never reaches the caller of the package."""


class _Here(threading.local):
    n_threads = 0
    warned: dict[tuple[str, type[Warning]], int] | None = None


_HERE = _Here()


def warn(text: str, number: int, category: type[Warning]) -> None:
    """Warn, with a number for ``{}`` in the text; in a thread of :func:`run`, its caller does, of the sum over all."""
    if _HERE.warned is None:
        warnings.warn(text.format(number), category, stacklevel=3)
    else:
        _HERE.warned[text, category] = _HERE.warned.get((text, category), 0) + number


@lru_cache(N_POOLS)
def _pool(n: int) -> ThreadPoolExecutor:
    # The number of torch's threads is set for one thread alone. Threads stay: launches of kernels are kept by thread.
    return ThreadPoolExecutor(n, "torch_modal", torch.set_num_threads, (1,))


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_pool.cache_clear)  # a child has none of its parent's threads


def n_threads() -> int:
    """Number of threads for :func:`run`, which is torch's."""
    return _HERE.n_threads or torch.get_num_threads()


@contextmanager
def alone() -> Iterator[None]:
    """One thread for torch, so that no bit depends on their number, and for :func:`run` as many as torch had."""
    before, threads = _HERE.n_threads, torch.get_num_threads()
    _HERE.n_threads = before or threads
    if threads > 1:  # MKL would be slower for some time after each setting, also of the same number
        torch.set_num_threads(1)
    try:
        yield
    finally:
        _HERE.n_threads = before
        if threads > 1:
            torch.set_num_threads(threads)


class _OneBlasThread:
    """Number of active `one_blas_thread` contexts, and the limits that the last one restores."""

    lock = threading.Lock()
    count = 0
    limits: AbstractContextManager[object]


@contextmanager
def one_blas_thread() -> Iterator[None]:
    """Limit BLAS to one thread; context manager and decorator.

    The matrix products here are small, and busy-waiting BLAS threads cost ten times the work. In most BLAS builds the
    limit belongs to the process, so the last context restores it; in some it belongs to the thread, so every thread
    enters one.
    """
    state = _OneBlasThread
    with state.lock:
        limits = ThreadpoolController().select(user_api="blas").limit(limits=1)
        if state.count == 0:
            state.limits = limits
        state.count += 1
    try:
        yield
    finally:
        with state.lock:
            state.count -= 1
            if state.count == 0:
                # Later versions of threadpoolctl accept the limit from its first thread only, unless that is cleared.
                getattr(OpenBLASController, "clear_controlling_thread", lambda **_: None)(force=True)
                state.limits.__exit__(None, None, None)


def run(
    work: Sequence[Callable[[], Result]], most: int | None = None, stop: threading.Event | None = None
) -> list[Result]:
    """Results of functions, in threads, as many as torch has; each has the modes of gradients and inference of here.

    The first error is raised, and Ctrl-C ends the call, once no thread computes any more. Within such a thread, and
    where torch has one, the functions run one after another.

    Args:
        work: The functions.
        most: Largest number of threads, to bound memory; at least one is used.
        stop: Event that is set at the first error or Ctrl-C, for functions that check it and raise `StoppedError`.
    """
    n = n_threads() if most is None else min(n_threads(), max(most, 1))
    # Transforms, forward mode and dispatch modes belong to this thread: others would not have them.
    if min(n, len(work)) < 2 or within_transforms() or current_dispatch_mode() is not None:
        with alone():
            return [compute() for compute in work]
    recording, inference = torch.is_grad_enabled(), torch.is_inference_mode_enabled()

    def within(compute: Callable[[], Result]) -> tuple[Result, dict[tuple[str, type[Warning]], int]]:
        _HERE.warned = {}
        with torch.inference_mode(inference), torch.set_grad_enabled(recording):  # in this order
            return compute(), _HERE.warned

    futures: list[Future[tuple[Result, dict[tuple[str, type[Warning]], int]]]] = []
    try:
        futures.extend(_pool(n).submit(within, compute) for compute in work)
        pending = set(futures)
        while pending:
            # A signal that another thread receives ends no wait of this one, which then looks for it by itself.
            done, pending = wait(pending, timeout=0.2, return_when=FIRST_EXCEPTION)
            for future in done:
                future.result()
    except BaseException:
        if stop is not None:
            stop.set()
        raise
    finally:
        for future in futures:
            future.cancel()
        wait(futures)
    results, warned = zip(*(future.result() for future in futures), strict=True)
    for key in dict.fromkeys(key for each in warned for key in each):
        warn(key[0], sum(each.get(key, 0) for each in warned), key[1])
    return list(results)


def chunk_sizes(n: int, n_vertices: int) -> list[int]:
    """Numbers of samples of the chunks of a batch, whatever the number of threads: halves, quarters and so on.

    Args:
        n: Number of samples.
        n_vertices: Number of vertices of a sample.
    """
    parts = 2 if n * n_vertices >= 2 * LEAST_VERTICES else 1
    while parts > 1 and n * n_vertices > parts * MOST_VERTICES:
        parts *= 2
    parts = max(min(parts, n), 1)
    return [n // parts + (i < n % parts) for i in range(parts)]


def by_chunks(compute: Callable[[Given], Result], samples: Given, n_vertices: int, closed: bool) -> Result:
    """A function of a batch, which on a CPU is computed chunk by chunk, and so are its gradients.

    Args:
        compute: The function; its result is a tree of tensors with one entry for each sample.
        samples: The batch, a tree of tensors (:mod:`torch_modal.trees`). *Shape of each:* ``(B, ...)``.
        n_vertices: Number of vertices of a sample.
        closed: True if no other tensor has gradients. Otherwise the backward pass is torch's, on one thread.
    """
    tensors = trees.leaves(samples)
    if not is_eager(*tensors) or within_transforms() or current_dispatch_mode() is not None or not tensors[0].is_cpu:
        return compute(samples)
    sizes, skeletons = chunk_sizes(len(tensors[0]), n_vertices), []
    recording = closed and torch.is_grad_enabled() and any(x.requires_grad for x in tensors)
    if len(sizes) == 1 and not recording:
        with alone():
            return compute(samples)
    tree = trees.skeleton(samples)

    def result(chunk: Sequence[Tensor]) -> list[Tensor]:
        output = compute(trees.fill(tree, chunk))
        skeletons.append(trees.skeleton(output))
        return trees.leaves(output)

    def results(*tensors: Tensor) -> list[tuple[Sequence[Tensor], list[Tensor]]]:
        parts = list(zip(*(x.split(sizes) for x in tensors), strict=True))  # views
        return list(zip(parts, run([partial(result, chunk) for chunk in parts]), strict=True))

    with alone():
        if recording:
            output = _Chunks.apply(results, sizes, *tensors)
        else:
            output = [torch.cat(each) for each in zip(*(outputs for _, outputs in results(*tensors)), strict=True)]
    return trees.fill(skeletons[0], output)


class _Chunks(torch.autograd.Function):
    """Each chunk has a graph of its own, from views of what is given: second derivatives go on into that."""

    @staticmethod
    def forward(ctx: Context, results: Callable[..., object], sizes: list[int], *tensors: Tensor) -> tuple[Tensor, ...]:
        ctx.set_materialize_grads(False)
        ctx.results, ctx.sizes = torch.enable_grad()(results), sizes
        holder = torch.empty(0)
        # Kept by a tensor that is saved, graphs are freed as soon as torch frees what is saved.
        holder.graphs = graphs = ctx.results(*tensors)  # type: ignore[attr-defined]
        ctx.save_for_backward(holder, *tensors)
        each = list(zip(*(results for _, results in graphs), strict=True))
        joined = [torch.cat([x.detach() for x in parts]) for parts in each]
        constant = [not any(x.requires_grad for x in parts) for parts in each]
        ctx.mark_non_differentiable(*(x for x, alone in zip(joined, constant, strict=True) if alone))
        return tuple(joined)

    @staticmethod
    @alone()
    def backward(ctx: Context, *grads: Tensor | None) -> tuple[Tensor | None, ...]:
        (holder, *saved), sizes, needed = ctx.saved_tensors, ctx.sizes, ctx.needs_input_grad[2:]
        graphs, again = getattr(holder, "graphs", None), torch.is_grad_enabled()
        # Second derivatives end the graph that they go through. A hook may have replaced what is saved.
        if again or graphs is None:
            graphs = ctx.results(*saved)

        def gradients(i: int) -> Sequence[Tensor]:
            inputs, results = graphs[i]
            to = [x for x, need in zip(inputs, needed, strict=True) if need]
            pairs = [(y, x.split(sizes)[i]) for y, x in zip(results, grads, strict=True) if x is not None]
            pairs = [(y, x) for y, x in pairs if y.requires_grad]
            if not pairs:
                return [torch.zeros_like(x) for x in to]
            outputs, slopes = zip(*pairs, strict=True)
            options = {"retain_graph": True, "create_graph": again, "materialize_grads": True}
            return torch.autograd.grad(outputs, to, slopes, **options)

        each = zip(*run([partial(gradients, i) for i in range(len(sizes))]), strict=True)
        return None, None, *(torch.cat(next(each)) if need else None for need in needed)
