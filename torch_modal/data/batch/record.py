"""How work on a set of a folder tree went: a file in the set's folder, and a line of the report."""

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
    """How work on a set went; ``docs/precompute.md`` says what the fields are."""

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
        """The same with its end."""
        now = datetime.now().astimezone().isoformat("T", "seconds")
        return replace(self, status=status, reason=reason or self.reason, finished=now, **details)

    def line(self) -> bytes:
        """One line of JSON, without what is empty."""
        return json.dumps({name: value for name, value in asdict(self).items() if value}).encode() + b"\n"

    def what_changed(self, new: "Record") -> str:
        """Why a set has to be done again; nothing if this record still speaks of the same files and settings."""
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
    """SHA-256 of the names and the content of a set's files, and of the buffers that lie beside those of glTF.

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
