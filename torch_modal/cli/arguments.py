"""Types of arguments, options that several commands share, and checks of output paths."""

import argparse
import inspect
import os
import re
from collections.abc import Callable, Collection, Iterable, Sequence
from pathlib import Path
from typing import Any

from torch_modal.io.formats import ANIMATION_FORMATS
from torch_modal.io.write import refuse_existing

MODES = ("n_modes", "method", "mesher", "cache", "progress")
"""Options of `extract_bases`, as `add_modes` and `add_cache` name them."""
REGISTRATION = ("landmarks", "same_subject", "cache", "progress")
"""Options of `register`, as `add_registration` and `add_cache` name them."""


def adder(sub: argparse._ActionsContainer, function: Callable[..., object]) -> Callable[..., argparse.Action]:
    """``sub.add_argument``, with the help of each argument from the lines below ``Options:`` in a docstring."""
    text = inspect.cleandoc(function.__doc__ or "").partition("Options:\n")[2]
    helps = {name: " ".join(words.split()) for name, words in re.findall(r"^    (\S+): (.*(?:\n {5,}.*)*)", text, re.M)}
    return lambda name, **options: sub.add_argument(name, **{"help": helps.get(name), **options})


def add_levels(sub: argparse.ArgumentParser) -> None:
    """Add an option of subdivision.

    Options:
        --levels: how often the number of intervals doubles (default: %(default)s, 8 frames an interval)
    """
    adder(sub, add_levels)("--levels", type=int, metavar="L", default=3)


def add_modes(sub: argparse.ArgumentParser) -> None:
    """Add options of `extract_bases`.

    Options:
        --modes: elastic modes of each key-frame; 20 to 100 are usual (default: %(default)s)
        --method: modes of the solid inside, of the surface itself (sheets, thin and open bodies), or what fits
            (default: %(default)s)
        --mesher: what fills solids: a lattice of cubes (deterministic), fTetWild, or what fits (default: %(default)s)
    """
    add = adder(sub, add_modes)
    add("--modes", dest="n_modes", type=int, default=30, metavar="N")
    add("--method", choices=("auto", "solid", "shell"), default="auto")
    add("--mesher", choices=("auto", "lattice", "tetwild"), default="auto")


def add_forms(sub: argparse._ActionsContainer) -> None:
    """Add forms of an animation as GLB.

    Options:
        --bones: GLB: a skin of at most N bones, a tenth of the size, for engines (40 are usual)
        --targets: GLB: N principal shapes as morph targets
    """
    for name in ("--bones", "--targets"):
        adder(sub, add_forms)(name, type=int, metavar="N")


def add_registration(sub: argparse.ArgumentParser, optional: bool = False) -> None:
    """Add options of the registration of meshes of different connectivity; ``--register`` if it is optional.

    Options:
        --register: the meshes have different connectivity: lay the first onto the others
        --landmarks: lines of vertex numbers, counted from 0, or of coordinates: a column for each mesh
        --across: the meshes are different subjects
    """
    add = adder(sub, add_registration)
    if optional:
        add("--register", action="store_true")
    add("--landmarks", type=Path, metavar="FILE")
    add("--across", dest="same_subject", action="store_false")


def add_cache(sub: argparse.ArgumentParser) -> None:
    """Add an option for tetrahedra, modes and registrations.

    Options:
        --no-cache: neither read the cache (the folder TORCH_MODAL_CACHE, or the user's cache folder) nor write to it
    """
    adder(sub, add_cache)("--no-cache", dest="cache", action="store_false")


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
