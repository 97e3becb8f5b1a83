"""Bases of every key-frame set of a folder tree."""

import contextlib
import os
import time
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path
from typing import NamedTuple, TypeVar

from torch_modal.bulk.progress import Progress, summary
from torch_modal.bulk.records import DONE, FAILED, Record, Records, ended, stamp
from torch_modal.bulk.review import Options, Review, Settled, Task
from torch_modal.bulk.set_process import Outcome, SetProcess
from torch_modal.bulk.sharing import Counts, Plan, Sharing, sharing_by_environment
from torch_modal.bulk.tree import find_keyframe_sets, places
from torch_modal.data.stored import BASES_FILE

POLL = 0.05
Answer = TypeVar("Answer")


class Result(NamedTuple):
    """What came of it, for all processes together."""

    counts: Counts
    """How many sets are settled."""
    n_sets: int
    """How many there are."""

    @property
    def complete(self) -> bool:
        """Whether every set has its bases."""
        return self.counts.settled == self.n_sets and not self.counts.not_done


def precompute_tree(
    root: Path,
    out: Path,
    options: Options | None = None,
    *,
    say: Callable[[str], None] = print,
    bar: bool = False,
    sharing: Sharing | None = None,
) -> Result:
    """Compute the bases of every key-frame set below a folder.

    Each set has a process and a time limit of its own; what goes wrong with one is written to the report and the
    others go on. Sets that have a result already are passed over, unless their files or the options changed.

    Args:
        root: The folder tree. See :func:`~torch_modal.bulk.tree.find_keyframe_sets` for what a set is.
        out: Gets a folder for each set, see :mod:`torch_modal.data.stored`, and the report.
        options: How.
        say: Takes lines: one for each set unless there is a bar, and the summary.
        bar: Whether a bar shows how far it is.
        sharing: Who takes which set; by default, what the environment says: alone, or under ``torchrun``.

    Returns:
        How many sets are done.

    Raises:
        ValueError: There are no sets, or the folders cannot be used.
        OSError: The output cannot be written, or the other processes are gone (ConnectionError).
    """
    options = options or Options()
    _check_folders(root, out)
    records = Records(out)
    if not options.overwrite and not records.is_own_report():
        raise ValueError(f"{records.report} exists and is no report of this command; --overwrite replaces it")
    sharing = sharing or sharing_by_environment()
    records.prepare()

    def make_plan() -> Plan:
        tree = find_keyframe_sets(root, skip=out)
        return Plan(places(tree.sets, root), tree.left_out)

    plan = sharing.agree(records.state, options.parameters(), make_plan)
    if not plan.places:
        why = "; ".join(f"{name}: {reason}" for name, reason in list(plan.left_out.items())[:3])
        raise ValueError(f"no folder below {root} directly holds two or more mesh files" + (f" ({why})" if why else ""))
    if sharing.rank == 0:
        say(f"{len(plan.places)} sets of key-frames in {root}")
    review = Review(root, out, options, plan.places, records)
    progress = Progress(len(plan.places), say, bar=bar and sharing.rank == 0)
    return _Run(out, options, plan, records, review, sharing, progress).finish(say)


class _Run:
    """The work of this process."""

    def __init__(
        self,
        out: Path,
        options: Options,
        plan: Plan,
        records: Records,
        review: Review,
        sharing: Sharing,
        progress: Progress,
    ) -> None:
        self.out, self.options, self.plan, self.records = out, options, plan, records
        self.review, self.sharing, self.progress = review, sharing, progress
        self.names = list(plan.places)
        self.lost: ConnectionError | None = None
        self._last_counts = Counts(0, 0, 0)

    def finish(self, say: Callable[[str], None]) -> Result:
        """Take sets until there are none left, wait for the others, report."""

        def report(counts: Counts) -> None:
            found = self.records.write_report(self.plan.places, self.plan.left_out)
            for line in summary(found, self.plan.left_out, counts, self.progress.seconds, self.records.report):
                say(line)

        try:
            self._work()
            self.progress.close()
            if self.lost is not None:
                raise self.lost
            return Result(self.sharing.finish(report), len(self.names))
        except BaseException:
            self.progress.close()
            if self.sharing.rank == 0:  # what is known so far
                with contextlib.suppress(OSError):
                    self.records.write_report(self.plan.places, self.plan.left_out)
            raise

    def _work(self) -> None:
        """Keep as many processes at work as were asked for, until the counter is past the last set."""
        n_workers = self.options.workers or default_workers()
        running: dict[SetProcess, Task] = {}
        more = True
        try:
            while more or running:
                busy = False
                if more and len(running) < n_workers:
                    busy = more = self._take(running)
                for process in list(running):
                    outcome = process.poll()
                    if outcome is not None:
                        busy = True
                        self._settle(self._judged(running.pop(process), outcome))
                self._reach(self.sharing.stay, None)
                self.progress.show(self._counts)
                if not busy:
                    time.sleep(POLL)
        finally:
            for process in running:
                process.ask_to_end()
            for process in running:
                process.close()

    def _take(self, running: dict[SetProcess, Task]) -> bool:
        """Take the next set, and start it if there is work to do; whether there was one."""
        number = self._reach(self.sharing.take, len(self.names))
        if number >= len(self.names):
            return False
        found = self.review.look_at(self.names[number])
        if isinstance(found, Settled):
            self._settle(found.record, before=found.before)
            return True
        self.records.write(found.record)
        extract_options = {
            "n_modes": self.options.n_modes,
            "mesher": self.options.mesher,
            "settings": self.options.quality,
            "cache_dir": self.options.cache_dir and os.path.abspath(os.path.expanduser(self.options.cache_dir)),
            "cache": self.options.cache_dir is not None,
        }
        job = {
            "files": [os.path.abspath(file) for file in found.files],
            "folder": os.path.abspath(self.out / found.record.output),
            "options": extract_options,
            "record": asdict(found.record),
            "record_file": os.path.abspath(self.records.file(found.record.output)),
        }
        running[SetProcess(job, self.options.timeout)] = found
        return True

    def _judged(self, task: Task, outcome: Outcome) -> Record:
        """The record of a set whose process has ended."""
        warnings = list(outcome.details.get("warnings", []))
        record = replace(
            task.record,
            seconds=round(outcome.seconds, 2),
            log=outcome.log,
            keyframes=outcome.details.get("keyframes", 0),
            vertices=outcome.details.get("vertices", 0),
        )
        if not _untouched(task):
            record = replace(record, inputs="", warnings=warnings)
            return ended(record, FAILED, "its files were written to while they were read; start again")
        if outcome.status == DONE:
            return ended(replace(record, warnings=warnings), DONE, record.reason)
        if (self.out / record.output / BASES_FILE).exists():
            warnings.append(f"{self.out / record.output} still holds the bases of earlier files or settings")
        return ended(replace(record, warnings=warnings), outcome.status, outcome.reason)

    def _settle(self, record: Record, *, before: bool = False) -> None:
        """Write down how a set stands, and say it."""
        if not before:
            self.records.write(record)
        self._reach(lambda: self.sharing.settle(skipped=before, done=record.status == DONE), None)
        if not before:
            self.progress.settled(record, self._counts())

    def _counts(self) -> Counts:
        self._last_counts = self._reach(self.sharing.counts, self._last_counts)
        return self._last_counts

    def _reach(self, ask: Callable[[], Answer], otherwise: Answer) -> Answer:
        """Ask what the processes share. Without it no more sets are taken, but those at work are brought to an end."""
        if self.lost is None:
            try:
                return ask()
            except ConnectionError as error:
                self.lost = error
        return otherwise


def _untouched(task: Task) -> bool:
    try:
        return stamp(task.files) == task.stamp
    except OSError:
        return False


def default_workers() -> int:
    """The processors that this process may use, shared with its neighbours of the same ``torchrun``."""
    n = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return max(1, n // max(1, int(os.environ.get("LOCAL_WORLD_SIZE") or 1)))


def _check_folders(root: Path, out: Path) -> None:
    if not root.is_dir():
        raise ValueError(f"{root} is no folder" if root.exists() else f"there is no folder {root}")
    if out.exists() and not out.is_dir():
        raise ValueError(f"{out} is a file; the output is a folder")
    if out.resolve() in (root.resolve(), *root.resolve().parents):
        raise ValueError(f"the output folder {out} is or contains the input {root}; choose another one")
