"""Work in threads: all of it, as many at a time as allowed, and an end when one fails."""

import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
import pytest
from threadpoolctl import threadpool_info, threadpool_limits

from torch_modal.modes import eigen, extract, parallel
from torch_modal.modes.extract import extract_modes
from torch_modal.modes.parallel import StoppedError, one_blas_thread, run_all


@pytest.fixture(params=[1, 3])
def cpus(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> int:
    monkeypatch.setattr(parallel, "n_cpus", lambda: request.param)
    return request.param


def test_results_are_in_order(cpus: int) -> None:
    def work(index: int) -> int:
        time.sleep(0.01 * (5 - index))
        return index * index

    assert run_all(work, 5, threading.Event(), 5) == [0, 1, 4, 9, 16]
    assert run_all(work, 0, threading.Event(), 5) == []


@pytest.mark.parametrize("bound", [0, 2, 9])
def test_as_many_at_once_as_processors(cpus: int, bound: int) -> None:
    running, most, lock = 0, 0, threading.Lock()
    allowed = min(cpus, max(bound, 1))
    together = threading.Barrier(allowed)

    def work(index: int) -> None:
        nonlocal running, most
        with lock:
            running += 1
            most = max(most, running)
        together.wait(timeout=30)  # passes only if so many are in here
        with lock:
            running -= 1

    run_all(work, 2 * cpus, threading.Event(), bound)
    assert most == allowed


def test_ctrl_c_while_work_is_handed_out_ends_what_has_begun(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(parallel, "n_cpus", lambda: 2)
    stop, begun, told = threading.Event(), threading.Event(), []

    def work(index: int) -> None:
        begun.set()
        told.append(stop.wait(30))

    class Interrupted(ThreadPoolExecutor):
        def submit(self, *given: Any) -> Any:
            if not begun.is_set():
                future = super().submit(*given)
                assert begun.wait(30)
                return future
            raise KeyboardInterrupt

    monkeypatch.setattr(parallel, "ThreadPoolExecutor", Interrupted)
    with pytest.raises(KeyboardInterrupt):
        run_all(work, 2, stop, 2)
    assert told == [True]


def test_the_first_error_ends_the_others(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(parallel, "n_cpus", lambda: 2)
    stop, begun, ended = threading.Event(), [], []

    def work(index: int) -> None:
        begun.append(index)
        if index == 0:
            raise ValueError("no luck")
        if not stop.wait(30):
            return
        ended.append(index)
        raise StoppedError

    with pytest.raises(ValueError, match="no luck"):
        run_all(work, 6, stop, 6)
    # The second ran beside the first and saw the flag; at most one more was begun before the rest was called off.
    assert sorted(begun) in ([0, 1], [0, 1, 2])
    assert sorted(ended) == [index for index in sorted(begun) if index > 0]
    assert not any(thread.name.startswith("torch_modal") for thread in threading.enumerate())


def blas_threads() -> set[int]:
    return {library["num_threads"] for library in threadpool_info() if library["user_api"] == "blas"}


@pytest.fixture
def two_threads() -> Iterator[None]:
    """BLAS with two threads, whatever the machine and its variables say."""
    with threadpool_limits(2, user_api="blas"):
        assert blas_threads() == {2}
        yield


@pytest.mark.usefixtures("two_threads")
def test_one_blas_thread_until_the_last_leaves() -> None:
    inside, go = threading.Barrier(2), threading.Event()

    def stay() -> None:
        with one_blas_thread():
            inside.wait(timeout=30)
            go.wait(timeout=30)

    thread = threading.Thread(target=stay)
    with pytest.raises(ValueError, match="on the way"), one_blas_thread():
        thread.start()
        inside.wait(timeout=30)
        raise ValueError("on the way")
    assert blas_threads() == {1}
    go.set()
    thread.join(timeout=30)
    assert blas_threads() == {2}


@pytest.mark.usefixtures("two_threads")
def test_modes_are_computed_with_one(capsule: tuple[np.ndarray, np.ndarray], monkeypatch: pytest.MonkeyPatch) -> None:
    """With several, that wait for each other in a loop, a basis takes ten times as long."""
    seen = []

    def lowest_modes(*args: Any) -> Any:
        seen.append(blas_threads())
        return eigen.lowest_modes(*args)

    monkeypatch.setattr(extract, "lowest_modes", lowest_modes)
    extract_modes(*capsule, 5, mesher="lattice", cache=False)
    assert seen == [{1}]
    assert blas_threads() == {2}
