"""Child processes that may crash or hang: how they ended, and how to end them."""

import contextlib
import os
import signal
import subprocess


def end_process(process: subprocess.Popen[bytes]) -> None:
    """Kill a process that leads a session of its own, and all its children; wait for its exit status."""
    if process.poll() is not None:
        return
    with contextlib.suppress(ProcessLookupError, PermissionError):
        if hasattr(os, "killpg"):
            os.killpg(process.pid, signal.SIGKILL)
        else:
            process.kill()
    process.wait()


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
