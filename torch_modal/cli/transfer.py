"""``torch-modal transfer``: the motion of one body on another one."""

import argparse
from pathlib import Path

from torch_modal.cli import arguments
from torch_modal.cli.arguments import pick_options
from torch_modal.cli.subdivide import add_output, check_files, write_sequence


def add_arguments(sub: argparse.ArgumentParser) -> None:
    """Add the arguments of ``transfer``."""
    add = sub.add_argument
    text = "the motion: meshes in their order, a folder or a quoted pattern, an animated GLB, Alembic or NPZ file"
    add("meshes", nargs="+", type=Path, metavar="MESH", help=text)
    add("--to", type=Path, required=True, metavar="FILE", help="the other body, in the pose of the first mesh")
    text = "the first body in the pose of the other one (default: the first mesh)"
    add("--rest", type=Path, metavar="FILE", help=text)
    text = "lines of vertex numbers, counted from 0, or of coordinates: of the first body, and of the other one"
    add("--landmarks", type=Path, metavar="FILE", help=text)
    add("--keep-doubtful", action="store_true", help="use a doubtful map too, with a warning")
    text = "shapes without an order, such as expressions: nothing is kept from sliding"
    add("--no-anchors", dest="anchors", action="store_false", help=text)
    add_output(sub, "the result")
    add("--fps", type=float, metavar="X", help="frames a second (default: as in the file, or 24)")
    add("--cyclic", action="store_true", help="the last frame leads on to the first")
    arguments.add_forms(sub)
    arguments.add_cache(sub)


def run(args: argparse.Namespace) -> None:
    """Give the motion of one body to another one.

    Move a body of any connectivity and proportions as another one moves.

    The other body has the pose of the first mesh, or of --rest. Its vertices, faces and
    materials stay. Without the same faces, the bodies are registered; a doubtful map is an error.

    Examples:
      the gait of one animal on another one:
        torch-modal transfer gait/*.obj --to camel.obj --out camel.glb
      landmarks are picked on a page, and saved there as pairs.txt:
        torch-modal view gait/0.obj camel.obj --landmarks
        torch-modal transfer gait/*.obj --to camel.obj --landmarks pairs.txt --out camel.glb
      expressions as numbered meshes in a folder:
        torch-modal transfer faces/*.obj --to neutral.obj --no-anchors --out expressions
    """
    import torch_modal as tm
    from torch_modal.data.sequence import sequence_files
    from torch_modal.motion.transfer import correspond
    from torch_modal.registration.report import Registration

    files = sequence_files(args.meshes)
    animation = check_files(args, [*files, args.to, *filter(None, [args.rest, args.landmarks])])
    frames, faces, args.fps = tm.load_sequence(files, args.fps)
    args.report(f"{len(frames)} frames of {frames.shape[1]} vertices")
    asset, rest = tm.open_asset(args.to), frames[0]
    if args.rest:
        rest = tm.load_keyframes([args.rest]).keyframes[0]
    options = pick_options(args, "landmarks", "cache", "progress")
    found = correspond(rest, faces, asset.positions, asset.faces, **options)
    if isinstance(found, Registration):
        args.report(f"map:       {found.summary()}")
        low = float((found.vertex_confidence < 0.5).double().mean())
        args.report(f"{100 * low:.0f} % of the vertices have no sure counterpart and follow their neighbours")
    options = pick_options(args, "anchors", "keep_doubtful", "progress")
    moved = tm.transfer(frames, faces, asset.positions, asset.faces, rest=rest, registration=found, **options)
    asset.carries.pop("posing", None)
    options = pick_options(args, "cyclic", "bones", "targets")
    write_sequence(args, animation, moved, asset.faces, asset, keyframe_indices=[], **options)
    if args.picture:
        tm.render_sequence({"moved": moved}, asset.faces, args.picture, keyframe_indices=[])
        args.report(f"picture:   {args.picture}")
