"""How long something takes, and on how many threads. The peers' process, which has no torch, imports it too."""

import os
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TypeVar

T = TypeVar("T")

ENOUGH_SECONDS = 1.5
REPEATS = "TORCH_MODAL_BENCHMARK_REPEATS"  # a variable of the environment, so that child processes know it
DEFAULT_REPEATS = 5


def timed(function: Callable[[], T]) -> tuple[T, float]:
    """What a call gives, and its processor seconds, the best of several calls after one that does not count.

    Processor time of all threads, not time on the clock: it hardly depends on what else the machine does.
    """
    result = function()
    best, spent = float("inf"), 0.0
    for _ in range(int(os.environ.get(REPEATS, DEFAULT_REPEATS))):
        start = time.process_time()
        function()
        seconds = time.process_time() - start
        best, spent = min(best, seconds), spent + seconds
        if spent > ENOUGH_SECONDS:
            break
    return result, best


def limit_threads(n: int = 1) -> None:
    """For the rest of this process: so many threads of torch, of BLAS and of OpenMP."""
    import torch
    from threadpoolctl import threadpool_limits

    torch.set_num_threads(n)
    threadpool_limits(n)


@contextmanager
def untimed() -> Iterator[None]:
    """Inside, `timed` calls once and gives no time."""
    before = os.environ.get(REPEATS, str(DEFAULT_REPEATS))
    os.environ[REPEATS] = "0"
    try:
        yield
    finally:
        os.environ[REPEATS] = before
