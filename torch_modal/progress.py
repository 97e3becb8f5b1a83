"""Progress of long computations: a bar on a terminal, log lines elsewhere, or a callback."""

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
nothing. A function: called with the completed steps, the total and a description; its exceptions stop the work."""

SECONDS_BETWEEN_LINES = 5.0


class ProgressReport:
    """Thread-safe progress reports.

    Args:
        total: Number of steps.
        what: Description of the work.
        progress: See :data:`Progress`.
        unit: Unit of the steps in the bar.
    """

    def __init__(self, total: int, what: str, progress: Progress = None, unit: str = "step") -> None:
        self.total, self.what, self.done = total, what, 0
        self._callback = progress if callable(progress) else None
        wants_bar = progress is True or (progress is None and sys.stderr is not None and sys.stderr.isatty())
        self._bar: Any = tqdm(total=total, desc=what, unit=unit, leave=False) if wants_bar else None
        self._logs = progress is None and not wants_bar
        self._reported_at = time.monotonic()
        self._lock = threading.Lock()

    def expect(self, steps: int) -> None:
        """Increase the total."""
        with self._lock:
            self.total += steps
            if self._bar is not None:
                self._bar.total = self.total
                self._bar.refresh()

    def describe(self, what: str) -> None:
        """Change the description."""
        with self._lock:
            self.what = what
            if self._bar is not None:
                self._bar.set_description(what)
            self._report()

    def update(self, steps: int = 1) -> None:
        """Report completed steps."""
        with self._lock:
            self.done += steps
            if self._bar is not None:
                self._bar.update(steps)
            self._report()

    def _report(self) -> None:
        if self._callback is not None:
            self._callback(self.done, self.total, self.what)
        elif self._logs and time.monotonic() - self._reported_at >= SECONDS_BETWEEN_LINES:
            self._reported_at = time.monotonic()
            logger.info("%s (%d of %d)", self.what, self.done, self.total)

    def __enter__(self) -> "ProgressReport":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, where: TracebackType | None
    ) -> None:
        if self._bar is not None:
            self._bar.close()
