"""Weighted means of shapes by local rotations of all triangles: the base of in-betweens."""

from torch import Tensor, nn

from torch_modal.elastic.backend import TorchBackend
from torch_modal.geometry.connectivity import Connectivity
from torch_modal.geometry.local_rotations import weights_per_length
from torch_modal.geometry.poisson import Poisson


class RotationBlend(nn.Module):
    r"""Vertices of :math:`\min_x \sum_e |e(x) - \bar e|^2 / l_e`, with edges from :class:`LocalRotations`.

    The weights follow from the references, so that one factorisation serves all shapes. Each piece of the surface keeps
    the centroid of linear interpolation; vertices that no face uses are pieces of their own.

    Args:
        mesh: The connectivity.
        references: Shapes near the key-frames, as for :class:`LocalRotations`. *Shape:* ``(K, V, 3)``.
        backend: Makes the parts.
    """

    def __init__(self, mesh: Connectivity, references: Tensor, backend: TorchBackend) -> None:
        super().__init__()
        self.rotations = backend.rotations(mesh, references)
        self.poisson = Poisson(mesh, weights_per_length(mesh, references))

    def forward(self, shapes: Tensor, weights: Tensor, straight: Tensor) -> Tensor:
        """The weighted mean of K shapes.

        Args:
            shapes: *Shape:* ``(B, K, V, 3)``.
            weights: They add up to one. *Shape:* ``(B, K)``.
            straight: The weighted sum. *Shape:* ``(B, V, 3)``.

        Returns:
            The weighted sum where the mean is not finite. *Shape:* ``(B, V, 3)``.
        """
        return self.poisson.forward_or_near(self.rotations.right_hand_side(shapes, weights, self.poisson), straight)
