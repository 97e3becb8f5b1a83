"""``torch-modal view``: shapes of files as a page, opened in the browser or written."""

from __future__ import annotations

import argparse
import tempfile
import webbrowser
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any

from torch_modal.cli.arguments import add_common, number
from torch_modal.cli.output import check_name, check_output
from torch_modal.io.formats import PAGES

if TYPE_CHECKING:
    from torch_modal.view.page import Page

SUMMARY = "show sequences of shapes, in a page for the browser"

DESCRIPTION = """\
Show sequences of shapes in a page: play, orbit, compare, colour by edge strain,
distance or volume change, pick vertices and copy their indices.

The page is one HTML file that needs no network. Shapes are numbered mesh files, a
folder of them, or a GLB that `subdivide` or save_animation wrote.

With --landmarks, they are meshes of any connectivity, side by side, on which vertices
that belong together are picked, for `register` and `subdivide --register`."""

EXAMPLES = """\
examples:
  open a page of an animation, beside linear interpolation of its key-frames:
    torch-modal view hand.glb --linear
  write a page of three sequences side by side:
    torch-modal view ours/ --compare other/ --compare truth/frame-*.ply --page hands.html
  pick landmarks on two meshes, and save them as the file that --landmarks of `register` takes:
    torch-modal view cat.obj dog.obj --landmarks"""


def add_arguments(sub: argparse.ArgumentParser) -> None:
    """Arguments of ``view``."""
    sub.add_argument("meshes", nargs="+", type=Path, metavar="FILE", help="shapes in their order, a folder, or one GLB")
    sub.add_argument(
        "--compare",
        nargs="+",
        type=Path,
        action="append",
        default=[],
        metavar="FILE",
        help="another sequence of as many shapes, of the same faces; may be given several times",
    )
    sub.add_argument(
        "--linear", action="store_true", help="also show linear interpolation of the key-frames of the first sequence"
    )
    sub.add_argument(
        "--names", nargs="+", metavar="NAME", help="of the sequences, in their order (default: of files or folders)"
    )
    sub.add_argument(
        "--keyframes",
        nargs="+",
        type=number(int, 0),
        metavar="N",
        help="which frames are key-frames, from 0 (default: the GLB's, or the first and the last)",
    )
    sub.add_argument("--cyclic", action="store_true", help="the last frame leads on to the first")
    sub.add_argument(
        "--fps",
        type=number(float, 0, above=True),
        metavar="X",
        help="frames a second (default: the GLB's, or 24)",
    )
    sub.add_argument("--up", choices=("y", "z"), help="what is up (default: Y, unless the first shape is flat in Y)")
    sub.add_argument(
        "--page", type=Path, metavar="FILE", help="write the page there, as .html (default: a temporary file, opened)"
    )
    sub.add_argument(
        "--landmarks",
        nargs="?",
        const=True,
        metavar="FILE",
        help="a page to pick landmarks of two meshes or more; with a FILE, those of it are there already",
    )
    add_common(sub, overwrite="replace the file if it exists (default: refuse)", cache_dir=None, all_of=False)


def run(args: argparse.Namespace) -> None:
    """Run the command."""
    check_name(args, "--page", args.page, PAGES)
    if args.landmarks:
        _landmarks(args)
        return
    given = [args.meshes, *args.compare]
    n_sequences = len(given) + args.linear
    if args.names and len(args.names) != n_sequences:
        args.fail(f"--names names {len(args.names)} sequences, but there are {n_sequences}")
    if args.page:
        check_output([args.page], chain(*given), args.overwrite, option="--page")

    import torch_modal as tm

    sequences, first = _sequences(given, args)
    page = tm.show(
        sequences,
        first.faces,
        keyframe_indices=first.keyframe_indices if args.keyframes is None else args.keyframes,
        times=first.times,
        fps=args.fps or first.fps or 24.0,
        cyclic=args.cyclic or first.cyclic,
        up=args.up,
        title=next(iter(sequences)),
    )
    shapes = next(iter(sequences.values()))
    times = f"{len(sequences)} x " if len(sequences) > 1 else ""
    _open(page, f"{times}{len(shapes)} shapes of {shapes.shape[1]} vertices", args)


def _open(page: Page, what: str, args: argparse.Namespace) -> None:
    """Write the page; open it unless --page names a file."""
    # Without --page it goes to a temporary folder, and stays: the browser reads it after this process.
    path = args.page or Path(tempfile.mkdtemp(prefix="torch_modal-"), "page.html")
    written = page.save(path, args.overwrite)
    if not args.quiet:
        print(f"{what}: {written}", flush=True)
    if not args.page and not webbrowser.open(written.absolute().as_uri()):
        print(f"no browser was found to open it; open it yourself, or write it elsewhere with --page: {written}")


def _landmarks(args: argparse.Namespace) -> None:
    """Meshes of any connectivity, to pick landmarks on."""
    _refuse(args, ("compare", "linear", "keyframes"), "belong to sequences; --landmarks shows single meshes")
    if len(args.meshes) < 2:
        args.fail("--landmarks needs two meshes or more")
    if args.names and len(args.names) != len(args.meshes):
        args.fail(f"--names names {len(args.names)} meshes, but there are {len(args.meshes)}")
    if args.page:
        inputs = args.meshes if args.landmarks is True else [*args.meshes, Path(args.landmarks)]
        check_output([args.page], inputs, args.overwrite, option="--page")

    import torch_modal as tm
    from torch_modal.io.read import read_mesh
    from torch_modal.registration.landmarks import landmark_vertices

    meshes = [read_mesh(path) for path in args.meshes]
    rows = None if args.landmarks is True else landmark_vertices(args.landmarks, [points for points, _ in meshes])
    named = _named(args.names or [path.name for path in args.meshes], meshes)
    page = tm.show_landmarks(named, rows, title="Landmarks")
    _open(page, f"{len(meshes)} meshes to pick landmarks on", args)


def _refuse(args: argparse.Namespace, options: tuple[str, ...], why: str) -> None:
    """Exit with the usage if options are given that mean nothing here."""
    given = [f"--{option}" for option in options if getattr(args, option)]
    if given:
        args.fail(f"{', '.join(given)} {why}")


def _sequences(given: list[list[Path]], args: argparse.Namespace) -> tuple[dict[str, Any], Any]:
    """The sequences under their names, and the first as it was read."""
    from torch_modal.io.read import require_same_mesh
    from torch_modal.view.page_input import read_shapes

    read = [read_shapes(paths) for paths in given]
    first = read[0]
    for paths, other in zip(given[1:], read[1:], strict=True):
        require_same_mesh(given[0][0], first.frames[0], first.faces, paths[0], other.frames[0], other.faces)
        if len(other.frames) != len(first.frames):
            raise ValueError(
                f"{paths[0]} has {len(other.frames)} shapes, {given[0][0]} has {len(first.frames)}; sequences are "
                "compared shape by shape, so both need as many"
            )
    shapes = [one.frames for one in read]
    names = [_name(paths) for paths in given]
    if args.linear:
        keys = args.keyframes or first.keyframe_indices or [0, len(first.frames) - 1]
        shapes.append(_linear(first.frames, sorted(set(keys)), args.cyclic or first.cyclic))
        names.append("linear")
    return _named(args.names or names, shapes), first


def _named(names: list[str], values: list[Any]) -> dict[str, Any]:
    """Values under their names, which get a number each if some are the same."""
    if len(set(names)) < len(names):
        names = [f"{name} {number}" for number, name in enumerate(names, 1)]
    return dict(zip(names, values, strict=True))


def _name(paths: list[Path]) -> str:
    """The name of a sequence: of its only file or folder, or of its files' folder."""
    path = paths[0].absolute() if len(paths) == 1 else paths[0].absolute().parent
    return path.stem if path.is_file() else path.name


def _linear(frames: Any, keys: list[int], cyclic: bool) -> Any:
    """Straight lines between the key-frames, for as many frames."""
    import torch

    import torch_modal as tm

    last = len(frames) - 1
    if keys[0] != 0 or keys[-1] > last or (keys[-1] != last and not cyclic):
        ends = "the first frame (0)" if cyclic else f"the first frame (0) and the last ({last})"
        raise ValueError(f"--linear needs {ends} among the key-frames, got {' '.join(map(str, keys))}")
    places = [*keys, len(frames)] if cyclic else keys
    return tm.linear_sequence(torch.from_numpy(frames[keys]), places).numpy()
