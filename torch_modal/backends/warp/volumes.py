"""Volumes of closed shapes by a Warp kernel."""

from torch import Tensor

from torch_modal.autograd import plain
from torch_modal.backends.torch.volumes import Volumes
from torch_modal.backends.warp.launch import Constants, kernels, launch
from torch_modal.geometry.connectivity import Connectivity


class WarpVolumes(Volumes):
    """:class:`Volumes` in one pass over the faces, in float64."""

    def __init__(self, mesh: Connectivity) -> None:
        super().__init__(mesh)
        faces = self.corners.T.contiguous().int()
        self.constants = Constants("rotations", "FaceTables", faces=faces, n_vertices=mesh.n_vertices)

    def forward(self, shapes: Tensor) -> Tensor:
        """Overrides the base class."""
        if not plain(shapes):
            return super().forward(shapes)
        x = shapes.detach().double().contiguous()
        found = x.new_zeros(shapes.shape[:2])
        launch(kernels("rotations").volumes, (found.numel(), self.corners.shape[1]), [self.constants, x, found])
        return found.to(shapes)
