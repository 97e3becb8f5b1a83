"""``torch-modal demo``: the main job on the sample key-frames, next to linear interpolation and the truth."""

from __future__ import annotations

import argparse
import time
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from torch_modal.cli.arguments import add_common, add_levels, add_modes, check_output, is_file, mode_options, reporter

if TYPE_CHECKING:
    from torch import Tensor

    from torch_modal.data.samples import Sample

# Columns of the picture, in intervals of key-frames: the truth is known at all of them.
PICTURE_TIMES = {"creature": (1.0, 1.5, 2.0, 2.5, 3.0), "hand": (0.0, 0.25, 0.5, 0.75, 1.0)}


def add_arguments(sub: argparse.ArgumentParser) -> None:
    """Add the arguments of ``demo``."""
    add, folder = sub.add_argument, Path("torch-modal-demo")
    add("--out", type=Path, default=folder, metavar="FOLDER", help="where the files go (default: %(default)s)")
    add("--sample", choices=list(PICTURE_TIMES), help="only this one (default: both)")
    add_levels(sub, 1)
    add_modes(sub)
    add_common(sub)


def run(args: argparse.Namespace) -> None:
    """Try it on the samples that come with it.

    Run the main job on the samples that come with the package: a galloping creature
    (a cycle of six key-frames) and a closing hand (two key-frames).

    For each it writes an animation (GLB) and a picture of the sequence next to linear
    interpolation and the truth, and prints how far both are from the true frames.

    Examples:
      torch-modal demo --sample hand --out hand-demo
    """
    names = [args.sample] if args.sample else list(PICTURE_TIMES)
    is_file(args, [])
    files = [args.out / f"{name}{suffix}" for name in names for suffix in (".glb", ".png")]
    check_output(files, (), args.overwrite)

    import torch

    import torch_modal as tm
    from torch_modal.data.samples import load_sample

    report, progress, n = reporter(args), False if args.quiet else None, 2**args.levels
    table = ["", f"{'against the true frames':26s}{'edge-length error':26s}volume / true volume"]
    for name in names:
        sample = load_sample(name)
        keyframes, faces, cyclic = sample.keyframes, sample.faces, sample.cyclic
        report(f"{name}: {len(keyframes)} key-frames of {keyframes.shape[1]} vertices")
        started = time.perf_counter()
        bases = partial(tm.extract_bases, **mode_options(args))
        frames = tm.subdivide(keyframes, faces, args.levels, bases=bases, cyclic=cyclic, progress=progress)
        report(f"  {len(frames) - len(keyframes)} shapes in between: {time.perf_counter() - started:.1f} s")
        places = tm.keyframe_places(len(keyframes), args.levels, cyclic=cyclic)
        tm.save_animation(
            frames,
            faces,
            args.out / f"{name}.glb",
            keyframe_indices=[place for place in places if place < len(frames)],
            cyclic=cyclic,
            ping_pong=not cyclic,
            duration=sample.seconds,
            overwrite=True,
        )
        sequences = {"linear": tm.linear_sequence(keyframes, places), "torch_modal": frames}
        times = [when for when in PICTURE_TIMES[name] if (when * n).is_integer()]
        known = dict(enumerate(keyframes)) | dict(zip(sample.true_times, sample.truth, strict=True))
        rows = {method: x[[int(when * n) for when in times]] for method, x in reversed(sequences.items())}
        tm.render_sequence(
            {"true": torch.stack([known[when] for when in times]), **rows},
            faces,
            args.out / f"{name}.png",
            columns=len(times),
            keyframe_indices=[i for i, when in enumerate(times) if when.is_integer()],
            view=sample.view,
            overwrite=True,
        )
        for method, x in sequences.items():
            edges, volumes = errors(sample, x, args.levels).T
            off = f"{100 * edges.mean():.1f} % (worst {100 * edges.max():.1f} %)"
            table.append(f"{f'{name}, {method}':26s}{off:26s}{volumes.mean():.3f}")
    for line in [*table, "", f"written to {args.out}: " + ", ".join(file.name for file in files)]:
        report(line)


def errors(sample: Sample, frames: Tensor, levels: int) -> Tensor:
    """Errors at the true times that fall on one of the frames, of which an interval has ``2**levels``.

    The mean of ``|l - l_true| / l_true`` over all edges, and the ratio to the true volume. *Shape:* ``(T, 2)``.
    """
    import torch

    from torch_modal.geometry.connectivity import Connectivity
    from torch_modal.geometry.inspect import signed_volume

    faces, rows = sample.faces.numpy(), []
    i, j = torch.tensor(Connectivity(faces).edges).T
    for when, true in zip(sample.true_times, sample.truth, strict=True):
        if (when * 2**levels).is_integer():
            x = frames[int(when * 2**levels)]
            length, true_length = ((shape[i] - shape[j]).norm(dim=-1) for shape in (x, true))
            off = float(((length - true_length).abs() / true_length).mean())
            rows.append((off, signed_volume(x.numpy(), faces) / signed_volume(true.numpy(), faces)))
    return torch.tensor(rows)
