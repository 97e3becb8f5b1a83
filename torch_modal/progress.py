"""What long work says while it goes on: a bar on a terminal, lines of the log elsewhere, or a callback."""

import logging
import sys
import threading
import time
from collections.abc import Callable
from types import TracebackType
from typing import Any

from tqdm import tqdm

logger = logging.getLogger("torch_modal")

Progress = bool | None | Callable[[int, int, str], object]
"""None: a bar on a terminal, and elsewhere a line of the log (level INFO) every few seconds. True: a bar. False:
nothing. A function: called with what is done, the total, and what goes on; what it raises ends the work."""

SECONDS_BETWEEN_LINES = 5.0


class ProgressReport:
    """Steps of long work, reported as the caller wants; from several threads if need be.

    Args:
        total: Number of steps.
        what: What goes on.
        progress: See :data:`Progress`.
        unit: What a step is, for the bar.
    """

    def __init__(self, total: int, what: str, progress: Progress = None, unit: str = "step") -> None:
        self.total, self.what, self.done = total, what, 0
        self._callback = progress if callable(progress) else None
        wants_bar = progress is True or (progress is None and sys.stderr is not None and sys.stderr.isatty())
        self._bar: Any = tqdm(total=total, desc=what, unit=unit, leave=False) if wants_bar else None
        self._logs = progress is None and not wants_bar
        self._said = time.monotonic()
        self._lock = threading.Lock()

    def expect(self, steps: int) -> None:
        """There are more steps than was known."""
        with self._lock:
            self.total += steps
            if self._bar is not None:
                self._bar.total = self.total
                self._bar.refresh()

    def describe(self, what: str) -> None:
        """Say what goes on now."""
        with self._lock:
            self.what = what
            if self._bar is not None:
                self._bar.set_description(what)
            self._tell()

    def update(self, steps: int = 1) -> None:
        """Some steps are done."""
        with self._lock:
            self.done += steps
            if self._bar is not None:
                self._bar.update(steps)
            self._tell()

    def _tell(self) -> None:
        if self._callback is not None:
            self._callback(self.done, self.total, self.what)
        elif self._logs and time.monotonic() - self._said >= SECONDS_BETWEEN_LINES:
            self._said = time.monotonic()
            logger.info("%s (%d of %d)", self.what, self.done, self.total)

    def __enter__(self) -> "ProgressReport":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, where: TracebackType | None
    ) -> None:
        if self._bar is not None:
            self._bar.close()
