"""Child processes that may crash or hang: running them, and errors that say how they ended."""

import contextlib
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Sequence
from pathlib import Path

from torch_modal.threads import StoppedError

POLL = 0.5
HINTS = {"signal SIGKILL": "perhaps memory ran out", "signal SIGXCPU": "its processor_time is over"}
"""Causes of signals that leave no message."""


class ChildError(RuntimeError):
    """A child process was killed after its timeout, or ended with an error."""


def package_command(function: str) -> list[str]:
    """Command of a new interpreter that calls a function of this package, named as ``module:function``."""
    program = "import sys, pkgutil; sys.path[:0] = {sys.argv[1]} - {*sys.path}; pkgutil.resolve_name(sys.argv[2])()"
    return [sys.executable, "-c", program, str(Path(__file__).resolve().parents[2]), function]


def run_child(
    command: Sequence[str],
    folder: Path,
    timeout: float,
    stop: threading.Event | None = None,
    job: bytes = b"",
    environment: dict[str, str] | None = None,
) -> None:
    """Run a program in a folder until it ends.

    The program leads a session of its own, which is killed as a whole, so that Ctrl-C reaches this process alone. Its
    standard input holds the job, and is closed when this process ends.

    Args:
        command: The program and its arguments.
        folder: The working directory, which also gets the output as ``log.txt``.
        timeout: Seconds until the program is killed.
        stop: Event that also ends the program.
        job: Content of its standard input.
        environment: Its environment variables; by default this process's.

    Raises:
        ChildError: The program ended with an error, or after the timeout.
        StoppedError: ``stop`` was set.
    """
    stop, end, code = stop or threading.Event(), time.monotonic() + timeout, None
    with (folder / "log.txt").open("wb") as log:  # a full pipe would block it
        process = subprocess.Popen(
            command,
            stdin=subprocess.PIPE,
            stdout=log,
            stderr=subprocess.STDOUT,
            cwd=folder,
            env=environment,
            start_new_session=True,
        )
    try:
        assert process.stdin is not None
        with contextlib.suppress(BrokenPipeError):  # it ended at once; its exit status says more
            process.stdin.write(job)
            process.stdin.flush()
        # Polled, as Ctrl-C cannot interrupt a single wait on every platform.
        while code is None and (left := end - time.monotonic()) > 0 and not stop.is_set():
            with contextlib.suppress(subprocess.TimeoutExpired):
                code = process.wait(min(POLL, left))
    finally:
        if process.poll() is None:
            with contextlib.suppress(ProcessLookupError, PermissionError):
                os.killpg(process.pid, signal.SIGKILL) if hasattr(os, "killpg") else process.kill()
        with contextlib.suppress(OSError):
            process.communicate()  # closes the pipe
    if code is None and stop.is_set():
        raise StoppedError
    if code is None:
        raise ChildError(f"no result after the timeout of {timeout:g} s")
    if code:
        lines = (folder / "log.txt").read_text(errors="replace").split("\n")
        last = next((line.strip() for line in reversed(lines) if line.strip()), "")  # of a traceback, the error
        status = f"signal {signal.Signals(-code).name}" if code < 0 else f"exit code {code}"
        hint = HINTS.get(status, last)
        raise ChildError(f"its process ended with {status}" + (f" ({hint})" if hint else ""))
