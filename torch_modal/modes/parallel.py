"""Threads for several key-frames: the mesher runs in child processes, and SuperLU and BLAS release the GIL."""

import os
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from contextlib import contextmanager
from typing import Any, TypeVar

from threadpoolctl import OpenBLASController, ThreadpoolController

from torch_modal.threads import n_threads

Result = TypeVar("Result")


class StoppedError(Exception):
    """Raised in threads that are cancelled by another failure or Ctrl-C; never reaches the caller of the package."""


def n_cpus() -> int:
    """Number of processors available to this process, or of torch's threads if they are fewer."""
    available = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return min(available, n_threads())


def run_all(work: Callable[[int], Result], n: int, stop: threading.Event, most: int) -> list[Result]:
    """Results of ``work(0)`` to ``work(n - 1)``, computed in one thread per processor.

    On the first error or Ctrl-C, ``stop`` is set, pending calls are cancelled, and the error is raised after the
    running calls have returned; long ones check ``stop`` and raise `StoppedError`. BLAS has one thread in each call.
    The largest number of threads bounds memory; at least one is used.
    """
    alone = one_blas_thread()(work)
    most = min(n, n_cpus(), max(most, 1))
    if most < 2:  # in this thread, which Ctrl-C ends at once
        return [alone(index) for index in range(n)]
    futures: list[Future[Result]] = []
    with ThreadPoolExecutor(most, thread_name_prefix="torch_modal") as pool:
        try:
            # Inside the try block: Ctrl-C may come between submissions.
            for index in range(n):
                futures.append(pool.submit(alone, index))
            pending = set(futures)
            while pending:
                # A signal that another thread receives ends no wait of this one, which then looks for it by itself.
                done, pending = wait(pending, timeout=0.2, return_when=FIRST_COMPLETED)
                for future in done:
                    future.result()
        except BaseException:
            stop.set()
            for future in futures:
                future.cancel()
            raise
    return [future.result() for future in futures]


class _Inside:
    """Number of active `one_blas_thread` contexts, and the limits that the last one restores."""

    lock = threading.Lock()
    count = 0
    limits: Any = None


@contextmanager
def one_blas_thread() -> Iterator[None]:
    """Limit BLAS to one thread; context manager and decorator.

    The matrix products here are small, and busy-waiting BLAS threads cost ten times the work. In most BLAS builds the
    limit belongs to the process, so the last context restores it; in some it belongs to the thread, so every thread
    enters one.
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
                # Later versions of threadpoolctl accept the limit from its first thread only, unless that is cleared.
                getattr(OpenBLASController, "clear_controlling_thread", lambda **_: None)(force=True)
                _Inside.limits.__exit__(None, None, None)
