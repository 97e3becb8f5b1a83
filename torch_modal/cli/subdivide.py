"""``torch-modal interpolate``, also called ``subdivide``: from key-frames to files."""

import argparse
import warnings
from functools import partial
from pathlib import Path
from typing import Any

from torch_modal.arrays import Array
from torch_modal.cli import arguments
from torch_modal.cli.arguments import pick_options
from torch_modal.io.asset import Asset
from torch_modal.io.formats import ANIMATION_FORMATS, MESH_FORMATS, PICTURES, Timing, check_forms
from torch_modal.io.write import check_suffix

ANIMATION = ("cyclic", "duration", "fps", "ping_pong", "ease")


def add_output(sub: argparse.ArgumentParser, picture: str) -> None:
    """Add ``--out``, ``--format`` and ``--picture`` of a sequence."""
    add = sub.add_argument
    text = f"the animation alone: {', '.join(ANIMATION_FORMATS)}; a folder: numbered frames and animation.glb"
    add("--out", type=Path, required=True, metavar="FILE_OR_FOLDER", help=text)
    text = "format of the numbered frames (default: as the first mesh, with everything else in its file)"
    add("--format", choices=[suffix[1:] for suffix in MESH_FORMATS], help=text)
    arguments.add_size(sub)
    add("--picture", type=Path, metavar="FILE", help=f"also draw {picture}, .png or .pdf")


def check_files(args: argparse.Namespace, inputs: list[Path]) -> Path:
    """Path of the animation, which a folder has next to the frames, after the checks of `check_output`."""
    Timing(2, fps=args.fps)
    if args.picture:
        check_suffix(args.picture, PICTURES)
    animation, frames = args.out, []
    if not arguments.is_file(args, ANIMATION_FORMATS):
        animation, frames = args.out / "animation.glb", [*args.out.glob("frame-*")]
    arguments.check_output(args, [animation, *filter(None, [args.picture]), *frames], inputs)
    return animation


def write_sequence(
    args: argparse.Namespace, animation: Path, frames: Array, faces: Array, asset: Asset | None, **options: Any
) -> None:
    """Write frames, if --out is a folder, and the animation; ``options`` are passed to `save_animation`."""
    import torch_modal as tm

    if animation != args.out:
        written = tm.save_mesh(frames, faces, args.out, args.format, overwrite=args.overwrite, asset=asset)
        args.report(f"frames:    {written[0]} to {written[-1].name}")
        left = sorted({*args.out.glob("frame-*")} - {*written})
        if left:  # they look like the end of this sequence
            message = f"{args.out} also holds {len(left)} frames of an earlier run, from {left[0].name}"
            warnings.warn(message, stacklevel=2)
    options |= pick_options(args, "progress", "size")
    tm.save_animation(frames, faces, animation, args.fps, asset=asset, **options)
    args.report(f"animation: {animation}")


def add_arguments(sub: argparse.ArgumentParser) -> None:
    """Add the arguments of ``interpolate``."""
    add = sub.add_argument
    add("meshes", nargs="+", type=Path, metavar="MESH", help="key-frames, two or more, in their order")
    add_output(sub, "the sequence next to linear interpolation")
    arguments.add_levels(sub)
    add("--frames", dest="n_frames", type=int, metavar="N", help="of the result (default: by the levels)")
    add("--cyclic", action="store_true", help="the last key-frame leads on to the first")
    text = "times of the key-frames, ascending, in any unit; of a cycle, also the time when it begins again"
    add("--times", nargs="+", type=float, metavar="T", help=text)
    text = "interpolate each pair of key-frames alone, without its neighbours in time"
    add("--no-smooth", dest="smooth", action="store_const", const=False, help=text)
    add("--contact", action="store_true", help="keep parts from passing through each other (extra contact)")
    text = "a coarser mesh of N vertices moves and carries the detail; 0: none (default: 20000 for large meshes)"
    add("--proxy", type=int, metavar="N", help=text)
    text = "accurate; fast, no elastic steps; modal, in vibration modes; paper, its method whole (default: %(default)s)"
    add("--preset", choices=("accurate", "fast", "modal", "paper"), default="accurate", help=text)
    group = sub.add_argument_group("animation")
    text = "of the sequence once (default: 1 for a cycle, 2 for two key-frames, 1 an interval of more)"
    group.add_argument("--duration", type=float, metavar="SECONDS", help=text)
    text = "frames a second; with --duration, pictures or samples a second of videos and point caches (default: 24)"
    group.add_argument("--fps", type=float, metavar="X", help=text)
    group.add_argument("--ping-pong", action="store_true", help="there and back again")
    group.add_argument("--ease", action="store_true", help="slow at both ends")
    arguments.add_forms(group)
    arguments.add_registration(sub, optional=True)
    arguments.add_modes(sub)
    arguments.add_cache(sub)


def run(args: argparse.Namespace) -> None:
    """Fill a sequence of key-frames.

    Compute a dense sequence of shapes from key-frames.

    Each level puts a new shape between all neighbours, so L levels turn every interval
    into 2**L. The key-frames themselves stay as they are, at their places.

    Examples:
      one animated file, with a picture next to linear interpolation:
        torch-modal interpolate open.obj fist.obj --out hand.glb --picture hand.png
      a cycle of six key-frames as 96 numbered OBJ files and animation.glb in a folder:
        torch-modal interpolate gait-?.ply --cyclic --levels 4 --out gait --format obj
      a GIF that goes there and back again:
        torch-modal interpolate open.obj fist.obj --out hand.gif --ping-pong --ease
      a point cache for the mesh that is already in Blender:
        torch-modal interpolate open.obj fist.obj --out hand.mdd --duration 3 --fps 24
    """
    if len(args.meshes) < 2:
        args.fail("interpolate needs two key-frames or more")
    animation = check_files(args, args.meshes)
    check_forms(animation, args.bones, args.targets)
    Timing(len(args.meshes), **pick_options(args, *ANIMATION))

    import torch

    import torch_modal as tm
    from torch_modal.motion.subdivide import keyframe_places
    from torch_modal.passengers.proxy import proxy_size
    from torch_modal.times import fill_linear

    n, spread = len(args.meshes), pick_options(args, "cyclic", "n_frames", "times")
    places = keyframe_places(n, args.levels, **spread)
    when = fill_linear(torch.tensor(args.times, dtype=torch.float64), places).tolist() if args.times else None
    registration = pick_options(args, "register", "report", *arguments.REGISTRATION)
    keyframes, faces = tm.load_keyframes(args.meshes, **registration)
    asset = tm.open_asset(args.meshes[0])
    welded = tm.weld_seams(keyframes, faces)
    bases = partial(tm.extract_bases, **pick_options(args, *arguments.MODES))
    options = pick_options(args, "smooth", "preset", "contact", "proxy", "progress")
    solved = tm.interpolate(welded.keyframes, welded.faces, args.levels, bases=bases, **spread, **options)
    if n_proxy := proxy_size(args.proxy, welded.keyframes.shape[1]):
        args.report(f"moved by a proxy of about {n_proxy} vertices (--proxy 0: by the whole mesh)")
    frames = welded.scatter(solved)
    keys = [place for place in places if place < len(frames)]
    frames[keys] = keyframes
    seams = f", {welded.n_merged} of them copies along seams" if welded.n_merged else ""
    args.report(f"{n} key-frames of {keyframes.shape[1]} vertices{seams} -> {len(frames)} frames")
    options = pick_options(args, "cyclic", "duration", "ping_pong", "ease", "bones", "targets")
    write_sequence(args, animation, frames, faces, asset, keyframe_indices=keys, times=when, **options)
    if args.picture:
        rows = {"torch_modal": frames, "linear": fill_linear(keyframes, places)}
        tm.render_sequence(rows, faces, args.picture, keyframe_indices=keys)
        args.report(f"picture:   {args.picture}")
