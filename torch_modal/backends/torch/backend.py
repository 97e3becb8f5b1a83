"""The parts of an in-between in torch."""

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from torch_modal.arrays import FloatArray, IntArray
from torch_modal.backends.torch.alignment import Alignment, Pair, PlacedPairs
from torch_modal.backends.torch.coarse_energy import CoarseEnergy
from torch_modal.backends.torch.distortion import Distortion
from torch_modal.backends.torch.fine_energy import FineEnergy
from torch_modal.energy.energy import Energy
from torch_modal.energy.term import Mesh, Term
from torch_modal.geometry.connectivity import Connectivity
from torch_modal.geometry.local_rotations import LocalRotations
from torch_modal.geometry.poisson import Poisson


class TorchBackend:
    """Makes the parts of in-betweens, all in torch.

    This is the reference: it serves all dtypes, devices, gradients and transforms. Another backend overrides the parts
    that it is faster at, and returns to these where it cannot serve; both give the same numbers, up to rounding.
    """

    def load(self) -> None:
        """Load what takes long, so that nobody waits for it later."""

    def place(self, frame: Alignment, x_a: Tensor, x_b: Tensor) -> PlacedPairs:
        """Bring pairs of key-frames into a frame. *Shape of each:* ``(P, V, 3)``."""
        (x_a, finite_a), (x_b, finite_b) = frame.finite(x_a), frame.finite(x_b)
        pair = frame.place(x_a, x_b)
        # Rows that lie together in memory are looked through several times as fast.
        ends = [x.detach().movedim(-1, 0).contiguous() for x in (pair.first, pair.second)]
        sizes = [(x.amax(-1) - x.amin(-1)).norm(dim=0) for x in ends]
        return PlacedPairs(pair, finite_a & finite_b, torch.minimum(*sizes))

    def restore(self, frame: Alignment, x: Tensor, pair: Pair, t: Tensor) -> Tensor:
        """Bring shapes back to the caller (:meth:`Alignment.restore`). *Shape:* ``(B, V, 3)``."""
        return frame.restore(x, pair, t)

    def rotations(self, mesh: Connectivity, references: Tensor) -> LocalRotations:
        """Local rotations of triangles between shapes near references. *Shape:* ``(K, V, 3)``."""
        return LocalRotations(mesh, references)

    def poisson(self, mesh: Connectivity, weights: Tensor) -> Poisson:
        """Shapes from edge vectors. *Shape:* ``(E,)``."""
        return Poisson(mesh, weights)

    def coarse_energy(self, energy: Energy, mesh: Mesh) -> CoarseEnergy:
        """The terms of Eq. 5 on the coarse mesh, for the modal solve."""
        return CoarseEnergy(energy)

    def fine_energy(self, mesh: Mesh, terms: Sequence[Term]) -> FineEnergy:
        """All terms on the caller's mesh, for steps of all vertices. Those of Eq. 5 come first."""
        return FineEnergy(mesh, terms)

    def distortion(self, mesh: Mesh, further: Energy | None) -> Distortion:
        """A bounded measure of shapes, with terms beside Eq. 5 where there are some."""
        return Distortion(mesh, further)

    def crossings(self, mesh: Connectivity, shape: FloatArray) -> Callable[[FloatArray], IntArray] | None:
        """A search for pairs of triangles that cross, near a shape; None: that of ``geometry/crossings.py``."""
        return None
