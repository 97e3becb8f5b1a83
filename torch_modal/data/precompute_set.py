"""Bases of one key-frame set of a folder tree, computed in a child process.

:func:`run_set` starts the process, unless the set has bases of the same files and options; :func:`main` runs in it.
The state of a set is one file in its folder, which is written whole: any machine can run a set, any number of times,
several at once. The process is not one of `multiprocessing`, as Dask workers may not start these, nor of a pool, where
a crash would end the neighbours.
"""

import _thread
import contextlib
import faulthandler
import hashlib
import json
import os
import signal
import socket
import sys
import tempfile
import threading
import time
import warnings
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

from torch_modal.data.stored import SET_FILE, read_note, write_set
from torch_modal.data.tree import mesh_files
from torch_modal.errors import MeshError
from torch_modal.io.cache import CACHE_VERSION, content_digest
from torch_modal.modes.extract import Method, extract_bases
from torch_modal.modes.processes import ChildError, package_command, run_child
from torch_modal.modes.tetrahedra import Mesher
from torch_modal.modes.tetwild import Auto, TetWild
from torch_modal.registration.load import load_keyframes
from torch_modal.times import check_times

DONE, FAILED = "done", "failed"
COMMAND = package_command("torch_modal.data.precompute_set:main")
THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "VECLIB_MAXIMUM_THREADS")
TIMES_FILE = "times.txt"
REASON_FILE = "reason.txt"
"""Why the child process refused its set; in its working directory."""
GRACE = 5.0
"""Seconds between interrupting a child process and killing it."""
CHILD_GRACE = 30.0
"""Seconds after which a child process kills itself, when its time is over or its parent has ended."""


@dataclass(frozen=True)
class Options:
    """Options of `extract_bases`, a time limit, and whether to replace sets that `precompute` did not write."""

    n_modes: int = 30
    method: Method = "auto"
    mesher: str = "auto"
    cache_dir: str | None = None
    """None: no cache."""
    timeout: float = 600.0
    """Seconds for a set; the mesher may take half of them."""
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
    """Why it failed, or why it was computed again."""
    warnings: Sequence[str] = ()
    seconds: float = 0.0
    key: str = ""
    """Digest of the files and options."""


def read_record(folder: Path) -> Record | None:
    """Record of the bases in a folder; None without bases.

    Raises:
        ValueError: The stored set is damaged, or was not written by :func:`compute`.
    """
    try:
        return Record(**json.loads(read_note(folder)))
    except FileNotFoundError:
        return None
    except (OSError, ValueError, TypeError) as error:
        raise ValueError(f"{folder} holds a damaged set, or one that this command did not write") from error


# ------------------------------------------------------------------------------------------------- in the command
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
    if not out.is_dir():
        raise FileNotFoundError(f"{socket.gethostname()} has no folder {out}; all machines need the same folders")
    target = out / name
    if target.exists() and not target.is_dir():
        return Record(reason=f"{target} is no folder; move it away"), True
    try:
        new = Record(key=options.key(mesh_files(source / name)))
    except OSError as error:
        return Record(reason=f"its files cannot be read: {error}"), True
    try:
        before = read_record(target)
    except ValueError as error:
        if not options.overwrite:
            return Record(reason=f"{error}; use --overwrite"), True
        before = None
    if before is not None and before.key == new.key:
        return before, False
    if before is not None:
        new = replace(new, reason="its files or options changed")
    started, failure = time.monotonic(), "its process left no result"
    try:
        _run_in_child(source / name, target, new, options, stop)
    except ChildError as error:
        failure = str(error)
    with contextlib.suppress(ValueError):
        after = read_record(target)
        if after is not None and after.key == new.key:
            return after, True  # by this process, or by another run meanwhile
    stale = [f"{target} still holds the bases of earlier files or options"] if (target / SET_FILE).exists() else []
    return replace(new, reason=failure, seconds=round(time.monotonic() - started, 2), warnings=stale), True


def _run_in_child(source: Path, target: Path, record: Record, options: Options, stop: threading.Event | None) -> None:
    """Run :func:`main` on a set in a process of its own; raises ChildError if it refuses the set or fails."""
    job = {"source": str(source), "target": str(target), "record": asdict(record), "options": asdict(options)}
    with tempfile.TemporaryDirectory(prefix="torch_modal-set-", ignore_cleanup_errors=True) as scratch:
        environment = {**os.environ, **dict.fromkeys(THREADS, "1"), "TMPDIR": scratch}
        line = json.dumps(job).encode() + b"\n"
        # Interrupted first, so that it ends the mesher, which leads a session of its own.
        run_child(COMMAND, Path(scratch), options.timeout, stop, line, environment, GRACE)
        if (refusal := Path(scratch, REASON_FILE)).is_file():
            raise ChildError(refusal.read_text())


# ------------------------------------------------------------------------------------------- in the set's process
def main() -> None:
    """Compute the set that a line of JSON on standard input describes; if it is refused, write the reason to a file."""
    # A parent that ignores SIGINT passes this on to its children.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    job = json.loads(sys.stdin.buffer.readline())
    options = Options(**job["options"])
    # Ends the process even if a library hangs with the interpreter's lock.
    faulthandler.dump_traceback_later(options.timeout + CHILD_GRACE, exit=True)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    try:
        compute(Path(job["source"]), Path(job["target"]), Record(**job["record"]), options)
    except (ValueError, RuntimeError) as error:
        Path(REASON_FILE).write_bytes(" ".join(str(error).split()).encode("utf-8", "backslashreplace"))


def compute(source: Path, target: Path, record: Record, options: Options) -> None:
    """Compute the bases of a set, and write them with the record.

    Raises:
        ValueError: The input cannot work.
        RuntimeError: The computation failed, or the files changed meanwhile.
        OSError: The result cannot be written.
    """
    started = time.monotonic()
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", UserWarning)
        files = mesh_files(source)
        stem, n_files = Counter(file.stem for file in files).most_common(1)[0]
        if n_files > 1:
            raise MeshError(f"{n_files} files have the name {stem}; a shape must be there in one format only")
        keyframes, faces = load_keyframes(files)
        times = _read_times(source / TIMES_FILE, len(files)) if options.sequence else None
        if options.key(files) != record.key:
            raise RuntimeError("its files were written to while they were read; start again")
        # Half of the time leaves some to report a failure, or for a second mesher.
        tetwild = TetWild(timeout=options.timeout / 2)
        meshers: dict[str, Mesher] = {"auto": Auto(tetwild), "tetwild": tetwild}
        bases = extract_bases(
            keyframes,
            faces,
            options.n_modes,
            method=options.method,
            mesher=meshers.get(options.mesher, options.mesher),
            cache_dir=options.cache_dir,
            cache=options.cache_dir is not None,
            progress=False,
        )
    texts = (" ".join(str(one.message).split()) for one in caught if issubclass(one.category, UserWarning))
    seconds = round(time.monotonic() - started, 2)
    done = replace(record, status=DONE, warnings=list(dict.fromkeys(texts)), seconds=seconds)
    cyclic, note = times is not None and len(times) == len(files) + 1, json.dumps(asdict(done))
    names = [file.name for file in files]
    write_set(target, keyframes, faces, bases, names, times=times, cyclic=cyclic, note=note)


def _read_times(file: Path, n_keyframes: int) -> list[float]:
    """Times of the key-frames of a motion, of a cycle also its end: from a file, or even times without it."""
    if not file.is_file():
        return [float(i) for i in range(n_keyframes)]
    try:
        times = [float(word) for word in file.read_text().split()]
        check_times(times, n_keyframes, None)
        return times
    except ValueError as error:
        wanted = f"one number for each of the {n_keyframes} key-frames, ascending, and one more if they are a cycle"
        raise ValueError(f"{file.name} needs {wanted}: {error}") from error


def _end_with_parent() -> None:
    """Wait for the end of the pipe from the parent, then end this process and its children."""
    while os.read(0, 1):  # not sys.stdin, whose lock would be missed at the interpreter's end
        pass
    _thread.interrupt_main()
    time.sleep(CHILD_GRACE)
    os._exit(1)
