"""Key-frame sets of a folder tree, and the folders of their bases."""

import os
import re
from collections.abc import Sequence
from pathlib import Path, PurePosixPath
from typing import NamedTuple

from torch_modal.io.read import SUFFIXES

MESH_SUFFIXES = (*SUFFIXES, ".stl")
"""STL cannot serve as a key-frame; it is listed so that its set is refused with a reason."""
ROOT = "."
"""Name of the set whose files lie in the root itself."""


class Tree(NamedTuple):
    """Sets and other folders below a folder.

    Names of sets are their folders' paths below the root, with ``/`` between the parts.
    """

    sets: list[str]
    """Folders that directly hold two or more mesh files, in natural order."""
    left_out: dict[str, str]
    """Folders with one mesh or unreadable ones, and why they are no sets."""


def find_keyframe_sets(root: Path, skip: Path | None = None) -> Tree:
    """Walk a folder tree.

    Skips hidden files and folders (a dot before the name). Follows links to folders, except to a parent.

    Args:
        root: Where to start.
        skip: A folder that is not entered, such as the results of an earlier run.

    Raises:
        OSError: The root cannot be read.
    """
    os.listdir(root)  # os.walk does not report a missing root
    tree = Tree([], {})

    def unreadable(error: OSError) -> None:
        tree.left_out[_name(Path(error.filename), root)] = f"cannot be read: {error.strerror}"

    passed = skip.resolve() if skip is not None else None
    for place, below, _ in os.walk(root, onerror=unreadable, followlinks=True):
        folder = Path(place)
        above = {folder.resolve(), *folder.resolve().parents}
        below[:] = [name for name in below if not name.startswith(".")]
        below[:] = [name for name in below if (folder / name).resolve() not in above | {passed}]
        meshes = mesh_files(folder)
        if len(meshes) > 1:
            tree.sets.append(_name(folder, root))
        elif meshes:
            tree.left_out[_name(folder, root)] = f"holds one mesh only, {meshes[0].name}; a set needs two or more"
    tree.sets.sort(key=natural)
    return tree


def mesh_files(folder: Path) -> list[Path]:
    """The mesh files that lie directly in a folder, in natural order of their names.

    Raises:
        OSError: The folder cannot be read.
    """
    with os.scandir(folder) as entries:
        names = [entry.name for entry in entries if not entry.name.startswith(".") and entry.is_file()]
    return [folder / name for name in sorted(names, key=natural) if Path(name).suffix.lower() in MESH_SUFFIXES]


def places(names: Sequence[str], root: Path) -> dict[str, str]:
    """The folder of each set's bases, as a path below the output folder.

    It is the set's own name, so that the output mirrors the tree. A folder with sets below it cannot hold the files of
    a set too, and the output folder itself holds the report: such a set goes one level deeper, into a folder of the
    same name, with ``_`` after it if that name is taken.
    """
    above = {str(parent) for name in names for parent in PurePosixPath(name).parents if name != ROOT}
    taken = above | set(names)
    found = {}
    for name in names:
        place = name
        if name in above or name == ROOT:
            own = root.resolve().name or "root"
            place = own if name == ROOT else f"{name}/{PurePosixPath(name).name}"
            while place in taken:
                place += "_"
        found[name] = place
    return found


def natural(name: str) -> list[tuple[list[str | int], str]]:
    """A sort key: ``frame-2`` before ``frame-10``, a folder before its contents."""
    return [
        ([int(part) if i % 2 else part.casefold() for i, part in enumerate(re.split(r"([0-9]+)", level))], level)
        for level in name.split("/")
    ]


def printable(name: str) -> str:
    """A name as one line of a terminal can show it; names of folders may hold anything but a slash."""
    text = name.encode("utf-8", "backslashreplace").decode()
    return text if text.isprintable() else repr(text)


def _name(folder: Path, root: Path) -> str:
    return folder.relative_to(root).as_posix()
