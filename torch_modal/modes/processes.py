"""Child processes that may crash or hang: running them, and how they ended."""

import contextlib
import os
import signal
import subprocess
import threading
import time
from collections.abc import Sequence
from pathlib import Path

POLL = 0.5


def run_child(
    command: Sequence[str],
    folder: Path,
    timeout: float,
    stop: threading.Event,
    job: bytes = b"",
    environment: dict[str, str] | None = None,
    grace: float = 0.0,
) -> tuple[int | None, str]:
    """Run a program in a folder, until it ends, its seconds are over, or ``stop`` is set.

    It leads a session of its own, which is killed as a whole, so that Ctrl-C reaches this process alone; what it reads,
    first the job, ends with this process. With a ``grace``, it is interrupted so many seconds before it is killed.

    Returns:
        Its exit status, None if it was killed; and its output.
    """
    end, code = time.monotonic() + timeout, None
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
        if grace and process.poll() is None:
            process.send_signal(signal.SIGINT if os.name == "posix" else signal.SIGTERM)
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(grace)
        if process.poll() is None:
            with contextlib.suppress(ProcessLookupError, PermissionError):
                os.killpg(process.pid, signal.SIGKILL) if hasattr(os, "killpg") else process.kill()
        with contextlib.suppress(OSError):
            process.communicate()  # closes the pipe
    return code, (folder / "log.txt").read_text(errors="replace")


def describe_exit(code: int) -> str:
    """``exit code 1`` or ``signal SIGSEGV``."""
    if code >= 0:
        return f"exit code {code}"
    try:
        return f"signal {signal.Signals(-code).name}"
    except ValueError:
        return f"signal {-code}"


def last_line(text: str) -> str:
    """The last line that is not blank; of a traceback, the error."""
    return next((line.strip() for line in reversed(text.splitlines()) if line.strip()), "")
