"""The process of one set: ``main(RESULT)``, with a line of JSON on its standard input.

The line has the set's ``record`` so far, its folders ``source`` and ``target``, and ``options``. The result is the
finished record of the set, which is also written beside the bases. A crash writes neither.
"""

import _thread
import faulthandler
import json
import os
import signal
import sys
import threading
import time
import traceback
import warnings
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

from torch_modal.data.batch.record import DONE, FAILED, REFUSED, Record, inputs_key
from torch_modal.data.batch.set_task import Options
from torch_modal.data.motion import Motion
from torch_modal.data.stored import RECORD_FILE, write_set
from torch_modal.errors import MeshError
from torch_modal.io.files import write_atomically
from torch_modal.precompute.extract import extract_bases
from torch_modal.precompute.tetwild import TetWild
from torch_modal.registration.load import load_keyframes

GRACE = 30.0
"""Seconds that the process has to end by itself before it is killed."""


def main(result_path: str) -> None:
    """Compute a set and write its record."""
    # A parent that ignores SIGINT passes this on to its children.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    job = json.loads(sys.stdin.buffer.readline())
    # Prints the stack of a crash, and ends the process even if a library hangs with the interpreter's lock.
    faulthandler.enable()
    faulthandler.dump_traceback_later(job["options"]["timeout"] + GRACE, exit=True)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    write_atomically(Path(result_path), compute(job).line())


def compute(job: dict[str, Any]) -> Record:
    """Compute and write the bases of a set; returns its record."""
    record, options, started = Record(**job["record"]), Options(**job["options"]), time.monotonic()
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", UserWarning)

        def ended(status: str, reason: str = "", log: str = "") -> Record:
            texts = (" ".join(str(one.message).split()) for one in caught if issubclass(one.category, UserWarning))
            seconds = round(time.monotonic() - started, 2)
            return record.ended(status, reason, log=log, warnings=list(dict.fromkeys(texts)), seconds=seconds)

        try:
            files = [Path(job["source"], name) for name in record.files]
            stem, n_files = Counter(file.stem for file in files).most_common(1)[0]
            if n_files > 1:
                raise MeshError(f"{n_files} files have the name {stem}; a shape must be there in one format only")
            beside = options.beside(Path(job["source"]))
            keyframes, faces = load_keyframes(files)
            motion = _motion(beside, len(files)) if options.sequence else None
            if inputs_key([*files, *beside]) != record.inputs:
                raise RuntimeError("its files were written to while they were read; start again")
            record = replace(record, keyframes=keyframes.shape[0], vertices=keyframes.shape[1])
            bases = extract_bases(
                keyframes,
                faces,
                options.n_modes,
                method=options.method,
                # Half of the time leaves some to report a failure.
                mesher=TetWild(timeout=options.timeout / 2) if options.mesher == "tetwild" else options.mesher,
                cache_dir=options.cache_dir,
                cache=options.cache_dir is not None,
                progress=False,
            )
            done = ended(DONE)
            write_set(
                job["target"],
                keyframes,
                faces,
                bases,
                record.files,
                times=None if motion is None else motion.times,
                cyclic=motion is not None and motion.cyclic,
                beside={RECORD_FILE: done.line()},
            )
            return done
        except (ValueError, RuntimeError) as error:
            return ended(REFUSED if isinstance(error, ValueError) else FAILED, " ".join(str(error).split()))
        except Exception as error:  # the machine or a bug: the other sets go on
            return ended(FAILED, f"{type(error).__name__}: {error}", traceback.format_exc()[-2000:])


def _motion(beside: list[Path], n_keyframes: int) -> Motion:
    """The motion of key-frames, at the times in their file or at even ones.

    Raises:
        ValueError: The file does not hold such times.
    """
    if not beside:
        return Motion(range(n_keyframes), n_keyframes)
    wanted = f"one number for each of the {n_keyframes} key-frames, ascending, and one more if they are a cycle"
    try:
        times = [float(word) for word in beside[0].read_text().split()]
        return Motion(times, n_keyframes, cyclic=len(times) == n_keyframes + 1)
    except ValueError as error:
        raise ValueError(f"{beside[0].name} needs {wanted}: {error}") from error


def _end_with_parent() -> None:
    """Wait for the end of the pipe from the parent, then end this process and what it started."""
    while os.read(0, 1):  # not sys.stdin, whose lock would be missed at the interpreter's end
        pass
    _thread.interrupt_main()
    time.sleep(GRACE)
    os._exit(1)
