"""Bases of every key-frame set of a folder tree, in processes of this machine or on a Dask cluster.

:func:`run_set` computes a set in a child process, unless the set has bases of the same files and options; :func:`main`
runs in that process. The state of a set is one file in its folder, which is written whole: any machine can run a set,
any number of times, several at once. The process is not one of `multiprocessing`, as Dask workers may not start these,
nor of a pool, where a crash would end the neighbours.
"""

import _thread
import contextlib
import hashlib
import json
import os
import socket
import sys
import tempfile
import threading
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor, ThreadPoolExecutor, as_completed, wait
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from torch_modal.data.stored import read_note, write_set
from torch_modal.data.tree import find_keyframe_sets, mesh_files
from torch_modal.errors import MeshError
from torch_modal.extras import require
from torch_modal.io.cache import CACHE_VERSION, content_digest
from torch_modal.modes.extract import Method, extract_bases
from torch_modal.modes.processes import ChildError, package_command, run_child
from torch_modal.registration.load import load_keyframes
from torch_modal.threads import StoppedError, n_threads
from torch_modal.times import check_times

DONE, FAILED = "done", "failed"
COMMAND = package_command("torch_modal.data.precompute:main")
ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
TIMES_FILE = "times.txt"
GRACE = 10.0
"""Seconds from the end of the command until its child processes end at the latest."""
RETRIES = 2
"""Retries of a task that raised an error on a cluster: a machine may lack the package or the folders."""


@dataclass(frozen=True)
class Options:
    """Options of `extract_bases`, a time limit, and whether to replace sets that `precompute` did not write."""

    n_modes: int = 30
    method: Method = "auto"
    mesher: str = "auto"
    timeout: float = 600.0
    """Seconds for a set."""
    overwrite: bool = False
    sequence: bool = False
    """True if the key-frames of a set are a motion, in the order of their files."""

    def key(self, files: Sequence[Path]) -> str:
        """Digest of everything that the bases depend on: options, names and contents of the files."""
        further = [files[0].parent / TIMES_FILE] if self.sequence else []
        if any(file.suffix.lower() == ".gltf" for file in files):
            further += sorted(files[0].parent.glob("*.bin"))
        every = (*files, *filter(Path.is_file, further))
        contents = [(file.name, hashlib.sha256(file.read_bytes()).hexdigest()) for file in every]
        return content_digest([self.n_modes, self.method, self.mesher, self.sequence, CACHE_VERSION, contents])


@dataclass(frozen=True)
class Record:
    """Result of a set; if its bases were computed, the note of the stored set."""

    status: str = FAILED
    """``done`` or ``failed``."""
    reason: str = ""
    """Why it failed."""
    warnings: Sequence[str] = ()
    seconds: float = 0.0
    key: str = ""
    """Digest of the files and options."""


def read_record(folder: Path, overwrite: bool = False) -> Record | None:
    """Record of the bases in a folder; None without bases.

    Raises:
        ValueError: The stored set is damaged, or was not written by :func:`compute`; None with ``overwrite``.
    """
    try:
        return Record(**json.loads(read_note(folder)))
    except FileNotFoundError:
        return None
    except (OSError, ValueError, TypeError) as error:
        if overwrite:
            return None
        reason = "holds a damaged set, or one that this command did not write; use --overwrite"
        raise ValueError(f"{folder} {reason}") from error


# ------------------------------------------------------------------------------------------------- in the command
def precompute_tree(
    root: Path,
    out: Path,
    options: Options | None = None,
    *,
    workers: int | None = None,
    scheduler: str | None = None,
    say: Callable[[str], None] = print,
) -> dict[str, Record]:
    """Compute the bases of every key-frame set below a folder.

    Each set has a process and a time limit of its own (:func:`run_set`): if one fails, the others go on. Sets with
    bases of the same files and options are skipped.

    Args:
        root: The folder tree. See :func:`~torch_modal.data.tree.find_keyframe_sets` for what a set is.
        out: Gets a folder for each set, see :mod:`torch_modal.data.stored`.
        options: Options of the sets.
        workers: Sets at a time; by default one for each processor.
        scheduler: Address of the scheduler of a Dask cluster, such as ``tcp://HOST:8786``, on whose workers the sets
            are computed instead of on this machine, one at a time in each of their threads.
        say: Receives lines: one for each computed set, and the summary.

    Returns:
        The record of each set, by its path below ``root``.

    Raises:
        ValueError: There are no sets, or the folders cannot be used.
        OSError: The output cannot be written, or there is no cluster.
        MissingPackageError: ``scheduler`` without dask.distributed.
    """
    if not root.is_dir():
        raise ValueError(f"there is no folder {root}")
    options = options or Options()
    if (workers is not None and workers < 1) or not options.timeout > 0:
        raise ValueError(f"workers and timeout must be positive, got {workers} and {options.timeout}")
    if out.resolve() in (root.resolve(), *root.resolve().parents):
        raise ValueError(f"the output folder {out} is or contains the input {root}; choose another one")
    out.mkdir(parents=True, exist_ok=True)
    sets, left_out = find_keyframe_sets(root, skip=out)
    if not sets:
        raise ValueError("; ".join([f"no folder below {root} directly holds two or more mesh files", *left_out[:3]]))
    say(f"{len(sets)} sets of key-frames in {root}")
    records: dict[str, Record] = {}
    started, n_now = time.monotonic(), 0
    with _executor(workers, scheduler) as (executor, stop):
        paths = root.resolve(), out.resolve()
        names = {executor.submit(run_set, *paths, name, options, stop): name for name in sets}
        try:
            for future in as_completed(names):
                name = names[future]
                try:
                    records[name], is_new = future.result()
                except Exception as error:  # it killed several machines, or one lacks the package or the folders
                    records[name], is_new = Record(reason=f"{type(error).__name__}: {error}"), True
                n_now += is_new
                if is_new:
                    say(f"[{len(records)}/{len(sets)}] {_line(name, records[name])}")
        except BaseException:
            with contextlib.suppress(Exception):  # the cluster is gone, with its tasks
                stop.set()
                wait(names)
            raise
    records = {name: records[name] for name in sets}
    n_done, seconds = sum(record.status == DONE for record in records.values()), time.monotonic() - started
    say(f"{n_done} of {len(sets)} sets have their bases; {n_now} were worked on now, in {seconds:.0f} s")
    notable = [_line(name, record) for name, record in records.items() if record.status != DONE or record.warnings]
    for line in notable + left_out:
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


def _line(name: str, record: Record) -> str:
    """``done a/b, 2.1 s: 2 triangles have no area``, in characters that every terminal can show."""
    took = f", {record.seconds:.1f} s" if record.status == DONE else ""
    reasons = "; ".join(filter(None, (record.reason, *record.warnings)))
    line = f"{record.status} {name}{took}" + (f": {reasons}" if reasons else "")
    return line.encode("utf-8", "backslashreplace").decode()


def run_set(
    source: Path, out: Path, name: str, options: Options, stop: threading.Event | None = None
) -> tuple[Record, bool]:
    """Compute the bases of a set, if there are none of the same files and options.

    Args:
        source: The folder tree. All paths are absolute, as another machine may run the set.
        out: The output folder.
        name: Path of the set below both.
        options: Options of the set.
        stop: Anything with ``is_set()``; once it is set, the process is ended and the set stays as it was.

    Returns:
        The record, and whether this call worked on the set.

    Raises:
        FileNotFoundError: This machine does not see the output folder.
        StoppedError: ``stop`` was set.
    """
    if stop is not None and stop.is_set():
        raise StoppedError
    if not out.is_dir():
        raise FileNotFoundError(f"{socket.gethostname()} has no folder {out}; all machines need the same folders")
    target = out / name
    try:
        key = options.key(mesh_files(source / name))
        before = read_record(target, options.overwrite)
        if before is not None and before.key == key:
            return before, False
        job = {"source": str(source / name), "target": str(target), "key": key, "options": asdict(options)}
        with tempfile.TemporaryDirectory(prefix="torch_modal-set-", ignore_cleanup_errors=True) as scratch:
            environment = {**os.environ, **ONE_THREAD, "TMPDIR": scratch}
            run_child(COMMAND, Path(scratch), options.timeout, stop, json.dumps(job).encode() + b"\n", environment)
        return read_record(target) or Record(), True
    except (OSError, ValueError, ChildError) as error:
        return Record(reason=str(error)), True


# ------------------------------------------------------------------------------------------- in the set's process
def main() -> None:
    """Compute the set that a line of JSON on standard input describes; the reason for refusing it ends the output."""
    job = json.loads(sys.stdin.buffer.readline())
    threading.Thread(target=_end_with_parent, daemon=True).start()
    try:
        compute(Path(job["source"]), Path(job["target"]), job["key"], Options(**job["options"]))
    except (ValueError, RuntimeError) as error:
        sys.exit(" ".join(str(error).split()))


def compute(source: Path, target: Path, key: str, options: Options) -> None:
    """Compute the bases of a set, and write them with the record of this key.

    Raises:
        ValueError: The input cannot work.
        RuntimeError: The computation failed.
        OSError: The result cannot be written.
    """
    started = time.monotonic()
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", UserWarning)
        files = mesh_files(source)
        if len({file.stem for file in files}) < len(files):
            raise MeshError("two files have the same name; a shape must be there in one format only")
        keyframes, faces = load_keyframes(files)
        times = _read_times(source / TIMES_FILE, len(files)) if options.sequence else None
        how: dict[str, Any] = {"method": options.method, "mesher": options.mesher, "cache": False, "progress": False}
        bases = extract_bases(keyframes, faces, options.n_modes, **how)
    texts = dict.fromkeys(" ".join(str(one.message).split()) for one in caught if issubclass(one.category, UserWarning))
    record = Record(DONE, "", list(texts), round(time.monotonic() - started, 2), key)
    cyclic, names = times is not None and len(times) == len(files) + 1, [file.name for file in files]
    write_set(target, keyframes, faces, bases, names, times=times, cyclic=cyclic, note=json.dumps(asdict(record)))


def _read_times(file: Path, n_keyframes: int) -> list[float]:
    """Times of the key-frames of a motion, of a cycle also its end: from a file, or even times without it."""
    try:
        times = [float(word) for word in file.read_text().split()] if file.exists() else None
        return check_times(times, n_keyframes, None).tolist()
    except ValueError as error:
        raise ValueError(f"{file.name}: {error}") from error


def _end_with_parent() -> None:
    """Wait for the end of the pipe from the parent, then end the mesher and this process."""
    while os.read(0, 1):  # not sys.stdin, whose lock would be missed at the interpreter's end
        pass
    _thread.interrupt_main()
    time.sleep(GRACE)
    os._exit(1)
