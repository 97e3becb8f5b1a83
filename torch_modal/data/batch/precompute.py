"""Bases of every key-frame set of a folder tree."""

import contextlib
import time
import traceback
from collections.abc import Callable, Iterable
from concurrent.futures import CancelledError, Future, as_completed, wait
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

from tqdm import tqdm

from torch_modal.data.batch.engines import Engine
from torch_modal.data.batch.record import DONE, FAILED, LEFT_OUT, Record, read_record
from torch_modal.data.batch.set_task import Options, Outcome, SetTask, run_set
from torch_modal.data.batch.tree import find_keyframe_sets, places, printable
from torch_modal.data.stored import RECORD_FILE
from torch_modal.io.files import write_atomically

SHOWN = 20
"""Most sets that the summary names; the report has all."""


class Shard(NamedTuple):
    """A part of the sets: every ``of``-th, from ``number``, which counts from 1."""

    number: int = 1
    of: int = 1

    @property
    def report(self) -> str:
        """Name of the file in the output folder with a line of JSON for each set."""
        return f"precompute-report{f'-{self.number}-of-{self.of}' if self.of > 1 else ''}.jsonl"


def precompute_tree(
    root: Path,
    out: Path,
    engine: Engine,
    options: Options | None = None,
    *,
    shard: Shard | None = None,
    say: Callable[[str], None] = print,
    bar: bool = False,
) -> list[Record]:
    """Compute the bases of every key-frame set below a folder.

    Each set is a task with a process and a time limit of its own
    (:func:`~torch_modal.data.batch.set_task.run_set`). The report names the sets that failed; the others go on. Sets
    with a result are skipped, unless their files or the options changed.

    Args:
        root: The folder tree. See :func:`~torch_modal.data.batch.tree.find_keyframe_sets` for what a set is.
        out: Gets a folder for each set, see :mod:`torch_modal.data.stored`, and the report.
        engine: Where the tasks run.
        options: Options of the sets.
        shard: The part of the sets that this call computes; by default all.
        say: Receives lines: one for each computed set, and the summary.
        bar: Whether to show a progress bar, and lines of failed sets only.

    Returns:
        The record of each set of the shard.

    Raises:
        ValueError: There are no sets, or the folders cannot be used.
        OSError: The output cannot be written, or the cluster is gone (ConnectionError).
    """
    _check_folders(root, out)
    out.mkdir(parents=True, exist_ok=True)
    tree = find_keyframe_sets(root, skip=out)
    left_out = [Record(name, LEFT_OUT, why) for name, why in tree.left_out.items()]
    if not tree.sets:
        why = "; ".join(_line(record) for record in left_out[:3])
        raise ValueError(f"no folder below {root} directly holds two or more mesh files" + (f" ({why})" if why else ""))
    shard, options, source, target = shard or Shard(), options or Options(), root.resolve(), out.resolve()
    new = [Record(name, output=at, parameters=options.parameters()) for name, at in places(tree.sets, root).items()]
    tasks = [SetTask(one, source / one.set, target, options) for one in new[shard.number - 1 :: shard.of]]
    part = f"shard {shard.number}/{shard.of}: {len(tasks)} of " if shard.of > 1 else ""
    say(f"{part}{len(new)} sets of key-frames in {root}" + (f"; {engine.name}" if engine.name else ""))

    known: dict[str, Record] = {}

    def write_report() -> list[Record]:
        found = [known.get(task.record.output) or read_record(task.target / RECORD_FILE) for task in tasks]
        new = (replace(task.record, reason="not reached, or interrupted") for task in tasks)
        records = [one or other for one, other in zip(found, new, strict=True)]
        write_atomically(out / shard.report, b"".join(record.line() for record in (*records, *left_out)))
        return records

    started, n_now = time.monotonic(), 0
    futures: dict[Future[Outcome], Record] = {}
    try:
        with tqdm(total=len(tasks), unit="set", leave=False, dynamic_ncols=True, disable=not bar) as shown:
            for task in tasks:
                futures[engine.executor.submit(run_set, task, engine.stop)] = task.record
            for future in as_completed(futures):
                record, now = _outcome(future, futures[future])
                known[futures[future].output] = record
                n_now += now
                shown.update()
                if now and not (bar and record.status == DONE):
                    with shown.external_write_mode():
                        say(f"[{len(known)}/{len(tasks)}] {_line(record)}")
    except BaseException:
        _cancel(futures, engine)
        with contextlib.suppress(OSError):  # the records so far
            write_report()
        raise
    records = write_report()
    n_done = sum(record.status == DONE for record in records)
    seconds = time.monotonic() - started
    say(f"{n_done} of {len(records)} sets have their bases; {n_now} were worked on now, in {seconds:.0f} s")
    notable = [record for record in (*records, *left_out) if record.status != DONE or record.warnings]
    for record in notable[:SHOWN]:
        say(f"  {_line(record)}")
    say(f"report: {out / shard.report}" + (f", with {len(notable) - SHOWN} more" if len(notable) > SHOWN else ""))
    return records


def _outcome(future: Future[Outcome], record: Record) -> Outcome:
    try:
        return future.result()
    except CancelledError as error:
        raise ConnectionError("the cluster dropped a set, or is gone; start the same command again to go on") from error
    except Exception as error:  # of the engine: the set killed several machines, or a machine lacks the folders
        log = "".join(traceback.format_exception(error))[-2000:]
        return Outcome(record.ended(FAILED, " ".join(f"{type(error).__name__}: {error}".split()), log=log), True)


def _cancel(futures: Iterable[Future[Outcome]], engine: Engine) -> None:
    """End all tasks; waits for those that cannot be cancelled, seconds after the stop event."""
    for future in futures:
        future.cancel()
    if engine.stop is not None:
        with contextlib.suppress(Exception):  # the cluster is gone, with its tasks
            engine.stop.set()
            wait([future for future in futures if not future.cancelled()])


def _line(record: Record) -> str:
    """``done a/b (its files changed): 3 key-frames of 164 vertices, 2.1 s``."""
    name, text = printable(record.set), record.reason
    if record.status == DONE:
        name += f" ({text})" if text else ""
        text = f"{record.keyframes} key-frames of {record.vertices:,} vertices, {record.seconds:.1f} s"
    return f"{record.status} {'; '.join([f'{name}: {text}', *record.warnings])}"


def _check_folders(root: Path, out: Path) -> None:
    if not root.is_dir():
        raise ValueError(f"{root} is no folder" if root.exists() else f"there is no folder {root}")
    if out.exists() and not out.is_dir():
        raise ValueError(f"{out} is a file; the output is a folder")
    if out.resolve() in (root.resolve(), *root.resolve().parents):
        raise ValueError(f"the output folder {out} is or contains the input {root}; choose another one")
