"""What is measured on a way through key-frames."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

import torch
from cases import Case
from measures import NAN, Yardstick, mean_ratio
from motions import Motion, fractions
from timing import timed
from torch import Tensor

from torch_modal.energy.bend import wrap_angle
from torch_modal.motion.path import Path

COLLAPSED = 0.05  # of the smaller area in both key-frames
MOVES = 1e-3  # of the diagonal: vertices that move less have no direction
DENSE = 32  # steps to each interval, for second differences and at a stop
SEQUENCE = 8  # shapes to each interval, for the cost of a sequence


@dataclass
class Found:
    """What is measured of one way through one motion: lists have a value for each time."""

    distance: list[float] = field(default_factory=list)
    edges: list[float] = field(default_factory=list)
    volume: list[float] = field(default_factory=list)
    energy: list[float] = field(default_factory=list)
    folds: int = 0
    true_folds: int = 0
    """What the truth has of them, at the same times."""
    unlike: int = 0
    """Hinges that are more than a right angle from the truth's."""
    turned: int = 0
    collapsed: int = 0
    corner: float = NAN
    """The mean of all key-frames."""
    worst_corner: float = NAN
    overshoot: float = NAN
    """In % of the diagonal."""


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

    def at(self, times: Any, smooth: bool = True) -> Tensor:
        """Shapes."""
        with torch.no_grad():
            return self.paths[smooth](self.motion.shapes.keyframes, torch.as_tensor(times, dtype=torch.float64))

    def measure(self, smooth: bool = True) -> Found:
        """All that can be measured on shapes."""
        motion, found = self.motion, Found()
        for n, (t, x) in enumerate(zip(motion.measured, self.at(motion.measured, smooth), strict=True)):
            i, u = motion.located(t)
            truth = None if self.truths is None else self.truths[n]
            self._shape(found, self.yards[i], u, x, truth)
        self.in_time(found, lambda times: self.at(times, smooth), DENSE if smooth else 4)
        return found

    def of_truth(self) -> Found:
        """What can be measured of a truth without a truth; empty where it is known at some times only."""
        found, truth = Found(), self.motion.truth
        if truth is not None and self.motion.known_anywhere:
            self.in_time(found, lambda times: torch.stack([truth(float(t)) for t in times]), DENSE)
        return found

    def in_time(self, found: Found, at: Callable[[Any], Tensor], places: int) -> None:
        """Second differences, at so many places of each interval, and overshoot."""
        ratio = self.corner(at, places)
        found.corner, found.worst_corner = float(ratio.mean()), float(ratio.amax())
        if self.motion.stop is not None:
            found.overshoot = self.overshoot(at)

    def _shape(self, found: Found, yard: Yardstick, u: float, x: Tensor, truth: Tensor | None) -> None:
        ends = yard.case.x_a, yard.case.x_b
        lengths = torch.lerp(*map(yard.lengths, ends), u) if truth is None else yard.lengths(truth)
        found.edges.append(100 * mean_ratio(yard.lengths(x), lengths))
        found.volume.append(yard.volume(x))
        found.folds += int(yard.folded(x).sum())
        areas = torch.minimum(*(yard.normals(y).norm(dim=1) for y in ends))
        found.collapsed += int((yard.normals(x).norm(dim=1) < COLLAPSED * areas).sum())
        if truth is None:
            energies = yard.shell(x * yard.scale, torch.stack(ends) * yard.scale)
            found.energy.append(float((1 - u) * energies[0] + u * energies[1]))
        else:
            found.distance.append(100 * float((x - truth).norm(dim=-1).mean()) / self.motion.diagonal)
            found.true_folds += int(yard.folded(truth).sum())
            apart = wrap_angle(yard.shell.measure(x).angle - yard.shell.measure(truth).angle).abs()
            found.unlike += int((apart > torch.pi / 2).sum())
            agree = (yard.normals(yard.laid(x, truth)) * yard.normals(truth)).sum(1)
            found.turned += int((agree < 0).sum())

    def corner(self, at: Callable[[Any], Tensor], places: int) -> Tensor:
        """Second differences at key-frames over their median elsewhere, means over the vertices. *Shape:* ``(K,)``."""
        motion, own = self.motion, self.motion.times
        h = [(b - a) / DENSE for a, b in pairwise(own)]
        keys = [(own[i], h[i - 1], h[i]) for i in range(0 if motion.cyclic else 1, len(h))]
        rest = [
            (t, h[i], h[i])
            for t in fractions(own, *(k / places for k in range(1, places)))
            for i in [motion.located(t)[0]]
        ]
        t, before, after = torch.tensor(keys + rest, dtype=torch.float64).T
        if motion.cyclic:
            t = t + own[-1] - own[0]  # one period on: there is a time before the first
        x = at(torch.cat([t - before, t, t + after])).unflatten(0, (3, -1))
        slope_before, slope_after = (x[1] - x[0]) / before[:, None, None], (x[2] - x[1]) / after[:, None, None]
        second = ((slope_after - slope_before) / (0.5 * (before + after))[:, None, None]).norm(dim=-1).mean(-1)
        return second[: len(keys)] / second[len(keys) :].median()

    def overshoot(self, at: Callable[[Any], Tensor]) -> float:
        """How far vertices leave a stop, or go beyond it just before and after: the farthest, in % of the diagonal."""
        motion = self.motion
        assert motion.stop is not None
        keys = [motion.times.index(t) for t in motion.stop]
        worst = 0.0
        for rest, other in ((keys[0], keys[0] - 1), (keys[1], keys[1] + 1)):
            still, beside = motion.shapes.keyframes[rest], motion.shapes.keyframes[other]
            a, b = motion.times[rest], motion.times[other]
            beyond = at([a + (b - a) * i / DENSE for i in range(1, DENSE)]) - still
            away = still - beside
            lengths = away.norm(dim=-1)
            moving = lengths > MOVES * motion.diagonal
            along = (beyond * away).sum(-1)[:, moving] / lengths[moving]
            worst = max(worst, float(along.amax()))
        start, end = motion.stop
        held = at([start + (end - start) * i / DENSE for i in range(1, DENSE)])
        worst = max(worst, float((held - motion.shapes.keyframes[keys[0]]).norm(dim=-1).amax()))
        return 100 * worst / motion.diagonal

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
