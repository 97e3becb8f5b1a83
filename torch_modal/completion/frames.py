"""Observations by their times, at a size of 100 in the axes of the first shape."""

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from torch_modal.arrays import FloatArray
from torch_modal.completion.observation import Observation
from torch_modal.completion.pairs import NOISES, ObservedPoints
from torch_modal.geometry.canonical import to_canonical
from torch_modal.geometry.connectivity import Connectivity
from torch_modal.keyframes.arrays import require_units
from torch_modal.registration.surface import places_between

SWAY, SOFT = 2.0, 3e-5
"""Standard deviation of the amplitude of the first mode, at a size of 100; least stiffness of the modes."""
NOISE = 0.5
"""Of points before it is estimated, at a size of 100."""
HALF, NOISES_OF_HALF = 1.0, 3.0
"""Distance at which half of a miss counts, at least, and in noises."""


class Frame(NamedTuple):
    """Observations of one time."""

    time: float
    seen: list[ObservedPoints]
    soft: float
    """Stiffness of the modes that the observations leave, if amplitudes have the standard deviation :data:`SWAY`."""
    unit: float
    """Distance at which half of a miss counts."""


class CompletionProblem:
    """Whole shapes and observations, at a size of 100 in the axes of the first shape.

    Args:
        shapes: Whole ones. *Shape:* ``(K, V, 3)``.
        faces: Vertex indices. *Shape:* ``(F, 3)``.
        times: Of the whole shapes; none, if there is one alone, of no time. *Shape:* ``(K,)``.
        observations: What was seen.

    Raises:
        ValueError: Points are in other units.
    """

    def __init__(self, shapes: FloatArray, faces: Tensor, times: FloatArray, observations: list[Observation]) -> None:
        self.faces, self.times = faces, times
        self.mesh = Connectivity(faces.numpy(), shapes.shape[1])
        _, self.axes, self.centre, self.scale = to_canonical(shapes[0], faces.numpy())
        self.whole = torch.from_numpy((shapes - self.centre) @ self.axes.T * self.scale)
        self.template = self.whole[0]
        ends = np.cumsum([len(one.points) for one in observations])
        seen = [(one, self._sample(one, int(end))) for one, end in zip(observations, ends, strict=True)]
        self.frames = [
            self._frame(t, [sample for one, sample in seen if one.time == t])
            for t in sorted({one.time for one in observations})
        ]

    def to_canonical(self, x: Tensor, direction: bool = False) -> FloatArray:
        """Points, or directions, in its axes. *Shape:* ``(..., 3)``."""
        points = x.detach().cpu().double().numpy()
        return points @ self.axes.T if direction else (points - self.centre) @ self.axes.T * self.scale

    def to_caller(self, x: Tensor) -> Tensor:
        """The inverse. *Shape:* ``(..., 3)``."""
        return (x / self.scale) @ torch.from_numpy(self.axes) + torch.from_numpy(self.centre)

    @staticmethod
    def _frame(time: float, seen: list[ObservedPoints]) -> Frame:
        soft = min((one.noise or NOISE) ** 2 / (SWAY**2 * len(one.points)) for one in seen)
        return Frame(time, seen, max(SOFT, soft), max(HALF, NOISES_OF_HALF * max(one.noise for one in seen)))

    def _sample(self, one: Observation, end: int) -> ObservedPoints:
        points, known = self.to_canonical(one.points), self.template[self.faces.unique()]
        weights = np.ones(len(points)) if one.weights is None else one.weights.cpu().double().numpy()
        normals, view = (None if x is None else self.to_canonical(x, True) for x in (one.normals, one.view))
        noise, places = 0.0 if one.noise is None else max(one.noise * self.scale, NOISES[0]), None
        if not one.is_cloud:
            corners, barycentric = one.places()
            places = places_between(corners.cpu().numpy(), barycentric.cpu().double().numpy(), len(self.template))
            known = torch.from_numpy(places @ self.template.numpy())
        require_units(f"{one}: the points", torch.from_numpy(points), "the first shape", known[None], 1 / self.scale)
        numbers = np.arange(end - len(points), end)
        return ObservedPoints(points, normals, weights / weights.sum(), numbers, noise, places, view)
