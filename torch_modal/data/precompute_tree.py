"""Bases of every key-frame set of a folder tree, in processes of this machine or on a Dask cluster."""

import contextlib
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import CancelledError, Executor, Future, ThreadPoolExecutor, as_completed, wait
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from tqdm import tqdm

from torch_modal.data.precompute_set import DONE, Options, Record, run_set
from torch_modal.data.tree import find_keyframe_sets
from torch_modal.extras import require
from torch_modal.threads import n_threads

RETRIES = 2
"""Retries of a task that raised an error on a cluster: a machine may lack the package or the folders."""


def precompute_tree(
    root: Path,
    out: Path,
    options: Options | None = None,
    *,
    workers: int | None = None,
    scheduler: str | None = None,
    say: Callable[[str], None] = print,
    bar: bool = False,
) -> dict[str, Record]:
    """Compute the bases of every key-frame set below a folder.

    Each set has a process and a time limit of its own (:func:`~torch_modal.data.precompute_set.run_set`): if one fails,
    the others go on. Sets with bases of the same files and options are skipped.

    Args:
        root: The folder tree. See :func:`~torch_modal.data.tree.find_keyframe_sets` for what a set is.
        out: Gets a folder for each set, see :mod:`torch_modal.data.stored`.
        options: Options of the sets.
        workers: Sets at a time; by default one for each processor.
        scheduler: Address of the scheduler of a Dask cluster, such as ``tcp://HOST:8786``, on whose workers the sets
            are computed instead of on this machine, one at a time in each of their threads.
        say: Receives lines: one for each computed set, and the summary.
        bar: Whether to show a progress bar, and lines of failed sets only.

    Returns:
        The record of each set, by its path below ``root``.

    Raises:
        ValueError: There are no sets, or the folders cannot be used.
        OSError: The output cannot be written, or there is no cluster, or it is gone (ConnectionError).
        MissingPackageError: ``scheduler`` without dask.distributed.
    """
    if not root.is_dir():
        raise ValueError(f"{root} is no folder" if root.exists() else f"there is no folder {root}")
    if (out.is_symlink() or out.exists()) and not out.is_dir():
        raise ValueError(f"{out} is a file, or a link to none; the output is a folder")
    if out.resolve() in (root.resolve(), *root.resolve().parents):
        raise ValueError(f"the output folder {out} is or contains the input {root}; choose another one")
    out.mkdir(parents=True, exist_ok=True)
    options = options or Options()
    sets, left_out = find_keyframe_sets(root, skip=out)
    lines = [f"left out {escape_name(name)}: {why}" for name, why in left_out.items()]
    if not sets:
        why = "; ".join(lines[:3])
        raise ValueError(f"no folder below {root} directly holds two or more mesh files" + (f" ({why})" if why else ""))
    say(f"{len(sets)} sets of key-frames in {root}")
    records: dict[str, Record] = {}
    started, n_now = time.monotonic(), 0
    with _executor(workers, scheduler) as (executor, stop):
        futures: dict[Future[tuple[Record, bool]], str] = {}
        try:
            with tqdm(total=len(sets), unit="set", leave=False, dynamic_ncols=True, disable=not bar) as shown:
                for name in sets:
                    futures[executor.submit(run_set, root.resolve(), out.resolve(), name, options, stop)] = name
                for future in as_completed(futures):
                    name = futures[future]
                    records[name], now = _result(future)
                    n_now += now
                    shown.update()
                    if now and not (bar and records[name].status == DONE):
                        with shown.external_write_mode():
                            say(f"[{len(records)}/{len(sets)}] {_line(name, records[name])}")
        except BaseException:
            for future in futures:
                future.cancel()
            with contextlib.suppress(Exception):  # the cluster is gone, with its tasks
                stop.set()
                wait([future for future in futures if not future.cancelled()])
            raise
    records = {name: records[name] for name in sets}
    n_done = sum(record.status == DONE for record in records.values())
    seconds = time.monotonic() - started
    say(f"{n_done} of {len(sets)} sets have their bases; {n_now} were worked on now, in {seconds:.0f} s")
    notable = [_line(name, record) for name, record in records.items() if record.status != DONE or record.warnings]
    for line in notable + lines:
        say(f"  {line}")
    return records


@contextmanager
def _executor(workers: int | None, scheduler: str | None) -> Iterator[tuple[Executor, Any]]:
    """An executor of threads that each wait for the process of one set, or of a Dask cluster; and its stop event."""
    if not scheduler:
        with ThreadPoolExecutor(workers or n_threads(), thread_name_prefix="torch_modal-set") as executor:
            yield executor, threading.Event()
        return
    # Sets of a dead worker go to others, until one has killed several (distributed.scheduler.allowed-failures).
    distributed = require("distributed", "dask", "a Dask cluster")
    with distributed.Client(scheduler, set_as_default=False) as client:
        # An event on the scheduler: running tasks cannot be cancelled from outside.
        yield client.get_executor(pure=False, retries=RETRIES), distributed.Event(client=client)


def _result(future: Future[tuple[Record, bool]]) -> tuple[Record, bool]:
    try:
        return future.result()
    except CancelledError as error:
        raise ConnectionError("the cluster dropped a set, or is gone; start the same command again to go on") from error
    except Exception as error:  # the set killed several machines, or a machine lacks the package or the folders
        return Record(reason=" ".join(f"{type(error).__name__}: {error}".split())), True


def _line(name: str, record: Record) -> str:
    """``done a/b, 2.1 s: its files changed``."""
    took = f", {record.seconds:.1f} s" if record.status == DONE else ""
    said = "; ".join(filter(None, (record.reason, *record.warnings)))
    return f"{record.status} {escape_name(name)}{took}" + (f": {said}" if said else "")


def escape_name(name: str) -> str:
    """Escape a name so that a terminal shows it as one line; names of folders may hold anything but a slash."""
    text = name.encode("utf-8", "backslashreplace").decode()
    return text if text.isprintable() else repr(text)
