"""``torch-modal compress`` and ``expand``: a motion as a small file, and back."""

import argparse
import warnings
from pathlib import Path

from torch_modal.cli.arguments import add_out, caching, number, reporter
from torch_modal.cli.output import check_name, check_output
from torch_modal.io.formats import ANIMATION_FORMATS, MESH_FORMATS

SUFFIX = ".tms"

COMPRESS = "a motion as a small file"
COMPRESS_DESCRIPTION = """\
Write frames of one connectivity as a small file: a few key-frames, and amplitudes of
vibration modes for the others. No frame is further from the given one than --error,
as a mean over the vertices, which is checked on the finished file."""
COMPRESS_EXAMPLES = """\
example:
  torch-modal compress frames/*.obj --error 0.2% --out walk.tms
  torch-modal expand walk.tms --out walk"""

EXPAND = "the frames of a small file"
EXPAND_DESCRIPTION = """\
Compute the frames of a file that `compress` wrote. Its modes are computed first,
once on each machine; they are kept in the cache."""
EXPAND_EXAMPLES = """\
examples:
  torch-modal expand walk.tms --out walk                 frame-000.ply, frame-001.ply, ...
  torch-modal expand walk.tms --out walk.glb             one animated file
  torch-modal expand walk.tms --frames 500 --out slow    in slow motion"""


def part(text: str) -> float:
    """An argument type: ``0.2%``, or ``0.002``."""
    try:
        value = float(text[:-1]) / 100 if text.endswith("%") else float(text)
    except ValueError:
        value = float("nan")
    if not 0 < value < 1:
        raise argparse.ArgumentTypeError(f"{text!r} is not a part of the diagonal such as 0.2% or 0.002")
    return value


def add_compress(sub: argparse.ArgumentParser) -> None:
    """Arguments of ``compress`` besides the common ones."""
    sub.add_argument("meshes", nargs="+", type=Path, metavar="MESH", help="frames, two or more, in their order")
    add_out(sub, "FILE.tms", "the file")
    sub.add_argument(
        "--error",
        type=part,
        default=0.002,
        metavar="PART",
        help="mean distance of the vertices that no frame is above, as a part of the bounding-box diagonal "
        "(default: 0.2%%)",
    )
    sub.add_argument(
        "--modes", type=number(int, 1), default=60, metavar="N", help="amplitudes of a frame (default: %(default)s)"
    )
    sub.add_argument("--cyclic", action="store_true", help="the last frame leads on to the first")


def add_expand(sub: argparse.ArgumentParser) -> None:
    """Arguments of ``expand`` besides the common ones."""
    sub.add_argument("file", type=Path, metavar="FILE.tms", help="a file that compress wrote")
    add_out(sub, "FILE_OR_FOLDER", f"an animation ({', '.join(ANIMATION_FORMATS)}), or a folder for numbered frames")
    sub.add_argument(
        "--format",
        choices=[suffix[1:] for suffix in MESH_FORMATS],
        default="ply",
        help="of numbered frames (default: %(default)s)",
    )
    sub.add_argument(
        "--frames", type=number(int, 2), metavar="N", help="another number of frames, even in time (default: its own)"
    )
    sub.add_argument("--fps", type=number(float, 0, above=True), default=24.0, metavar="X", help="of an animation")


def compress(args: argparse.Namespace) -> None:
    """Run ``torch-modal compress``."""
    if len(args.meshes) < 2:
        args.fail("compress needs two frames or more")
    check_name(args, "--out", args.out, (SUFFIX,))
    check_output([args.out], args.meshes, args.overwrite)

    import torch_modal as tm

    frames, faces = tm.load_keyframes(args.meshes)
    if merged := tm.weld_seams(frames, faces).n_merged:
        warnings.warn(
            f"{merged} vertices are copies along seams, which may open by as much as the error; welded meshes do not",
            stacklevel=2,
        )
    args.out.parent.mkdir(parents=True, exist_ok=True)
    found = tm.compress(frames, faces, args.out, args.error, args.modes, cyclic=args.cyclic, **caching(args))
    report, (n, v) = reporter(args), frames.shape[:2]
    worst = int(found.errors.argmax())
    bits = 8 * (found.n_bytes - found.n_faces_bytes) / (n * v)
    less = 12 * n * v / found.n_bytes
    report(f"{n} frames of {v} vertices -> {args.out}, {found.n_bytes} bytes, 1/{less:.0f} of float32")
    report(f"faces: {found.n_faces_bytes} bytes; all else: {bits:.3g} bits a vertex and frame")
    report(f"key-frames: {', '.join(map(str, found.keyframes))}")
    report(
        f"distance, of the written file: mean {100 * float(found.errors.mean()):.3g} %, at most "
        f"{100 * float(found.errors[worst]):.3g} % of the diagonal (frame {worst}; allowed: {100 * args.error:g} %)"
    )


def expand(args: argparse.Namespace) -> None:
    """Run ``torch-modal expand``."""
    from torch_modal.view.animation import require_packages

    animated = args.out.suffix.lower() in ANIMATION_FORMATS
    if animated:
        check_output([args.out], [args.file], args.overwrite)
        require_packages(args.out)
    else:
        files = [args.out / f"frame-000.{args.format}"]
        check_output(files, [args.file], args.overwrite, folder=args.out, pattern=f"frame-*.{args.format}")

    import torch

    import torch_modal as tm

    motion = tm.ModalSequence.load(args.file, cache_dir=args.cache_dir, cache=not args.no_cache)
    times = None
    if args.frames is not None:
        ends = motion.keyframe_times if motion.cyclic else motion.times
        times = torch.linspace(float(ends[0]), float(ends[-1]), args.frames + motion.cyclic).double()[: args.frames]
    frames = motion.decode(times, progress=False if args.quiet else None)
    if animated:
        args.out.parent.mkdir(parents=True, exist_ok=True)
        tm.save_animation(frames, motion.faces, args.out, args.fps, cyclic=motion.cyclic, overwrite=args.overwrite)
        written = [args.out]
    else:
        written = tm.save_frames(frames, motion.faces, args.out, args.format, overwrite=args.overwrite)
    last = f" to {written[-1].name}" if len(written) > 1 else ""
    reporter(args)(f"{len(frames)} frames of {frames.shape[1]} vertices: {written[0]}{last}")
