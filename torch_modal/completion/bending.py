"""Modal deformations of a shape near a reference, with their derivatives: rotation-strain coordinates of modes."""

from typing import NamedTuple

import torch
from torch import Tensor

from torch_modal.geometry.poisson import Reconstruction
from torch_modal.geometry.rigid import infinitesimal_motions
from torch_modal.geometry.rotations import exp
from torch_modal.geometry.triangle_frames import Frames, bend_sides, bend_slopes, frames_of
from torch_modal.motion.decoder import bending_columns

MOST_LOG_STRETCH = 1.0
"""Bound on the logarithm of a triangle's stretch: on a fine mesh, few triangles of a mode may have far more than on the
coarse one on which amplitudes are found."""


class ModalPose(NamedTuple):
    """Amplitudes of modes, then a rigid motion. *Shape:* ``(k,), (3, 3), (3,)``."""

    amplitudes: Tensor
    rotation: Tensor
    move: Tensor


class ModalBending:
    """Deformations of shapes by the modes of a reference, at a size of 100, float64 on the CPU.

    An amplitude of 1 moves the vertices of the reference by as much as the modes do. *Shape:* ``(V, 3), (F, 3), (k, V,
    3)``.
    """

    def __init__(self, reference: Tensor, faces: Tensor, modes: Tensor) -> None:
        self.faces, self.reference = faces, reference
        self.reconstruction = Reconstruction(reference, faces)
        #: What an amplitude of 1 does to each triangle, in its own coordinates. *Shape:* ``(k, 6, F)``.
        self.columns = bending_columns(reference, faces, modes)
        self._by_face = self.columns.permute(2, 1, 0).contiguous()

    def still(self) -> ModalPose:
        """No deformation."""
        return ModalPose(self.columns.new_zeros(len(self.columns)), torch.eye(3).double(), torch.zeros(3).double())

    def _bending(self, base: Tensor, pose: ModalPose) -> tuple[Tensor, Tensor, Frames]:
        """Rotation vectors, unbounded strains, and the frames of the shape. *Shape of both:* ``(3, 1, F)``."""
        rest, bending = frames_of(base[None], self.faces), torch.einsum("k,kcf->cf", pose.amplitudes, self.columns)
        turn = bending[0] * rest.e1 + bending[1] * rest.e2 + bending[2] * rest.normal
        return turn, bending[3:, None], rest

    def shape(self, base: Tensor, pose: ModalPose) -> Tensor:
        """The deformed shape. *Shape:* ``(V, 3)``."""
        return self._bent(base, pose, *self._bending(base, pose))

    def _bent(self, base: Tensor, pose: ModalPose, turn: Tensor, strain: Tensor, rest: Frames) -> Tensor:
        wanted = bend_sides(turn, strain.clamp(-MOST_LOG_STRETCH, MOST_LOG_STRETCH), rest)
        return self.reconstruction(wanted, base[None])[0] @ pose.rotation.mT + pose.move

    def linearise(self, base: Tensor, pose: ModalPose, n: int | None = None) -> tuple[Tensor, Tensor]:
        """The deformed shape, and its derivatives in the first n amplitudes, a move and a turn about its centroid.

        *Shape:* ``(V, 3), (V, 3, n + 6)``.
        """
        turn, strain, rest = self._bending(base, pose)
        x = self._bent(base, pose, turn, strain, rest)
        motions = infinitesimal_motions(x - x.mean(0)).movedim(0, -1)
        bounded = strain.clamp(-MOST_LOG_STRETCH, MOST_LOG_STRETCH)
        within = torch.cat([torch.ones_like(strain), (bounded == strain).to(strain)])
        slopes = bend_slopes(turn, bounded, rest, torch.stack(rest[:3], 1))
        # The right-hand side of the Poisson problem at the corners of each face, by its bending: faster than by edges.
        of_first, of_second = ((side * within)[:, :, 0].permute(2, 0, 1) for side in slopes)  # (F, 3, 6) each
        one, other, last = self.reconstruction.weights.view(3, -1)[..., None, None]
        corners = [
            -one * of_first - last * of_second,
            (one + other) * of_first - other * of_second,
            (other + last) * of_second - other * of_first,
        ]
        moved = (torch.cat(corners, 1) @ self._by_face[..., :n]).view(3 * len(self.faces), -1)
        right = moved.new_zeros(len(base), moved.shape[1]).index_add(0, self.faces.flatten(), moved)
        fields = self.reconstruction.poisson(right, torch.zeros_like(right)).view(len(base), 3, -1)
        return x, torch.cat([pose.rotation @ fields, motions], -1)

    @staticmethod
    def step(pose: ModalPose, step: Tensor, centre: Tensor) -> ModalPose:
        """A pose after a step in the directions of :meth:`linearise`. *Shape:* ``(k + 6,), (3,)``."""
        turn, move = exp(step[-3:]), step[-6:-3]
        amplitudes = pose.amplitudes.clone()
        amplitudes[: len(step) - 6] += step[:-6]
        return ModalPose(amplitudes, turn @ pose.rotation, turn @ (pose.move - centre) + centre + move)
