"""``torch-modal subdivide``: from key-frames to files."""

import argparse
import warnings
from functools import partial
from pathlib import Path
from typing import Any

from torch_modal.cli.arguments import (
    add_common,
    add_forms,
    add_levels,
    add_modes,
    add_registration,
    check_forms,
    check_output,
    file_name,
    is_file,
    mode_options,
    number,
    pick_options,
    register_options,
    reporter,
)
from torch_modal.io.formats import ANIMATION_FORMATS, MESH_FORMATS, PICTURES


def add_output(sub: argparse.ArgumentParser, picture: str) -> None:
    """Add ``--out``, ``--format`` and ``--picture`` of a sequence."""
    add = sub.add_argument
    text = f"the animation alone: {', '.join(ANIMATION_FORMATS)}; a folder: numbered frames and animation.glb"
    add("--out", type=Path, required=True, metavar="FILE_OR_FOLDER", help=text)
    text = "format of the numbered frames (default: as the first mesh, with everything else in its file)"
    add("--format", choices=[suffix[1:] for suffix in MESH_FORMATS], help=text)
    add("--picture", type=file_name(PICTURES), metavar="FILE", help=f"also draw {picture}, as .png or .pdf")


def check_files(args: argparse.Namespace, inputs: list[Path]) -> tuple[Path, str | None, list[Path]]:
    """Path of the animation; for a folder also the format of its frames, and frames of an earlier run.

    Raises as `check_output`.
    """
    animation, fmt, earlier = args.out, None, []
    if not is_file(args, ANIMATION_FORMATS):
        animation, fmt = args.out / "animation.glb", args.format or inputs[0].suffix.lower()[1:].replace("gltf", "glb")
        earlier = sorted(args.out.glob(f"frame-*.{fmt}"))
    check_output([animation, *([args.picture] if args.picture else []), *earlier], inputs, args.overwrite)
    return animation, fmt, earlier


def write_sequence(args: argparse.Namespace, files: Any, frames: Any, faces: Any, asset: Any, **options: Any) -> None:
    """Write frames and animation to the paths from `check_files`; ``options`` are passed to `save_animation`."""
    import torch_modal as tm

    report, (animation, fmt, earlier) = reporter(args), files
    same = {"overwrite": args.overwrite, "asset": asset}
    if fmt:
        written = tm.save_frames(frames, faces, args.out, fmt, **same)
        report(f"frames:    {written[0]} to {written[-1].name}")
        left = sorted(set(earlier) - set(written))
        if left:  # they look like the end of this sequence
            message = f"{args.out} also holds {len(left)} frames of an earlier run, from {left[0].name}"
            warnings.warn(message, stacklevel=2)
    tm.save_animation(frames, faces, animation, args.fps, progress=False if args.quiet else None, **same, **options)
    report(f"animation: {animation}")


def add_arguments(sub: argparse.ArgumentParser) -> None:
    """Add the arguments of ``subdivide``."""
    add, positive = sub.add_argument, number(float, 0, above=True)
    add("meshes", nargs="+", type=Path, metavar="MESH", help="key-frames, two or more, in their order")
    add_output(sub, "the sequence next to linear interpolation")
    add_levels(sub, 0)
    text = "number of frames of the result (default: as many as the levels give)"
    add("--frames", type=number(int, 2), metavar="N", help=text)
    add("--cyclic", action="store_true", help="the last key-frame leads on to the first")
    text = "times of the key-frames, ascending, in any unit; of a cycle, also the time when it begins again"
    add("--times", type=times, metavar="T,T,...", help=text)
    text = "interpolate each pair of key-frames alone, without its neighbours in time"
    add("--no-smooth", dest="smooth", action="store_const", const=False, help=text)
    add("--contact", action="store_true", help="keep parts from passing through each other (extra contact)")
    text = (
        "a coarser mesh of N vertices moves, and carries the detail; 0: the mesh itself (default: 20000, for meshes "
        "of more than 100000 vertices)"
    )
    add("--proxy", type=number(int, 0), metavar="N", help=text)
    text = "accurate; fast, without steps on the fine mesh; paper, its method whole (default: %(default)s)"
    add("--preset", choices=("accurate", "fast", "paper"), default="accurate", help=text)
    add("--mu", type=number(float, 0), metavar="X", help="with --preset paper: weight of the similarity")
    text = "with --preset paper: segments, the worst of 24, that are interpolated locally (default: 8)"
    add("--regions", type=number(int, 0), metavar="N", help=text)
    group = sub.add_argument_group("animation")
    text = "of the sequence once (default: 1 for a cycle, 2 for two key-frames, 1 an interval of more)"
    group.add_argument("--duration", type=positive, metavar="SECONDS", help=text)
    text = "frames a second; with --duration, pictures or samples a second of videos and point caches (default: 24)"
    group.add_argument("--fps", type=positive, metavar="X", help=text)
    group.add_argument("--ping-pong", action="store_true", help="there and back again")
    group.add_argument("--ease", action="store_true", help="slow at both ends")
    add_forms(group)
    add_registration(sub, optional=True)
    add_modes(sub)
    add_common(sub)


def times(text: str) -> list[float]:
    """An argument type: numbers with commas between them."""
    try:
        return [float(word) for word in text.split(",")]
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is no list of numbers such as 0,0.4,1") from None


def run(args: argparse.Namespace) -> None:
    """Fill a sequence of key-frames.

    Compute a dense sequence of shapes from key-frames.

    Each level puts a new shape between all neighbours, so L levels turn every interval
    into 2**L. The key-frames themselves stay as they are, at their places.

    Examples:
      one animated file, with a picture next to linear interpolation:
        torch-modal subdivide open.obj fist.obj --out hand.glb --picture hand.png
      a cycle of six key-frames as 96 numbered OBJ files and animation.glb in a folder:
        torch-modal subdivide gait-?.ply --cyclic --levels 4 --out gait --format obj
      a GIF that goes there and back again:
        torch-modal subdivide open.obj fist.obj --out hand.gif --ping-pong --ease
      a point cache for the mesh that is already in Blender:
        torch-modal subdivide open.obj fist.obj --out hand.mdd --duration 3 --fps 24
    """
    if len(args.meshes) < 2:
        args.fail("subdivide needs two key-frames or more")
    if args.contact and args.preset == "paper":
        args.fail("--contact needs one shape for each in-between; --preset paper has two")
    if args.preset != "paper" and (args.mu is not None or args.regions is not None):
        args.fail(f"--{'regions' if args.mu is None else 'mu'} is for the two shapes of --preset paper")
    if args.cyclic and (args.ping_pong or args.ease):
        option = "ping-pong" if args.ping_pong else "ease"
        args.fail(f"--{option} is for sequences that begin and end; a cycle does not")
    files = check_files(args, args.meshes)
    check_forms(args, files[0])
    registration = {"register": args.register, **register_options(args)}

    import torch_modal as tm
    from torch_modal.passengers.proxy import proxy_size
    from torch_modal.view.animation import require_packages

    require_packages(files[0])
    n, spread = len(args.meshes), {"cyclic": args.cyclic, "n_frames": args.frames, "times": args.times}
    places = tm.keyframe_places(n, args.levels, **spread)
    when = tm.frame_times(n, args.levels, **spread).tolist() + args.times[-1:] * args.cyclic if args.times else None
    report = reporter(args)
    keyframes, faces = tm.load_keyframes(args.meshes, **registration, report=report)
    asset = tm.open_asset(args.meshes[0])
    welded = tm.weld_seams(keyframes, faces)
    solved = tm.subdivide(
        welded.keyframes,
        welded.faces,
        args.levels,
        bases=partial(tm.extract_bases, **mode_options(args)),
        **spread,
        **pick_options(args, "smooth", "preset", "contact", "mu", "regions", "proxy"),
        progress=False if args.quiet else None,
    )
    n_proxy = proxy_size(args.proxy, welded.keyframes.shape[1])
    if n_proxy:
        report(f"moved by a proxy of about {n_proxy} vertices (--proxy 0: by the whole mesh)")
    frames = welded.scatter(solved)
    keys = [place for place in places if place < len(frames)]
    frames[keys] = keyframes
    seams = f", {welded.n_merged} of them copies along seams" if welded.n_merged else ""
    report(f"{n} key-frames of {keyframes.shape[1]} vertices{seams} -> {len(frames)} frames")
    options = pick_options(args, "cyclic", "duration", "ping_pong", "ease", "bones", "targets")
    write_sequence(args, files, frames, faces, asset, keyframe_indices=keys, times=when, **options)
    if args.picture:
        rows = {"torch_modal": frames, "linear": tm.linear_sequence(keyframes, places)}
        tm.render_sequence(rows, faces, args.picture, keyframe_indices=keys, overwrite=args.overwrite)
        report(f"picture:   {args.picture}")
