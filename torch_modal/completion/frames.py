"""Observations by their times, at a size of 100 in the axes of the first shape."""

from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from torch_modal.arrays import FloatArray
from torch_modal.completion.observation import Observation
from torch_modal.completion.pairs import Cloud, Pairs, SampledSurface
from torch_modal.geometry.canonical import to_canonical
from torch_modal.geometry.connectivity import Connectivity
from torch_modal.keyframes.arrays import require_units
from torch_modal.registration.surface import places_between

SWAY, SOFT = 2.0, 3e-5
"""Standard deviation of the amplitude of the first mode, at a size of 100; least stiffness of the modes."""
NOISE = 0.5
"""Of points before it is estimated, at a size of 100."""
NOISES = 0.1, 2.0
"""Least noise, and the largest that is estimated, at a size of 100."""
HALF, NOISES_OF_HALF = 1.0, 3.0
"""Distance at which half of a miss counts, at least, and in noises."""


class Frame(NamedTuple):
    """Observations of one time."""

    time: float
    clouds: list[Cloud]
    markers: list[Pairs]
    soft: float
    """Stiffness of the modes that the observations leave, if amplitudes have the standard deviation :data:`SWAY`."""
    unit: float
    """Distance at which half of a miss counts."""

    @property
    def seen(self) -> list[Cloud | Pairs]:
        """All observations."""
        return [*self.clouds, *self.markers]

    def with_noise(self, surface: SampledSurface) -> "Frame":
        """The noise estimated where it is not known."""
        clouds, markers = ([_with_noise(one, surface) for one in seen] for seen in (self.clouds, self.markers))
        return self._replace(clouds=clouds, markers=markers)

    def thin(self, n: int) -> "Frame":
        """With so many points of each cloud, chosen at random, always the same."""
        return self._replace(clouds=[cloud.thin(n) for cloud in self.clouds])


def _with_noise(seen: Any, surface: SampledSurface) -> Any:
    """The noise from the median of distances with such an error, from a surface or from a point."""
    median = float(np.median(seen.misses(surface)[0])) / (0.6745 if isinstance(seen, Cloud) else 1.538)
    return seen._replace(noise=seen.noise or float(np.clip(median, *NOISES)))


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
    def _frame(time: float, samples: list[Cloud | Pairs]) -> Frame:
        soft = min((one.noise or NOISE) ** 2 / (SWAY**2 * len(one.points)) for one in samples)
        unit = NOISES_OF_HALF * max(one.noise for one in samples)
        clouds = [one for one in samples if isinstance(one, Cloud)]
        markers = [one for one in samples if isinstance(one, Pairs)]
        return Frame(time, clouds, markers, max(SOFT, soft), max(HALF, unit))

    def _sample(self, one: Observation, end: int) -> Cloud | Pairs:
        points, known = self.to_canonical(one.points), self.template[self.faces.unique()]
        weights = np.ones(len(points)) if one.weights is None else one.weights.cpu().double().numpy()
        noise = 0.0 if one.noise is None else max(one.noise * self.scale, NOISES[0])
        weights, numbers = weights / weights.sum(), np.arange(end - len(points), end)
        sample: Cloud | Pairs
        if one.is_cloud:
            normals, view = (None if x is None else self.to_canonical(x, True) for x in (one.normals, one.view))
            sample = Cloud(points, normals, weights, numbers, noise, view)
        else:
            corners, barycentric = one.places()
            places = places_between(corners.cpu().numpy(), barycentric.cpu().double().numpy(), len(self.template))
            sample = Pairs(points, None, weights, numbers, noise, places)
            known = torch.from_numpy(places @ self.template.numpy())
        require_units(f"{one}: the points", torch.from_numpy(points), "the first shape", known[None], 1 / self.scale)
        return sample
