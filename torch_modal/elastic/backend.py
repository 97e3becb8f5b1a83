"""Backends of in-betweens: torch, the reference, and kernels of NVIDIA Warp. A layer chooses one when it is made."""

import importlib.util
import warnings
from collections.abc import Callable
from functools import cache

import torch

from torch_modal.arrays import FloatArray, IntArray
from torch_modal.elastic.bend import Bend
from torch_modal.elastic.crossings import WarpPairs
from torch_modal.elastic.distortion import Distortion, KernelDistortion
from torch_modal.elastic.kernel_steps import KernelFineEnergy
from torch_modal.elastic.kernel_terms import volumes_by_kernel
from torch_modal.elastic.kernels.launch import kernels, launch, load_kernels, of_elements
from torch_modal.elastic.rotations import WarpRotations, best_rotations
from torch_modal.elastic.rotations import mean_pose as mean_pose_by_kernel
from torch_modal.elastic.steps import FineEnergy
from torch_modal.elastic.stretch import Stretch
from torch_modal.elastic.volume import Volume
from torch_modal.errors import MissingPackageError
from torch_modal.geometry.connectivity import Connectivity
from torch_modal.geometry.local_rotations import LocalRotations
from torch_modal.geometry.procrustes import mean_pose
from torch_modal.geometry.rigid import best_rotation, volumes_of


class TorchBackend:
    """Makes the parts of in-betweens, all in torch. Each takes K shapes of every sample with their weights.

    It has all dtypes, devices, gradients and transforms. Another backend overrides the parts that it is faster at, and
    falls back on these; both compute the same numbers, up to rounding.
    """

    mean_pose, volumes_of = staticmethod(mean_pose), staticmethod(volumes_of)
    best_rotations = staticmethod(best_rotation)
    rotations = staticmethod(LocalRotations)
    """Local rotations of triangles between shapes near references. *Shape:* ``(K, V, 3)``."""
    fine_energy = staticmethod(FineEnergy)
    """All terms on the caller's mesh, for steps of all vertices. The terms of Eq. 5 come first."""
    distortion = staticmethod(Distortion)
    """A bounded measure of shapes, with the terms beyond Eq. 5 where there are some."""

    def load(self) -> None:
        """Load what takes long, so that the first call does not wait for it."""

    def crossings(self, mesh: Connectivity, shape: FloatArray) -> Callable[[FloatArray], IntArray] | None:
        """A search for pairs of triangles that may cross, near a shape; None for ``geometry/crossings.py``."""
        return None


def _make_kernels() -> None:
    """Kernels of in-betweens without gradients."""
    for name in ("distortion", "procrustes", "rotations", "steps", "volume"):
        kernels(name)
    for term in (Stretch, Bend, Volume):
        of_elements("merging", "merge", term.own_formulas)
    of_elements("merging", "total", Stretch.own_formulas)
    of_elements("elements", "convex", Bend.own_formulas, Stretch.own_formulas)
    of_elements("elements", "convex", Volume.own_formulas, None)


class WarpBackend(TorchBackend):
    """Parts that do in one pass over the elements what torch does in dozens, in float64.

    Raises:
        MissingPackageError: Warp is not installed.
    """

    mean_pose, volumes_of = staticmethod(mean_pose_by_kernel), staticmethod(volumes_by_kernel)
    best_rotations = staticmethod(best_rotations)
    rotations = staticmethod(WarpRotations)
    fine_energy = staticmethod(KernelFineEnergy)
    distortion = staticmethod(KernelDistortion)

    def __init__(self) -> None:
        if importlib.util.find_spec("warp") is None:
            raise MissingPackageError("backend='warp' needs warp-lang, which is not installed: pip install warp-lang")

    def load(self) -> None:
        """Overrides the base class."""
        load_kernels(_make_kernels)

    @staticmethod
    @cache
    def works() -> bool:
        """True where Warp is installed, compiles, and computes."""
        if importlib.util.find_spec("warp") is None:
            return False
        try:
            shapes = torch.eye(3, dtype=torch.float64).expand(2, 3, 3).contiguous()
            results = [shapes.new_empty(1, 1, n) for n in (4, 1, 12)]
            launch(kernels("rotations").turns, (1, 1), [torch.arange(3).int(), 3, shapes, *results])
            if abs(results[0][0, 0, 0] - 1) > 1e-6:
                raise RuntimeError(f"a kernel gave a turn of {results[0].tolist()} for none")
        except Exception as error:  # whatever keeps Warp from compiling: torch does the same, only slower
            warnings.warn(f"Warp is installed, but its kernels cannot be used, so torch is: {error}", stacklevel=2)
            return False
        return True

    def crossings(self, mesh: Connectivity, shape: FloatArray) -> Callable[[FloatArray], IntArray]:
        """Overrides the base class."""
        return WarpPairs(mesh, shape)


BACKENDS: dict[str, Callable[[], TorchBackend]] = {"torch": TorchBackend, "warp": WarpBackend}


def choose(name: str) -> TorchBackend:
    """The backend of a name: ``"auto"`` is the kernels where they work, otherwise torch.

    Raises:
        MissingPackageError: ``"warp"`` is requested and not installed.
    """
    if name == "auto":
        name = "warp" if WarpBackend.works() else "torch"
    return BACKENDS[name]()
