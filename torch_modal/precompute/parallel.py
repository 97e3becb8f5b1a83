"""Several key-frames at once, in threads: the mesher has processes of its own, and SuperLU and BLAS free the GIL."""

import os
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor, as_completed
from contextlib import contextmanager
from typing import Any, TypeVar

import numpy as np
from scipy.spatial import cKDTree
from threadpoolctl import OpenBLASController, ThreadpoolController

from torch_modal.arrays import FloatArray, IntArray

Result = TypeVar("Result")

MANY = 500
"""Points from which on a search of a tree is worth threads."""


class StoppedError(Exception):
    """What a thread ends with when another has failed, or on Ctrl-C. No caller of the package ever meets it."""


def n_cpus() -> int:
    """Processors that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def run_all(
    work: Callable[[int], Result], n: int, stop: threading.Event, meanwhile: Callable[[], object] | None = None
) -> list[Result]:
    """The results of ``work(0)`` to ``work(n - 1)``, as many at a time as there are processors.

    The first error ends everything: ``stop`` is set, what has not begun is not begun, and the error is raised once the
    running calls have returned. So it is with Ctrl-C, which only the calling thread is told of. BLAS has one thread in
    each of them.

    Args:
        work: Looks at ``stop`` from time to time if it takes long, and then raises `StoppedError`.
        n: How many.
        stop: Set when the results are no longer wanted.
        meanwhile: What the first processor does that has nothing else to do while others are at work; left out where
            there is but one, or one result.
    """

    def alone(index: int) -> Result:
        with one_blas_thread():
            return work(index)

    n_threads = min(n, n_cpus())
    if n_threads < 2:
        return [alone(index) for index in range(n)]
    with one_blas_thread(), ThreadPoolExecutor(n_threads, thread_name_prefix="torch_modal") as pool:
        futures: list[Future[Any]] = []
        try:
            # Ctrl-C may come before all are told: the first are at work by then.
            for index in range(n):
                futures.append(pool.submit(alone, index))
            if meanwhile is not None:
                futures.append(pool.submit(meanwhile))
            for future in as_completed(futures):
                future.result()
        except BaseException:
            stop.set()
            for future in futures:
                future.cancel()
            raise
    return [future.result() for future in futures[:n]]


class _Inside:
    """How many calls are inside `one_blas_thread` now, and what is undone when the last one leaves."""

    lock = threading.Lock()
    count = 0
    limits: Any = None


@contextmanager
def one_blas_thread() -> Iterator[None]:
    """Inside, BLAS has one thread; a decorator too.

    The products here are small, and BLAS threads that wait for each other in a loop cost ten times the work, the more
    so where several key-frames are solved at once. With most builds of BLAS the number belongs to the process, so the
    last that leaves puts it back; with some, to each thread, so every thread comes in.
    """
    with _Inside.lock:
        limits = ThreadpoolController().select(user_api="blas").limit(limits=1)
        if _Inside.count == 0:
            _Inside.limits = limits
        _Inside.count += 1
    try:
        yield
    finally:
        with _Inside.lock:
            _Inside.count -= 1
            if _Inside.count == 0:
                # Later versions of threadpoolctl obey the thread alone that came first, unless it is told off.
                getattr(OpenBLASController, "clear_controlling_thread", lambda **_: None)(force=True)
                _Inside.limits.__exit__(None, None, None)


def closest_in(tree: cKDTree, points: FloatArray, k: int = 1, within: float = np.inf) -> tuple[FloatArray, IntArray]:
    """Distances and indices of what is nearest in a tree, by all processors where there are many points.

    *Shape:* ``(n, 3) -> (n,), (n,)``, or ``(n, k), (n, k)``. What is not within the distance has the index ``tree.n``.
    """
    n_threads = n_cpus() if len(points) >= MANY else 1
    distance, index = tree.query(points, k=k, distance_upper_bound=within, workers=n_threads)
    return distance, index


class Budget:
    """A quantity, of memory say, that threads share: they wait for their part of it.

    Args:
        total: How much there is. Who wants more than that gets all of it, alone.
    """

    def __init__(self, total: int) -> None:
        self._total = self._left = total
        self._changed = threading.Condition()

    @contextmanager
    def part(self, amount: int) -> Iterator[None]:
        """Hold some of it."""
        amount = min(amount, self._total)
        with self._changed:
            self._changed.wait_for(lambda: self._left >= amount)
            self._left -= amount
        try:
            yield
        finally:
            with self._changed:
                self._left += amount
                self._changed.notify_all()
