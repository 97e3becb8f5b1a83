"""A shape between two key-frames by local rotations, with every vertex free: what the modes then improve."""

import torch
from torch import Tensor, nn

from torch_modal.geometry.connectivity import Connectivity
from torch_modal.geometry.local_rotations import Course, LocalRotations
from torch_modal.geometry.poisson import Poisson
from torch_modal.nn.fused_rotations import FusedRotations


class RotationBlend(nn.Module):
    r"""Vertices of :math:`\min_x \sum_e |e(x) - \bar e|^2 / l_e`, with edges from :class:`LocalRotations`.

    The weights are those of references, so that one factorisation serves all shapes. Each piece of the surface keeps
    the centroid of linear interpolation; vertices that no face uses are pieces of their own.

    Args:
        mesh: The connectivity.
        references: Two shapes near the key-frames. *Shape:* ``(2, V, 3)``.
        fused: Whether the edges come from kernels.
    """

    def __init__(self, mesh: Connectivity, references: Tensor, fused: bool = False) -> None:
        super().__init__()
        self.rotations = (FusedRotations if fused else LocalRotations)(mesh, references)
        self.poisson = Poisson(mesh, self.rotations.per_length)

    def forward(self, first: Tensor, second: Tensor, t: Tensor) -> Tensor:
        """The shape at the time ``t``. *Shape:* ``(B, V, 3), (B, V, 3), (B,) -> (B, V, 3)``."""
        return self._reached(self.rotations(first, second, t), torch.lerp(first, second, t[:, None, None]))

    def along(self, course: Course, which: Tensor, straight: Tensor, t: Tensor) -> Tensor:
        """The shape at the time ``t`` of a course.

        Args:
            course: Of :meth:`LocalRotations.course`.
            which: Of which pair of shapes. *Shape:* ``(B,)``.
            straight: Shapes whose pieces have their centroids where they are wanted. *Shape:* ``(B, V, 3)``.
            t: *Shape:* ``(B,)``.
        """
        return self._reached(self.rotations.along(course, which, t), straight)

    def bent_along(self, course: Course, straight: Tensor, t: Tensor, bending: Tensor) -> Tensor:
        """The same of one pair of shapes, whose triangles also bend, see :meth:`LocalRotations.bent_along`."""
        return self._reached(self.rotations.bent_along(course, t, bending), straight)

    def _reached(self, edges: Tensor, near: Tensor) -> Tensor:
        return self.poisson(edges, near.movedim(-1, 0)).movedim(0, -1)
