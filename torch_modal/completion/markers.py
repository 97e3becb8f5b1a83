"""Shapes between the key-frames that markers show: local weights of all key-frames, as rest shapes of the frames."""

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from torch_modal.arrays import IntArray
from torch_modal.completion.frames import Frame
from torch_modal.statistics.local_weights import LocalWeights, Observations
from torch_modal.statistics.variation import Variation

FEWEST, MOST = 3, 200
"""Markers from which a pose follows; above which each weight would take long, and is no longer needed."""
STRAY = 5.0
"""Distance of a marker from the shape by modes, in medians or noises, beyond which it does not count."""


class MarkerShape(NamedTuple):
    """A shape as a function of markers, with its graph where they require a gradient."""

    points: Tensor
    """*Shape:* ``(n, 3)``."""
    numbers: IntArray
    """Indices of the markers among all observed points. *Shape:* ``(n,)``."""
    x: Tensor
    """*Shape:* ``(V, 3)``."""


def shape_of_markers(
    variation: Variation, frame: Frame, about: Tensor, by_modes: Tensor, differentiable: bool = False
) -> MarkerShape | None:
    """The shape of local weights of the key-frames that is nearest to the markers of a frame; None of too few, or many.

    Args:
        variation: Of the key-frames.
        frame: Its observations all have known places.
        about: The most likely weights of the key-frames. *Shape:* ``(K,)``.
        by_modes: The shape by modes. *Shape:* ``(V, 3)``.
        differentiable: True for a graph, which takes as much memory as several shapes.
    """
    least, rows = min(one.noise for one in frame.seen), []
    for one in frame.seen:
        misses = one.distances(by_modes.numpy())
        counts = misses <= STRAY * max(float(np.median(misses)), one.noise)
        one = one.select(counts)
        corners, shares = (np.zeros((len(one.points), 3), dtype) for dtype in (np.int64, np.float64))
        row, column = one.places.nonzero()
        order = np.arange(len(row)) - np.searchsorted(row, row)
        corners[row, order] = column
        shares[row, order] = np.asarray(one.places[row, column]).ravel()
        weights = one.weights * (frame.weight * len(counts) * (least / one.noise) ** 2)
        rows.append((one.points, corners, shares, weights, one.numbers))
    *columns, numbers = (np.concatenate(column) for column in zip(*rows, strict=True))
    to = Observations(*map(torch.from_numpy, columns))
    if not FEWEST <= len(to.corners.unique(dim=0)) <= len(to.points) <= MOST:
        return None
    points = to.points.requires_grad_(differentiable)
    with torch.set_grad_enabled(differentiable):
        local = LocalWeights(variation, to, about, least)
        factors, to = local.solve(robust=False)
        x = local.shape(factors)
        return MarkerShape(points, numbers, to.pose(x).apply(x))
