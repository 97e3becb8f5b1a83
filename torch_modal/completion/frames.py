"""Observations by their times, at a size of 100 in the axes of the first shape."""

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from torch_modal.arrays import BoolArray, FloatArray
from torch_modal.completion.observation import Observation
from torch_modal.completion.pairs import Cloud, Pairs, SampledSurface
from torch_modal.completion.search import HALF, SOFT, Seen
from torch_modal.geometry.canonical import to_canonical
from torch_modal.geometry.connectivity import Connectivity
from torch_modal.keyframes.arrays import require_units
from torch_modal.registration.surface import places_between

SWAY = 2.0
"""Standard deviation of the amplitude of the first mode, at a size of 100."""
NOISE = 0.5
"""Of points before it is estimated, at a size of 100."""
NOISES = 0.1, 2.0
"""Least noise, and the largest that is estimated, at a size of 100."""
NOISES_OF_HALF = 3.0
"""Noises of the distance at which half of a miss counts."""
OUTLIERS = 4.0
"""Distance, in standard deviations of the noise, at which a point loses three quarters of its weight."""


class ObservedPoints(NamedTuple):
    """An observation at a size of 100."""

    observation: Observation
    number: int
    seen: Cloud | Pairs
    noise: float
    """Its standard deviation; 0 where it is not known yet."""

    def misses(self, surface: SampledSurface) -> tuple[FloatArray, BoolArray]:
        """Distances of the points from their places, and if normals agree. *Shape:* ``(n,)``."""
        if isinstance(self.seen, Cloud):
            return self.seen.closest(surface)[2:]
        distances = self.seen.distances(surface.vertices)
        return distances, np.ones(len(distances), bool)

    def with_noise(self, surface: SampledSurface) -> "ObservedPoints":
        """The noise estimated where it is not known: from the median of distances with such an error."""
        if self.noise:
            return self
        median = float(np.median(self.misses(surface)[0])) / (0.6745 if isinstance(self.seen, Cloud) else 1.538)
        return self._replace(noise=float(np.clip(median, *NOISES)))


class Frame:
    """Observations of one time."""

    def __init__(self, time: float, samples: list[ObservedPoints]) -> None:
        self.time, self.samples = time, samples
        self.clouds = [one.seen for one in samples if isinstance(one.seen, Cloud)]
        self.markers = [one.seen for one in samples if isinstance(one.seen, Pairs)]

    def seen(self, markers: list[Pairs]) -> Seen:
        """Observations that a pose is searched for; modes' amplitudes have the standard deviation :data:`SWAY`."""
        soft = min((one.noise or NOISE) ** 2 / (SWAY**2 * len(one.observation.points)) for one in self.samples)
        unit = NOISES_OF_HALF * max(one.noise for one in self.samples)
        return Seen(self.clouds, markers, max(SOFT, soft), max(HALF, unit))


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
        samples = [self._sample(one, i) for i, one in enumerate(observations)]
        every = sorted({one.time for one in observations})
        self.frames = [Frame(t, [one for one in samples if one.observation.time == t]) for t in every]

    def to_canonical(self, x: Tensor, direction: bool = False) -> FloatArray:
        """Points, or directions, in its axes. *Shape:* ``(..., 3)``."""
        points = x.detach().cpu().double().numpy()
        return points @ self.axes.T if direction else (points - self.centre) @ self.axes.T * self.scale

    def to_caller(self, x: Tensor) -> Tensor:
        """The inverse. *Shape:* ``(..., 3)``."""
        return (x / self.scale) @ torch.from_numpy(self.axes) + torch.from_numpy(self.centre)

    def _sample(self, one: Observation, number: int) -> ObservedPoints:
        points, known = self.to_canonical(one.points), self.template[self.faces.unique()]
        weights = np.ones(len(points)) if one.weights is None else one.weights.cpu().double().numpy()
        seen: Cloud | Pairs
        if one.is_cloud:
            normals, view = (None if x is None else self.to_canonical(x, True) for x in (one.normals, one.view))
            seen = Cloud(points, normals, weights, view)
        else:
            corners, barycentric = one.places()
            places = places_between(corners.cpu().numpy(), barycentric.cpu().double().numpy(), len(self.template))
            seen = Pairs(places, points, None, weights / weights.sum(), np.arange(len(points)))
            known = torch.from_numpy(places @ self.template.numpy())
        require_units(f"{one}: the points", torch.from_numpy(points), "the first shape", known[None], 1 / self.scale)
        return ObservedPoints(one, number, seen, 0.0 if one.noise is None else max(one.noise * self.scale, NOISES[0]))


def robust(distances: FloatArray, noise: float) -> FloatArray:
    """Weights of points at distances (Geman and McClure)."""
    weights: FloatArray = 1 / (1 + (distances / (OUTLIERS * noise)) ** 2) ** 2
    return weights
