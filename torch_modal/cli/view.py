"""``torch-modal view``: shapes of files as a page, opened in the browser or written."""

from __future__ import annotations

import argparse
import tempfile
import webbrowser
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING

from torch_modal.cli.arguments import check_output
from torch_modal.io.formats import PAGES
from torch_modal.io.write import check_suffix

if TYPE_CHECKING:
    from torch_modal.view.page import Page


def add_arguments(sub: argparse.ArgumentParser) -> None:
    """Add the arguments of ``view``."""
    add = sub.add_argument
    text = "shapes in their order, a folder, or one animated GLB, Alembic or NPZ file"
    add("meshes", nargs="+", type=Path, metavar="MESH", help=text)
    text = "another sequence of as many shapes, of the same faces; may be given several times"
    add("--compare", nargs="+", type=Path, action="append", default=[], metavar="FILE", help=text)
    add("--linear", action="store_true", help="also show linear interpolation of the key-frames of the first sequence")
    text = "which frames are key-frames, from 0 (default: the GLB's, or the first and the last)"
    add("--keyframes", nargs="+", type=int, metavar="N", help=text)
    add("--cyclic", action="store_true", help="the last frame leads on to the first")
    add("--fps", type=float, metavar="X", help="frames a second (default: the GLB's, or 24)")
    add("--up", choices=("y", "z"), help="what is up (default: Y, unless the first shape is flat in Y)")
    text = "write the page there, as .html (default: a temporary file, opened)"
    add("--page", type=Path, metavar="FILE", help=text)
    text = "a page to pick landmarks of two meshes or more; it starts with the landmarks of FILE, if given"
    add("--landmarks", nargs="?", const=True, metavar="FILE", help=text)


def run(args: argparse.Namespace) -> None:
    """Show sequences of shapes, in a page for the browser.

    Show sequences of shapes in a page: play, orbit, compare, pick vertices and copy their
    indices.

    The page is one HTML file that needs no network. Shapes are numbered mesh files, a
    folder or a quoted pattern of them, or an animated GLB, Alembic or NPZ file.

    With --landmarks, they are meshes of any connectivity, side by side, on which vertices
    that belong together are picked, for `register` and `subdivide --register`.

    Examples:
      open a page of an animation, next to linear interpolation of its key-frames:
        torch-modal view hand.glb --linear
      write a page of three sequences side by side:
        torch-modal view ours/ --compare other/ --compare truth/frame-*.ply --page hands.html
      pick landmarks on two meshes, and save them as the file that --landmarks of `register` takes:
        torch-modal view cat.obj dog.obj --landmarks
    """
    sequences = [args.meshes, *args.compare]
    if args.landmarks and (args.compare or args.linear or args.keyframes):
        args.fail("--compare, --linear and --keyframes belong to sequences; --landmarks shows single meshes")
    if args.landmarks and len(args.meshes) < 2:
        args.fail("--landmarks needs two meshes or more")
    if args.page:
        check_suffix(args.page, PAGES)
        inputs = [] if args.landmarks in (None, True) else [Path(args.landmarks)]
        check_output(args, [args.page], [*chain(*sequences), *inputs])

    page = _landmarks(args) if args.landmarks else _sequences(sequences, args)
    # Without --page it goes to a temporary folder, and stays: the browser reads it after this process.
    path = page.save(args.page or Path(tempfile.mkdtemp(prefix="torch_modal-"), "page.html"))
    args.report(f"page: {path}")
    if not args.page and not webbrowser.open(path.absolute().as_uri()):
        print(f"no browser was found to open it; open it yourself, or write it elsewhere with --page: {path}")


def _landmarks(args: argparse.Namespace) -> Page:
    """A page to pick landmarks on meshes of any connectivity."""
    from torch_modal.io.read import open_asset
    from torch_modal.registration.landmarks import landmark_vertices
    from torch_modal.view.page import show_landmarks

    meshes = [(asset.positions, asset.faces) for asset in map(open_asset, args.meshes)]
    rows = None if args.landmarks is True else landmark_vertices(args.landmarks, [points for points, _ in meshes])
    names = _number_names([path.name for path in args.meshes])
    return show_landmarks(dict(zip(names, meshes, strict=True)), rows, title="Landmarks")


def _sequences(sequences: list[list[Path]], args: argparse.Namespace) -> Page:
    """A page that plays sequences of the same faces."""
    import torch

    import torch_modal as tm
    from torch_modal.data.sequence import read_shapes, sequence_asset
    from torch_modal.io.read import require_same_mesh
    from torch_modal.io.write import check_indices
    from torch_modal.times import fill_linear

    first, faces, options = read_shapes(sequences[0])
    names = [(paths[0] if len(paths) == 1 else paths[0].parent).absolute().stem for paths in sequences]
    shapes = [first]
    for paths in sequences[1:]:
        frames, other_faces, _ = read_shapes(paths)
        require_same_mesh(sequences[0][0], (first[0], faces), paths[0], (frames[0], other_faces))
        shapes.append(frames)
    asked = {"keyframe_indices": args.keyframes, "fps": args.fps, "cyclic": args.cyclic or None, "up": args.up}
    options |= {name: value for name, value in asked.items() if value is not None}
    if args.linear:
        n, cyclic = len(first), bool(options.get("cyclic"))
        ends = [0] if cyclic else [0, n - 1]
        keys = check_indices([*ends, *(options.get("keyframe_indices") or [n - 1])], n, "key-frames")
        names.append("linear")
        shapes.append(fill_linear(torch.from_numpy(first[keys]), [*keys, n] if cyclic else keys).numpy())
    options |= {"asset": sequence_asset(sequences[0]), "title": names[0]}
    return tm.show(dict(zip(_number_names(names), shapes, strict=True)), faces, **options)


def _number_names(names: list[str]) -> list[str]:
    """Append numbers to the names, if some are equal."""
    return names if len(set(names)) == len(names) else [f"{name} {i}" for i, name in enumerate(names, 1)]
