"""Progress of long computations: a bar on a terminal."""

import logging
import sys

from tqdm import tqdm

logger = logging.getLogger("torch_modal")

Progress = bool | None
"""A bar: True shows one, False none, None one on a terminal."""


class ProgressReport(tqdm):
    """A progress bar whose total may grow.

    Args:
        total: Number of steps; None if it is not known.
        what: Description of the work.
        progress: See :data:`Progress`.
        unit: Unit of the steps.
    """

    def __init__(self, total: int | None, what: str, progress: Progress = None, unit: str = "step") -> None:
        shown = sys.stderr is not None and sys.stderr.isatty() if progress is None else progress
        super().__init__(total=total, desc=what, unit=unit, leave=False, disable=not shown)

    def expect(self, steps: int) -> None:
        """Increase the total."""
        self.total += steps
        self.refresh()
