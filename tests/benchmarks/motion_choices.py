"""Other ways of choosing velocities and times, put in the place of the package's."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from itertools import pairwise
from statistics import fmean
from typing import Any
from unittest import mock

import torch
from measures import NAN
from motion_measures import Found, Measured
from motions import Motion
from tables import number
from torch import Tensor

from torch_modal.geometry import hermite
from torch_modal.geometry.rigid import best_fit

USERS = ("torch_modal.geometry.local_rotations", "torch_modal.inbetween.frame", "torch_modal.inbetween.joint")
CHOICES = "| motion | choice | distance over ours | edge error over ours | worst corner | folds | overshoot % |"


@contextmanager
def without_limit() -> Iterator[None]:
    """Velocities as the parabola wants them."""

    def velocity(before: Tensor, after: Tensor, h_before: Tensor, h_after: Tensor, squared: object) -> Tensor:
        return (h_after * before + h_before * after) / (h_before + h_after)

    with mock.patch.object(hermite, "_velocity", velocity):
        yield


@contextmanager
def ends(part: float) -> Iterator[None]:
    """The excess at an end is this part of the other: -1/2 is natural, -1 is a parabola, 0 the speed of the step."""

    def tangent_offset(step: Tensor, before: Tensor | None, after: Tensor | None, *rest: Any) -> hermite.TangentOffset:
        found = hermite.tangent_offset(step, before, after, *rest)
        if before is None and after is not None:
            return hermite.TangentOffset(part * found.last, found.last)
        if after is None and before is not None:
            return hermite.TangentOffset(found.first, part * found.first)
        return found

    with ExitStack() as stack:
        for user in USERS:
            stack.enter_context(mock.patch(f"{user}.tangent_offset", tangent_offset))
        yield


def by_distance(motion: Motion, power: float) -> Tensor:
    """Times of key-frames by the distance between them: 1 is chordal, 1/2 centripetal."""
    x = motion.shapes.keyframes
    x = torch.cat([x, x[:1]]) if motion.cyclic else x
    weights = torch.ones(x.shape[1], dtype=x.dtype)
    laid = [best_fit(b, a, weights).apply(b) for a, b in pairwise(x)]
    steps = torch.stack([(b - a).norm(dim=-1).mean() for a, b in zip(x[:-1], laid, strict=True)])
    return torch.cat([steps.new_zeros(1), steps.clamp_min(1e-3 * steps.amax()).pow(power).cumsum(0)])


def print_choices(measured: Measured) -> None:
    """What other ways of choosing velocities do, over the default."""
    motion = measured.motion
    base = measured.measure()

    def row(name: str, found: Found) -> None:
        near = fmean(found.distance) / fmean(base.distance) if base.distance else NAN
        edges = fmean(found.edges) / fmean(base.edges)
        numbers = [number(near, ".3f"), number(edges, ".3f"), number(found.worst_corner, ".2f"), str(found.folds)]
        print(f"| {motion.name} | {name} | {' | '.join(numbers)} | {number(found.overshoot, '.2f')} |", flush=True)

    row("as it is", base)
    with without_limit():
        row("velocities without a limit", measured.measure())
    if not motion.cyclic:
        for name, part in (("ends: parabola", -1.0), ("ends: speed of the step", 0.0)):
            with ends(part):
                row(name, measured.measure())
    for name, power in (("chordal times", 1.0), ("centripetal times", 0.5)):
        row(name, measured.measure(knots=by_distance(motion, power)))
