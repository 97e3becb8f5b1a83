"""Types of arguments, and the groups of arguments that several commands share."""

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import Any

OVERWRITE = "replace files that exist (default: refuse)"
CACHE_DIR = "folder of tetrahedra and modes (default: TORCH_MODAL_CACHE, or the user's cache folder)"


class Formatter(argparse.RawDescriptionHelpFormatter):
    """Help texts as they are, with a wide column for options."""

    def __init__(self, prog: str) -> None:
        super().__init__(prog, max_help_position=30, width=100)


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


def times(text: str) -> list[float]:
    """An argument type: numbers with commas between them."""
    try:
        return [float(word) for word in text.split(",")]
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is no list of numbers such as 0,0.4,1") from None


def add_out(sub: argparse.ArgumentParser, metavar: str, text: str) -> None:
    """``--out``, which must be given."""
    sub.add_argument("--out", type=Path, required=True, metavar=metavar, help=text)


def add_levels(sub: argparse.ArgumentParser, lowest: int) -> None:
    """How often intervals are halved."""
    sub.add_argument(
        "--levels",
        type=number(int, lowest),
        metavar="L",
        default=3,
        help="how often the number of intervals doubles (default: %(default)s, 8 frames an interval)",
    )


def add_modes(sub: argparse.ArgumentParser) -> None:
    """What modes are computed, and how."""
    sub.add_argument(
        "--modes",
        type=number(int, 1),
        default=30,
        metavar="N",
        help="elastic modes of each key-frame; 20 to 100 are usual (default: %(default)s)",
    )
    sub.add_argument(
        "--method",
        choices=("auto", "solid", "shell"),
        default="auto",
        help="modes of the solid inside, of the surface itself (sheets, thin and open bodies), or what fits (default: "
        "%(default)s)",
    )
    sub.add_argument(
        "--mesher",
        choices=("lattice", "tetwild"),
        default="lattice",
        help="what fills surfaces for solids: a lattice of cubes (deterministic, takes every surface), or fTetWild "
        "(default: %(default)s)",
    )


def add_common(
    sub: argparse.ArgumentParser, *, overwrite: str = OVERWRITE, cache_dir: str | None = CACHE_DIR, all_of: bool = True
) -> None:
    """The group "files and messages".

    Args:
        sub: The command's parser.
        overwrite: Help of ``--overwrite``.
        cache_dir: Help of ``--cache-dir``; None: there is no such option.
        all_of: Whether there are ``--no-cache`` and ``--verbose`` too.
    """
    group = sub.add_argument_group("files and messages")
    group.add_argument("--overwrite", action="store_true", help=overwrite)
    if cache_dir is not None:
        group.add_argument("--cache-dir", metavar="DIR", help=cache_dir)
    if all_of:
        group.add_argument("--no-cache", action="store_true", help="neither read the cache nor write to it")
        group.add_argument("--verbose", action="store_true", help="also report each step")
    group.add_argument("--quiet", action="store_true", help="report warnings and errors only")
    add_debug(group)


def caching(args: argparse.Namespace) -> dict[str, Any]:
    """Options of computations that the group "files and messages" sets."""
    return {
        "cache_dir": args.cache_dir,
        "cache": not args.no_cache,
        "progress": False if args.quiet else None,
    }


def reporter(args: argparse.Namespace) -> Callable[[str], None]:
    """Print a line at once, unless --quiet."""
    return (lambda _: None) if args.quiet else (lambda line: print(line, flush=True))


def add_debug(group: Any) -> None:
    """``--debug``, which every command has."""
    group.add_argument("--debug", action="store_true", help="show the traceback of an error")
