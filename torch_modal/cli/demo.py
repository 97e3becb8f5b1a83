"""``torch-modal demo``: the main job on the sample key-frames, next to linear interpolation."""

import argparse
from pathlib import Path
from typing import Any

from torch_modal.cli import arguments

SAMPLES = ("creature", "hand")


def add_arguments(sub: argparse.ArgumentParser) -> None:
    """Add the arguments of ``demo``."""
    add, folder = sub.add_argument, Path("torch-modal-demo")
    add("--out", type=Path, default=folder, metavar="FOLDER", help="where the files go (default: %(default)s)")
    add("--sample", choices=SAMPLES, help="only this one (default: both)")
    arguments.add_levels(sub)


def run(args: argparse.Namespace) -> None:
    """Try it on the samples that come with it.

    Run the main job on the samples that come with the package: a galloping creature
    (a cycle of six key-frames) and a closing hand (two key-frames).

    For each it writes an animation (GLB) and a picture of the sequence next to linear
    interpolation.

    Examples:
      torch-modal demo --sample hand --out hand-demo
    """
    names = [args.sample] if args.sample else SAMPLES
    files = [args.out / f"{name}{suffix}" for name in names for suffix in (".glb", ".png")]
    arguments.check_output(args, files, ())

    import torch_modal as tm
    from torch_modal.data.samples import load_sample

    for name in names:
        sample = load_sample(name)
        keyframes, faces, cyclic = sample.keyframes, sample.faces, sample.cyclic
        args.report(f"{name}: {len(keyframes)} key-frames of {keyframes.shape[1]} vertices")
        frames = tm.subdivide(keyframes, faces, args.levels, cyclic=cyclic, progress=args.progress)
        places = tm.keyframe_places(len(keyframes), args.levels, cyclic=cyclic)
        keys = [place for place in places if place < len(frames)]
        plays: dict[str, Any] = {"cyclic": cyclic, "ping_pong": not cyclic, "duration": sample.seconds}
        glb, png = (args.out / f"{name}{suffix}" for suffix in (".glb", ".png"))
        tm.save_animation(frames, faces, glb, keyframe_indices=keys, overwrite=True, **plays)
        rows = {"torch_modal": frames, "linear": tm.linear_sequence(keyframes, places)}
        tm.render_sequence(rows, faces, png, keyframe_indices=keys, view=sample.view, overwrite=True)
    args.report(f"written to {args.out}: " + ", ".join(file.name for file in files))
