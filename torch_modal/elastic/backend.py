"""The parts of an in-between in torch."""

from collections.abc import Callable, Sequence
from typing import Any

from torch import Tensor

from torch_modal.arrays import FloatArray, IntArray
from torch_modal.elastic.distortion import Distortion
from torch_modal.elastic.energy import Energy
from torch_modal.elastic.modal import ModalEnergy
from torch_modal.elastic.steps import FineEnergy
from torch_modal.elastic.term import Mesh, Term
from torch_modal.elastic.volumes import Volumes
from torch_modal.geometry.connectivity import Connectivity
from torch_modal.geometry.local_rotations import LocalRotations
from torch_modal.geometry.poisson import Poisson
from torch_modal.geometry.procrustes import mean_pose


class TorchBackend:
    """Makes the parts of in-betweens, all in torch. Each takes K shapes of every sample with their weights.

    This is the reference: it serves all dtypes, devices, gradients and transforms. Another backend overrides the parts
    that it is faster at, and returns to these where it cannot serve; both give the same numbers, up to rounding.
    """

    quasi_newton: Callable[..., Any] | None = None
    """Does what :func:`torch_modal.elastic.minimise.updated` does."""

    mean_pose = staticmethod(mean_pose)

    def load(self) -> None:
        """Load what takes long, so that nobody waits for it later."""

    def rotations(self, mesh: Connectivity, references: Tensor) -> LocalRotations:
        """Local rotations of triangles between shapes near references. *Shape:* ``(K, V, 3)``."""
        return LocalRotations(mesh, references)

    def poisson(self, mesh: Connectivity, weights: Tensor) -> Poisson:
        """Shapes from edge vectors. *Shape:* ``(E,)``."""
        return Poisson(mesh, weights)

    def modal_energy(self, energy: Energy, mesh: Mesh, columns: Tensor) -> ModalEnergy:
        """Terms in the amplitudes of columns, for the modal solve. *Shape:* ``(n, V, 3)``."""
        return ModalEnergy(energy, columns)

    def fine_energy(self, mesh: Mesh, terms: Sequence[Term]) -> FineEnergy:
        """All terms on the caller's mesh, for steps of all vertices. Those of Eq. 5 come first."""
        return FineEnergy(mesh, terms)

    def volumes(self, mesh: Connectivity) -> Volumes:
        """Signed volumes of closed shapes."""
        return Volumes(mesh)

    def distortion(self, mesh: Mesh, further: Energy | None) -> Distortion:
        """A bounded measure of shapes, with terms beside Eq. 5 where there are some."""
        return Distortion(mesh, further)

    def crossings(self, mesh: Connectivity, shape: FloatArray) -> Callable[[FloatArray], IntArray] | None:
        """A search for pairs of triangles that cross, near a shape; None: that of ``geometry/crossings.py``."""
        return None
