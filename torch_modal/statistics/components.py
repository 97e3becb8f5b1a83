"""Principal components of a set of shapes."""

import torch
from torch import Tensor

from torch_modal.autograd import outside_inference_mode
from torch_modal.geometry.rigid import align
from torch_modal.keyframes.arrays import check_tensor
from torch_modal.statistics.variation import Variation


class Components:
    """Directions in which the shapes of a set vary most, and coordinates along them.

    They are components of rotations and strains of the triangles, weighted by area: one of them bends a leg, where a
    component of displacements would shear it. There are at most K - 1.
    """

    @outside_inference_mode
    def __init__(self, variation: Variation, n: int) -> None:
        self._variation, deviations = variation, variation.deviations
        off = (deviations * variation.coordinates.shares.sqrt()).flatten(1)
        left, values, _ = torch.linalg.svd(off, full_matrices=False)
        left, values = left[:, :n], values[:n]
        # The sign under which the first shape that is not in the middle lies on the positive side.
        first = left.abs().argmax(0, keepdim=True)
        left = left * torch.where(left.gather(0, first) < 0, -1, 1)
        #: Variance along each, in squared radians (or squared strains). *Shape:* ``(n,)``.
        self.variances = values.square() / (len(variation) - 1)
        #: Part of the whole variance that each has. *Shape:* ``(n,)``.
        self.shares = values.square() / off.square().sum().clamp_min(torch.finfo(off.dtype).tiny)
        #: Directions of root mean square one over the area. *Shape:* ``(n, 6, E)``.
        self.directions = torch.einsum("kn,kjf->njf", left / values.clamp_min(torch.finfo(off.dtype).tiny), deviations)

    def __len__(self) -> int:
        return len(self.directions)

    def coordinates(self, shapes: Tensor) -> Tensor:
        """Coordinates of shapes along the components. *Shape:* ``(..., V, 3) -> (..., n)``."""
        check_tensor("shapes", shapes, "...", *self._variation.coordinates.mean.shape)
        flat = shapes.reshape(shapes.shape[:-2].numel(), *shapes.shape[-2:]).to(self.directions)
        off = (self._variation.coordinates.of(flat) - self._variation.average) * self._variation.coordinates.shares
        values = torch.einsum("bjf,njf->bn", off, self.directions)
        return values.view(*shapes.shape[:-2], len(self)).to(shapes)

    def shapes(self, coordinates: Tensor, like: Tensor | None = None) -> Tensor:
        """The shapes of coordinates; zeros give the average of rotations and strains.

        They have the pose of the mean, or are moved rigidly onto shapes ``like``, *shape* ``(V, 3)`` or
        ``(..., V, 3)``, by :func:`torch_modal.align`. *Shape:* ``(..., n) -> (..., V, 3)``.
        """
        check_tensor("coordinates", coordinates, "...", "n")
        flat = coordinates.reshape(coordinates.shape[:-1].numel(), coordinates.shape[-1]).to(self.directions)
        bending = self._variation.average + torch.einsum("bn,njf->bjf", flat, self.directions[: flat.shape[1]])
        of = self._variation.coordinates
        shapes = of.align(of.shapes(bending)) + self._variation.origin
        shapes = shapes.view(*coordinates.shape[:-1], *shapes.shape[1:])
        return (shapes if like is None else align(shapes, like.to(shapes))).to(coordinates)
