"""Motion through many key-frames, smooth in time, beside each pair of key-frames alone.

    python tests/benchmarks/motion.py [gallop hand-path grip]

Distances are means over the vertices, in % of the diagonal, without any alignment; edge errors are means of
``|l - l_true| / l_true``, or, without a truth, of the strain against lengths that change evenly between key-frames.
*Corner* is the largest second difference in time at a key-frame, with a step of 1/32 of an interval, over its median at
the quarters of the intervals. Times are of the processor, on one thread, the best of several,
over those of pairs: of single shapes at random times, and of a sequence of eight shapes to each interval.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from itertools import pairwise
from statistics import fmean
from typing import Any, NamedTuple

import torch
from cases import Case
from known_motions import MOTIONS, Motion, fractions
from measures import NAN, Yardstick, mean_ratio
from results import Table, add_keep, number
from timing import limit_threads, timed
from torch import Tensor

from torch_modal.motion.path import Path

STEPS, PLACES = 32, 4  # of each interval, for second differences and their median
SEQUENCE = 8  # shapes to each interval, for the cost of a sequence


class Found(NamedTuple):
    """What is measured of one way through one motion: lists have a value for each time."""

    distance: list[float]
    edges: list[float]
    corner: float
    """The largest of all key-frames."""


class Measured:
    """A motion with its path."""

    def __init__(self, motion: Motion) -> None:
        self.motion, shapes = motion, motion.shapes
        #: Smooth, and each pair alone.
        self.paths = {
            smooth: Path(shapes.bases(30), shapes.faces, motion.times, motion.cyclic, smooth)
            for smooth in (True, False)
        }
        n = len(shapes.keyframes)
        self.yards = [Yardstick(Case(motion.name, shapes, i, (i + 1) % n, {})) for i in range(len(motion.times) - 1)]
        self.truths = None if motion.truth is None else [motion.truth(t) for t in motion.measured]

    def at(self, times: Any, smooth: bool) -> Tensor:
        """Shapes."""
        with torch.no_grad():
            return self.paths[smooth](self.motion.shapes.keyframes, torch.as_tensor(times, dtype=torch.float64))

    def measure(self, smooth: bool) -> Found:
        """All that is measured on shapes."""
        motion, distance, edges = self.motion, [], []
        for n, (t, x) in enumerate(zip(motion.measured, self.at(motion.measured, smooth), strict=True)):
            i, u = motion.located(t)
            yard = self.yards[i]
            if self.truths is None:
                lengths = torch.lerp(yard.lengths(yard.case.x_a), yard.lengths(yard.case.x_b), u)
            else:
                lengths = yard.lengths(self.truths[n])
                distance.append(100 * float((x - self.truths[n]).norm(dim=-1).mean()) / motion.diagonal)
            edges.append(100 * mean_ratio(yard.lengths(x), lengths))
        return Found(distance, edges, self.corner(lambda times: self.at(times, smooth)))

    def true_corner(self) -> float:
        """That of the truth, where it is known at any time."""
        truth = self.motion.truth
        assert truth is not None
        return self.corner(lambda times: torch.stack([truth(float(t)) for t in times]))

    def corner(self, at: Callable[[Any], Tensor]) -> float:
        """Largest second difference at a key-frame over the median elsewhere."""
        motion, own = self.motion, self.motion.times
        h = [(b - a) / STEPS for a, b in pairwise(own)]
        keys = [(own[i], h[i - 1], h[i]) for i in range(0 if motion.cyclic else 1, len(h))]
        rest = [
            (t, h[i], h[i])
            for t in fractions(own, *(k / PLACES for k in range(1, PLACES)))
            for i in [motion.located(t)[0]]
        ]
        t, before, after = torch.tensor(keys + rest, dtype=torch.float64).T
        if motion.cyclic:
            t = t + own[-1] - own[0]  # one period on: there is a time before the first
        x = at(torch.cat([t - before, t, t + after])).unflatten(0, (3, -1))
        slope_before, slope_after = (x[1] - x[0]) / before[:, None, None], (x[2] - x[1]) / after[:, None, None]
        second = ((slope_after - slope_before) / (0.5 * (before + after))[:, None, None]).norm(dim=-1).mean(-1)
        return float(second[: len(keys)].amax() / second[len(keys) :].median())

    def costs(self) -> tuple[float, float]:
        """One shape at a random time, and a sequence, over the same of the pairs."""
        first, last = self.motion.times[0], self.motion.times[-1]
        generator = torch.Generator().manual_seed(0)
        random = first + (last - first) * torch.rand(8, dtype=torch.float64, generator=generator)
        whole = fractions(self.motion.times, *(i / SEQUENCE for i in range(SEQUENCE)))

        def one_by_one(smooth: bool) -> None:
            for t in random:
                self.at(t, smooth)

        single = [timed(lambda smooth=smooth: one_by_one(smooth))[1] for smooth in (True, False)]
        sequence = [timed(lambda smooth=smooth: self.at(whole, smooth))[1] for smooth in (True, False)]
        return single[0] / single[1], sequence[0] / sequence[1]


def add(measured: Measured, table: Table) -> None:
    """Rows of one motion."""
    name, costs = measured.motion.name, measured.costs()
    for way, smooth in (("smooth", True), ("separate pairs", False)):
        found = measured.measure(smooth)
        values = fmean(found.distance) if found.distance else NAN, fmean(found.edges), found.corner
        times = (f"{cost:.2f}" for cost in costs) if smooth else ("1", "1")
        table.add(name, way, *(number(value, ".3g") for value in values), *times)
    if measured.motion.known_anywhere:
        table.add(name, "truth", "", "", number(measured.true_corner(), ".3g"), "", "")


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("motions", nargs="*", help=f"of {', '.join(MOTIONS)}; default: all")
    add_keep(parser)
    given = parser.parse_args()
    limit_threads()
    times = ["time, one shape", "time, a sequence"]
    columns = ["motion", "", "distance, %", "edge error, %", "largest corner", *times]
    with Table("motion", columns, given.keep, times, check="gallop", labels=2) as table:
        for name in given.motions or MOTIONS:
            for motion in MOTIONS[name]():
                add(Measured(motion), table)


if __name__ == "__main__":
    main()
