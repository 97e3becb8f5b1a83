"""What is said about many sets: a bar on terminals, a line for each set elsewhere, and the summary."""

import sys
import time
from collections.abc import Callable, Mapping, Sequence

from tqdm import tqdm

from torch_modal.bulk.records import DONE, Record
from torch_modal.bulk.sharing import Counts

SHOWN = 20
"""Sets that the summary names, of each kind; the report has them all."""
REFRESH = 0.5


class Progress:
    """Says how far the work is.

    Args:
        total: Number of sets.
        say: Takes lines.
        bar: Whether a bar shows the rate and the time left. Otherwise lines do, one for each set that was computed.
    """

    def __init__(self, total: int, say: Callable[[str], None] = print, *, bar: bool = False) -> None:
        self._say, self._total = say, total
        self._started = self._shown = time.monotonic()
        self._bar = tqdm(
            total=total, unit="set", smoothing=0, leave=False, dynamic_ncols=True, disable=not bar, file=sys.stderr
        )

    @property
    def seconds(self) -> float:
        """Since the start."""
        return time.monotonic() - self._started

    def settled(self, record: Record, counts: Counts) -> None:
        """Say how a set went."""
        done = record.status == DONE
        if done and not self._bar.disable and not record.reason:
            return
        what = f"{record.keyframes} key-frames of {record.vertices:,} vertices" if done else record.reason
        again = f" ({record.reason})" if done and record.reason else ""
        line = f"[{counts.settled}/{self._total}] {record.status} {printable(record.set)}{again}: {what}"
        line += f", {record.seconds:.1f} s" if record.seconds else ""
        if not self._bar.disable:
            self._bar.clear()
        self._say(line if not self._bar.disable else line + self._pace(counts))

    def show(self, counts: Callable[[], Counts]) -> None:
        """Bring the bar up to date, now and then.

        Args:
            counts: Asked for only if it is time.
        """
        if self._bar.disable or time.monotonic() - self._shown < REFRESH:
            return
        self._shown = time.monotonic()
        found = counts()
        # Sets of an earlier run took no time: with them, the rate would promise too much.
        self._bar.n, self._bar.initial = found.settled, found.skipped
        self._bar.refresh()

    def close(self) -> None:
        """Remove the bar."""
        self._bar.close()

    def _pace(self, counts: Counts) -> str:
        """``; 31 sets a minute, 02:10 left``."""
        computed = counts.settled - counts.skipped
        left = self._total - counts.settled
        if not left or computed < 1:
            return ""
        rate = computed / max(self.seconds, 1e-3)
        return f"; {60 * rate:.3g} sets a minute, {tqdm.format_interval(left / rate)} left"


def summary(
    found: Sequence[Record], left_out: Mapping[str, str], counts: Counts, seconds: float, report: object
) -> list[str]:
    """Lines to print at the end.

    Args:
        found: A record for each set.
        left_out: Folders that are no sets, and why.
        counts: What was settled in this run and before.
        seconds: How long this run took.
        report: Where the report is.
    """
    bad = [record for record in found if record.status != DONE]
    n_now = counts.settled - counts.skipped
    lines = [
        f"{len(found) - len(bad)} of {len(found)} sets have their bases; {n_now} were worked on now, in {seconds:.0f} s"
        + (f", {counts.skipped} earlier" if counts.skipped else "")
    ]
    if bad:
        lines.append(f"{len(bad)} have none:")
        width = max(len(record.status) for record in bad[:SHOWN])
        for record in bad[:SHOWN]:
            took = f" ({record.seconds:.1f} s)" if record.seconds else ""
            lines.append(f"  {record.status:{width}}  {printable(record.set)}: {record.reason}{took}")
    lines += _and_more(bad)
    warned = [record for record in found if record.status == DONE and record.warnings]
    if warned:
        lines.append(f"{len(warned)} have them with a warning:")
        lines += [f"  {printable(record.set)}: {record.warnings[0]}" for record in warned[:SHOWN]] + _and_more(warned)
    if left_out:
        lines.append(f"{len(left_out)} folders were left out:")
        some = list(left_out.items())
        lines += [f"  {printable(name)}: {why}" for name, why in some[:SHOWN]] + _and_more(some)
    return [*lines, f"report: {report}"]


def _and_more(listed: Sequence[object]) -> list[str]:
    return [f"  and {len(listed) - SHOWN} more, in the report"] if len(listed) > SHOWN else []


def printable(name: str) -> str:
    """A name that any terminal can show; names of folders may hold anything but a slash."""
    text = name.encode("utf-8", "backslashreplace").decode()
    return text if text.isprintable() else repr(text)
