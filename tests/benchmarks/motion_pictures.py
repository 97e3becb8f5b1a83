"""The pictures of docs/motion.md: trails of a hoof and a fingertip, and speeds."""

from __future__ import annotations

from pathlib import Path

import matplotlib
import torch
from motion_measures import Measured
from motions import Motion, fractions, gallop, grip
from torch import Tensor

matplotlib.use("Agg")
import matplotlib.pyplot as plt

DENSE = 16  # shapes to each interval
LOOKS = {
    "truth": {"color": "0.55", "lw": 3.5, "alpha": 0.6},
    "each pair alone": {"color": "tab:red", "lw": 1.1},
    "smooth": {"color": "tab:blue", "lw": 1.3},
}
# What is looked at, and from where: the axes of the picture.
SEEN = {"creature": ("a hoof", 0, 1), "hand with a stop": ("a fingertip", 2, 1)}


def draw(folder: Path) -> None:
    """Write ``motion-trails.png`` and ``motion-speed.png``."""
    drawn = [(motion, *_sequences(motion)) for source in (gallop, grip) for motion in source()]
    trails, below = plt.subplots(1, 2, figsize=(9.0, 3.8), layout="constrained")
    for axes, (motion, _, ways) in zip(below, drawn, strict=True):
        _draw_trails(axes, motion, ways)
    speeds, below = plt.subplots(2, 1, figsize=(9.0, 5.0), layout="constrained")
    for axes, (motion, times, ways) in zip(below, drawn, strict=True):
        _draw_speeds(axes, motion, times, ways)
    below[0].legend(fontsize="small", loc="upper right")
    for figure, name in ((trails, "motion-trails.png"), (speeds, "motion-speed.png")):
        figure.savefig(folder / name, dpi=90)
        plt.close(figure)
        print(f"{folder / name}: {(folder / name).stat().st_size / 1e3:.0f} kB")


def _sequences(motion: Motion) -> tuple[Tensor, dict[str, Tensor]]:
    """Times, and all shapes then in truth and in both ways. *Shape of each:* ``(T, V, 3)``."""
    measured, truth = Measured(motion), motion.truth
    assert truth is not None
    times = [*fractions(motion.times, *(i / DENSE for i in range(DENSE))), motion.times[-1]]
    ways = {
        "truth": torch.stack([truth(t) for t in times]),
        "each pair alone": measured.at(times, smooth=False),
        "smooth": measured.at(times),
    }
    return torch.tensor(times), ways


def _draw_trails(axes: plt.Axes, motion: Motion, ways: dict[str, Tensor]) -> None:
    """Where the vertex that travels the farthest goes; the first key-frame behind it."""
    what, across, up = SEEN[motion.name]
    keys = motion.shapes.keyframes
    farthest = int(ways["truth"].diff(dim=0).norm(dim=-1).sum(0).argmax())
    axes.scatter(*keys[0][::3, [across, up]].T, s=1, color="0.88", linewidths=0)
    for name, x in ways.items():
        axes.plot(*x[:, farthest, [across, up]].T, label=name, **LOOKS[name])
    axes.plot(*keys[:, farthest, [across, up]].T, "k.", ms=7, label="key-frames")
    path = ways["truth"][:, farthest, [across, up]]
    low, high = path.amin(0), path.amax(0)
    room = 0.12 * float((high - low).amax())
    axes.set(xlim=(low[0] - room, high[0] + room), ylim=(low[1] - room, high[1] + room), title=f"{motion.name}: {what}")
    axes.set_aspect("equal", adjustable="datalim")
    axes.set(xticks=[], yticks=[])
    axes.legend(fontsize="small")


def _draw_speeds(axes: plt.Axes, motion: Motion, times: Tensor, ways: dict[str, Tensor]) -> None:
    """Mean speed of the vertices."""
    middle = 0.5 * (times[1:] + times[:-1])
    for name, x in ways.items():
        speed = x.diff(dim=0).norm(dim=-1).mean(-1) / times.diff() / motion.diagonal
        axes.plot(middle, speed, label=name, **LOOKS[name])
    for t in motion.times:
        axes.axvline(t, color="0.8", lw=0.8, zorder=0)
    axes.set(title=motion.name, xlabel="time (lines: key-frames)", ylabel="diagonals a unit of time", ylim=(0, None))
    axes.margins(x=0)
