"""Observations of a motion at a time: point clouds, markers, noisy meshes."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

LEAST = 3
"""Points of an observation, at least: a pose follows from three."""


@dataclass(frozen=True, eq=False)
class Observation:
    """Points of a surface at a time, in the coordinates of the key-frames.

    Without ``vertices`` or ``corners`` it is a cloud: each point lies somewhere on the surface, and parts of the
    surface may be missing.

    Attributes:
        time: When they were seen.
        points: *Shape:* ``(n, 3)``, n of 3 or more.
        normals: Outward normals of a cloud's points, of any length: better pairs, and none with the wrong side.
            *Shape:* ``(n, 3)``.
        vertices: The vertex that each point shows: markers, or, with all vertices, a noisy mesh. *Shape:* ``(n,)``.
        corners: The vertices of the triangle that each point lies on: markers between vertices. *Shape:* ``(n, 3)``.
        barycentric: Their weights at each point, with sum one. *Shape:* ``(n, 3)``.
        weights: Of the points, none below zero; one each by default. *Shape:* ``(n,)``.
        noise: Standard deviation of the points, in their unit. Default: estimated.
        view: Direction from the surface to the camera of a cloud: what it does not see counts, too. *Shape:* ``(3,)``.

    Raises:
        ValueError: Shapes that do not fit, numbers that are not finite, fewer than three points, or arguments that
            exclude each other.
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

    def __post_init__(self) -> None:
        def put(name: str, value: object) -> None:
            object.__setattr__(self, name, value)

        put("time", float(self.time))
        if not torch.tensor(self.time).isfinite():
            raise ValueError(f"an observation's time is a finite number; got {self.time}")
        points = torch.as_tensor(self.points)
        if points.dim() != 2 or points.shape[1] != 3 or len(points) < LEAST or not points.is_floating_point():
            raise ValueError(
                f"{self}: points are floating-point of the shape (n, 3), with n of {LEAST} or more; got "
                f"{tuple(points.shape)} of {points.dtype}"
            )
        put("points", points)
        n = len(points)
        for name, shape in (("normals", (n, 3)), ("barycentric", (n, 3)), ("weights", (n,)), ("view", (3,))):
            value = getattr(self, name)
            if value is not None:
                value = torch.as_tensor(value, device=points.device).to(points.dtype).detach()
                if value.shape != shape:
                    raise ValueError(f"{self}: {name} have the shape {shape}; got {tuple(value.shape)}")
                put(name, value)
        for name, shape in (("vertices", (n,)), ("corners", (n, 3))):
            value = getattr(self, name)
            if value is not None:
                value = torch.as_tensor(value, device=points.device)
                if value.shape != shape or value.is_floating_point() or value.dtype == torch.bool:
                    raise ValueError(
                        f"{self}: {name} are vertex indices of the shape {shape}; got {tuple(value.shape)} of "
                        f"{value.dtype}"
                    )
                put(name, value.long())
        for name in ("points", "normals", "barycentric", "weights", "view"):
            value = getattr(self, name)
            if value is not None and not bool(value.detach().isfinite().all()):
                raise ValueError(f"{self}: {name} hold numbers that are not finite; leave out what was not observed")
        if (self.corners is None) != (self.barycentric is None):
            raise ValueError(f"{self}: corners and barycentric go together")
        if self.vertices is not None and self.corners is not None:
            raise ValueError(f"{self}: markers lie at vertices, or in triangles (corners); got both")
        if not self.is_cloud and (self.normals is not None or self.view is not None):
            raise ValueError(f"{self}: normals and view belong to clouds; these points have their places already")
        if self.weights is not None and not (bool((self.weights >= 0).all()) and bool(self.weights.sum() > 0)):
            raise ValueError(f"{self}: weights are 0 or more, and not all 0")
        if self.noise is not None and not 0 < self.noise < torch.inf:
            raise ValueError(f"{self}: noise is a length above 0, in the unit of the points; got {self.noise}")
        for name in ("normals", "view"):
            value = getattr(self, name)
            if value is not None:
                lengths = value.norm(dim=-1, keepdim=True)
                if name == "view" and not bool(lengths > 0):
                    raise ValueError(f"{self}: view is a direction; got a vector of length 0")
                put(name, value / lengths.clamp_min(torch.finfo(value.dtype).tiny))

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


def check_observations(observations: Sequence[Observation], n_vertices: int) -> list[Observation]:
    """The observations as a list; raises a ValueError where one does not fit the mesh."""
    if isinstance(observations, Observation):
        raise ValueError("observations are a list of torch_modal.Observation; got one alone")
    given = list(observations)
    others = sorted({type(one).__name__ for one in given if not isinstance(one, Observation)})
    if others or not given:
        raise ValueError(f"observations are a list of torch_modal.Observation; got {', '.join(others) or 'none'}")
    for one in given:
        if not one.is_cloud:
            corners = one.places()[0]
            if not 0 <= int(corners.min()) <= int(corners.max()) < n_vertices:
                raise ValueError(
                    f"{one}: vertices lie in 0 to {n_vertices - 1}; got {int(corners.min())} to {int(corners.max())}"
                )
    return given
