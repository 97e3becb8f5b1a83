"""Confidence of completed shapes: what was seen of them, what points count for, how far they move."""

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from torch_modal.completion.frames import CompletionProblem
from torch_modal.completion.pairs import SampledSurface, robust_weights
from torch_modal.geometry.rigid import best_fit

SEEN_WITHIN = 2.5
"""Distance from an observed point within which a vertex counts as seen, at a size of 100."""
NEIGHBOURS = 0.9
"""Confidence of what a neighbour in time saw."""
HALF_AFTER = 0.02
"""Motion between neighbours in time, in parts of the diagonal, that halves the confidence of what is half seen."""
DOUBTFUL = 0.5
"""Part of the points that a shape has to explain."""


def compare(problem: CompletionProblem, x: Tensor) -> tuple[Tensor, Tensor, Tensor, dict[float, float]]:
    """Compare shapes with what was seen.

    Args:
        problem: What was seen, with its noise.
        x: The shapes at its times. *Shape:* ``(T, V, 3)``.

    Returns:
        The distances of all observed points at a size of 100, and what they count for, *shape* ``(n,)``; what of each
        shape was seen then, *shape* ``(T, V)``; and the times of doubtful shapes with the part of the points that they
        explain.
    """
    doubtful, seen = dict[float, float](), x.new_zeros(x.shape[:2])
    misses, trust = np.zeros((2, sum(len(one.points) for frame in problem.frames for one in frame.seen)))
    for i, frame in enumerate(problem.frames):
        surface = SampledSurface(x[i].numpy(), problem.mesh)
        for one in frame.seen:
            distances, agree = one.misses(surface)
            weights = agree * robust_weights(distances, one.noise)
            misses[one.numbers], trust[one.numbers] = distances, weights
            gaps, nearest = cKDTree(one.points).query(surface.vertices, 3)
            close = (weights[nearest] * np.exp(-0.5 * (gaps / SEEN_WITHIN) ** 2)).max(1)
            explained = float(weights.mean())
            if explained < DOUBTFUL:
                doubtful[frame.time] = explained
            seen[i] = torch.maximum(seen[i], min(1.0, explained / DOUBTFUL) * torch.from_numpy(close))
    return torch.from_numpy(misses), torch.from_numpy(trust), seen, doubtful


def confidence_of(problem: CompletionProblem, x: Tensor, seen: Tensor) -> Tensor:
    """Confidence from what was seen at each time, there and nearby, and from the motion. *Shape:* ``(T, V)``.

    What moves far between its neighbours in time is less certain.
    """
    whole = [(float(t), one, torch.ones_like(one[:, 0])) for t, one in zip(problem.times, problem.whole, strict=False)]
    times = {frame.time for frame in problem.frames}
    frames = [(frame.time, *one) for frame, *one in zip(problem.frames, x, seen, strict=True)]
    every = sorted([*frames, *(one for one in whole if one[0] not in times)], key=lambda one: one[0])
    shapes, near = torch.stack([one[1] for one in every]), torch.stack([one[2] for one in every])
    for order in (range(1, len(near)), range(len(near) - 2, -1, -1)):
        for i in order:
            near[i] = torch.maximum(near[i], NEIGHBOURS * near[i - order.step])
    half = HALF_AFTER * float((problem.template.amax(0) - problem.template.amin(0)).norm())
    confidence = torch.zeros_like(seen)
    for row, i in enumerate(i for i, one in enumerate(every) if one[0] in times):
        neighbours = [j for j in (i - 1, i + 1) if 0 <= j < len(shapes)]
        others = shapes[neighbours] if neighbours else problem.whole[:1]
        moved = (best_fit(others, shapes[i].expand_as(others)).apply(others) - shapes[i]).norm(dim=-1).mean(0)
        confidence[row] = near[i] * torch.exp2(-(1.5 - seen[row]) * moved / half)
    return confidence
