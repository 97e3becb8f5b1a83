"""Observations by their times, at a size of 100 in the axes of the first shape."""

from typing import NamedTuple

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


class Sample(NamedTuple):
    """An observation at a size of 100."""

    seen: Cloud | Pairs
    rows: slice
    """Its points among the points of all observations."""
    noise: float
    """Its standard deviation; 0 where it is not known yet."""

    def with_noise(self, surface: SampledSurface) -> "Sample":
        """The noise estimated where it is not known: from the median of distances with such an error."""
        median = float(np.median(self.seen.misses(surface)[0])) / (0.6745 if isinstance(self.seen, Cloud) else 1.538)
        return self._replace(noise=self.noise or float(np.clip(median, *NOISES)))


class Frame(NamedTuple):
    """Observations of one time."""

    time: float
    samples: list[Sample]
    clouds: list[Cloud]
    markers: list[Pairs]
    soft: float
    """Stiffness of the modes that the observations leave, if amplitudes have the standard deviation :data:`SWAY`."""
    unit: float
    """Distance at which half of a miss counts."""

    @classmethod
    def of(cls, time: float, samples: list[Sample]) -> "Frame":
        """All samples of a time."""
        clouds = [one.seen for one in samples if isinstance(one.seen, Cloud)]
        markers = [one.seen for one in samples if isinstance(one.seen, Pairs)]
        soft = min((one.noise or NOISE) ** 2 / (SWAY**2 * len(one.seen.points)) for one in samples)
        unit = NOISES_OF_HALF * max(one.noise for one in samples)
        return cls(time, samples, clouds, markers, max(SOFT, soft), max(HALF, unit))

    def thin(self, n: int) -> "Frame":
        """With so many points of each cloud, chosen at random, always the same."""
        return self._replace(clouds=[cloud.thin(n) for cloud in self.clouds])


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
        samples: dict[float, list[Sample]] = {}
        start = 0
        for one in observations:
            samples.setdefault(one.time, []).append(self._sample(one, slice(start, start := start + len(one.points))))
        #: *Length:* T.
        self.frames = [Frame.of(t, samples[t]) for t in sorted(samples)]

    def to_canonical(self, x: Tensor, direction: bool = False) -> FloatArray:
        """Points, or directions, in its axes. *Shape:* ``(..., 3)``."""
        points = x.detach().cpu().double().numpy()
        return points @ self.axes.T if direction else (points - self.centre) @ self.axes.T * self.scale

    def to_caller(self, x: Tensor) -> Tensor:
        """The inverse. *Shape:* ``(..., 3)``."""
        return (x / self.scale) @ torch.from_numpy(self.axes) + torch.from_numpy(self.centre)

    def _sample(self, one: Observation, rows: slice) -> Sample:
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
        return Sample(seen, rows, 0.0 if one.noise is None else max(one.noise * self.scale, NOISES[0]))
