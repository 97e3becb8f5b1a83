"""Checks of output paths, before any work and any heavy import."""

import argparse
import os
from collections.abc import Collection, Iterable, Sequence
from pathlib import Path


def check_output(
    files: Sequence[Path],
    inputs: Iterable[Path],
    overwrite: bool,
    *,
    option: str = "--out",
    folder: Path | None = None,
    pattern: str | None = None,
) -> None:
    """Raise if an output file could not or must not be written.

    Args:
        files: Files that will be written.
        inputs: Files that are read, and must not be replaced.
        overwrite: Whether files that exist may be replaced.
        option: The option that names the files.
        folder: Folder of further files.
        pattern: The names of those.

    Raises:
        ValueError: The message names the file and the reason.
    """
    read = {path.resolve() for path in inputs}
    existing = [file for file in files if file.exists() or file.resolve() in read]
    if folder is not None and pattern is not None and folder.is_dir():
        existing += sorted(folder.glob(pattern))
    for file in existing:
        if file.resolve() in read:
            raise ValueError(f"{file} is one of the meshes that are read; choose another {option}")
        if file.is_dir():
            raise ValueError(f"{file} is a folder; a file is to be written there")
        if not overwrite:
            raise ValueError(f"{file} exists; --overwrite replaces it")
    for above in dict.fromkeys(file.parent for file in files):
        there = next(parent for parent in (above, *above.absolute().parents) if parent.exists())
        if not there.is_dir():
            raise ValueError(f"{there} is a file, so nothing can be written below it; choose another {option}")
        if not os.access(there, os.W_OK):
            raise ValueError(f"the folder {there} cannot be written; choose another {option}")


def check_name(args: argparse.Namespace, option: str, path: Path | None, suffixes: Collection[str]) -> None:
    """Exit with the usage if an option names a file of another kind."""
    from torch_modal.io.write import check_suffix

    try:
        if path is not None:
            check_suffix(path, suffixes, option)
    except ValueError as error:
        args.fail(str(error).removesuffix("."))
