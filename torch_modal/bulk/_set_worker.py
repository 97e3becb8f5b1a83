"""The process that computes one set, seen from inside: ``main(JOB, RESULT)``, two JSON files.

The job has ``files``, ``folder`` (where the bases go), ``options`` (of `extract_bases`), ``timeout``, and the set's
``record`` with the ``record_file`` it stands in. The result has ``status`` and ``reason``, and what is known of the
set: ``keyframes``, ``vertices``, ``warnings``. A crash leaves none.
"""

import _thread
import faulthandler
import json
import os
import signal
import threading
import time
import traceback
import warnings
from pathlib import Path
from typing import Any

from torch_modal.bulk.records import DONE, FAILED, REFUSED, Record, ended
from torch_modal.bulk.tree import same_stems
from torch_modal.errors import MeshError
from torch_modal.io.files import write_atomically

MESHER_SHARE = 0.5
"""Part of the set's time that the mesher may take, so that its failure can still be told, or made good."""
ENOUGH = 30.0
"""Seconds after which a process that was told to end does so at once."""


def main(job_path: str, result_path: str) -> None:
    """Compute a set and say how it went."""
    job = json.loads(Path(job_path).read_bytes())
    # Of a crash, the stack. And an end, even where a library hangs that lets no other thread of Python run.
    faulthandler.enable()
    faulthandler.dump_traceback_later(job["timeout"] + ENOUGH, exit=True)
    # Whatever started the command may have SIGINT ignored, which children inherit.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    threading.Thread(target=_end_with_parent, daemon=True).start()

    found: dict[str, Any] = {"status": DONE}
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", UserWarning)
        try:
            _compute(job, found)
            _keep(job, {**found, "warnings": _texts(caught)})
        except (ValueError, RuntimeError, OSError, MemoryError) as error:
            found["status"] = REFUSED if isinstance(error, ValueError) else FAILED
            kind = "" if isinstance(error, (ValueError, RuntimeError)) else f"{type(error).__name__}: "
            found["reason"] = " ".join(f"{kind}{error}".split())
        except Exception as error:  # a bug, which should not take the other sets' time
            found["status"], found["log"] = FAILED, traceback.format_exc()[-2000:]
            found["reason"] = f"{type(error).__name__}: {error}"
    found["warnings"] = _texts(caught)
    write_atomically(Path(result_path), json.dumps(found).encode())


def _compute(job: dict[str, Any], found: dict[str, Any]) -> None:
    # Imported here, where an error of the import is told like others.
    from torch_modal.data.stored import write_set
    from torch_modal.keyframes.load import load_keyframes
    from torch_modal.precompute.modes import extract_bases

    files = [Path(file) for file in job["files"]]
    if twice := same_stems(files):
        raise MeshError(
            f"{twice[0].name} and {twice[1].name} have the same name; if they are one shape, keep one of them, and "
            "otherwise rename one"
        )
    keyframes, faces = load_keyframes(files)
    found["keyframes"], found["vertices"] = keyframes.shape[0], keyframes.shape[1]
    timeout = MESHER_SHARE * job["timeout"]
    bases = extract_bases(keyframes, faces, timeout=timeout, progress=False, **job["options"])
    write_set(job["folder"], keyframes, faces, bases, [file.name for file in files])


def _keep(job: dict[str, Any], found: dict[str, Any]) -> None:
    """Write down at once that the bases are there: the process that waits for this one may be killed before it can."""
    record = Record(**{**job["record"], **found})
    record = ended(record, DONE, record.reason)
    write_atomically(Path(job["record_file"]), record.line().encode())


def _texts(caught: list[warnings.WarningMessage]) -> list[str]:
    texts = (" ".join(str(one.message).split()) for one in caught if issubclass(one.category, UserWarning))
    return list(dict.fromkeys(texts))


def _end_with_parent() -> None:
    """Wait for the end of the pipe from the parent, then end this process and what it started."""
    while os.read(0, 1):  # not sys.stdin, whose lock would be missed at the interpreter's end
        pass
    _thread.interrupt_main()
    time.sleep(ENOUGH)
    os._exit(1)
