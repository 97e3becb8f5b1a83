"""Completed shapes beside what was seen: distances, what points count for, doubts, and expected errors."""

from collections.abc import Sequence

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from torch_modal.completion.frames import CompletionProblem, Frame
from torch_modal.completion.pairs import OUTLIERS, SampledSurface, robust_weights, seen_at
from torch_modal.elastic.volume import encloses
from torch_modal.geometry.inspect import volume_of
from torch_modal.geometry.rigid import best_fit

OF_NOISE, OF_MODES, OF_TIME = 0.3, 1.6, 0.5
"""Factors of the noise, of the way from the shape by modes, and of the distance from neighbours in time, in errors."""
HALF_AT = 0.02
"""Expected error, in parts of the template's diagonal, at which confidence is a half."""
DOUBTFUL = 0.5
"""Part of the points that a shape has to explain."""
OF_EDGES, OF_VOLUMES = 0.035, 0.05
"""Relative changes of edges, and of the root of volumes, beyond which the points may be of another size."""
STRAY, STRAY_BEYOND = 0.02, 2.0
"""Part of a cloud that makes a group, and the distance from the surface, at a size of 100, beyond which that is named.
"""


def compare(
    problem: CompletionProblem, frames: Sequence[Frame], x: Tensor
) -> tuple[Tensor, Tensor, Tensor, dict[float, float], list[str]]:
    """Compare shapes with what was seen.

    Args:
        problem: The mesh.
        frames: What was seen.
        x: The shapes then. *Shape:* ``(T, V, 3)``.

    Returns:
        The distances of all observed points at a size of 100, and their final weights, *shape* ``(n,)``; what of each
        shape was seen then, *shape* ``(T, V)``; the times of doubtful shapes with the part of the points that they
        explain; and, in words, groups of points that no shape explains.
    """
    doubtful, stray, seen = dict[float, float](), list[str](), x.new_zeros(x.shape[:2])
    misses, trust = np.zeros((2, sum(len(one.points) for frame in frames for one in (*frame.seen, *frame.unused))))
    for i, frame in enumerate(frames):
        surface = SampledSurface(x[i].numpy(), problem.mesh)
        for one in frame.unused:
            misses[one.numbers] = one.misses(surface)[0]
        for one in [one.with_noise(surface) for one in frame.seen]:
            distances, agree = one.misses(surface)
            weights = agree * robust_weights(distances, one.noise)
            misses[one.numbers], trust[one.numbers] = distances, weights
            gaps, nearest = cKDTree(one.points).query(surface.vertices, 3)
            close = (weights[nearest] * seen_at(gaps)).max(1)
            explained = float(np.average(weights, weights=one.weights))
            if explained < DOUBTFUL:
                doubtful[frame.time] = explained
            seen[i] = torch.maximum(seen[i], min(1.0, explained / DOUBTFUL) * torch.from_numpy(close))
            n, reach = len(one.points), max(STRAY_BEYOND, OUTLIERS * one.noise)
            for group in one.find_unexplained(surface, reach, max(4, int(STRAY * n))) if one.places is None else ():
                place = problem.to_caller(torch.from_numpy(one.points[group].mean(0)))
                where = ", ".join(f"{coordinate:.4g}" for coordinate in place.tolist())
                stray.append(f"{len(group)} of {n} points at {frame.time:g} around ({where})")
    return torch.from_numpy(misses), torch.from_numpy(trust), seen, doubtful, stray


def size_of(problem: CompletionProblem, x: Tensor) -> float:
    """Size of shapes over that of the whole ones, by the edges or the volume, whichever tells more; 1 within bounds.

    *Shape:* ``(T, V, 3)``.
    """
    edges = torch.tensor(problem.mesh.edges)
    lengths = [float((each[:, edges[:, 0]] - each[:, edges[:, 1]]).norm(dim=-1).mean()) for each in (x, problem.whole)]
    ratios, bounds = [lengths[0] / lengths[1]], [OF_EDGES]
    if encloses(problem.template, problem.mesh):
        volumes = [
            float(np.mean([abs(volume_of(one.numpy(), problem.mesh.faces)) for one in each]))
            for each in (x, problem.whole)
        ]
        ratios, bounds = [*ratios, (volumes[0] / volumes[1]) ** (1 / 3)], [*bounds, OF_VOLUMES]
    beyond = [abs(ratio - 1) / bound for ratio, bound in zip(ratios, bounds, strict=True)]
    return ratios[int(np.argmax(beyond))] if max(beyond) > 1 else 1.0


def expected_errors(
    problem: CompletionProblem, frames: Sequence[Frame], x: Tensor, by_modes: dict[float, Tensor], seen: Tensor
) -> Tensor:
    """Distances from the truth within which nine of ten vertices are, at a size of 100; 0 of whole shapes.

    Three parts, with factors fitted to motions whose truth is at hand (``tests/benchmarks/completion.py``): the noise;
    the way from the shape by modes, which is long where that was wrong; and the distance from the neighbours in time,
    more of what was not seen. Shapes by modes are given by their times. *Shape:* ``(T, V, 3), (T, V) -> (T, V)``.
    """
    whole = [(float(t), shape) for t, shape in zip(problem.times, problem.whole, strict=False)]
    every = sorted([*whole, *((frame.time, one) for frame, one in zip(frames, x, strict=True))], key=lambda one: one[0])
    errors = torch.zeros_like(seen)
    for i, (frame, shape) in enumerate(zip(frames, x, strict=True)):
        if frame.time in problem.times:
            continue
        before = [one for one in every if one[0] < frame.time][-1:]
        after = [one for one in every if one[0] > frame.time][:1]
        others = torch.stack([one for _, one in [*before, *after]] or [problem.whole[0]])
        u = (frame.time - before[0][0]) / (after[0][0] - before[0][0]) if before and after else 0.0
        others = best_fit(others, shape.expand_as(others)).apply(others)
        off = (torch.lerp(others[0], others[-1], u) - shape).norm(dim=-1)
        noise = min(one.noise for one in frame.seen)
        errors[i] = (
            OF_NOISE * noise + OF_MODES * (by_modes[frame.time] - shape).norm(dim=-1) + OF_TIME * (1.5 - seen[i]) * off
        )
    return errors
