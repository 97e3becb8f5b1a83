"""What is known of each set: a small file of its own in the output folder, and the report that all of them make.

Each record is written by those who work on its set alone, and moved into place whole: several machines never write to
one file.
"""

import contextlib
import hashlib
import json
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, field, replace
from datetime import datetime
from pathlib import Path
from typing import Any

from torch_modal.io.files import write_atomically

STATE = ".precompute"
REPORT = "precompute-report.jsonl"

STARTED, DONE, REFUSED, FAILED, CRASHED, TIMEOUT = "started", "done", "refused", "failed", "crashed", "timeout"
NOT_DONE = (REFUSED, FAILED, CRASHED, TIMEOUT)
UNFINISHED, LEFT_OUT = "unfinished", "left out"


@dataclass(frozen=True)
class Record:
    """How work on a set went.

    Attributes:
        set: Name of the set: the path of its folder below the root.
        status: ``done``; ``refused`` (the input cannot work), ``failed`` (an error), ``crashed`` (a signal ended the
            process), ``timeout``; ``started``, which stays if the work was interrupted.
        reason: Why it is not done, or why it was done again.
        output: Place of its bases below the output folder.
        seconds: From the start of its process to the end.
        keyframes: Number of key-frames, K.
        vertices: Number of vertices, V.
        files: Names of the files, in the order of the key-frames.
        warnings: What was wrong with the input but did not prevent a result.
        log: The end of what the process wrote, if it ended badly.
        inputs: Hash of the files' names and content.
        parameters: What else the bases depend on.
        finished: When, ISO 8601 with the time zone.
        host: Name of the machine.
        ours: Whether what stands at its place was written by this command, or nothing stood there.
    """

    set: str
    status: str
    reason: str = ""
    output: str = ""
    seconds: float = 0.0
    keyframes: int = 0
    vertices: int = 0
    files: list[str] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)
    log: str = ""
    inputs: str = ""
    parameters: dict[str, Any] = field(default_factory=dict)
    finished: str = ""
    host: str = ""
    ours: bool = False

    def line(self) -> str:
        """One line of JSON, without what is empty."""
        return json.dumps({name: value for name, value in asdict(self).items() if value})


def ended(record: Record, status: str, reason: str) -> Record:
    """A record with its end."""
    return replace(record, status=status, reason=reason, finished=datetime.now().astimezone().isoformat("T", "seconds"))


class Records:
    """The records of an output folder.

    Args:
        out: The output folder.
    """

    def __init__(self, out: Path) -> None:
        self.out = out
        self.state = out / STATE
        self._sets = self.state / "sets"

    def prepare(self) -> None:
        """Make the folders."""
        self._sets.mkdir(parents=True, exist_ok=True)

    def read(self, place: str) -> Record | None:
        """The record of the set at a place below the output folder; None if there is none that can be read."""
        with contextlib.suppress(OSError, ValueError, TypeError):
            return Record(**json.loads(self.file(place).read_bytes()))
        return None

    def write(self, record: Record) -> None:
        """Keep a record, in place of the earlier one of its place.

        Raises:
            OSError: It cannot be written.
        """
        write_atomically(self.file(record.output), record.line().encode())

    def file(self, place: str) -> Path:
        """The file with the record of the set at a place below the output folder."""
        # Names of folders may be longer than a file's may be with a suffix, and hold anything.
        return self._sets / (hashlib.sha256(place.encode("utf-8", "surrogateescape")).hexdigest()[:40] + ".json")

    @property
    def report(self) -> Path:
        """The file with a line of JSON for each set."""
        return self.out / REPORT

    def is_own_report(self) -> bool:
        """Whether the report may be replaced: it is none, or one of ours."""
        if not self.report.exists():
            return True
        try:
            with self.report.open("rb") as file:
                first = file.readline()
            return not first or {"set", "status"} <= json.loads(first).keys()
        except (OSError, ValueError, AttributeError):
            return False

    def write_report(self, places: dict[str, str], left_out: dict[str, str]) -> list[Record]:
        """Gather the records of all sets into the report.

        Args:
            places: Sets and their places below the output folder.
            left_out: Folders that are no sets, and why.

        Returns:
            The records of the sets; those without a result have the status ``unfinished``.
        """
        found = []
        for name, place in places.items():
            record = self.read(place)
            if record is None or record.status == STARTED:
                record = Record(name, UNFINISHED, "not reached, or interrupted", output=place)
            found.append(replace(record, set=name))
        lines = [record.line() for record in (*found, *(Record(*item) for item in _with_status(left_out)))]
        write_atomically(self.report, "".join(line + "\n" for line in lines).encode())
        return found


def _with_status(left_out: dict[str, str]) -> Iterable[tuple[str, str, str]]:
    return ((name, LEFT_OUT, why) for name, why in left_out.items())


def inputs_key(files: Sequence[Path]) -> str:
    """SHA-256 of the names and the content of a set's files.

    The buffers of a GLTF file lie in files beside it, so those count too.

    Raises:
        OSError: A file cannot be read.
    """
    listed = list(files)
    if any(file.suffix.lower() == ".gltf" for file in listed):
        listed += sorted(file for file in listed[0].parent.glob("*.bin") if file.is_file())
    total = hashlib.sha256()
    for file in listed:
        one = hashlib.sha256(file.name.encode("utf-8", "surrogateescape"))
        with file.open("rb") as content:
            while block := content.read(1 << 20):
                one.update(block)
        total.update(one.digest())
    return total.hexdigest()


def stamp(files: Sequence[Path]) -> list[tuple[str, int, int]]:
    """Names, sizes and times of files: what shows that somebody wrote to them meanwhile."""
    stats = [(file.name, file.stat()) for file in files]
    return [(name, stat.st_size, stat.st_mtime_ns) for name, stat in stats]


def what_changed(record: Record, inputs: str, parameters: dict[str, Any]) -> str:
    """Why a set with an earlier result has to be done again; nothing if that result still holds."""
    reasons = []
    if record.inputs != inputs:
        reasons.append("its files changed")
    for name in sorted(record.parameters.keys() | parameters.keys()):
        old, new = record.parameters.get(name), parameters.get(name)
        if old != new:
            reasons.append(f"{name} changed from {old} to {new}")
    return ", ".join(reasons)
