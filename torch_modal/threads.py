"""Batches on all cores: chunks of samples in Python threads, forward and backward.

Kernels take one core of a CPU and release the interpreter's lock; torch's own threads hardly help. Here one thread
computes one chunk at a time, with torch's own threads at one. The chunks do not depend on the number of threads, and so
no bit of the results does.
"""

import os
import threading
import warnings
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, wait
from contextlib import contextmanager
from functools import cache, partial
from typing import Any, TypeVar

import torch
from torch import Tensor

from torch_modal import trees
from torch_modal.autograd import current_dispatch_mode, is_eager, one_thread, within_transforms

Result = TypeVar("Result")

# Vertices of a chunk: at most, but for rounding; and at least, as each takes some milliseconds whatever its size.
MOST_VERTICES = 40_000
LEAST_VERTICES = 8_000


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


@cache
def _pool(n: int) -> ThreadPoolExecutor:
    # The number of torch's threads is set for one thread alone. Threads stay: launches of kernels are kept by thread.
    return ThreadPoolExecutor(n, "in-betweens", torch.set_num_threads, (1,))


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_pool.cache_clear)  # a child has none of its parent's threads


def n_threads() -> int:
    """Number of threads for :func:`run`, which is torch's."""
    return _HERE.n_threads or torch.get_num_threads()


@contextmanager
def alone() -> Iterator[None]:
    """One thread for torch, so that no bit depends on their number, and for :func:`run` as many as torch had."""
    before = _HERE.n_threads
    _HERE.n_threads = n_threads()
    try:
        with one_thread():
            yield
    finally:
        _HERE.n_threads = before


def run(work: Sequence[Callable[[], Result]]) -> list[Result]:
    """Results of functions, in threads, as many as torch has; each has the modes of gradients and inference of here.

    An error is raised, and Ctrl-C ends the call, once no thread computes any more. Within such a thread, and where
    torch has one, the functions run one after another.
    """
    # Transforms, forward mode and dispatch modes belong to this thread: others would not have them.
    if min(n_threads(), len(work)) < 2 or within_transforms() or current_dispatch_mode() is not None:
        with alone():
            return [compute() for compute in work]
    recording, inference = torch.is_grad_enabled(), torch.is_inference_mode_enabled()

    def within(compute: Callable[[], Result]) -> tuple[Result, dict[Any, int]]:
        _HERE.warned = {}
        with torch.inference_mode(inference), torch.set_grad_enabled(recording):  # in this order
            return compute(), _HERE.warned

    futures: list[Future[Any]] = []
    try:
        futures.extend(_pool(n_threads()).submit(within, compute) for compute in work)
        # A signal that another thread receives ends no wait of this one, which then looks for it by itself.
        while wait(futures, timeout=0.2).not_done:
            pass
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


def by_chunks(compute: Callable[[Any], Any], samples: Any, n_vertices: int, closed: bool) -> Any:
    """A function of a batch, which on a CPU is computed chunk by chunk, and so are its gradients.

    Args:
        compute: The function; its result is a tree of tensors with one entry for each sample.
        samples: The batch, a tree of tensors (:mod:`torch_modal.trees`). *Shape of each:* ``(B, ...)``.
        n_vertices: Number of vertices of a sample.
        closed: True if no other tensor has gradients. Otherwise the backward pass is torch's, on one thread.
    """
    tensors, tree = trees.leaves(samples), trees.skeleton(samples)
    if not is_eager(*tensors) or within_transforms() or current_dispatch_mode() is not None or not tensors[0].is_cpu:
        return compute(samples)
    sizes, skeletons = chunk_sizes(len(tensors[0]), n_vertices), []

    def result(chunk: Sequence[Tensor]) -> list[Tensor]:
        output = compute(trees.fill(tree, chunk))
        skeletons.append(trees.skeleton(output))
        return trees.leaves(output)

    def results(*tensors: Tensor) -> list[tuple[Sequence[Tensor], list[Tensor]]]:
        parts = list(zip(*(x.split(sizes) for x in tensors), strict=True))  # views
        return list(zip(parts, run([partial(result, chunk) for chunk in parts]), strict=True))

    with alone():
        recording = closed and torch.is_grad_enabled() and any(x.requires_grad for x in tensors)
        if len(sizes) == 1 and not recording:
            return compute(samples)
        if recording:
            output = _Chunks.apply(results, sizes, *tensors)
        else:
            output = [_join(each) for each in zip(*(outputs for _, outputs in results(*tensors)), strict=True)]
    return trees.fill(skeletons[0], output)


class _Chunks(torch.autograd.Function):
    """Each chunk has a graph of its own, from views of what is given: second derivatives go on into that."""

    @staticmethod
    def forward(ctx: Any, results: Callable[..., Any], sizes: list[int], *tensors: Tensor) -> tuple[Tensor, ...]:
        ctx.set_materialize_grads(False)
        ctx.results, ctx.sizes = torch.enable_grad()(results), sizes
        holder: Any = torch.empty(0)
        # Kept by a tensor that is saved, graphs are freed as soon as torch frees what is saved.
        holder.graphs = graphs = ctx.results(*tensors)
        ctx.save_for_backward(holder, *tensors)
        each = list(zip(*(results for _, results in graphs), strict=True))
        joined = [_join([x.detach() for x in parts]) for parts in each]
        constant = [not any(x.requires_grad for x in parts) for parts in each]
        ctx.mark_non_differentiable(*(x for x, alone in zip(joined, constant, strict=True) if alone))
        return tuple(joined)

    @staticmethod
    @alone()
    def backward(ctx: Any, *grads: Tensor | None) -> tuple[Tensor | None, ...]:
        (holder, *saved), sizes, needed = ctx.saved_tensors, ctx.sizes, ctx.needs_input_grad[2:]
        graphs, again = getattr(holder, "graphs", None), torch.is_grad_enabled()
        # Second derivatives end the graph that they go through. A hook may have replaced what is saved.
        if again or graphs is None:
            graphs = ctx.results(*saved)

        def gradients(i: int) -> Sequence[Tensor | None]:
            inputs, results = graphs[i]
            to = [x for x, need in zip(inputs, needed, strict=True) if need]
            pairs = [(y, x.split(sizes)[i]) for y, x in zip(results, grads, strict=True) if x is not None]
            pairs = [(y, x) for y, x in pairs if y.requires_grad]
            if not pairs:
                return [None] * len(to)
            outputs, slopes = zip(*pairs, strict=True)
            return torch.autograd.grad(outputs, to, slopes, retain_graph=True, create_graph=again, allow_unused=True)

        each = zip(*run([partial(gradients, i) for i in range(len(sizes))]), strict=True)
        sums = (_gradient(x.split(sizes), next(each)) if need else None for x, need in zip(saved, needed, strict=True))
        return None, None, *sums


def _gradient(tensors: Sequence[Tensor], parts: Sequence[Tensor | None]) -> Tensor | None:
    """Gradients of chunks as one; None if no chunk has one."""
    if all(own is None for own in parts):
        return None
    return _join([torch.zeros_like(x) if own is None else own for x, own in zip(tensors, parts, strict=True)])


def _join(parts: Sequence[Tensor]) -> Tensor:
    return parts[0] if len(parts) == 1 else torch.cat(list(parts))
