"""The energy of observed points: of the vertices that they are paired with."""

from collections.abc import Sequence

import numpy as np
import torch
from scipy import sparse
from torch import Tensor

from torch_modal.arrays import FloatArray
from torch_modal.completion.pairs import SLIDE, ObservedPoints
from torch_modal.elastic.steps import Point


class PointEnergy:
    r"""Springs between places on a surface and points, weaker along it where there are normals.

    :math:`\sum_i w_i (s |p_i - q_i|^2 + (1 - s) (n_i \cdot (p_i - q_i))^2)`, with s of 1 where there is no normal.

    Args:
        pairs: The places, each between three vertices at most, at one shape.
        trust: Robust weights of the pairs that follow the distances; 1 of those that are constants. *Shape:* ``(n,)``.
    """

    def __init__(self, pairs: Sequence[ObservedPoints], trust: FloatArray | None = None) -> None:
        self.trust = np.ones(sum(len(one.points) for one in pairs)) if trust is None else trust
        self.places = sparse.vstack([one.places for one in pairs]).tocsr()
        self.points = torch.from_numpy(np.concatenate([one.points for one in pairs]))
        #: The observed point of each pair. *Shape:* ``(n,)``.
        self.numbers = np.concatenate([one.numbers for one in pairs])
        eye, blocks = torch.eye(3, dtype=torch.float64), []
        for one in pairs:
            block = eye.expand(len(one.points), 3, 3)
            if one.normals is not None:
                normals = torch.from_numpy(one.normals)
                block = SLIDE * eye + (1 - SLIDE) * normals[:, :, None] * normals[:, None]
            blocks.append(torch.from_numpy(one.weights)[:, None, None] * block)
        #: Stiffness of each pair. *Shape:* ``(n, 3, 3)``.
        self.stiffness = torch.cat(blocks)
        squares = self.places.multiply(self.places).tocsr()
        upper = self.stiffness.flatten(1)[:, [0, 1, 2, 4, 5, 8]]
        self.diagonal = 2 * torch.from_numpy(squares.T @ upper.numpy())

    def forces(
        self, field: Tensor, points: Tensor | float = 0.0, stiffness: Tensor | None = None
    ) -> tuple[Tensor, Tensor]:
        """Differences from the points, and the forces on them. *Shape:* ``(1, V, 3) -> (n, 3), (n, 3)``."""
        off = torch.from_numpy(self.places @ field[0].numpy()) - points
        return off, ((self.stiffness if stiffness is None else stiffness) @ off[..., None])[..., 0]

    def tangent(self, x: Tensor) -> Tensor:
        r"""Derivative of the forces where weights of known places are those of the distances. *Shape:* ``(n, 3, 3)``.

        With :math:`w(d) = (1 + (d / c)^2)^{-2}` it is :math:`w (I - 4 (1 - \sqrt w) \hat d \hat d^T)`.
        """
        off = self.forces(x, self.points)[0]
        towards = off / off.norm(dim=1, keepdim=True).clamp_min(torch.finfo(off.dtype).tiny)
        lost = 4 * (1 - torch.from_numpy(self.trust) ** 0.5)[:, None, None] * towards[:, :, None] * towards[:, None]
        return self.stiffness - self.stiffness @ lost

    def spread(self, forces: Tensor) -> Tensor:
        """Gradient in the vertices of forces on places. *Shape:* ``(n, 3) -> (1, V, 3)``."""
        return 2 * torch.from_numpy(self.places.T @ forces.numpy())[None]

    def value(self, x: Tensor) -> Tensor:
        """*Shape:* ``(1, V, 3) -> (1,)``."""
        return self.at(x).value

    def at(self, x: Tensor) -> Point:
        """*Shape:* ``(1, V, 3)``."""
        off, forces = self.forces(x, self.points)
        gradient = self.spread(forces)
        return Point(
            (off * forces).sum()[None], gradient, self.diagonal[None], lambda d: self.spread(self.forces(d)[1])
        )
