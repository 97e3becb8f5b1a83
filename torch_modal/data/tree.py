"""Key-frame sets and mesh files of a folder tree."""

import os
import re
from pathlib import Path

from torch_modal.io.read import SUFFIXES

MESH_SUFFIXES = (*SUFFIXES, ".stl")
"""STL cannot serve as a key-frame; it is listed so that its set is refused with a reason."""


def find_keyframe_sets(root: Path, skip: Path | None = None) -> tuple[list[str], dict[str, str]]:
    """Walk a folder tree.

    Skips hidden files and folders (a dot before the name). Follows links to folders, except to a parent.

    Args:
        root: Start of the walk.
        skip: A folder that is not entered, such as the results of an earlier run.

    Returns:
        Paths below the root, with ``/`` between the parts: the folders that directly hold two or more mesh files, in
        natural order; and other folders, with one mesh or unreadable, with the reason why they are no sets.

    Raises:
        OSError: The root cannot be read.
    """
    os.listdir(root)  # os.walk does not report a missing root
    sets: list[str] = []
    left_out: dict[str, str] = {}

    def unreadable(error: OSError) -> None:
        left_out[Path(error.filename).relative_to(root).as_posix()] = f"cannot be read: {error.strerror}"

    passed = skip.resolve() if skip is not None else None
    for place, below, _ in os.walk(root, onerror=unreadable, followlinks=True):
        folder = Path(place)
        above = {folder.resolve(), *folder.resolve().parents}
        below[:] = [name for name in below if not name.startswith(".")]
        below[:] = [name for name in below if (folder / name).resolve() not in above | {passed}]
        name, meshes = folder.relative_to(root).as_posix(), mesh_files(folder)
        if len(meshes) > 1:
            sets.append(name)
        elif meshes:
            left_out[name] = f"holds one mesh only, {meshes[0].name}; a set needs two or more"
    return sorted(sets, key=natural), left_out


def mesh_files(folder: Path) -> list[Path]:
    """The mesh files that lie directly in a folder, in natural order of their names."""
    names = [name for name in os.listdir(folder) if not name.startswith(".") and os.path.isfile(folder / name)]
    return [folder / name for name in sorted(names, key=natural) if Path(name).suffix.lower() in MESH_SUFFIXES]


def natural(name: str) -> list[tuple[list[str | int], str]]:
    """A sort key: ``frame-2`` before ``frame-10``, a folder before its contents."""
    return [
        ([int(chunk) if i % 2 else chunk.casefold() for i, chunk in enumerate(re.split(r"([0-9]+)", level))], level)
        for level in name.split("/")
    ]
