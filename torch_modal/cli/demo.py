"""``torch-modal demo``: the main job on the sample key-frames, beside linear interpolation and the truth."""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from typing import TYPE_CHECKING

from torch_modal.cli.arguments import (
    add_common,
    add_levels,
    add_modes,
    check_output,
    is_file,
    mode_options,
    reporter,
)

if TYPE_CHECKING:
    from torch import Tensor

    from torch_modal.data.samples import Sample

# Columns of the picture, in intervals of key-frames: the truth is known at all of them.
PICTURE_TIMES = {"creature": (1.0, 1.5, 2.0, 2.5, 3.0), "hand": (0.0, 0.25, 0.5, 0.75, 1.0)}


def add_arguments(sub: argparse.ArgumentParser) -> None:
    """Arguments of ``demo``."""
    folder = Path("torch-modal-demo")
    sub.add_argument(
        "--out", type=Path, default=folder, metavar="FOLDER", help="where the files go (default: %(default)s)"
    )
    sub.add_argument("--sample", choices=list(PICTURE_TIMES), help="only this one (default: both)")
    add_levels(sub, 1)
    add_modes(sub)
    add_common(sub)


def run(args: argparse.Namespace) -> None:
    """Try it on the samples that come with it.

    Run the main job on the samples that come with the package: a galloping creature
    (a cycle of six key-frames) and a closing hand (two key-frames).

    For each it writes an animation (GLB) and a picture of the sequence beside linear
    interpolation and the truth, and prints how far both are from the true frames.

    Examples:
      torch-modal demo --sample hand --out hand-demo
    """
    names = [args.sample] if args.sample else list(PICTURE_TIMES)
    is_file(args, [])
    files = [args.out / f"{name}{suffix}" for name in names for suffix in (".glb", ".png")]
    check_output(files, (), args.overwrite)

    import numpy as np

    import torch_modal as tm
    from torch_modal.data.samples import load_sample

    report = reporter(args)
    table = [
        "",
        f"{'against the true frames':26s}{'edge-length error':>24s}   {'volume / true volume':>24s}",
        f"{'':26s}" + "   ".join([f"{'linear':>10s}{'torch_modal':>14s}"] * 2),
    ]
    for name in names:
        sample = load_sample(name)
        keyframes, faces = sample.keyframes, sample.faces
        report(f"{name}: {len(keyframes)} key-frames of {keyframes.shape[1]} vertices")
        started = time.perf_counter()
        bases = tm.extract_bases(keyframes, faces, args.modes, **mode_options(args))
        extracted = time.perf_counter()
        report(
            f"  {args.modes} modes of each: {extracted - started:.1f} s{', kept in the cache' * (not args.no_cache)}"
        )
        progress = False if args.quiet else None
        frames = tm.subdivide(keyframes, faces, args.levels, bases=bases, cyclic=sample.cyclic, progress=progress)
        report(f"  {len(frames) - len(keyframes)} shapes in between: {time.perf_counter() - extracted:.1f} s")
        places = tm.keyframe_places(len(keyframes), args.levels, cyclic=sample.cyclic)
        linear = tm.linear_sequence(keyframes, places)
        tm.save_animation(
            frames,
            faces,
            args.out / f"{name}.glb",
            keyframe_indices=[place for place in places if place < len(frames)],
            cyclic=sample.cyclic,
            ping_pong=not sample.cyclic,
            duration=sample.seconds,
            overwrite=True,
        )
        _draw(name, sample, linear, frames, args.levels, args.out / f"{name}.png")
        straight, own = (list(errors(sample, shapes, args.levels).items()) for shapes in (linear, frames))
        labels = [f"{name}, key-frame {when:g}" for when, _ in own] + [f"{name}, mean"]
        both = np.array([[one for _, one in straight], [one for _, one in own]])
        both = np.concatenate([both, both.mean(1, keepdims=True)], axis=1)
        for label, edges, volumes in zip(labels, 100 * both[..., 0].T, both[..., 1].T, strict=True):
            table.append(f"{label:26s}{edges[0]:>8.1f} %{edges[1]:>12.1f} %   {volumes[0]:>10.3f}{volumes[1]:>14.3f}")
    for line in [*table, "", f"written to {args.out}: " + ", ".join(file.name for file in files)]:
        report(line)


def errors(sample: Sample, frames: Tensor, levels: int) -> dict[float, tuple[float, float]]:
    """Errors of a sequence at the times of true frames that fall on one of its own.

    Args:
        sample: With the true frames.
        frames: *Shape:* ``(N, V, 3)``.
        levels: ``2**levels`` frames an interval.

    Returns:
        By time: the mean of ``|l - l_true| / l_true`` over all edges, and the ratio to the true volume.
    """
    import torch

    from torch_modal.geometry.connectivity import Connectivity
    from torch_modal.geometry.inspect import signed_volume

    faces = sample.faces.numpy()
    ends = torch.tensor(Connectivity(faces).edges).T
    found = {}
    for when, true in zip(sample.true_times, sample.truth, strict=True):
        if (when * 2**levels).is_integer():
            x = frames[int(when * 2**levels)]
            length, true_length = ((shape[ends[0]] - shape[ends[1]]).norm(dim=-1) for shape in (x, true))
            off = float(((length - true_length).abs() / true_length).mean())
            found[when] = off, signed_volume(x.numpy(), faces) / signed_volume(true.numpy(), faces)
    return found


def _draw(name: str, sample: Sample, linear: Tensor, ours: Tensor, levels: int, file: Path) -> None:
    """Draw the truth, the result and linear interpolation under each other."""
    import torch

    import torch_modal as tm

    known = dict(enumerate(sample.keyframes)) | dict(zip(sample.true_times, sample.truth, strict=True))
    times = [when for when in PICTURE_TIMES[name] if (when * 2**levels).is_integer()]
    columns = [int(when * 2**levels) for when in times]
    rows = {
        "true": torch.stack([known[when] for when in times]),
        "torch_modal": ours[columns],
        "linear": linear[columns],
    }
    keys = [i for i, when in enumerate(times) if when.is_integer()]
    tm.render_sequence(
        rows, sample.faces, file, columns=len(times), keyframe_indices=keys, view=sample.view, overwrite=True
    )
