"""Executors of the tasks of a folder tree: processes of this machine, or a Dask cluster.

Any other executor of `concurrent.futures` works too, as tasks share nothing.
"""

import os
import threading
from collections.abc import Iterator
from concurrent.futures import Executor, ThreadPoolExecutor
from contextlib import contextmanager
from typing import Any, NamedTuple

from torch_modal.extras import require
from torch_modal.precompute.parallel import n_cpus

RETRIES = 2
"""Retries of a task that raised an error: a machine may lack the package or the folders."""


class Engine(NamedTuple):
    """Where tasks run."""

    executor: Executor
    stop: Any = None
    """An event of `threading` or `distributed` that ends the tasks."""
    name: str = ""


@contextmanager
def local_processes(workers: int | None = None) -> Iterator[Engine]:
    """Threads that each wait for the process of one set.

    Args:
        workers: Sets at a time; by default one for each processor, shared with the neighbours of the same ``torchrun``.
    """
    workers = workers or max(1, n_cpus() // int(os.environ.get("LOCAL_WORLD_SIZE") or 1))
    stop = threading.Event()
    executor = ThreadPoolExecutor(workers, thread_name_prefix="torch_modal-set")
    try:
        yield Engine(executor, stop)
    finally:
        stop.set()
        executor.shutdown(cancel_futures=True)


@contextmanager
def dask_cluster(address: str) -> Iterator[Engine]:
    """The workers of a running Dask cluster, a set for each of their threads at a time.

    The scheduler gives the sets of a dead worker to others, and gives up a set that killed several workers
    (``distributed.scheduler.allowed-failures``). A running task cannot be cancelled from outside, so the tasks check
    an event on the scheduler.

    Args:
        address: Of the scheduler, ``tcp://HOST:8786`` for example.

    Raises:
        MissingPackageError: dask.distributed is not installed.
        OSError: There is no scheduler.
    """
    distributed = require("distributed", "dask", "a Dask cluster")
    with distributed.Client(address, set_as_default=False) as client:
        n_threads = sum(client.nthreads().values())
        there = f"{n_threads} sets at a time" if n_threads else "which has no workers yet: sets wait for one"
        executor = client.get_executor(pure=False, retries=RETRIES)
        yield Engine(executor, distributed.Event(client=client), f"Dask cluster at {address}, {there}")
