"""Who takes which set: a counter in this process, or one in the TCPStore that ``torchrun`` starts."""

import contextlib
import json
import os
import time
import uuid
from collections.abc import Callable, Iterator, Mapping
from datetime import timedelta
from pathlib import Path
from typing import Any, NamedTuple

from torch_modal.io.files import write_atomically

MEETING = timedelta(minutes=10)
"""How long processes wait for each other at the start."""
BEAT = 5.0
"""Seconds between two signs of life."""
SILENCE = 60.0
"""Seconds without a sign of life after which nobody waits for a process any more."""
SHARED_FOLDER_WAIT = 60.0
"""Seconds that a file may take to be seen by another machine."""


class Plan(NamedTuple):
    """What all processes must agree on."""

    places: dict[str, str]
    """Sets, in the order in which they are taken, and where their bases go."""
    left_out: dict[str, str]
    """Folders that are no sets, and why."""


class Counts(NamedTuple):
    """How far all processes together are."""

    settled: int
    """Sets that nobody needs to look at any more."""
    skipped: int
    """Those of them that an earlier run had settled."""
    not_done: int
    """Those of them without a result."""


class Alone:
    """This process takes all sets."""

    rank, n_processes = 0, 1

    def __init__(self) -> None:
        self._taken = 0
        self._counts = Counts(0, 0, 0)

    def agree(self, state: Path, parameters: Mapping[str, Any], make: Callable[[], Plan]) -> Plan:
        """The plan."""
        return make()

    def take(self) -> int:
        """Number of the next set; past the last, there are none left."""
        self._taken += 1
        return self._taken - 1

    def settle(self, *, skipped: bool, done: bool) -> None:
        """Say that a set is settled."""
        old = self._counts
        self._counts = Counts(old.settled + 1, old.skipped + skipped, old.not_done + (not done))

    def counts(self) -> Counts:
        """How far it is."""
        return self._counts

    def stay(self) -> None:
        """Give a sign of life."""

    def finish(self, report: Callable[[Counts], None]) -> Counts:
        """Call what writes the report; the counts at the end."""
        report(self._counts)
        return self._counts


class Together:
    """Several processes, on one or several machines, take sets by adding to a counter in a TCPStore.

    The store is that of ``torch.distributed``'s ``env://`` rendezvous: ``torchrun`` hosts it in its first agent, and
    otherwise the process of rank 0 does. It may outlive a group of processes, as ``torchrun`` restarts those, so every
    group counts under a mark of its own.

    Args:
        store: A connected store.
        rank: Number of this process.
        n_processes: How many there are.
    """

    def __init__(self, store: Any, rank: int, n_processes: int) -> None:
        self.rank, self.n_processes = rank, n_processes
        self._store = store
        self._mark = ""
        self._last_beat = float("-inf")
        self._parent = _parent()

    @classmethod
    def by_environment(cls) -> "Together":
        """Meet the others at MASTER_ADDR and MASTER_PORT, as RANK of WORLD_SIZE.

        Raises:
            ConnectionError: They did not meet.
        """
        import torch.distributed as dist

        if not dist.is_available():
            raise ConnectionError("this build of PyTorch has no torch.distributed, so processes cannot share the work")
        from torch.distributed.rendezvous import rendezvous

        with _as_connection_error():
            store, rank, n_processes = next(rendezvous("env://", timeout=MEETING))
        return cls(store, rank, n_processes)

    def agree(self, state: Path, parameters: Mapping[str, Any], make: Callable[[], Plan]) -> Plan:
        """The plan of rank 0, which it leaves in the output folder, where all must see it.

        Args:
            state: Folder of the output folder for our own files.
            parameters: What this process was asked for, which must be the same everywhere.
            make: Makes the plan; called by rank 0 alone.

        Raises:
            ConnectionError: The others are gone.
            ValueError: The output folder is another one here, or the parameters are.
        """
        file = state / "plan.json"
        if self.rank == 0:
            self._mark = uuid.uuid4().hex
            content = {"mark": self._mark, "parameters": dict(parameters), **make()._asdict()}
            write_atomically(file, json.dumps(content).encode())
            self._call("set", "torch_modal/mark", self._mark)
            content = json.loads(json.dumps(content))
        else:
            self._mark = self._call("get", "torch_modal/mark").decode()
            content = self._read_plan(file)
        if content["parameters"] != json.loads(json.dumps(dict(parameters))):
            raise ValueError(
                f"this process (rank {self.rank}) works with {dict(parameters)}, rank 0 with {content['parameters']}; "
                "give all machines the same command and the same version of torch_modal"
            )
        return Plan(content["places"], content["left_out"])

    def _read_plan(self, file: Path) -> dict[str, Any]:
        end = time.monotonic() + SHARED_FOLDER_WAIT
        while True:
            with contextlib.suppress(OSError, ValueError, KeyError):
                content = json.loads(file.read_bytes())
                if content["mark"] == self._mark:
                    return content
            if time.monotonic() > end:
                raise ValueError(
                    f"{file.parent.parent} is not the folder that rank 0 writes to; all machines need the same "
                    "folders, on a file system that they share"
                )
            time.sleep(0.2)

    def take(self) -> int:
        """Number of the next set; past the last, there are none left.

        Raises:
            ConnectionError: The store is gone.
        """
        return self._add("taken", 1) - 1

    def settle(self, *, skipped: bool, done: bool) -> None:
        """Say that a set is settled."""
        for name, true in (("skipped", skipped), ("not done", not done), ("settled", True)):
            if true:
                self._add(name, 1)

    def counts(self) -> Counts:
        """How far all processes are."""
        return Counts(self._add("settled", 0), self._add("skipped", 0), self._add("not done", 0))

    def stay(self) -> None:
        """Give a sign of life, and look for the one of torchrun.

        Raises:
            ConnectionError: The store is gone.
            ChildProcessError: torchrun is gone; it starts each process in a session of its own, so a signal that ends
                torchrun and all of its group does not reach this one.
        """
        if _parent() != self._parent:
            raise ChildProcessError("torchrun, which started this process, has ended; start it again to go on")
        if time.monotonic() - self._last_beat > BEAT:
            self._last_beat = time.monotonic()
            self._add(f"beat {self.rank}", 1)

    def finish(self, report: Callable[[Counts], None]) -> Counts:
        """Wait until all processes have settled their sets, or give no sign of life; then one of them reports.

        Only after that may any of them end with a bad exit status: torchrun would end its neighbours.

        Args:
            report: Writes the report; called in one process.

        Returns:
            The counts at the end.

        Raises:
            ConnectionError: The store is gone.
            ChildProcessError: torchrun is gone.
        """
        self._tell(f"finished {self.rank}")
        others = [rank for rank in range(self.n_processes) if rank != self.rank]
        gone = self._wait_for({rank: f"finished {rank}" for rank in others})
        counts = self.counts()
        writer = min({self.rank, *others} - gone)
        if writer == self.rank:
            report(counts)
            self._tell("reported")
        else:
            with contextlib.suppress(ConnectionError):  # the writer may host the store, and have left
                self._wait_for({writer: "reported"})
        return counts

    def _wait_for(self, keys: dict[int, str]) -> set[int]:
        """Wait for a key of each process; those that give no sign of life are returned."""
        waiting, gone = dict(keys), set()
        seen = dict.fromkeys(keys, (-1, time.monotonic()))
        while waiting:
            self.stay()
            for rank, key in list(waiting.items()):
                if self._call("check", [self._key(key)]):
                    del waiting[rank]
                    continue
                beat = self._add(f"beat {rank}", 0)
                if beat != seen[rank][0]:
                    seen[rank] = beat, time.monotonic()
                elif time.monotonic() - seen[rank][1] > SILENCE:
                    del waiting[rank]
                    gone.add(rank)
            time.sleep(0.1)
        return gone

    def _tell(self, key: str) -> None:
        self._call("set", self._key(key), "yes")

    def _add(self, key: str, amount: int) -> int:
        return self._call("add", self._key(key), amount)

    def _key(self, key: str) -> str:
        return f"torch_modal/{self._mark}/{key}"

    def _call(self, operation: str, *args: Any) -> Any:
        with _as_connection_error():
            return getattr(self._store, operation)(*args)


Sharing = Alone | Together


def sharing_by_environment() -> Sharing:
    """Several processes where ``torchrun`` or somebody else has set MASTER_ADDR, RANK and WORLD_SIZE; otherwise one.

    Raises:
        ConnectionError: The others were not met.
    """
    needed = ("MASTER_ADDR", "MASTER_PORT", "RANK", "WORLD_SIZE")
    met = all(os.environ.get(name) for name in needed)
    return Together.by_environment() if met and (os.environ["WORLD_SIZE"] != "1" or _parent()) else Alone()


def _parent() -> int:
    """The process that started this one, if it is torchrun."""
    return os.getppid() if "TORCHELASTIC_RUN_ID" in os.environ else 0


@contextlib.contextmanager
def _as_connection_error() -> Iterator[None]:
    """Errors of the store are RuntimeErrors, some with a stack of C++ calls."""
    try:
        yield
    except (RuntimeError, ValueError) as error:
        where = f"{os.environ.get('MASTER_ADDR')}:{os.environ.get('MASTER_PORT')}"
        reason = str(error).strip().split("\n")[0]
        raise ConnectionError(
            f"the store at {where}, in which the processes share the work, does not answer ({reason}); the process "
            "that hosts it has ended, or was never started. Start the same command again to go on"
        ) from error
