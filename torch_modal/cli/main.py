"""The command line: ``torch-modal subdivide``, ``register``, ``modes`` and the others.

Checks the arguments before any heavy import.
"""

import argparse
import contextlib
import os
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from torch_modal.cli import carry, check, commands, precompute, register, view
from torch_modal.cli.arguments import (
    CACHE_DIR,
    Formatter,
    add_common,
    add_debug,
    add_levels,
    add_modes,
    add_out,
    number,
    times,
)
from torch_modal.cli.messages import PROGRAM, log_as_lines, say, warnings_as_lines
from torch_modal.io.formats import ANIMATION_FORMATS, MESH_FORMATS
from torch_modal.version import __version__

DESCRIPTION = """\
Fill key-frame meshes with physically plausible shapes in between.

Key-frames are triangle meshes (OBJ, PLY, OFF, GLB, GLTF) with the same faces and
the same vertex order, in any units. Results are in the same units and coordinates."""

MAIN_EXAMPLES = """\
start here:
  torch-modal demo                                        try it on the samples that come with it
  torch-modal subdivide a.obj b.obj --out between.glb     from your meshes to an animation
  torch-modal subdivide a.obj scan.ply --register --out between.glb   of different connectivity
  torch-modal subdivide --help                            all that can be set"""

SUBDIVIDE = """\
Fill a sequence of key-frames.

Each level puts a new shape between all neighbours, so L levels turn every interval
into 2**L. The key-frames themselves stay as they are, at their places."""

SUBDIVIDE_EXAMPLES = """\
examples:
  one animated file, with a picture beside linear interpolation:
    torch-modal subdivide open.obj fist.obj --out hand.glb --picture hand.png
  a cycle of six key-frames as 96 numbered OBJ files and animation.glb in a folder:
    torch-modal subdivide gait-?.ply --cyclic --levels 4 --out gait --format obj
  a GIF that goes there and back again:
    torch-modal subdivide open.obj fist.obj --out hand.gif --ping-pong --ease
  a point cache for the mesh that is already in Blender:
    torch-modal subdivide open.obj fist.obj --out hand.mdd --duration 3 --fps 24"""

MODES = """\
Compute the vibration modes of key-frames: the lowest elastic modes of the solid
that each surface encloses, restricted to the surface, or of the surface itself
where it is open or thin.

They are what `subdivide` computes first. Read the files with
torch_modal.ModalBasis.load. With --mesher tetwild, which is not deterministic, two
runs without the cache give slightly different modes."""

MODES_EXAMPLES = """\
examples:
  torch-modal modes horse.obj --out horse.safetensors
  torch-modal modes gait-?.ply --modes 50 --out bases"""

DEMO = """\
Run the main job on the samples that come with the package: a galloping creature
(a cycle of six key-frames) and a closing hand (two key-frames).

For each it writes an animation (GLB) and a picture of the sequence beside linear
interpolation and the truth, and prints how far both are from the true frames."""

DEMO_EXAMPLES = """\
example:
  torch-modal demo --sample hand --out hand-demo"""

CACHE = """\
Say how large the cache is, where tetrahedra and modes are kept between runs.

It never takes more than 4 GiB, or what the environment variable TORCH_MODAL_CACHE_LIMIT
says (500M, 10G): what was not used for the longest makes room for what is new."""

CACHE_EXAMPLES = """\
example:
  torch-modal cache --shrink 1G
  torch-modal cache --clear"""


EXPECTED = (ValueError, OSError, MemoryError, ImportError)
"""Errors of input, files and machine, which become one line; all others are bugs and show their traceback."""
EXPECTED_NAMES = ("TetrahedralizationError", "ModalAnalysisError")
"""Further ones, whose modules are heavy."""


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line.

    Args:
        argv: Arguments; by default those of the process.

    Returns:
        The exit code: 0, 1 after an error, 130 after Ctrl-C; `precompute` has one of its own when some sets have no
        result, `check` when parts pass through each other. Wrong usage leaves with ``SystemExit(2)``.
    """
    try:
        args = build_parser().parse_args(argv)
        with warnings_as_lines(), log_as_lines(args):
            code = _run(args)
        sys.stdout.flush()
        return code
    except KeyboardInterrupt:
        say("interrupted")
        return 130
    except BrokenPipeError:
        # The reader (head, less) has closed the pipe. Python flushes once more at exit, into the null device.
        with contextlib.suppress(OSError, ValueError):
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1


def _run(args: argparse.Namespace) -> int:
    """Run the command; expected errors become one line."""
    try:
        return args.command(args) or 0
    except BrokenPipeError:
        raise
    except Exception as error:
        expected = isinstance(error, EXPECTED) or type(error).__name__ in EXPECTED_NAMES
        if args.debug or not expected:
            raise
        say(f"error: {_one_line(error)}")
        return 1


def _one_line(error: BaseException) -> str:
    if isinstance(error, OSError) and error.strerror:
        return f"{error.filename}: {error.strerror}" if error.filename else error.strerror
    if isinstance(error, MemoryError):
        return "out of memory; take fewer levels or a smaller mesh"
    return " ".join(str(error).split()) or type(error).__name__


def build_parser() -> argparse.ArgumentParser:
    """All commands and their options."""
    parser = argparse.ArgumentParser(
        prog=PROGRAM, description=DESCRIPTION, epilog=MAIN_EXAMPLES, formatter_class=Formatter
    )
    parser.add_argument("--version", action="version", version=f"{PROGRAM} {__version__}")
    subparsers = parser.add_subparsers(title="commands", required=True, metavar="COMMAND ...")

    def command(name: str, run: Callable[[Any], int | None], summary: str, text: str, examples: str) -> Any:
        sub = subparsers.add_parser(
            name, help=summary, description=text, epilog=examples, formatter_class=Formatter, allow_abbrev=False
        )
        sub.set_defaults(command=run, fail=sub.error)
        return sub

    sub = command("subdivide", commands.subdivide, "key-frames in, a dense sequence out", SUBDIVIDE, SUBDIVIDE_EXAMPLES)
    sub.add_argument("meshes", nargs="+", type=Path, metavar="MESH", help="key-frames, two or more, in their order")
    animations = ", ".join(ANIMATION_FORMATS)
    add_out(sub, "FILE_OR_FOLDER", f"the animation alone: {animations}; a folder: numbered frames and animation.glb")
    add_levels(sub, 0)
    sub.add_argument(
        "--frames",
        type=number(int, 2),
        metavar="N",
        help="number of frames of the result, filled in linearly between the levels' shapes (default: all of those)",
    )
    sub.add_argument("--cyclic", action="store_true", help="the last key-frame leads on to the first")
    sub.add_argument(
        "--times",
        type=times,
        metavar="T,T,...",
        help="when the key-frames are, ascending, in any unit; of a cycle, with the time when it begins again",
    )
    sub.add_argument(
        "--no-smooth",
        dest="smooth",
        action="store_const",
        const=False,
        help="treat each pair of key-frames alone, without what its neighbours in time know",
    )
    sub.add_argument(
        "--contact", action="store_true", help="keep parts from passing through each other (extra contact)"
    )
    sub.add_argument(
        "--proxy",
        type=number(int, 0),
        metavar="N",
        help="a coarser mesh of N vertices moves, and carries the detail; 0: the mesh itself (default: 20000, for "
        "meshes of more than 100000 vertices)",
    )
    sub.add_argument(
        "--preset",
        choices=("accurate", "fast", "paper"),
        default="accurate",
        help="accurate; fast, without steps on the fine mesh; paper, its Eq. 4 as it stands (default: %(default)s)",
    )
    sub.add_argument(
        "--format",
        choices=[suffix[1:] for suffix in MESH_FORMATS],
        help="of the numbered frames (default: that of the first key-frame, with all that its file carries)",
    )
    group = sub.add_argument_group("animation")
    group.add_argument(
        "--duration",
        type=number(float, 0, above=True),
        metavar="SECONDS",
        help="of the sequence once (default: 1 for a cycle, 2 for two key-frames, 1 an interval of more)",
    )
    group.add_argument(
        "--fps",
        type=number(float, 0, above=True),
        metavar="X",
        help="frames a second; with --duration, pictures or samples a second of videos and point caches (default: 24)",
    )
    group.add_argument("--ping-pong", action="store_true", help="there and back again")
    group.add_argument("--ease", action="store_true", help="slow at both ends")
    sub.add_argument(
        "--picture",
        type=Path,
        metavar="FILE",
        help="also draw the sequence beside linear interpolation, as .png or .pdf",
    )
    sub.add_argument(
        "--register", action="store_true", help="the meshes have different connectivity: lay the first onto the others"
    )
    register.add_options(sub)
    add_modes(sub)
    add_common(sub)

    sub = command("register", register.run, register.SUMMARY, register.DESCRIPTION, register.EXAMPLES)
    register.add_arguments(sub)
    add_common(sub)

    sub = command("check", check.run, check.SUMMARY, check.DESCRIPTION, check.EXAMPLES)
    check.add_arguments(sub)

    sub = command("carry", carry.run, carry.SUMMARY, carry.DESCRIPTION, carry.EXAMPLES)
    carry.add_arguments(sub)
    add_common(sub, cache_dir=None, all_of=False)

    sub = command("modes", commands.modes, "vibration modes of key-frames, as safetensors", MODES, MODES_EXAMPLES)
    sub.add_argument("meshes", nargs="+", type=Path, metavar="MESH", help="key-frames of one connectivity")
    add_out(sub, "FILE_OR_FOLDER", "FILE.safetensors for one mesh, or a folder for a file of each mesh's name")
    add_modes(sub)
    add_common(sub)

    sub = command("precompute", precompute.run, precompute.SUMMARY, precompute.DESCRIPTION, precompute.EXAMPLES)
    precompute.add_arguments(sub)

    sub = command("view", view.run, view.SUMMARY, view.DESCRIPTION, view.EXAMPLES)
    view.add_arguments(sub)

    sub = command("demo", commands.demo, "try it on the samples that come with it", DEMO, DEMO_EXAMPLES)
    sub.add_argument(
        "--out",
        type=Path,
        default=Path("torch-modal-demo"),
        metavar="FOLDER",
        help="where the files go (default: %(default)s)",
    )
    sub.add_argument("--sample", choices=("creature", "hand"), help="only this one (default: both)")
    add_levels(sub, 1)
    add_modes(sub)
    add_common(sub)

    sub = command("cache", commands.cache, "size of the cache of tetrahedra and modes", CACHE, CACHE_EXAMPLES)
    which = sub.add_mutually_exclusive_group()
    which.add_argument("--clear", action="store_true", help="remove what is in it; other files in the folder stay")
    which.add_argument(
        "--shrink",
        metavar="SIZE",
        help="remove what was not used for the longest, until the rest is no larger than SIZE (500M, 4G)",
    )
    sub.add_argument("--cache-dir", metavar="DIR", help=CACHE_DIR)
    add_debug(sub)
    return parser
