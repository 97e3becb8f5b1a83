"""Work in threads: all of it, as many at a time as allowed, and an end when one fails."""

import threading
from collections.abc import Iterator
from functools import partial
from typing import Any

import numpy as np
import pytest
import torch
from threadpoolctl import threadpool_info, threadpool_limits

from torch_modal.modes import eigen, extract
from torch_modal.modes.extract import extract_modes
from torch_modal.threads import StoppedError, one_blas_thread, run


@pytest.fixture(autouse=True)
def three_threads() -> Iterator[None]:
    before = torch.get_num_threads()
    torch.set_num_threads(3)
    yield
    torch.set_num_threads(before)


@pytest.mark.parametrize("bound", [0, 2, 9])
def test_as_many_at_once_as_allowed(bound: int) -> None:
    running, most, lock = 0, 0, threading.Lock()
    allowed = min(3, max(bound, 1))
    together = threading.Barrier(allowed)

    def work(index: int) -> int:
        nonlocal running, most
        with lock:
            running += 1
            most = max(most, running)
        together.wait(timeout=30)  # passes only if so many are in here
        with lock:
            running -= 1
        return index

    assert run([partial(work, index) for index in range(6)], bound) == [*range(6)]
    assert most == allowed


def test_the_first_error_ends_the_others() -> None:
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
        run([partial(work, index) for index in range(6)], 2, stop)
    # The second ran next to the first and saw the event; at most one more began before the rest was cancelled.
    assert sorted(begun) in ([0, 1], [0, 1, 2])
    assert sorted(ended) == [index for index in sorted(begun) if index > 0]


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
