"""Modal deformations of a shape near a reference, with their derivatives: rotation-strain coordinates of modes."""

import torch
from torch import Tensor

from torch_modal.geometry.poisson import Reconstruction
from torch_modal.geometry.rigid import infinitesimal_motions
from torch_modal.geometry.rotations import exp
from torch_modal.geometry.triangle_frames import bent_sides, edge_means, frames, sides
from torch_modal.motion.decoder import bending_columns


class ModalPose:
    """Amplitudes of modes, then a rigid motion. *Shape:* ``(k,), (3, 3), (3,)``."""

    def __init__(self, amplitudes: Tensor, rotation: Tensor, move: Tensor) -> None:
        self.amplitudes, self.rotation, self.move = amplitudes, rotation, move

    def apply(self, x: Tensor) -> Tensor:
        """The rigid motion. *Shape:* ``(V, 3)``."""
        return x @ self.rotation.mT + self.move


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

    def still(self) -> ModalPose:
        """No deformation."""
        return ModalPose(self.columns.new_zeros(len(self.columns)), torch.eye(3).double(), torch.zeros(3).double())

    def _sides(self, base: Tensor, bending: Tensor) -> tuple[Tensor, Tensor]:
        own = frames(sides(base.T[:, None].contiguous(), self.faces))
        turn = bending[0] * own.e1[:, 0] + bending[1] * own.e2[:, 0] + bending[2] * own.normal[:, 0]
        return bent_sides(turn[:, None], bending[3:, None], own)

    def shape(self, base: Tensor, pose: ModalPose) -> Tensor:
        """The deformed shape. *Shape:* ``(V, 3)``."""
        bending = torch.einsum("k,kcf->cf", pose.amplitudes, self.columns)
        rest = base.T[:, None].contiguous()
        return pose.apply(self.reconstruction(self._sides(base, bending), rest)[:, 0].T)

    def linearised(self, base: Tensor, pose: ModalPose, rigid: bool = False) -> tuple[Tensor, Tensor]:
        """The deformed shape, and its derivatives in amplitudes, a move and a turn about its centroid.

        If rigid, in the last two alone. *Shape:* ``(V, 3), (k + 6, V, 3)``.
        """
        own, rest = self.reconstruction, base.T[:, None].contiguous()
        with torch.enable_grad():
            bending = torch.einsum("k,kcf->cf", pose.amplitudes, self.columns).requires_grad_()
            first, second = self._sides(base, bending)
            ends = () if rigid else torch.cat([first, second])[:, 0]
            slopes = [torch.autograd.grad(row.sum(), bending, retain_graph=True)[0] for row in ends]
        x = pose.apply(own((first.detach(), second.detach()), rest)[:, 0].T)
        motions = infinitesimal_motions(x - x.mean(0))
        if rigid:
            return x, motions
        moved = torch.einsum("rcf,kcf->rkf", torch.stack(slopes), self.columns)
        edges = edge_means((moved[:3], moved[3:]), own.weights, own.sides, own.signs, len(own.edges))
        fields = own.poisson(own.poisson.pulls(edges), edges.new_zeros(edges.shape[1], len(base), 3))
        return x, torch.cat([fields @ pose.rotation.mT, motions])

    @staticmethod
    def stepped(pose: ModalPose, step: Tensor, centre: Tensor) -> ModalPose:
        """A pose after a step in the directions of :meth:`linearised`. *Shape:* ``(k + 6,), (3,)``."""
        turn, move = exp(step[-3:]), step[-6:-3]
        amplitudes = pose.amplitudes + step[:-6] if len(step) > 6 else pose.amplitudes
        return ModalPose(amplitudes, turn @ pose.rotation, turn @ (pose.move - centre) + centre + move)
