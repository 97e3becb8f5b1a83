"""Types of arguments, options that several commands share, and checks of output paths."""

import argparse
import os
import re
import sys
from collections.abc import Callable, Collection, Iterable, Sequence
from pathlib import Path
from typing import Any

CACHE_DIR = "folder of tetrahedra and modes (default: TORCH_MODAL_CACHE, or the user's cache folder)"


def number(kind: Callable[[str], Any], low: float, above: bool = False) -> Callable[[str], Any]:
    """An argument type: a finite number of at least (or above) a bound."""

    def convert(text: str) -> Any:
        wanted = f"a {'whole ' if kind is int else ''}number {'above' if above else 'of at least'} {low:g}"
        try:
            value = kind(text)
        except ValueError:
            value = float("nan")
        if not (low < value if above else low <= value) or value == float("inf"):
            raise argparse.ArgumentTypeError(f"{text!r} is not {wanted}")
        return value

    return convert


def file_name(suffixes: Collection[str]) -> Callable[[str], Path]:
    """An argument type: a file with one of these endings."""

    def convert(text: str) -> Path:
        if Path(text).suffix.lower() not in suffixes:
            *others, last = suffixes
            raise argparse.ArgumentTypeError(f"must end in {', '.join(others)} or {last}, got {text!r}")
        return Path(text)

    return convert


def add_levels(sub: argparse.ArgumentParser, lowest: int) -> None:
    """Add ``--levels`` of subdivision."""
    text = "how often the number of intervals doubles (default: %(default)s, 8 frames an interval)"
    sub.add_argument("--levels", type=number(int, lowest), metavar="L", default=3, help=text)


def add_modes(sub: argparse.ArgumentParser) -> None:
    """Add options of `extract_bases`."""
    add, default = sub.add_argument, "(default: %(default)s)"
    text = f"elastic modes of each key-frame; 20 to 100 are usual {default}"
    add("--modes", type=number(int, 1), default=30, metavar="N", help=text)
    text = f"modes of the solid inside, of the surface itself (sheets, thin and open bodies), or what fits {default}"
    add("--method", choices=("auto", "solid", "shell"), default="auto", help=text)
    text = f"what fills solids: a lattice of cubes (deterministic), fTetWild, or what fits {default}"
    add("--mesher", choices=("auto", "lattice", "tetwild"), default="auto", help=text)


def add_forms(sub: argparse._ActionsContainer) -> None:
    """Add ``--bones`` and ``--targets``, forms of an animation as GLB."""
    text = "GLB: a skin of at most N bones, a tenth of the size, for engines (40 are usual)"
    sub.add_argument("--bones", type=number(int, 1), metavar="N", help=text)
    sub.add_argument(
        "--targets", type=number(int, 1), metavar="N", help="GLB: N principal shapes as the only morph targets"
    )


def check_forms(args: argparse.Namespace, file: Path) -> None:
    """Usage error for two forms, or for a form of another format."""
    if (args.bones or args.targets) and (file.suffix.lower() != ".glb" or (args.bones and args.targets)):
        args.fail("--bones and --targets are two forms of a .glb file; take one of them")


def add_registration(sub: argparse.ArgumentParser, optional: bool = False) -> None:
    """Add options of the registration of meshes of different connectivity, with ``--register`` if it is optional."""
    if optional:
        text = "the meshes have different connectivity: lay the first onto the others"
        sub.add_argument("--register", action="store_true", help=text)
    text = "lines of vertex numbers, counted from 0, or of coordinates: a column for each mesh"
    sub.add_argument("--landmarks", type=Path, metavar="FILE", help=text)
    text = "the meshes are different subjects; may need five landmarks or more"
    sub.add_argument("--across", action="store_true", help=text)


def add_common(
    sub: argparse.ArgumentParser,
    overwrite: str = "replace files that exist (default: refuse)",
    cache_dir: str | None = CACHE_DIR,
) -> None:
    """Add the group "files and messages"; ``cache_dir`` is that option's help, None for commands without a cache."""
    group = sub.add_argument_group("files and messages")
    group.add_argument("--overwrite", action="store_true", help=overwrite)
    if cache_dir:
        group.add_argument("--cache-dir", metavar="DIR", help=cache_dir)
    if cache_dir == CACHE_DIR:
        group.add_argument("--no-cache", action="store_true", help="neither read the cache nor write to it")
        group.add_argument("--verbose", action="store_true", help="also report each step")
    group.add_argument("--quiet", action="store_true", help="report warnings and errors only")


def pick_options(args: argparse.Namespace, *names: str) -> dict[str, Any]:
    """Keyword arguments for functions whose parameters have the same names as the options."""
    return {name: getattr(args, name) for name in names}


def cache_options(args: argparse.Namespace) -> dict[str, Any]:
    """Options of functions that cache their results."""
    return {"cache_dir": args.cache_dir, "cache": not args.no_cache, "progress": False if args.quiet else None}


def mode_options(args: argparse.Namespace) -> dict[str, Any]:
    """Options of `extract_bases`."""
    return {"n_modes": args.modes, **pick_options(args, "method", "mesher"), **cache_options(args)}


def register_options(args: argparse.Namespace) -> dict[str, Any]:
    """Options of `register`; a usage error if it is optional and not asked for."""
    if (args.landmarks or args.across) and not getattr(args, "register", True):
        args.fail("--landmarks and --across are for --register")
    return {"landmarks": args.landmarks, "same_subject": not args.across, **cache_options(args)}


def reporter(args: argparse.Namespace) -> Callable[[str], None]:
    """A function that prints a line at once, unless --quiet; it escapes characters that the terminal cannot show."""

    def report(line: str) -> None:
        if not args.quiet:
            encoding = sys.stdout.encoding or "utf-8"
            print(line.encode(encoding, "backslashreplace").decode(encoding), flush=True)

    return report


def is_file(args: argparse.Namespace, suffixes: Collection[str]) -> bool:
    """True if --out names a file with one of these endings, False for a folder; other files are a usage error."""
    if args.out.suffix.lower() in suffixes:
        return True
    # An ending has letters, unlike the number of a version; a folder that exists may have any name.
    if re.fullmatch(r"\.\w*[A-Za-z]\w*", args.out.suffix) and not args.out.is_dir():
        what = f"a file ending in {', '.join(suffixes)}, or a folder" if suffixes else "a folder here"
        args.fail(f"--out is {what}, got {args.out.name!r}; a folder whose name has an ending must exist")
    return False


def check_output(files: Sequence[Path], inputs: Iterable[Path], overwrite: bool) -> None:
    """Raise a ValueError if files cannot be written, exist already, or are among the inputs."""
    read = {os.path.realpath(path) for path in inputs}
    for file in files:
        if os.path.realpath(file) in read:
            raise ValueError(f"{file} is one of the meshes that are read; choose another name")
        if file.is_dir():
            raise ValueError(f"{file} is a folder; a file is to be written there")
        if file.exists() and not overwrite:
            raise ValueError(f"{file} exists; --overwrite replaces it")
    for above in dict.fromkeys(file.parent for file in files):
        there = next(parent for parent in (above, *above.absolute().parents) if parent.is_symlink() or parent.exists())
        if not there.is_dir():
            raise ValueError(f"{there} is a file, so nothing can be written below it; choose another name")
        if not os.access(there, os.W_OK):
            raise ValueError(f"the folder {there} cannot be written; choose another one")
