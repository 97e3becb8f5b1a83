"""Observations by their times, at a size of 100 in the axes of the template."""

import warnings
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from torch_modal.arrays import FloatArray, IntArray
from torch_modal.completion.bending import ModalPose
from torch_modal.completion.clouds import Camera, estimate_normals, find_view, outwardness
from torch_modal.completion.observation import Observation
from torch_modal.completion.pairs import NOISES, ObservedPoints, SampledSurface
from torch_modal.errors import MeshWarning
from torch_modal.geometry.canonical import CANONICAL_SIZE, GENERIC, to_canonical
from torch_modal.geometry.connectivity import Connectivity
from torch_modal.keyframes.arrays import require_units
from torch_modal.registration.surface import places_between

SWAY, SOFT = 2.0, 3e-5
"""Standard deviation of the amplitude of the first mode, at a size of 100; least stiffness of the modes."""
INWARD = -0.05
"""Mean cosine of the clouds' normals with the directions from their centroids, below which they point inward."""
SIZE_DIGITS = 6
"""Digits of the logarithm of a size: equal ones, as of mirrored poses, differ by rounding."""
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
    weight: float
    """Mean of the points' weights: those of ``seen`` are relative to it, and add up to 1 in each, on average."""
    unused: list[ObservedPoints]
    """Points of weight 0: their distances are reported, and that is all."""

    def seen_from(self, pose: ModalPose) -> "Frame":
        """The observations in the coordinates of a body in a rigid pose."""
        rotation, move = pose.rotation.numpy(), pose.move.numpy()
        return self._replace(seen=[one.seen_from(rotation, move) for one in self.seen])

    def without_cameras(self) -> "Frame":
        """With the points of clouds alone, whatever a camera should see."""
        return self._replace(seen=[one._replace(camera=None) for one in self.seen])

    def score(self, surface: SampledSurface) -> float:
        """Part of the observations that a surface leaves unexplained."""
        return sum(one.score(surface, self.unit) for one in self.seen)


def find_largest(shapes: FloatArray, faces: IntArray) -> int:
    """Index of the largest shape, whatever the order and the pose of all. *Shape:* ``(K, V, 3), (F, 3)``."""
    keys = []
    for x in shapes:
        coordinates, _, _, scale = to_canonical(x, faces)
        generic = float(np.sin(np.arange(len(x))) @ coordinates @ GENERIC)
        keys.append((round(float(np.log(scale)), SIZE_DIGITS), generic))
    return keys.index(min(keys))


class CompletionProblem:
    """Whole shapes and observations, at a size of 100 in the axes of the largest shape, which is the template.

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
        # Not the first: reversed times give the same motion reversed.
        self.largest = largest = find_largest(shapes, faces.numpy())
        _, self.axes, self.centre, self.scale = to_canonical(shapes[largest], faces.numpy())
        self.whole = torch.from_numpy((shapes - self.centre) @ self.axes.T * self.scale)
        self.template = self.whole[largest]
        #: True where gradients in the points may be asked for.
        self.differentiable = any(one.points.requires_grad for one in observations)
        #: 1, or -1 where the normals of the clouds point inward, and are turned.
        self.side = self._side(observations)
        ends = np.cumsum([len(one.points) for one in observations])
        seen = [(one.time, self._sample(one, int(end))) for one, end in zip(observations, ends, strict=True)]
        every = [self._frame(t, [one for time, one in seen if time == t]) for t in sorted({time for time, _ in seen})]
        #: Those whose shapes are to be found, and those at the times of whole shapes.
        self.frames = [frame for frame in every if frame.time not in times]
        self.exact = [frame for frame in every if frame.time in times]

    def to_canonical(self, x: Tensor, direction: bool = False) -> FloatArray:
        """Points, or directions, in its axes. *Shape:* ``(..., 3)``."""
        points = x.detach().cpu().double().numpy()
        return points @ self.axes.T if direction else (points - self.centre) @ self.axes.T * self.scale

    def to_caller(self, x: Tensor) -> Tensor:
        """The inverse. *Shape:* ``(..., 3)``."""
        return (x / self.scale) @ torch.from_numpy(self.axes) + torch.from_numpy(self.centre)

    @staticmethod
    def _side(observations: list[Observation]) -> int:
        given = []
        for one in observations:
            if one.normals is not None:
                counts = slice(None) if one.weights is None else one.weights > 0
                points, normals = (x[counts].detach().cpu().double().numpy() for x in (one.points, one.normals))
                given.append(outwardness(points, normals))
        if not given or np.mean(given) >= INWARD:
            return 1
        message = "the normals of the clouds point into the body: they are turned over; pass -normals to be sure"
        warnings.warn(message, MeshWarning, stacklevel=8)
        return -1

    @staticmethod
    def _frame(time: float, every: list[ObservedPoints]) -> Frame:
        weight = float(np.mean([one.weights[one.weights > 0].mean() for one in every]))
        seen, unused = ([one.select(f(one.weights, 0)) for one in every] for f in (np.greater, np.equal))
        seen = [one._replace(weights=one.weights / (weight * len(one.weights))) for one in seen]
        soft = min((one.noise or NOISE) ** 2 / (SWAY**2 * weight * len(one.points)) for one in seen)
        unit = max(HALF, NOISES_OF_HALF * max(one.noise for one in seen))
        return Frame(time, seen, max(SOFT, soft), unit, weight, unused)

    def _sample(self, one: Observation, end: int) -> ObservedPoints:
        points, known = self.to_canonical(one.points), self.template[self.faces.unique()]
        weights = np.ones(len(points)) if one.weights is None else one.weights.cpu().double().numpy()
        counts = weights > 0
        normals = None if one.normals is None else self.to_canonical(one.normals, True)
        camera = None if one.view is None else Camera(self.to_canonical(one.view, True))
        if one.camera is not None:
            place = self.to_canonical(one.camera)
            away = place - np.median(points[counts], 0)
            camera = Camera(away / np.linalg.norm(away), place)
        noise, places = 0.0 if one.noise is None else max(one.noise * self.scale, NOISES[0]), None
        if one.is_cloud and normals is None:
            normals = np.zeros_like(points)
            normals[counts] = estimate_normals(points[counts], camera and camera.towards(points[counts]))
        elif normals is not None:
            normals = self.side * normals
            if camera is None and (view := find_view(normals[counts])) is not None:
                camera = Camera(view)
        if not one.is_cloud:
            corners, barycentric = one.places()
            places = places_between(corners.cpu().numpy(), barycentric.cpu().double().numpy(), len(self.template))
            known = torch.from_numpy(places[counts] @ self.template.numpy())
        seen = torch.from_numpy(points[counts])
        require_units(f"{one}: the points", seen, "the template", known[None], 1 / self.scale)
        if noise > CANONICAL_SIZE:
            raise ValueError(
                f"{one}: noise is {one.noise:g}, and the body's size {CANONICAL_SIZE / self.scale:.3g}; give the "
                "standard deviation of the points, in their unit"
            )
        numbers = np.arange(end - len(points), end)
        return ObservedPoints(points, normals, weights, numbers, noise, places, camera)
