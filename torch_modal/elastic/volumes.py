"""Volumes of closed shapes, to tell mirror images."""

import torch
from torch import Tensor, nn

from torch_modal.autograd import plain
from torch_modal.elastic import volume
from torch_modal.elastic.kernels.launch import launch, made
from torch_modal.geometry.connectivity import Connectivity
from torch_modal.geometry.vectors import cross, pick


class Volumes(nn.Module):
    """Signed volumes, without gradient, of shapes without boundary.

    Args:
        mesh: Their connectivity.
    """

    corners: Tensor

    def __init__(self, mesh: Connectivity) -> None:
        super().__init__()
        #: Of the faces. *Shape:* ``(3, F)``.
        self.register_buffer("corners", torch.tensor(mesh.faces).T.contiguous(), persistent=False)

    def forward(self, shapes: Tensor) -> Tensor:
        """Compute. *Shape:* ``(B, K, V, 3) -> (B, K)``."""
        rows = shapes.detach().mT.contiguous()
        a, b, c = (pick(rows, corner).movedim(2, 0) for corner in self.corners)
        return (a * cross(b, c)).sum((0, -1)) / 6


class KernelVolumes(Volumes):
    """:class:`Volumes` in one pass over the faces, in float64."""

    def __init__(self, mesh: Connectivity) -> None:
        super().__init__(mesh)
        self.register_buffer("faces", self.corners.T.int().contiguous(), persistent=False)

    def forward(self, shapes: Tensor) -> Tensor:
        """Overrides the base class."""
        if not plain(shapes):
            return super().forward(shapes)
        x = shapes.detach().double().contiguous()
        found, n = x.new_zeros(shapes.shape[:2]), shapes.shape[2]
        launch(
            made(volume.kernels).sizes, (found.numel(), len(self.faces)), [self.faces, n, x, None, found, None, None]
        )
        return found.to(shapes)
