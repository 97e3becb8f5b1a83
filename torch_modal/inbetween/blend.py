"""A shape between two key-frames by local rotations of all triangles; the base of the modal space."""

from functools import cached_property

import torch
from torch import Tensor, nn

from torch_modal.autograd import lasting
from torch_modal.backends.torch.backend import TorchBackend
from torch_modal.geometry.connectivity import Connectivity
from torch_modal.geometry.local_rotations import Trajectory, weights_per_length
from torch_modal.geometry.poisson import Poisson
from torch_modal.geometry.vectors import pick


class RotationBlend(nn.Module):
    r"""Vertices of :math:`\min_x \sum_e |e(x) - \bar e|^2 / l_e`, with edges from :class:`LocalRotations`.

    The weights are those of references, so that one factorisation serves all shapes. Each piece of the surface keeps
    the centroid of linear interpolation; vertices that no face uses are pieces of their own.

    Args:
        mesh: The connectivity.
        references: Shapes near the key-frames, as for :class:`LocalRotations`. *Shape:* ``(K, V, 3)``.
        backend: Makes the parts.
        poisson: The system, where others share it. Default: that of the mean edge lengths of the references.
    """

    def __init__(
        self, mesh: Connectivity, references: Tensor, backend: TorchBackend, poisson: Poisson | None = None
    ) -> None:
        super().__init__()
        self.rotations = backend.rotations(mesh, references)
        self.poisson = backend.poisson(mesh, weights_per_length(mesh, references)) if poisson is None else poisson

    def forward(self, shapes: Tensor, weights: Tensor, straight: Tensor) -> Tensor:
        """The weighted mean of K shapes.

        Args:
            shapes: *Shape:* ``(B, K, V, 3)``.
            weights: *Shape:* ``(B, K)``.
            straight: Their weighted sum. *Shape:* ``(B, V, 3)``.
        """
        return self._reached(self.rotations(shapes, weights), straight)

    def along(self, trajectory: Trajectory, which: Tensor, straight: Tensor, t: Tensor) -> Tensor:
        """The shape at the time ``t`` of a trajectory.

        Args:
            trajectory: Of :meth:`LocalRotations.trajectory`.
            which: Of which pair of shapes. *Shape:* ``(B,)``.
            straight: Shapes whose pieces have their centroids where they are wanted. *Shape:* ``(B, V, 3)``.
            t: *Shape:* ``(B,)``.
        """
        return self._reached(self.rotations.along(trajectory, which, t), straight)

    def bent_along(self, trajectory: Trajectory, straight: Tensor, t: Tensor, bending: Tensor) -> Tensor:
        """The same of one pair of shapes, whose triangles also bend, see :meth:`LocalRotations.bent_along`."""
        return self._reached(self.rotations.bent_along(trajectory, t, bending), straight)

    def _reached(self, edges: Tensor, near: Tensor) -> Tensor:
        """The shape of edge vectors; where that is not finite, the one near it. *Shape:* ``(3, B, E), (B, V, 3)``."""
        found = self.poisson(edges, near.movedim(-1, 0)).movedim(0, -1)
        return torch.where(found.isfinite().flatten(1).all(1)[:, None, None], found, near)


class Blends:
    """The blends of pairs of shapes. One Poisson system serves all, so that velocities go on where two of them meet.

    So does the tree of the first pair, wherever turns have the same senses by every tree: where neighbours have the
    same one by this, and nothing goes beyond a full turn. Other pairs have one of their own.

    Args:
        mesh: The connectivity.
        shapes: All of them, float64 on the CPU. *Shape:* ``(K, V, 3)``.
        first: The pair whose tree others share, if they can.
        backend: Makes the parts.
    """

    def __init__(self, mesh: Connectivity, shapes: Tensor, first: tuple[int, int], backend: TorchBackend) -> None:
        self.mesh, self.shapes, self.backend = mesh, shapes, backend
        self._pair = first

    @cached_property
    @lasting
    def first(self) -> RotationBlend:
        """That of the first pair."""
        others = [k for k in range(len(self.shapes)) if k not in self._pair]
        return RotationBlend(self.mesh, self.shapes[[*self._pair, *others]], self.backend)

    @lasting
    def of(self, i: int, j: int) -> RotationBlend:
        """The blend of two of the shapes."""
        if (i, j) == self._pair or self._is_plain(i, j):
            return self.first
        return RotationBlend(self.mesh, self.shapes[[i, j]], self.backend, self.first.poisson)

    def _is_plain(self, i: int, j: int) -> bool:
        """Whether neighbours have the same quaternion sign by the first tree, and so by every other, below a turn."""
        rotations = self.first.rotations
        pair = self.shapes[[i, j]].to(rotations.piece.device)
        if rotations.clusters is not None or rotations.is_beyond_a_turn(*pair):
            return False
        turns = rotations.turns(pair[:1], pair[1:])[:, 0]
        one, other = torch.tensor(self.mesh.face_neighbours, device=turns.device).unbind(1)
        return bool(((pick(turns, one) * pick(turns, other)).sum(0) >= 0).all())
