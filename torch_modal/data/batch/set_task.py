"""The task of one set of a folder tree: compute its bases, in a process of its own, unless they exist.

Tasks are idempotent and share nothing but the file system: the state of a set is in its folder, which is renamed into
place as a whole. So any machine can run a task, any number of times, several at once.

Each set has a fresh process rather than one of joblib's loky: loky has no time limit for a task that ends its process
and the mesher's, and a crash there fails all tasks of the pool.
"""

import contextlib
import json
import os
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

from torch_modal.data.batch.record import CRASHED, DONE, FAILED, REFUSED, TIMEOUT, Record, inputs_key, read_record
from torch_modal.data.batch.tree import mesh_files
from torch_modal.data.stored import BASES_FILE, KEYFRAMES_FILE, RECORD_FILE, open_set, why_not_replaceable
from torch_modal.io.cache import CACHE_VERSION
from torch_modal.io.files import write_atomically
from torch_modal.precompute.extract import Method
from torch_modal.precompute.processes import describe_exit, end_process, last_line

BOOT = """\
import sys
root = sys.argv.pop(1)
if root not in sys.path:
    sys.path.insert(0, root)
from torch_modal.data.batch.set_worker import main
main(sys.argv[1])
"""
COMMAND = [sys.executable, "-c", BOOT, str(Path(__file__).resolve().parents[3])]
"""The command of the process; the path of the result follows."""
THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "VECLIB_MAXIMUM_THREADS")
TIMES_FILE = "times.txt"
POLL = 0.5
GRACE = 5.0
"""Seconds between asking a process to end and killing it."""


@dataclass(frozen=True)
class Options:
    """Options of `extract_bases`, and whether to retry failed sets or to replace sets of other origin."""

    n_modes: int = 30
    method: Method = "auto"
    mesher: str = "lattice"
    cache_dir: str | None = None
    """None: no cache."""
    timeout: float = 600.0
    """Seconds for a set; the mesher may take half of them."""
    retry: bool = False
    overwrite: bool = False
    sequence: bool = False
    """Whether the key-frames of a set are a motion, in the order of their files."""

    def parameters(self) -> dict[str, Any]:
        """All that the result depends on besides the files."""
        made = {"n_modes": self.n_modes, "method": self.method, "mesher": self.mesher}
        # No sequence is None: as in records from before there was this option.
        return {**made, "algorithm": CACHE_VERSION, "sequence": self.sequence or None}

    def beside(self, source: Path) -> list[Path]:
        """Files of a set besides its meshes: the times of a motion, if there are any."""
        return [file for file in [source / TIMES_FILE] if self.sequence and file.is_file()]


class SetTask(NamedTuple):
    """A set whose bases are computed; with absolute paths, as another machine may run it."""

    record: Record
    """Its name, its place below the output folder, and the parameters."""
    source: Path
    """The folder with its meshes."""
    out: Path
    """The output folder, which must exist."""
    options: Options

    @property
    def target(self) -> Path:
        """The folder that gets its bases."""
        return self.out / self.record.output


class Outcome(NamedTuple):
    """Result of a task."""

    record: Record
    now: bool
    """Whether this task found the result, rather than an earlier one."""


def run_set(task: SetTask, stop: threading.Event | None = None) -> Outcome:
    """Compute the bases of a set, if there are none of the same files and settings.

    Args:
        task: The set.
        stop: Anything with ``is_set()``. Once it is set, the set's process is ended and the set stays as it was.

    Raises:
        RuntimeError: This machine has another version of the package, or does not see the output folder.
    """
    new, target = replace(task.record, host=socket.gethostname()), task.target
    if new.parameters != task.options.parameters() or not task.out.is_dir():
        why = f"no folder {task.out}" if not task.out.is_dir() else "another version of torch_modal than the command"
        raise RuntimeError(f"{new.host} has {why}; all machines need the same package and the same folders")
    try:
        files = mesh_files(task.source)
        inputs = inputs_key([*files, *task.options.beside(task.source)])
        new = replace(new, files=[file.name for file in files], inputs=inputs)
    except OSError as error:
        return Outcome(new.ended(FAILED, f"its files cannot be read: {error}"), True)
    before = read_record(target / RECORD_FILE)
    if before is not None:
        why = before.what_changed(new) or _why_again(before, task)
        if not why:
            return Outcome(before, False)
        new = replace(new, reason=why)
    if obstacle := _obstacle(target, task.options.overwrite):
        return Outcome(new.ended(REFUSED, obstacle), True)

    record = _in_own_process(task._replace(record=new), stop)
    if record.status == DONE or not record.finished:
        return Outcome(record, True)
    meanwhile = read_record(target / RECORD_FILE)  # another run may have succeeded
    if meanwhile is not None and meanwhile.status == DONE and not meanwhile.what_changed(new):
        return Outcome(meanwhile, True)
    if (target / BASES_FILE).exists():
        record.warnings.append(f"{target} still holds the bases of earlier files or settings")
    with contextlib.suppress(OSError):  # then it is tried again next time
        target.mkdir(parents=True, exist_ok=True)
        write_atomically(target / RECORD_FILE, record.line())
    return Outcome(record, True)


def _why_again(before: Record, task: SetTask) -> str:
    """Why an unchanged set is computed again; empty if it is not."""
    if before.status != DONE:
        return f"tried again after: {before.reason}" if task.options.retry else ""
    try:
        open_set(task.target)
        return ""
    except (OSError, ValueError) as error:
        return f"its bases are gone or damaged: {error}"


def _obstacle(folder: Path, overwrite: bool) -> str:
    """Why the bases cannot be written; the user's files stay, sets of other origin unless ``overwrite``."""
    if obstacle := why_not_replaceable(folder):
        return f"{obstacle}; move it away"
    there = any((folder / name).exists() for name in (KEYFRAMES_FILE, BASES_FILE))
    if there and not (folder / RECORD_FILE).exists() and not overwrite:
        return f"{folder} holds a stored set that this command did not write; --overwrite replaces it"
    return ""


def _in_own_process(task: SetTask, stop: threading.Event | None) -> Record:
    """Start a new interpreter for the set and wait for it; the record is unfinished if it was stopped.

    It has a session of its own, so that Ctrl-C reaches this process alone, and ends itself when the pipe from this
    process closes. `multiprocessing` does not serve: a Dask worker is daemonic and may not start its processes.
    """
    started, timeout = time.monotonic(), task.options.timeout
    job = {"record": asdict(task.record), "options": asdict(task.options), "source": task.source, "target": task.target}
    with tempfile.TemporaryDirectory(prefix="torch_modal-set-", ignore_cleanup_errors=True) as scratch:
        result, log_file = Path(scratch) / "record.json", Path(scratch) / "log.txt"
        with log_file.open("wb") as log:
            process = subprocess.Popen(
                [*COMMAND, str(result)],
                stdin=subprocess.PIPE,
                stdout=log,
                stderr=subprocess.STDOUT,
                cwd=scratch,
                env={**os.environ, **dict.fromkeys(THREADS, "1"), "TMPDIR": scratch},
                start_new_session=True,
            )
        try:
            assert process.stdin is not None
            with contextlib.suppress(BrokenPipeError):  # it ended at once; its exit status says more
                process.stdin.write(json.dumps(job, default=str).encode() + b"\n")
                process.stdin.flush()
            in_time = _wait(process, started + timeout, stop)
            seconds = round(time.monotonic() - started, 2)
        finally:
            _end(process)
        said, record = log_file.read_text(errors="replace")[-2000:], read_record(result)
    if record is not None or in_time is None:
        return record or task.record
    new, code = replace(task.record, seconds=seconds, log=said), process.returncode
    if not in_time:
        return new.ended(TIMEOUT, f"no result after the timeout of {timeout:g} s")
    hint = "perhaps memory ran out" if code == -signal.SIGKILL else last_line(said)
    reason = f"its process ended with {describe_exit(code)}" + (f" ({hint})" if hint else "")
    return new.ended(CRASHED if code < 0 else FAILED, reason)


def _wait(process: subprocess.Popen[bytes], end: float, stop: threading.Event | None) -> bool | None:
    """Whether a process ended before a time; None if it was stopped."""
    while stop is None or not stop.is_set():
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(min(POLL, max(end - time.monotonic(), 0.0)))
            return True
        if time.monotonic() >= end:
            return False
    return None


def _end(process: subprocess.Popen[bytes]) -> None:
    """Interrupt a process, so that it ends the mesher, whose session is another; kill it if that does not help."""
    if process.poll() is None:
        process.send_signal(signal.SIGINT if os.name == "posix" else signal.SIGTERM)
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(GRACE)
    end_process(process)
    with contextlib.suppress(OSError):
        process.communicate()  # closes the pipe
