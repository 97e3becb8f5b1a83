"""The command line, ``torch-modal``: its parser, and the lines that errors, warnings and the log become."""

import argparse
import contextlib
import functools
import inspect
import logging
import os
import signal
import sys
import warnings
from argparse import ArgumentParser, Namespace
from collections.abc import Callable, Iterator, Sequence

from torch_modal.cli import bake, check, commands, complete, subdivide, transfer, view
from torch_modal.version import __version__

PROGRAM = "torch-modal"

DESCRIPTION = """\
Fill key-frame meshes with physically plausible shapes in between.

Key-frames are triangle meshes (OBJ, PLY, OFF, GLB, GLTF, STL, VTK) with the same faces and
the same vertex order, in any units. Results are in the same units and coordinates."""

EXAMPLES = """\
start here:
  torch-modal demo                                        try it on the samples that come with it
  torch-modal interpolate a.obj b.obj --out between.glb     from your meshes to an animation
  torch-modal interpolate a.obj scan.ply --register --out between.glb   of different connectivity
  torch-modal bake frames/*.obj --bones 40 --out x.glb                from a sequence to one file
  torch-modal complete a.obj scans/*.ply --out motion.glb             from scans and a template
  torch-modal interpolate --help                            all that can be set"""

COMMANDS: dict[str, tuple[Callable[[ArgumentParser], None], Callable[[Namespace], int | None]]] = {
    "interpolate": (subdivide.add_arguments, subdivide.run),
    "bake": (bake.add_arguments, bake.run),
    "complete": (complete.add_arguments, complete.run),
    "transfer": (transfer.add_arguments, transfer.run),
    "register": (commands.add_register, commands.register),
    "check": (check.add_arguments, check.run),
    "carry": (commands.add_carry, commands.carry),
    "modes": (commands.add_modes, commands.modes),
    "precompute": (commands.add_precompute, commands.precompute),
    "view": (view.add_arguments, view.run),
    "demo": (commands.add_demo, commands.demo),
}
"""For each command, a function that declares its arguments, and a function that runs it and returns None or an exit
status. The docstring of the second is the help: summary, description and examples with empty lines between them."""

EXPECTED = (ValueError, OSError, MemoryError, ImportError)
"""Errors of input, files and machine, which become one line, as do errors of this package; all others are bugs."""


def build_parser() -> argparse.ArgumentParser:
    """All commands and their options."""
    formatter = functools.partial(argparse.RawDescriptionHelpFormatter, max_help_position=30, width=100)
    parser = argparse.ArgumentParser(prog=PROGRAM, description=DESCRIPTION, epilog=EXAMPLES, formatter_class=formatter)
    parser.add_argument("--version", action="version", version=f"{PROGRAM} {__version__}")
    subparsers = parser.add_subparsers(title="commands", required=True, metavar="COMMAND ...")
    for name, (add_arguments, run) in COMMANDS.items():
        summary, _, rest = inspect.cleandoc(run.__doc__ or "").partition("\n\n")
        description, _, examples = rest.rpartition("\n\n")
        texts = {"description": description, "epilog": examples, "formatter_class": formatter}
        short = summary[:1].lower() + summary[1:].removesuffix(".")
        aliases = ["subdivide"] if name == "interpolate" else []  # the paper's word
        sub = subparsers.add_parser(name, help=short, aliases=aliases, allow_abbrev=False, **texts)  # type: ignore[arg-type]
        add_arguments(sub)
        group = sub.add_argument_group("files and messages")
        group.add_argument("--overwrite", action="store_true", help="replace files that exist (default: refuse)")
        group.add_argument("--quiet", action="store_true", help="report warnings and errors only")
        group.add_argument("--debug", action="store_true", help="show the traceback of an error")
        # Arguments that contradict each other end with the usage and status 2, like all that argparse refuses.
        sub.set_defaults(command=run, fail=sub.error, parse=parser.parse_args)
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line with these arguments, by default the process's; returns the exit code.

    It is 0, 1 after an error, 130 after Ctrl-C or SIGTERM; 3 of `precompute` when some sets have no result, and of
    `check` when parts pass through each other. Wrong usage raises ``SystemExit(2)``.
    """
    with contextlib.suppress(ValueError):  # in the main thread, SIGTERM of a batch system acts like Ctrl-C
        signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        args = build_parser().parse_args(argv)
        args.progress, args.report = (False, lambda line: None) if args.quiet else (None, _print_line)
        with _print_messages(args.quiet):
            code = args.command(args) or 0
        sys.stdout.flush()
        return code
    except KeyboardInterrupt:
        _print_error("interrupted")
        return 130
    except BrokenPipeError:
        # The reader (head, less) has closed the pipe. Python flushes once more at exit, into the null device.
        with contextlib.suppress(OSError, ValueError):
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    except Exception as error:
        if args.debug or not (isinstance(error, EXPECTED) or type(error).__module__.startswith("torch_modal.")):
            raise
        if isinstance(error, OSError) and error.strerror:
            reason = f"{str(error.filename)[:300]}: {error.strerror}" if error.filename else error.strerror
        else:
            reason = str(error) or type(error).__name__
        _print_error(f"error: {reason}")
        return 1


def _print_line(line: str) -> None:
    """Print a line at once; characters that the terminal cannot show are escaped."""
    encoding = sys.stdout.encoding or "utf-8"
    print(line.encode(encoding, "backslashreplace").decode(encoding), flush=True)


def _print_error(message: str) -> None:
    """Print a message on the error output as one line."""
    print(f"{PROGRAM}: {' '.join(message.split())}", file=sys.stderr, flush=True)


@contextlib.contextmanager
def _print_messages(quiet: bool) -> Iterator[None]:
    """Print the package's log, unless quiet, and each warning about input or result once, as lines."""
    seen = set()

    def show(message: Warning | str, category: type[Warning], *_: object) -> None:
        if issubclass(category, UserWarning) and str(message) not in seen:
            seen.add(str(message))
            _print_error(f"warning: {message}")

    logger, handler = logging.getLogger("torch_modal"), logging.StreamHandler()
    level = logger.level
    handler.setFormatter(logging.Formatter(f"{PROGRAM}: %(message)s"))
    logger.setLevel(logging.WARNING if quiet else logging.INFO)
    logger.addHandler(handler)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("always", UserWarning)
            warnings.showwarning = show  # type: ignore[assignment]
            yield
    finally:
        logger.removeHandler(handler)
        logger.setLevel(level)
