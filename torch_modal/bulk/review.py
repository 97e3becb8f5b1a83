"""What has to be done with a set: nothing, because it has a result that still holds; work; or a refusal."""

import os
import re
import shutil
import socket
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

from torch_modal.bulk import records as r
from torch_modal.bulk.records import Record, Records
from torch_modal.bulk.tree import mesh_files
from torch_modal.data.stored import BASES_FILE, DERIVED_FILES, KEYFRAMES_FILE, open_set
from torch_modal.precompute.cache import CACHE_VERSION
from torch_modal.precompute.modes import QUALITIES


@dataclass(frozen=True)
class Options:
    """How a tree is worked on.

    Attributes:
        n_modes: Elastic modes of each key-frame.
        mesher: As for `extract_bases`.
        quality: As for `extract_bases`: ``"fast"`` or ``"fine"``.
        timeout: Seconds for each set; the mesher may take half of them.
        workers: Sets at a time in this process; None: one for each processor of the machine.
        retry: Whether sets that failed before are tried again.
        overwrite: Whether stored sets that an earlier run did not write are replaced.
        cache_dir: Where tetrahedra and modes are kept as well; None keeps nothing but the results.
    """

    n_modes: int = 30
    mesher: str = "auto"
    quality: str = "fast"
    timeout: float = 600.0
    workers: int | None = None
    retry: bool = False
    overwrite: bool = False
    cache_dir: str | None = None

    def parameters(self) -> dict[str, Any]:
        """What the bases depend on besides the files."""
        settings = asdict(QUALITIES[self.quality])
        return {"n_modes": self.n_modes, "mesher": self.mesher, "settings": settings, "algorithm": CACHE_VERSION}


class Task(NamedTuple):
    """A set that is to be computed."""

    record: Record
    """With the status ``started``."""
    files: list[Path]
    """Its key-frames, in their order."""
    stamp: list[tuple[str, int, int]]
    """The files as they were when their content was hashed."""


class Settled(NamedTuple):
    """A set on which nothing is to be done."""

    record: Record
    """How it stands."""
    before: bool
    """Whether an earlier run settled it."""


class Review:
    """Compares the sets with what is known of them.

    Args:
        root: The folder tree.
        out: The output folder.
        options: What is asked for.
        places: Sets and their places below the output folder.
        records: What is known.
    """

    def __init__(self, root: Path, out: Path, options: Options, places: dict[str, str], records: Records) -> None:
        self._root, self._out, self._options, self._places, self._records = root, out, options, places, records
        self._parameters = options.parameters()

    def look_at(self, name: str) -> Task | Settled:
        """What is to be done with a set. Reads all of its files."""
        place = self._places[name]
        before = self._records.read(place)
        new = Record(name, r.STARTED, output=place, parameters=self._parameters, host=socket.gethostname())
        new = replace(new, ours=before is not None and before.ours)
        try:
            files = mesh_files(self._root / name)
            stamp = r.stamp(files)
            new = replace(new, inputs=r.inputs_key(files), files=[file.name for file in files])
        except OSError as error:
            return Settled(r.ended(new, r.FAILED, f"its files cannot be read: {error}"), False)
        if before is not None and before.inputs:
            why = r.what_changed(before, new.inputs, new.parameters) or self._why_again(before)
            if not why:
                return Settled(before, True)
            new = replace(new, reason=why)
        if obstacle := self._obstacle(self._out / place, new.ours):
            return Settled(r.ended(replace(new, inputs=""), r.REFUSED, obstacle), False)
        if before is not None and before.status == r.STARTED:
            _remove_leftovers(self._out / place)
        return Task(replace(new, ours=True), files, stamp)

    def _why_again(self, before: Record) -> str:
        """Why a set is worked on again though nothing changed; nothing if it is not."""
        if before.status == r.STARTED:
            return "it was interrupted"
        if before.status != r.DONE:
            return f"tried again after: {before.reason}" if self._options.retry else ""
        try:
            stored = open_set(self._out / before.output)
        except (OSError, ValueError) as error:
            return f"its bases are gone or damaged: {error}"
        same = (len(stored), stored.n_vertices) == (before.keyframes, before.vertices)
        return "" if same else "its bases are those of other key-frames"

    def _obstacle(self, folder: Path, ours: bool) -> str:
        """What is in the way of the bases; files of the user are never touched, stored sets only if asked."""
        if not os.path.lexists(folder):
            return ""
        if not folder.is_dir():
            return f"{folder} exists and is no folder; move it away"
        there = {path.name for path in folder.iterdir()}
        others = sorted(there - {KEYFRAMES_FILE, BASES_FILE})
        if others := [name for name in others if not Path(name).match(DERIVED_FILES)]:
            return f"{folder} also holds {others[0]}, which is no part of a stored set; move it away"
        if there and not ours and not self._options.overwrite:
            return f"{folder} holds a stored set that this command did not write; --overwrite replaces it"
        return ""


def _remove_leftovers(folder: Path) -> None:
    """Remove what a killed process left beside the place it wrote to. Nobody else works on this set."""
    mark = re.compile(rf"\.{re.escape(folder.name)}\.\d+-[0-9a-f]{{8}}\.(old\.)?tmp")
    if folder.parent.is_dir():
        for path in folder.parent.iterdir():
            if mark.fullmatch(path.name):
                shutil.rmtree(path, ignore_errors=True)
