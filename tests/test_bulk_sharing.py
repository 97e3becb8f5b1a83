"""Several processes share the sets by a counter in a TCPStore."""

import json
import threading
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
import torch.distributed as dist

from torch_modal.bulk import sharing
from torch_modal.bulk.sharing import Alone, Counts, Plan, Together, sharing_by_environment

PLAN = Plan({"a": "a", "b": "b/b"}, {"c": "holds one mesh only"})


@pytest.fixture
def server() -> dist.TCPStore:
    """A store like the one that torchrun's first agent hosts."""
    return dist.TCPStore("127.0.0.1", 0, is_master=True, wait_for_workers=False)


def group(server: dist.TCPStore, state: Path, n: int = 2, parameters: dict | None = None) -> list[Together]:
    """Processes that have agreed on the plan, each with its own connection."""
    members = [
        Together(dist.TCPStore("127.0.0.1", server.port, is_master=False, wait_for_workers=False), rank, n)
        for rank in range(n)
    ]
    with ThreadPoolExecutor(n) as pool:
        plans = list(pool.map(lambda one: one.agree(state, parameters or {"n_modes": 30}, lambda: PLAN), members))
    assert plans == [PLAN] * n
    return members


def test_every_set_is_taken_once(server: dist.TCPStore, tmp_path: Path) -> None:
    members = group(server, tmp_path, 4)
    with ThreadPoolExecutor(4) as pool:
        taken = list(pool.map(lambda one: [one.take() for _ in range(250)], members))
    assert sorted(number for numbers in taken for number in numbers) == list(range(1000))


def test_counts_are_those_of_all(server: dist.TCPStore, tmp_path: Path) -> None:
    first, second = group(server, tmp_path)
    alone = Alone()
    for one in (first, alone):
        one.settle(skipped=True, done=True)
        one.settle(skipped=False, done=False)
    assert first.counts() == second.counts() == alone.counts() == Counts(2, 1, 1)
    second.settle(skipped=False, done=True)
    assert first.counts() == Counts(3, 1, 1)
    assert (alone.take(), alone.take()) == (0, 1)


def test_a_new_group_in_the_same_store_counts_anew(server: dist.TCPStore, tmp_path: Path) -> None:
    """torchrun restarts processes and keeps the store."""
    old = group(server, tmp_path)
    assert [one.take() for one in old] == [0, 1]
    old[0].settle(skipped=False, done=True)
    new = Together(server, 0, 2)
    new.agree(tmp_path, {"n_modes": 30}, lambda: PLAN)
    assert new.take() == 0 and new.counts() == Counts(0, 0, 0)


def test_all_finish_together_and_one_reports(server: dist.TCPStore, tmp_path: Path) -> None:
    members = group(server, tmp_path, 3)
    reported: list[tuple[int, Counts]] = []
    ended = []

    def finish(one: Together) -> None:
        counts = one.finish(lambda counts: reported.append((one.rank, counts)))
        ended.append((one.rank, counts))

    threads = [threading.Thread(target=finish, args=(one,)) for one in members]
    for thread in threads[:2]:
        thread.start()
    threads[0].join(0.5)
    assert not reported and not ended, "the third is still at work"
    members[2].settle(skipped=False, done=False)
    threads[2].start()
    for thread in threads:
        thread.join(20)
    assert reported == [(0, Counts(1, 0, 1))]
    assert sorted(ended) == [(rank, Counts(1, 0, 1)) for rank in range(3)]


def test_nobody_waits_for_the_dead(server: dist.TCPStore, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sharing, "SILENCE", 0.6)
    monkeypatch.setattr(sharing, "BEAT", 0.1)
    members = group(server, tmp_path, 3)
    slow = members[1]
    stop = threading.Event()

    def work() -> None:
        while not stop.wait(0.05):
            slow.stay()

    reported = []
    worker = threading.Thread(target=work)
    worker.start()
    finishing = threading.Thread(target=lambda: members[2].finish(lambda counts: reported.append(2)))
    finishing.start()  # rank 0 is dead, rank 1 is at work for longer than the silence that is allowed
    finishing.join(1.5)
    assert finishing.is_alive() and not reported
    stop.set()
    worker.join()
    slow.finish(lambda counts: reported.append(1))
    finishing.join(20)
    assert reported == [1]


def test_other_options_are_refused(server: dist.TCPStore, tmp_path: Path) -> None:
    first, second = (Together(server, rank, 2) for rank in (0, 1))
    first.agree(tmp_path, {"n_modes": 30}, lambda: PLAN)
    with pytest.raises(ValueError, match=r"rank 1\) works with {'n_modes': 40}, rank 0 with {'n_modes': 30}"):
        second.agree(tmp_path, {"n_modes": 40}, lambda: PLAN)


def test_another_output_folder_is_refused(
    server: dist.TCPStore, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A folder of the same name on a machine that does not share its files; with an older plan in it."""
    monkeypatch.setattr(sharing, "SHARED_FOLDER_WAIT", 0.5)
    first, second = (Together(server, rank, 2) for rank in (0, 1))
    for name in ("here", "there"):
        (tmp_path / name / ".precompute").mkdir(parents=True)
    first.agree(tmp_path / "there" / ".precompute", {}, lambda: PLAN)
    first.agree(tmp_path / "here" / ".precompute", {}, lambda: PLAN)
    with pytest.raises(ValueError, match="there is not the folder that rank 0 writes to"):
        second.agree(tmp_path / "there" / ".precompute", {}, lambda: PLAN)


def test_lost_store_and_lost_parent_are_said(
    server: dist.TCPStore, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Gone:
        def add(self, *_: object) -> int:
            raise dist.DistNetworkError("Broken pipe\nframe #0: c10::Error")

    with pytest.raises(ConnectionError, match=r"does not answer \(Broken pipe\); .* Start the same command again"):
        Together(Gone(), 1, 2).take()
    monkeypatch.setenv("TORCHELASTIC_RUN_ID", "x")
    one = Together(server, 1, 2)
    one.stay()
    monkeypatch.setattr(sharing.os, "getppid", lambda: 1)
    with pytest.raises(ChildProcessError, match="torchrun, which started this process, has ended"):
        one.stay()


def test_environment_decides(server: dist.TCPStore, monkeypatch: pytest.MonkeyPatch) -> None:
    values = {"MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(server.port), "RANK": "1", "WORLD_SIZE": "2"}
    for name in values:
        monkeypatch.delenv(name, raising=False)
    assert isinstance(sharing_by_environment(), Alone)
    for name, value in values.items():
        monkeypatch.setenv(name, value)
    monkeypatch.setenv("WORLD_SIZE", "1")
    assert isinstance(sharing_by_environment(), Alone)
    monkeypatch.setenv("WORLD_SIZE", "2")
    found = sharing_by_environment()
    assert isinstance(found, Together) and (found.rank, found.n_processes) == (1, 2)
    # Where torchrun hosts the store, rank 0 does not try to host another one at the same port.
    monkeypatch.setenv("RANK", "0")
    monkeypatch.setenv("TORCHELASTIC_USE_AGENT_STORE", "True")
    assert sharing_by_environment().rank == 0


def test_plan_is_readable(server: dist.TCPStore, tmp_path: Path) -> None:
    group(server, tmp_path)
    content = json.loads((tmp_path / "plan.json").read_text())
    assert content["places"] == PLAN.places and list(content["places"]) == list(PLAN.places)
    assert content["left_out"] == PLAN.left_out
