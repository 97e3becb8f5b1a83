"""Observations of a motion at a time: point clouds, markers, noisy meshes."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from torch_modal.autograd import is_transformed

LEAST_POINTS = 3
"""Points of an observation, at least: a pose follows from three."""
SUM_TOLERANCE = 1e-3
"""Largest difference of a sum of barycentric weights from one: files round them."""


@dataclass(frozen=True, eq=False)
class Observation:
    """Points of a surface at a time, in the coordinates of the key-frames.

    Without ``vertices`` or ``corners`` it is a cloud: each point lies somewhere on the surface, and parts of the
    surface may be missing.

    Attributes:
        time: When they were seen.
        points: *Shape:* ``(n, 3)``, n of 3 or more.
        normals: Outward normals of a cloud's points, of any length: better pairs, and none with the wrong side.
            Default: of the planes through each point's neighbours, towards the camera or outward. *Shape:* ``(n, 3)``.
        vertices: The vertex that each point shows: markers, or, with all vertices, a noisy mesh. *Shape:* ``(n,)``.
        corners: The vertices of the triangle that each point lies on: markers between vertices. *Shape:* ``(n, 3)``.
        barycentric: Their weights at each point, with sum one. *Shape:* ``(n, 3)``.
        weights: Of the points, none below zero, comparable among observations: 4 counts as half of the noise. Points of
            weight 0 have no effect. Default: 1 each. *Shape:* ``(n,)``.
        noise: Standard deviation of the points, in their unit. Default: estimated.
        view: Direction from the surface to the camera of a cloud, far away: what it should see and has not counts, too.
            Default: found from the normals given, if all face one side. *Shape:* ``(3,)``.
        camera: The place of a camera that is near, instead. *Shape:* ``(3,)``.

    Raises:
        ValueError: Shapes that do not fit, numbers that are not finite, fewer than three points, or arguments that
            exclude each other.
        RuntimeError: Points within a transform of ``torch.func``, or with a tangent.
    """

    time: float
    points: Tensor
    normals: Tensor | None = None
    vertices: Tensor | None = None
    corners: Tensor | None = None
    barycentric: Tensor | None = None
    weights: Tensor | None = None
    noise: float | None = None
    view: Tensor | None = None
    camera: Tensor | None = None

    def __post_init__(self) -> None:
        values: dict[str, Any] = {"time": float(self.time)}
        object.__setattr__(self, "time", values["time"])  # named by all other messages
        if self.noise is not None:
            if torch.as_tensor(self.noise).numel() != 1:
                raise ValueError(f"{self}: noise is one number; points of different noise have weights, 1 / noise**2")
            object.__setattr__(self, "noise", float(self.noise))
        points = torch.as_tensor(self.points)
        refuse_transforms(str(self), points)
        if points.dim() != 2 or points.shape[1] != 3 or len(points) < LEAST_POINTS or not points.is_floating_point():
            raise ValueError(
                f"{self}: points are floating-point of the shape (n, 3), with n of {LEAST_POINTS} or more; got "
                f"{tuple(points.shape)} of {points.dtype}"
            )
        values["points"], n = points, len(points)
        indices = {"vertices": (n,), "corners": (n, 3)}
        numbers = {"normals": (n, 3), "barycentric": (n, 3), "weights": (n,), "view": (3,), "camera": (3,)}
        for name, shape in (indices | numbers).items():
            if getattr(self, name) is None:
                continue
            value = torch.as_tensor(getattr(self, name), device=points.device)
            whole = not (value.is_floating_point() or value.dtype == torch.bool)
            if value.shape != shape or (name in indices and not whole):
                what = "are vertex indices of" if name in indices else "have"
                raise ValueError(f"{self}: {name} {what} the shape {shape}; got {tuple(value.shape)} of {value.dtype}")
            values[name] = value.long() if name in indices else value.to(points.dtype).detach()
        for name, value in values.items():
            if not bool(torch.as_tensor(value).detach().isfinite().all()):
                raise ValueError(f"{self}: {name} must be finite; leave out what was not observed")
        weights, view = values.get("weights"), values.get("view")
        sums = values["barycentric"].sum(1) if "barycentric" in values else points.new_ones(1)
        worst = float(sums[(sums - 1).abs().argmax()])
        for wrong, message in (
            ((self.corners is None) != (self.barycentric is None), "corners and barycentric go together"),
            (self.vertices is not None and self.corners is not None, "markers have vertices or corners; got both"),
            (not self.is_cloud and bool({"normals", "view", "camera"} & {*values}), "normals and views are for clouds"),
            ({"view", "camera"} <= {*values}, "a camera has a view, from far, or a place; got both"),
            (weights is not None and not (weights >= 0).all(), "weights are 0 or more"),
            (weights is not None and int((weights > 0).sum()) < LEAST_POINTS, "3 points or more have a weight above 0"),
            (abs(worst - 1) > SUM_TOLERANCE, f"barycentric weights of a point have the sum one; got {worst:.6g}"),
            (self.noise is not None and not 0 < self.noise < torch.inf, "noise is a length above 0, in their unit"),
            (view is not None and not view.any(), "view is a direction; got a vector of length 0"),
        ):
            if wrong:
                raise ValueError(f"{self}: {message}")
        for name in values.keys() & {"normals", "view"}:
            lengths = values[name].norm(dim=-1, keepdim=True)
            values[name] = values[name] / lengths.clamp_min(torch.finfo(points.dtype).tiny)
        for name, value in values.items():
            object.__setattr__(self, name, value)

    def __repr__(self) -> str:
        return f"Observation at {self.time:g}"

    @property
    def is_cloud(self) -> bool:
        """True where the places of the points on the surface are not known."""
        return self.vertices is None and self.corners is None

    def places(self) -> tuple[Tensor, Tensor]:
        """Vertices and weights of a marker's place. *Shape:* ``(n, 3), (n, 3)``."""
        if self.corners is not None and self.barycentric is not None:
            return self.corners, self.barycentric
        assert self.vertices is not None
        first = self.points.new_tensor([1.0, 0.0, 0.0]).expand(len(self.points), 3)
        return self.vertices[:, None].expand(-1, 3), first


def refuse_transforms(what: str, x: Tensor) -> None:
    """Raise a RuntimeError within a transform of ``torch.func``, or forward mode."""
    if is_transformed(x):
        raise RuntimeError(f"{what}: no transforms of torch.func and no forward mode; take torch.autograd.grad")


def check_observations(observations: Sequence[Any], n_vertices: int) -> None:
    """Raise a ValueError where an observation is none, or does not fit the mesh."""
    others = sorted({type(one).__name__ for one in observations if not isinstance(one, Observation)})
    if others or not observations:
        raise ValueError(f"observations are a list of torch_modal.Observation; got {', '.join(others) or 'none'}")
    for one in observations:
        low, high = (0, 0) if one.is_cloud else map(int, one.places()[0].aminmax())
        if not 0 <= low <= high < n_vertices:
            raise ValueError(f"{one}: vertices lie in 0 to {n_vertices - 1}; got {low} to {high}")
