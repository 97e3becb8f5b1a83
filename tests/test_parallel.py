"""Work in threads: all of it, as many at a time as allowed, and an end when one fails."""

import threading
import time

import pytest

from torch_modal.precompute import parallel
from torch_modal.precompute.parallel import Budget, StoppedError, n_cpus, run_all


@pytest.fixture(params=[1, 3])
def cpus(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> int:
    monkeypatch.setattr(parallel, "n_cpus", lambda: request.param)
    return request.param


def test_results_are_in_order(cpus: int) -> None:
    def work(index: int) -> int:
        time.sleep(0.01 * (5 - index))
        return index * index

    assert run_all(work, 5, threading.Event()) == [0, 1, 4, 9, 16]
    assert run_all(work, 0, threading.Event()) == []


def test_as_many_at_once_as_processors(cpus: int) -> None:
    running, most, lock = 0, 0, threading.Lock()
    together = threading.Barrier(cpus)

    def work(index: int) -> None:
        nonlocal running, most
        with lock:
            running += 1
            most = max(most, running)
        together.wait(timeout=30)  # passes only if so many are in here
        with lock:
            running -= 1

    run_all(work, 2 * cpus, threading.Event())
    assert most == cpus


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
        run_all(work, 6, stop)
    # The second ran beside the first and saw the flag; at most one more was begun before the rest was called off.
    assert sorted(begun) in ([0, 1], [0, 1, 2])
    assert sorted(ended) == [index for index in sorted(begun) if index > 0]
    assert not any(thread.name.startswith("torch_modal") for thread in threading.enumerate())


def test_a_budget_is_shared() -> None:
    budget, used, most, lock = Budget(10), 0, 0, threading.Lock()

    def work(amount: int) -> None:
        nonlocal used, most
        with budget.part(amount):
            with lock:
                used += min(amount, 10)
                most = max(most, used)
            time.sleep(0.02)
            with lock:
                used -= min(amount, 10)

    threads = [threading.Thread(target=work, args=(amount,)) for amount in (4, 4, 4, 100, 3, 3, 3)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(timeout=30)
    assert used == 0
    assert 8 <= most <= 10


def test_number_of_processors() -> None:
    assert n_cpus() >= 1
