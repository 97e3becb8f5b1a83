"""The main job on the sample key-frames, beside linear interpolation and the truth."""

import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from torch_modal.data.samples import Sample, load_sample
from torch_modal.geometry.connectivity import Connectivity
from torch_modal.geometry.inspect import signed_volume
from torch_modal.motion.subdivide import keyframe_places, linear_sequence, subdivide
from torch_modal.precompute.extract import extract_bases
from torch_modal.view.animation import save_animation
from torch_modal.view.picture import render_sequence

# Columns of the picture, in intervals of key-frames: the truth is known at all of them.
PICTURE_TIMES = {"creature": (1.0, 1.5, 2.0, 2.5, 3.0), "hand": (0.0, 0.25, 0.5, 0.75, 1.0)}


class Error(NamedTuple):
    """How far a frame is from the true one."""

    edges: float
    """Mean of ``|l - l_true| / l_true`` over all edges."""
    volume: float
    """Ratio to the true volume."""


class Comparison(NamedTuple):
    """Both methods at one time of a sample."""

    sample: str
    time: float
    linear: Error
    ours: Error


def run_demo(
    names: Sequence[str],
    out: Path,
    *,
    levels: int = 3,
    n_modes: int = 30,
    precompute: Mapping[str, Any] | None = None,
    report: Callable[[str], None] = print,
) -> list[Comparison]:
    """Subdivide the samples; write an animation and a picture of each, and say how good they are.

    Args:
        names: Samples, see :func:`torch_modal.data.samples.load_sample`.
        out: Folder for ``NAME.glb`` and ``NAME.png``, which are replaced.
        levels: How often the number of intervals doubles.
        n_modes: Elastic modes of each key-frame.
        precompute: Further options of `extract_bases`; ``progress`` holds for the rest too.
        report: Takes each line of the table and of the summary.

    Returns:
        The comparisons behind the table: one for each true frame that a frame of the result falls on.
    """
    options = dict(precompute or {})
    found: list[Comparison] = []
    files: list[Path] = []
    for name in names:
        sample = load_sample(name)
        report(f"{name}: {len(sample.keyframes)} key-frames of {sample.keyframes.shape[1]} vertices")
        started = time.perf_counter()
        bases = extract_bases(sample.keyframes, sample.faces, n_modes, **options)
        extracted = time.perf_counter()
        frames = subdivide(
            sample.keyframes, sample.faces, levels, bases=bases, cyclic=sample.cyclic, progress=options.get("progress")
        )
        finished = time.perf_counter()
        new = len(frames) - len(sample.keyframes)
        report(
            f"  {n_modes} modes of each: {extracted - started:.1f} s"
            + (", kept in the cache" if options.get("cache", True) else "")
        )
        report(f"  {new} shapes in between: {finished - extracted:.1f} s")
        places = keyframe_places(len(sample.keyframes), levels, cyclic=sample.cyclic)
        linear = linear_sequence(sample.keyframes, places)
        found += compare(name, sample, linear, frames, levels)
        files += [
            _animate(sample, frames, levels, out / f"{name}.glb"),
            _draw(name, sample, linear, frames, levels, out / f"{name}.png"),
        ]
    for line in table(found):
        report(line)
    report(f"written to {out}: " + ", ".join(file.name for file in files))
    return found


def compare(name: str, sample: Sample, linear: Tensor, ours: Tensor, levels: int) -> list[Comparison]:
    """Errors against the true frames. *Shape of the sequences:* ``(N, V, 3)``."""
    edges = torch.tensor(Connectivity(sample.faces.numpy()).edges)

    def error(shape: Tensor, true: Tensor) -> Error:
        lengths, wanted = (torch.linalg.norm(x[edges[:, 0]] - x[edges[:, 1]], dim=-1) for x in (shape, true))
        volumes = [signed_volume(x.numpy(), sample.faces.numpy()) for x in (shape, true)]
        return Error(float(((lengths - wanted).abs() / wanted).mean()), volumes[0] / volumes[1])

    found = []
    for when, true in zip(sample.true_times, sample.truth, strict=True):
        place = when * 2**levels
        if place == int(place):
            found.append(Comparison(name, when, error(linear[int(place)], true), error(ours[int(place)], true)))
    return found


def table(found: Sequence[Comparison]) -> list[str]:
    """Lines to print: each true frame, the mean of each sample."""
    lines = [
        "",
        f"{'against the true frames':26s}{'edge-length error':>24s}   {'volume / true volume':>24s}",
        f"{'':26s}" + "   ".join([f"{'linear':>10s}{'torch_modal':>14s}"] * 2),
    ]

    def row(label: str, linear: Error, ours: Error) -> str:
        return (
            f"{label:26s}{100 * linear.edges:>8.1f} %{100 * ours.edges:>12.1f} %"
            f"   {linear.volume:>10.3f}{ours.volume:>14.3f}"
        )

    for name in dict.fromkeys(one.sample for one in found):
        own = [one for one in found if one.sample == name]
        lines += [row(f"{name}, key-frame {one.time:g}", one.linear, one.ours) for one in own]
        means = [Error(*np.mean([getattr(one, which) for one in own], axis=0)) for which in ("linear", "ours")]
        lines.append(row(f"{name}, mean", *means))
    return [*lines, ""]


def _animate(sample: Sample, frames: Tensor, levels: int, file: Path) -> Path:
    """Write the GLB: round and round, or there and back."""
    if not sample.cyclic:
        frames = torch.cat([frames, frames[1:-1].flip(0)])
    seconds = sample.seconds if sample.cyclic else 2 * sample.seconds
    keys = list(range(0, len(frames), 2**levels))
    return save_animation(
        frames, sample.faces, file, len(frames) / seconds, keys, cyclic=True, overwrite=True, max_targets=100
    )


def _draw(name: str, sample: Sample, linear: Tensor, ours: Tensor, levels: int, file: Path) -> Path:
    """Draw the truth, the result and linear interpolation under each other."""
    known = {float(i): shape for i, shape in enumerate(sample.keyframes)}
    known |= dict(zip(sample.true_times, sample.truth, strict=True))
    times = [when for when in PICTURE_TIMES[name] if (when * 2**levels).is_integer()]
    columns = [int(when * 2**levels) for when in times]
    rows = {
        "true": torch.stack([known[when] for when in times]),
        "torch_modal": ours[columns],
        "linear": linear[columns],
    }
    keys = [i for i, when in enumerate(times) if when == int(when)]
    return render_sequence(
        rows, sample.faces, file, columns=len(times), keyframe_indices=keys, view=sample.view, overwrite=True
    )
