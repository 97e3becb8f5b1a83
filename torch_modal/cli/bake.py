"""``torch-modal bake``: from a sequence of meshes to one file that plays."""

import argparse
from pathlib import Path

from torch_modal.cli import arguments
from torch_modal.cli.arguments import pick_options
from torch_modal.io.formats import ANIMATION_FORMATS, check_forms
from torch_modal.io.write import check_suffix


def add_arguments(sub: argparse.ArgumentParser) -> None:
    """Add the arguments of ``bake``."""
    add = sub.add_argument
    text = "meshes in their order, a folder or a quoted pattern of them, an animated GLB, Alembic or NPZ file"
    add("meshes", nargs="+", type=Path, metavar="MESH", help=text)
    text = f"the file: {', '.join(ANIMATION_FORMATS)}"
    add("--out", type=Path, required=True, metavar="FILE", help=text)
    arguments.add_forms(sub)
    arguments.add_size(sub)
    add("--fps", type=float, metavar="X", help="frames a second (default: as in the file, or 24)")
    add("--cyclic", action="store_true", help="the last frame leads on to the first")
    text = "take out trembling: what has a period of X frames is halved, what is slower hardly changes"
    add("--smooth", type=float, metavar="X", help=text)
    text = "keep each N-th frame and the last as key-frames, and fill in a smooth path through them"
    add("--every", type=int, metavar="N", help=text)
    arguments.add_registration(sub, optional=True)
    arguments.add_cache(sub)


def run(args: argparse.Namespace) -> None:
    """Make one animated or skinned file of a sequence of meshes.

    Write the frames of a motion as one file that plays: as a skin of bones, as principal
    shapes, as a morph target for each frame, as USD, a point cache or a video.

    Errors are root mean square distances from the frames, in % of the diagonal of the first;
    half-way, from the mean of both after their turns. Materials and textures come from the first mesh.

    Examples:
      a skin for engines, of a hundred meshes:
        torch-modal bake frames/*.obj --bones 40 --fps 24 --out motion.glb
      the animation of another program, without trembling, as a video:
        torch-modal bake walk.glb --smooth 4 --out walk.mp4
      scans of different connectivity:
        torch-modal bake "scans/*.ply" --register --bones 40 --out motion.glb
    """
    if args.every is not None and args.every < 2:
        args.fail(f"--every must be 2 or more; got {args.every}")
    check_suffix(args.out, ANIMATION_FORMATS)
    check_forms(args.out, args.bones, args.targets)

    import torch

    import torch_modal as tm
    from torch_modal.data.sequence import sequence_asset, sequence_files, smooth_in_time

    files = sequence_files(args.meshes)
    arguments.check_output(args, [args.out], files)
    registration = pick_options(args, "register", "report", *arguments.REGISTRATION)
    frames, faces, fps = tm.load_sequence(files, args.fps, **registration)
    if len(frames) < 2:
        raise ValueError(f"{files[0]} is one shape; a motion has two frames or more: name more meshes, or a folder")
    args.report(f"{len(frames)} frames of {frames.shape[1]} vertices, {fps:g} a second")
    if args.smooth is not None:
        frames = smooth_in_time(frames, args.smooth, args.cyclic)
    used = frames[0, faces.unique()]
    diagonal = (used.amax(0) - used.amin(0)).norm()

    def error(off: torch.Tensor) -> str:
        return f"{100 * float(off.square().sum(-1).mean().sqrt() / diagonal):.3f} %"

    if args.every:
        n, welded = len(frames), tm.weld_seams(frames, faces)
        kept = [*range(0, n - 1, args.every), *([n - 1] * (not args.cyclic))]
        keyframes = welded.keyframes[kept]
        path = tm.Path(keyframes, welded.faces, kept + [n] * args.cyclic, args.cyclic)
        with torch.no_grad():
            filled = welded.scatter(path(keyframes, torch.arange(n)))
        left = sorted({*range(n)} - {*kept})
        if left:
            args.report(f"error:     {error((filled - frames)[left])} at the {len(left)} frames between key-frames")
        frames = filled
    skin = tm.bake(frames, faces, args.bones) if args.bones else None
    asset = sequence_asset(files)
    if asset is not None:
        asset.carries.pop("posing", None)  # it is what is written
    options = pick_options(args, "cyclic", "targets", "progress", "size")
    tm.save_animation(frames, faces, args.out, fps, bones=skin, asset=asset, **options)
    bones = f", {skin.weights.shape[1]} bones" if skin else ""
    args.report(f"animation: {args.out}, {args.out.stat().st_size / 1e6:.2f} MB{bones}")
    if skin:
        at, between = 100 * skin.error_at_frames, 100 * skin.error_between_frames
        args.report(f"error:     {at:.3f} % at the frames, {between:.3f} % half-way between them")
