"""Progress of long computations: a bar on a terminal."""

import logging
import sys
import threading
from types import TracebackType

from tqdm import tqdm

logger = logging.getLogger("torch_modal")

Progress = bool | None
"""A bar: True shows one, False none, None one on a terminal."""


class ProgressReport:
    """A progress bar that several threads may update, and whose clock goes on during a long step.

    Args:
        total: Number of steps.
        what: Description of the work.
        progress: See :data:`Progress`.
        unit: Unit of the steps.
    """

    def __init__(self, total: int, what: str, progress: Progress = None, unit: str = "step") -> None:
        shown = sys.stderr is not None and sys.stderr.isatty() if progress is None else progress
        self._bar = tqdm(total=total, desc=what, unit=unit, leave=False, disable=not shown)
        self._lock, self._closed = threading.Lock(), threading.Event()
        if shown:
            threading.Thread(target=self._tick, daemon=True).start()

    def _tick(self) -> None:
        while not self._closed.wait(1.0):
            self.expect(0)

    def expect(self, steps: int) -> None:
        """Increase the total."""
        with self._lock:
            self._bar.total += steps
            self._bar.refresh()

    def describe(self, what: str) -> None:
        """Change the description."""
        with self._lock:
            self._bar.set_description(what)

    def update(self, steps: int = 1) -> None:
        """Add completed steps."""
        with self._lock:
            self._bar.update(steps)

    def __enter__(self) -> "ProgressReport":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, where: TracebackType | None
    ) -> None:
        self._closed.set()
        with self._lock:
            self._bar.close()
