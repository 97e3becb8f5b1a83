"""Key-frame sets and mesh files of a folder tree."""

import os
import re
from pathlib import Path

from torch_modal.io.read import SUFFIXES


def find_keyframe_sets(root: Path, skip: Path) -> tuple[list[str], list[str]]:
    """Walk a folder tree.

    Skips hidden files and folders (a dot before the name). Follows links to folders, except to a parent.

    Args:
        root: Start of the walk.
        skip: A folder that is not entered: the results of an earlier run.

    Returns:
        Paths below the root, with ``/`` between the parts, of the folders that directly hold two or more mesh files, in
        natural order; and a line about each folder with one mesh, which is no set.
    """
    sets, left_out = [], []
    for place, below, _ in os.walk(root, followlinks=True):
        folder = Path(place)
        closed = {folder.resolve(), *folder.resolve().parents, skip.resolve()}
        below[:] = [name for name in below if name[0] != "." and (folder / name).resolve() not in closed]
        name, n_meshes = folder.relative_to(root).as_posix(), len(mesh_files(folder))
        if n_meshes > 1:
            sets.append(name)
        elif n_meshes:
            left_out.append(f"left out {name}: it holds one mesh only; a set needs two or more")
    return sorted(sets, key=natural), left_out


def mesh_files(folder: Path) -> list[Path]:
    """The mesh files that lie directly in a folder, in natural order of their names."""
    files = [path for path in folder.iterdir() if path.name[0] != "." and path.suffix.lower() in SUFFIXES]
    return sorted(filter(Path.is_file, files), key=lambda path: natural(path.name))


def natural(name: str) -> tuple[list[str | int], str]:
    """A sort key: ``frame-2`` before ``frame-10``."""
    chunks = re.split(r"([0-9]+)", name.casefold())
    return [int(chunk) if i % 2 else chunk for i, chunk in enumerate(chunks)], name
