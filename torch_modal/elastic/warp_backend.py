"""The parts of an in-between by kernels of NVIDIA Warp."""

import importlib.util
import warnings
from collections.abc import Callable, Sequence
from functools import cache

from torch import Tensor

from torch_modal.arrays import FloatArray, IntArray
from torch_modal.elastic.backend import TorchBackend
from torch_modal.elastic.bend import Bend
from torch_modal.elastic.distortion import Distortion
from torch_modal.elastic.energy import Energy
from torch_modal.elastic.kernels.launch import kernels, load_kernels
from torch_modal.elastic.modal import ModalEnergy
from torch_modal.elastic.shell import N_SHELL_TERMS
from torch_modal.elastic.steps import FineEnergy
from torch_modal.elastic.stretch import Stretch
from torch_modal.elastic.term import Mesh, Term
from torch_modal.elastic.volume import Volume
from torch_modal.elastic.warp_crossings import WarpPairs
from torch_modal.elastic.warp_distortion import WarpDistortion
from torch_modal.elastic.warp_fine_steps import WarpFineEnergy
from torch_modal.elastic.warp_modal_energy import WarpModalEnergy
from torch_modal.elastic.warp_procrustes import mean_pose
from torch_modal.elastic.warp_quasi_newton import update
from torch_modal.elastic.warp_rotations import WarpRotations
from torch_modal.elastic.warp_volumes import WarpVolumes
from torch_modal.errors import MissingPackageError
from torch_modal.geometry.connectivity import Connectivity


class WarpBackend(TorchBackend):
    """Parts that do in one pass over the elements what torch does in dozens, in float64.

    Raises:
        MissingPackageError: Warp is not installed.
    """

    quasi_newton, mean_pose = staticmethod(update), staticmethod(mean_pose)

    def __init__(self) -> None:
        if importlib.util.find_spec("warp") is None:
            raise MissingPackageError("backend='warp' needs warp-lang, which is not installed: pip install warp-lang")

    @staticmethod
    @cache
    def works() -> bool:
        """Whether Warp is installed, and compiles."""
        if importlib.util.find_spec("warp") is None:
            return False
        try:
            kernels("shell")
        except Exception as error:  # whatever keeps Warp from compiling: torch does the same, only slower
            warnings.warn(f"Warp is installed, but its kernels cannot be used, so torch is: {error}", stacklevel=2)
            return False
        return True

    def load(self) -> None:
        """As in the base class: the kernels of in-betweens."""
        load_kernels()

    def rotations(self, mesh: Connectivity, references: Tensor) -> WarpRotations:
        """Overrides the base class."""
        return WarpRotations(mesh, references)

    def modal_energy(self, energy: Energy, mesh: Mesh, columns: Tensor) -> ModalEnergy:
        """Overrides the base class."""
        serves = _are_of_shell([part.term for part in energy.parts])
        return WarpModalEnergy(energy, mesh, columns) if serves else super().modal_energy(energy, mesh, columns)

    def fine_energy(self, mesh: Mesh, terms: Sequence[Term]) -> FineEnergy:
        """Overrides the base class."""
        return WarpFineEnergy(mesh, terms) if _are_of_shell(terms) else super().fine_energy(mesh, terms)

    def volumes(self, mesh: Connectivity) -> WarpVolumes:
        """Overrides the base class."""
        return WarpVolumes(mesh)

    def distortion(self, mesh: Mesh, further: Energy | None) -> Distortion:
        """Overrides the base class."""
        return WarpDistortion(mesh, further)

    def crossings(self, mesh: Connectivity, shape: FloatArray) -> Callable[[FloatArray], IntArray]:
        """Overrides the base class."""
        return WarpPairs(mesh, shape[None])


def _are_of_shell(terms: Sequence[Term]) -> bool:
    """Whether the first terms are those of Eq. 5 themselves, and not classes that inherit from them."""
    return [type(term) for term in terms[:N_SHELL_TERMS]] == [Stretch, Bend, Volume]
