"""Linear blend skinning: vertices that follow bones."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from torch_modal.geometry.rigid import best_rotation
from torch_modal.geometry.rotations import quaternion

WEIGHT_STEPS = 65_535
"""Weights are whole parts of it, as files hold them."""
FOLLOWED = 0.25
"""Weight in the root's rotation of the turn since the frame before; best fits of a body twisted by a turn jump."""


@dataclass(frozen=True, eq=False)
class Skin:
    r"""A motion of bones: :math:`\sum_j w_{vj}\, T_{tj}\, (x_v, 1)` is the vertex ``v`` in frame ``t``. No gradients.

    Attributes:
        rest: The shape that the bones move, frame 0. *Shape:* ``(V, 3)``.
        weights: Not negative, with sum one. *Shape:* ``(V, J)``.
        transforms: Rigid motions of the bones from rest, in the coordinates of the shapes. *Shape:* ``(T, J, 4, 4)``.
        error_at_frames: Root mean square distance to the frames, over the bounding-box diagonal of frame 0.
        error_between_frames: Root mean square distance half-way between frames, as players show it, to the mean of both
            after the turns of the body and of the bones' vertices; over the same diagonal.
        times: When the frames are, as passed to :func:`torch_modal.bake`. *Shape:* ``(T,)``.
    """

    rest: Tensor
    weights: Tensor
    transforms: Tensor
    error_at_frames: float
    error_between_frames: float
    times: Tensor | None = None

    @property
    def error(self) -> float:
        """Root mean square of both errors."""
        return math.hypot(self.error_at_frames, self.error_between_frames) / math.sqrt(2)

    @torch.no_grad()
    def shapes(self) -> Tensor:
        """The motion again. *Shape:* ``(T, V, 3)``."""
        return blend_bones(self.weights, self.transforms[:, :, :3], self.rest.expand(len(self.transforms), -1, -1))

    @torch.no_grad()
    def tracks(self) -> tuple[Tensor, Tensor, Tensor]:
        """Places at rest, and motions, of a root that carries the rigid motion and of joints below it, as in files.

        Joints are at the means of their vertices; players interpolate quaternions and translations between frames.

        Returns:
            Transforms at rest in the coordinates of the shapes, quaternions, and translations relative to the root, in
            double precision on the CPU. *Shape:* ``(1 + J, 4, 4), (4, T, 1 + J), (T, 1 + J, 3)``.
        """
        arrays = self.weights, self.rest, self.transforms, self.shapes()
        weights, rest, transforms, shapes = (array.double().cpu() for array in arrays)
        centred, here = shapes - shapes.mean(1, keepdim=True), rest - rest.mean(0)
        fits = centred.mT @ here / here.square().sum()
        steps, rotations = best_rotation(centred[1:].mT @ centred[:-1]), [best_rotation(fits[0])]
        for fit, step in zip(fits[1:], steps, strict=True):
            rotations.append(best_rotation(fit + FOLLOWED * step @ rotations[-1]))
        bind = torch.eye(4, dtype=torch.float64).repeat(1 + weights.shape[1], 1, 1)
        bind[0, :3, 3], bind[1:, :3, 3] = rest.mean(0), weights.mT @ rest / weights.sum(0)[:, None]
        root = bind[:1].repeat(len(shapes), 1, 1)
        root[:, :3, :3], root[:, :3, 3] = torch.stack(rotations), shapes.mean(1)
        local = torch.cat([root[:, None], torch.linalg.solve(root[:, None], transforms @ bind[1:])], 1)
        return bind, quaternion(local[..., :3, :3].movedim((2, 3), (0, 1))), local[..., :3, 3]


def blend_bones(weights: Tensor, bones: Tensor, points: Tensor) -> Tensor:
    """Points moved by weighted affine maps. *Shape:* ``(V, J), (T, J, 3, 4), (T, V, 3) -> (T, V, 3)``."""
    wide = torch.nn.functional.pad(points, (0, 1), value=1)[..., None]
    return torch.stack(
        [((weights @ a).unflatten(1, (3, 4)) @ x)[..., 0] for a, x in zip(bones.flatten(2), wide, strict=True)]
    )
