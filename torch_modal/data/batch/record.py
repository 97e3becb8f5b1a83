"""The record of a set of a folder tree: a file in the set's folder, and a line of the report."""

import contextlib
import hashlib
import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from datetime import datetime
from pathlib import Path
from typing import Any

DONE, REFUSED, FAILED, CRASHED, TIMEOUT = "done", "refused", "failed", "crashed", "timeout"
UNFINISHED, LEFT_OUT = "unfinished", "left out"


@dataclass(frozen=True)
class Record:
    """State and result of a set; ``docs/precompute.md`` describes the fields."""

    set: str
    status: str = UNFINISHED
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

    def ended(self, status: str, reason: str = "", **details: Any) -> "Record":
        """A copy with its final status."""
        now = datetime.now().astimezone().isoformat("T", "seconds")
        return replace(self, status=status, reason=reason or self.reason, finished=now, **details)

    def line(self) -> bytes:
        """One line of JSON, without empty fields."""
        return json.dumps({name: value for name, value in asdict(self).items() if value}).encode() + b"\n"

    def what_changed(self, new: "Record") -> str:
        """Why a set must be computed again; empty if files and settings are the same."""
        reasons = [] if self.inputs == new.inputs else ["its files changed"]
        for name, now in new.parameters.items():
            if (before := self.parameters.get(name)) != now:
                reasons.append(f"{name} changed from {before} to {now}")
        return ", ".join(reasons)


def read_record(file: Path) -> Record | None:
    """The record in a file; None if there is none that can be read."""
    with contextlib.suppress(OSError, ValueError, TypeError):
        return Record(**json.loads(file.read_bytes()))
    return None


def inputs_key(files: Sequence[Path]) -> str:
    """SHA-256 of the names and the content of a set's files, and of the buffers beside its glTF files.

    Raises:
        OSError: A file cannot be read.
    """
    gltf = [file for file in files if file.suffix.lower() == ".gltf"]
    buffers = sorted(file for file in gltf[0].parent.glob("*.bin") if file.is_file()) if gltf else []
    total = hashlib.sha256()
    for file in (*files, *buffers):
        for part in (file.name.encode("utf-8", "surrogateescape"), file.read_bytes()):
            total.update(hashlib.sha256(part).digest())
    return total.hexdigest()
