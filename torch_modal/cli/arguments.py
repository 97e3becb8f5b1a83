"""Types of arguments, options that several commands share, and checks of output paths."""

import argparse
import os
import re
from collections.abc import Collection, Iterable, Sequence
from pathlib import Path
from typing import Any

from torch_modal.io.formats import ANIMATION_FORMATS, PIXELS
from torch_modal.io.write import refuse_existing

MODES = ("n_modes", "method", "mesher", "cache", "progress")
"""Options of `extract_bases`, as `add_modes` and `add_cache` name them."""
REGISTRATION = ("landmarks", "same_subject", "cache", "progress")
"""Options of `register`, as `add_registration` and `add_cache` name them."""


def add_levels(sub: argparse.ArgumentParser) -> None:
    """Add ``--levels`` of subdivision."""
    text = "how often the number of intervals doubles (default: %(default)s, 8 frames an interval)"
    sub.add_argument("--levels", type=int, metavar="L", default=3, help=text)


def add_modes(sub: argparse.ArgumentParser) -> None:
    """Add options of `extract_bases`."""
    add, default = sub.add_argument, "(default: %(default)s)"
    text = f"elastic modes of each key-frame; 20 to 100 are usual {default}"
    add("--modes", dest="n_modes", type=int, default=30, metavar="N", help=text)
    text = f"modes of the solid inside, of the surface itself (sheets, thin and open bodies), or what fits {default}"
    add("--method", choices=("auto", "solid", "shell"), default="auto", help=text)
    text = f"what fills solids: a lattice of cubes (deterministic), fTetWild, or what fits {default}"
    add("--mesher", choices=("auto", "lattice", "tetwild"), default="auto", help=text)


def add_forms(sub: argparse._ActionsContainer) -> None:
    """Add ``--bones`` and ``--targets``, forms of an animation as GLB."""
    text = "GLB: a skin of at most N bones, a tenth of the size, for engines (40 are usual)"
    sub.add_argument("--bones", type=int, metavar="N", help=text)
    sub.add_argument("--targets", type=int, metavar="N", help="GLB: N principal shapes as morph targets")


def add_size(sub: argparse._ActionsContainer) -> None:
    """Add ``--size`` of videos."""
    text = "MP4, GIF: pixels of the longer side (default: %(default)s)"
    sub.add_argument("--size", type=int, default=PIXELS, metavar="N", help=text)


def add_registration(sub: argparse.ArgumentParser, optional: bool = False) -> None:
    """Add options of the registration of meshes of different connectivity, with ``--register`` if it is optional."""
    if optional:
        text = "the meshes have different connectivity: lay the first onto the others"
        sub.add_argument("--register", action="store_true", help=text)
    text = "lines of vertex numbers, counted from 0, or of coordinates: a column for each mesh"
    sub.add_argument("--landmarks", type=Path, metavar="FILE", help=text)
    sub.add_argument("--across", dest="same_subject", action="store_false", help="the meshes are different subjects")


def add_cache(sub: argparse.ArgumentParser) -> None:
    """Add ``--no-cache``, for tetrahedra, modes and registrations."""
    text = "neither read the cache (the folder TORCH_MODAL_CACHE, or the user's cache folder) nor write to it"
    sub.add_argument("--no-cache", dest="cache", action="store_false", help=text)


def pick_options(args: argparse.Namespace, *names: str) -> dict[str, Any]:
    """Keyword arguments for functions whose parameters have the same names as the options."""
    return {name: getattr(args, name) for name in names}


def is_file(args: argparse.Namespace, suffixes: Collection[str]) -> bool:
    """True if --out names a file with one of these endings, False for a folder; other files are a usage error."""
    if args.out.suffix.lower() in suffixes:
        return True
    # An ending has letters, unlike the number of a version; a folder that exists may have any name.
    if re.fullmatch(r"\.\w*[A-Za-z]\w*", args.out.suffix) and not args.out.is_dir():
        what = f"a file ending in {', '.join(suffixes)}, or a folder"
        args.fail(f"--out is {what}, got {args.out.name!r}; a folder whose name has an ending must exist")
    return False


def check_output(args: argparse.Namespace, files: Sequence[Path], inputs: Iterable[Path]) -> None:
    """Raise an error, before the work, if files cannot be written, exist already, or are among the inputs."""
    read = {os.path.realpath(path) for path in inputs}
    for file in files:
        if os.path.realpath(file) in read:
            raise ValueError(f"{file} is one of the meshes that are read; choose another name")
        refuse_existing(file, args.overwrite)
        if fmt := ANIMATION_FORMATS.get(file.suffix.lower()):
            fmt.check_installed(file.name)
    for folder in dict.fromkeys(file.absolute().parent for file in files):
        there = next(parent for parent in (folder, *folder.parents) if parent.is_symlink() or parent.exists())
        if not there.is_dir():
            raise ValueError(f"{there} is a file, so nothing can be written below it; choose another name")
        if not os.access(there, os.W_OK):
            raise ValueError(f"the folder {there} cannot be written; choose another one")
