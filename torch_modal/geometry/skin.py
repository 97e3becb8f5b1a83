"""Linear blend skinning: vertices that follow bones."""

from dataclasses import dataclass

import torch
from torch import Tensor

STEPS = 65_535
"""Weights are whole parts of it, as files hold them."""


@dataclass(frozen=True, eq=False)
class Skin:
    r"""A motion of bones: :math:`\sum_j w_{vj}\, T_{tj}\, (x_v, 1)` is the vertex ``v`` in frame ``t``. No gradients.

    Attributes:
        rest: The shape that the bones move, frame 0. *Shape:* ``(V, 3)``.
        weights: Not negative, with sum one. *Shape:* ``(V, J)``.
        transforms: Rigid motions of the bones from rest, in the coordinates of the shapes. *Shape:* ``(T, J, 4, 4)``.
        error: Root mean square distance to the frames, over the bounding-box diagonal of frame 0.
        times: When the frames are, as passed to :func:`torch_modal.bake`. *Shape:* ``(T,)``.
    """

    rest: Tensor
    weights: Tensor
    transforms: Tensor
    error: float
    times: Tensor | None = None

    @torch.no_grad()
    def shapes(self) -> Tensor:
        """The motion again. *Shape:* ``(T, V, 3)``."""
        points = torch.nn.functional.pad(self.rest, (0, 1), value=1)[:, :, None]
        rows = self.transforms[:, :, :3].flatten(2)
        return torch.stack([((self.weights @ bones).unflatten(1, (3, 4)) @ points)[..., 0] for bones in rows])
