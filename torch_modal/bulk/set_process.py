"""The process that computes one set, seen from outside: started, watched, ended."""

import contextlib
import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any, NamedTuple

from torch_modal.bulk.records import CRASHED, FAILED, TIMEOUT
from torch_modal.io.processes import describe_exit, end_process, last_line

PACKAGE_ROOT = str(Path(__file__).resolve().parents[2])
BOOT = """\
import sys
root = sys.argv.pop(1)
if root not in sys.path:
    sys.path.insert(0, root)
from torch_modal.bulk._set_worker import main
main(*sys.argv[1:])
"""
COMMAND = [sys.executable, "-c", BOOT, PACKAGE_ROOT]
"""What is started, with the paths of the job and of the result after it."""
ONE_THREAD = dict.fromkeys(
    ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "VECLIB_MAXIMUM_THREADS", "NUMEXPR_NUM_THREADS"), "1"
)
GRACE = 5.0
"""Seconds between asking a process to end and killing it."""
LOG_TAIL = 2000


class Outcome(NamedTuple):
    """How a set's process ended."""

    status: str
    reason: str
    seconds: float
    details: dict[str, Any]
    """What the process said about the set."""
    log: str
    """The end of what it wrote, if it ended badly."""


class SetProcess:
    """One set in a fresh interpreter with one thread for linear algebra.

    It has a session of its own, so that Ctrl-C reaches this process alone, and a pipe from it, whose end tells it that
    this process is gone. Its temporary files lie in a folder that is removed with it.

    Args:
        job: What it is to do, see :mod:`torch_modal.bulk._set_worker`.
        timeout: Seconds after which it is ended.
    """

    def __init__(self, job: dict[str, Any], timeout: float) -> None:
        self._timeout = timeout
        self._scratch = Path(tempfile.mkdtemp(prefix="torch_modal-set-"))
        self._result, self._log = self._scratch / "result.json", self._scratch / "log.txt"
        job_file = self._scratch / "job.json"
        job_file.write_text(json.dumps({**job, "timeout": timeout}))
        self._started = time.monotonic()
        self._asked_to_end: float | None = None
        with self._log.open("wb") as log:
            self._process = subprocess.Popen(
                [*COMMAND, str(job_file), str(self._result)],
                stdin=subprocess.PIPE,
                stdout=log,
                stderr=subprocess.STDOUT,
                cwd=self._scratch,
                env={**os.environ, **ONE_THREAD, "TMPDIR": str(self._scratch)},
                start_new_session=True,
            )

    def poll(self) -> Outcome | None:
        """How it ended, or None while it runs. Call this often: it is what ends the process after its time."""
        code = self._process.poll()
        now = time.monotonic()
        if code is None and self._asked_to_end is None and now - self._started > self._timeout:
            self.ask_to_end()
        if code is None and (self._asked_to_end is None or now - self._asked_to_end < GRACE):
            return None
        seconds = (self._asked_to_end or now) - self._started
        end_process(self._process)
        try:
            return self._outcome(code, seconds)
        finally:
            self.close()

    def ask_to_end(self) -> None:
        """Interrupt it, so that it ends the mesher, which runs in a session of its own."""
        self._asked_to_end = time.monotonic()
        with contextlib.suppress(ProcessLookupError, OSError):
            self._process.send_signal(signal.SIGINT if os.name == "posix" else signal.SIGTERM)

    def close(self) -> None:
        """End it without waiting for a result."""
        if self._asked_to_end is None:
            self.ask_to_end()
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(max(self._asked_to_end + GRACE - time.monotonic(), 0) if self._asked_to_end else 0)
        end_process(self._process)
        if self._process.stdin is not None:
            self._process.stdin.close()
        shutil.rmtree(self._scratch, ignore_errors=True)

    def _outcome(self, code: int | None, seconds: float) -> Outcome:
        log = self._log.read_text(errors="replace")[-LOG_TAIL:]
        with contextlib.suppress(OSError, ValueError):
            details = json.loads(self._result.read_bytes())
            return Outcome(details.pop("status"), details.pop("reason", ""), seconds, details, details.pop("log", ""))
        if self._asked_to_end is not None or code is None:
            return Outcome(TIMEOUT, f"no result after the timeout of {self._timeout:g} s", seconds, {}, log)
        if code < 0:
            hint = "; perhaps memory ran out" if -code == signal.SIGKILL else ""
            return Outcome(CRASHED, f"its process ended with {describe_exit(code)}{hint}", seconds, {}, log)
        said = last_line(log)
        why = f"its process ended with {describe_exit(code)} and no result" + (f" ({said})" if said else "")
        return Outcome(FAILED, why, seconds, {}, log)
