"""Bases of one key-frame set of a folder tree, in a process of their own.

:func:`run_set` starts the process, unless the set has a result of the same files and options; :func:`main` runs in it.
The state of a set is in its own folder, each file of which is written whole: any machine can run a set, any number of
times, several at once. The process is not one of `multiprocessing`, as Dask workers may not start those, nor of a pool,
where a crash would end the neighbours.
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
from torch_modal.io.files import write_file
from torch_modal.modes.extract import Method, extract_bases
from torch_modal.modes.processes import describe_exit, last_line, run_child
from torch_modal.modes.tetrahedra import Mesher
from torch_modal.modes.tetwild import Auto, TetWild
from torch_modal.registration.load import load_keyframes
from torch_modal.times import check_times

DONE, FAILED, UNFINISHED = "done", "failed", "unfinished"
COMMAND = [
    sys.executable,
    "-c",
    "import sys; sys.path[:0] = {sys.argv[1]} - {*sys.path}; from torch_modal.data.precompute_set import main; main()",
    str(Path(__file__).resolve().parents[2]),
]
THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "VECLIB_MAXIMUM_THREADS")
TIMES_FILE = "times.txt"
FAILURE_FILE = "precompute-failure.json"
"""Record of a set without result; that of a result is the note of the stored set."""
GRACE = 5.0
"""Seconds between interrupting a process and killing it."""
OWN_GRACE = 30.0
"""Seconds that a process has to end by itself before it kills itself."""


@dataclass(frozen=True)
class Options:
    """Options of `extract_bases`, and whether to retry failed sets or to replace sets of other origin."""

    n_modes: int = 30
    method: Method = "auto"
    mesher: str = "auto"
    cache_dir: str | None = None
    """None: no cache."""
    timeout: float = 600.0
    """Seconds for a set; the mesher may take half of them."""
    retry: bool = False
    overwrite: bool = False
    sequence: bool = False
    """True if the key-frames of a set are a motion, in the order of their files."""

    def key(self, files: Sequence[Path]) -> str:
        """Digest of all that the bases depend on: options, names and contents of the files and of those beside them."""
        beside = [files[0].parent / TIMES_FILE] if self.sequence else []
        if any(file.suffix.lower() == ".gltf" for file in files):
            beside += sorted(files[0].parent.glob("*.bin"))
        every = (*files, *filter(Path.is_file, beside))
        contents = [(file.name, hashlib.sha256(file.read_bytes()).hexdigest()) for file in every]
        return content_digest([self.n_modes, self.method, self.mesher, self.sequence, CACHE_VERSION, contents])


@dataclass(frozen=True)
class Record:
    """Result of a set, which its folder keeps."""

    status: str = UNFINISHED
    """``done``, ``failed``; or ``unfinished`` if the command was interrupted, which no file says."""
    reason: str = ""
    """Why it failed, or why it was computed again."""
    warnings: Sequence[str] = ()
    seconds: float = 0.0
    key: str = ""
    """Digest of the files and options."""
    log: str = ""
    """End of the output of a process that failed."""


def read_record(folder: Path) -> Record | None:
    """The record of the last computation of a set; None if there is none that can be read."""
    failure = folder / FAILURE_FILE
    with contextlib.suppress(OSError, ValueError, TypeError):
        return Record(**json.loads(failure.read_bytes() if failure.is_file() else read_note(folder)))
    return None


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
    """
    if not out.is_dir():
        raise FileNotFoundError(f"{socket.gethostname()} has no folder {out}; all machines need the same folders")
    target = out / name
    try:
        new = Record(key=options.key(mesh_files(source / name)))
    except OSError as error:
        return Record(FAILED, f"its files cannot be read: {error}"), True
    if obstacle := _obstacle(target, options.overwrite):
        return replace(new, status=FAILED, reason=obstacle), True
    before = read_record(target)
    if before is not None and before.key != new.key:
        new = replace(new, reason="its files or options changed")
    elif before is not None and before.status == FAILED and options.retry:
        new = replace(new, reason=f"tried again after: {before.reason}")
    elif before is not None:
        return before, False

    started = time.monotonic()
    reason, log = _in_own_process(source / name, target, new, options, stop or threading.Event())
    found = read_record(target)
    if found is not None and found.status == DONE and found.key == new.key:
        return found, True  # by this process, or by another run meanwhile
    if reason is None:
        return new, True
    seconds = round(time.monotonic() - started, 2)
    kept = [f"{target} still holds the bases of earlier files or options"] if (target / SET_FILE).exists() else []
    record = replace(new, status=FAILED, reason=reason, seconds=seconds, warnings=kept, log=log)
    with contextlib.suppress(OSError):  # then it is tried again next time
        write_file(target / FAILURE_FILE, json.dumps(asdict(record)).encode())
    return record, True


def _obstacle(folder: Path, overwrite: bool) -> str:
    """Why the bases cannot be written; stored sets of other origin stay, unless ``overwrite``."""
    if folder.exists() and not folder.is_dir():
        return f"{folder} is no folder; move it away"
    try:
        ours = overwrite or bool(read_note(folder))
    except FileNotFoundError:
        ours = True
    except (OSError, ValueError):
        ours = False
    return "" if ours else f"{folder} holds a damaged set, or one that this command did not write; use --overwrite"


def _in_own_process(
    source: Path, target: Path, record: Record, options: Options, stop: threading.Event
) -> tuple[str | None, str]:
    """Why an interpreter of its own has no result for the set, None if it was stopped; and the end of its output."""
    with tempfile.TemporaryDirectory(prefix="torch_modal-set-", ignore_cleanup_errors=True) as scratch:
        reason = Path(scratch) / "reason.txt"
        job = {"source": str(source), "target": str(target), "record": asdict(record), "options": asdict(options)}
        environment = {**os.environ, **dict.fromkeys(THREADS, "1"), "TMPDIR": scratch}
        line, command = json.dumps(job).encode() + b"\n", [*COMMAND, str(reason)]
        # Interrupted first, so that it ends the mesher, whose session is another.
        code, said = run_child(command, Path(scratch), options.timeout, stop, line, environment, GRACE)
        said = said[-2000:]
        if code is None:
            return None if stop.is_set() else f"no result after the timeout of {options.timeout:g} s", said
        if reason.is_file():
            return reason.read_text(), said
        hint = "perhaps memory ran out" if code == -signal.SIGKILL else last_line(said)
        return f"its process ended with {describe_exit(code)}" + (f" ({hint})" if hint else ""), said


# ------------------------------------------------------------------------------------------- in the set's process
def main() -> None:
    """Compute the set that a line of JSON on standard input describes; the last argument is a file for an error."""
    # A parent that ignores SIGINT passes this on to its children.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    job = json.loads(sys.stdin.buffer.readline())
    options = Options(**job["options"])
    # Prints the stack of a crash, and ends the process even if a library hangs with the interpreter's lock.
    faulthandler.enable()
    faulthandler.dump_traceback_later(options.timeout + OWN_GRACE, exit=True)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    try:
        compute(Path(job["source"]), Path(job["target"]), Record(**job["record"]), options)
    except (ValueError, RuntimeError) as error:
        write_file(Path(sys.argv[-1]), " ".join(str(error).split()).encode("utf-8", "backslashreplace"))


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
        times = _times(source / TIMES_FILE, len(files)) if options.sequence else None
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
    (target / FAILURE_FILE).unlink(missing_ok=True)


def _times(file: Path, n_keyframes: int) -> list[float]:
    """Times of the key-frames of a motion, with the end of a cycle: those in a file, or even ones without it."""
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
    """Wait for the end of the pipe from the parent, then end this process and what it started."""
    while os.read(0, 1):  # not sys.stdin, whose lock would be missed at the interpreter's end
        pass
    _thread.interrupt_main()
    time.sleep(OWN_GRACE)
    os._exit(1)
