"""Vibration modes of one key-frame, as tensors."""

import os
from collections.abc import Iterable
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import torch

from torch_modal.autograd import as_normal_tensor, outside_inference_mode
from torch_modal.geometry.rigid import infinitesimal_motions
from torch_modal.io.tensors import TensorFile, write_tensors
from torch_modal.keyframes.arrays import as_positions, check_tensor

FORMAT = "torch_modal.basis"
VERSION = "2"


def as_bases(bases: Any) -> "list[ModalBasis]":
    """One basis or several of one mesh as a list; key-frames, *shape* ``(K, V, 3)``, as bases without modes.

    Raises:
        ValueError: There are none, they are something else, or belong to meshes of different sizes.
    """
    several = list(bases) if isinstance(bases, Iterable) else [bases]
    if several and not any(hasattr(basis, "modes") for basis in several):
        keyframes = as_positions(several).detach()
        check_tensor("key-frames without modes", keyframes, "K", "V", 3)
        return [ModalBasis(x, x.new_zeros(0), x.new_zeros(0, *x.shape), x.new_zeros(6)) for x in keyframes]
    others = sorted({type(basis).__name__ for basis in several if not hasattr(basis, "modes")})
    if others or not several:
        raise ValueError(f"bases, one or more, come from extract_bases; got {', '.join(others) or 'none'}")
    sizes = sorted({len(basis.reference) for basis in several})
    if len(sizes) > 1:
        raise ValueError(f"the bases belong to meshes of {sizes} vertices; they need one connectivity")
    return several


@dataclass(frozen=True, eq=False)
class ModalBasis:
    """Lowest vibration modes of one shape, restricted to its surface.

    The modes are constants of the autograd graph: all tensors are detached.

    Modes have unit mass at a density of 1, of the solid or of a sheet with a thickness of a hundredth of the size:
    ``phi`` scales as ``length^-3/2`` and eigenvalues as ``length^-2`` with the units of the shape. Eigenvalues of
    solids and sheets have different units of stiffness. Signs are arbitrary but fixed.

    Attributes:
        reference: The shape that the modes belong to, in the caller's coordinates. *Shape:* ``(V, 3)``.
        eigenvalues: Ascending, of the elastic modes. *Shape:* ``(k,)``.
        modes: Elastic displacements, without rigid motions; zero at unreferenced vertices. *Shape:* ``(k, V, 3)``.
        rigid_eigenvalues: The six computed eigenvalues of rigid motions, zero up to rounding. *Shape:* ``(6,)``.

    Raises:
        ValueError: Shapes, dtypes or devices do not match.
    """

    reference: torch.Tensor
    eigenvalues: torch.Tensor
    modes: torch.Tensor
    rigid_eigenvalues: torch.Tensor

    def __repr__(self) -> str:
        return f"<ModalBasis of {self.n_modes} modes, {self.n_vertices:,} vertices>"

    @outside_inference_mode
    def __post_init__(self) -> None:
        shapes = {name: tuple(tensor.shape) for name, tensor in self._tensors().items()}
        v, k = shapes["reference"][:1], shapes["eigenvalues"][:1]
        expected = {"reference": (*v, 3), "eigenvalues": k, "modes": (*k, *v, 3), "rigid_eigenvalues": (6,)}
        if shapes != expected:
            raise ValueError(
                "a basis needs reference (V, 3), eigenvalues (k,), modes (k, V, 3), rigid_eigenvalues (6,); "
                f"got {shapes}"
            )
        kinds = {(tensor.dtype, tensor.device) for tensor in self._tensors().values()}
        if len(kinds) > 1 or not self.reference.is_floating_point():
            raise ValueError(f"the tensors of a basis share one floating-point dtype and one device; got {kinds}")
        for name, tensor in self._tensors().items():
            object.__setattr__(self, name, as_normal_tensor(tensor.detach()))

    def _tensors(self) -> dict[str, torch.Tensor]:
        return {field.name: getattr(self, field.name) for field in fields(self)}

    @property
    def n_modes(self) -> int:
        """Number of elastic modes, k."""
        return self.modes.shape[0]

    @property
    def n_vertices(self) -> int:
        """Number of vertices, V."""
        return self.modes.shape[1]

    @property
    def rigid_modes(self) -> torch.Tensor:
        """Orthonormal translations and infinitesimal rotations of the reference. *Shape:* ``(6, V, 3)``.

        In the Euclidean product over all vertices: translations along x, y and z, then rotations about their mean.
        """
        arms = self.reference - self.reference.mean(dim=0)
        translations, spins = infinitesimal_motions(arms / arms.abs().max()).split(3)  # scaled against overflow
        rotations = torch.linalg.qr(spins.flatten(1).T).Q.T.view_as(spins)
        return torch.cat([translations / self.n_vertices**0.5, rotations])

    def truncate(self, k: int) -> "ModalBasis":
        """The basis of the lowest ``k`` modes.

        Raises:
            ValueError: ``k`` is below 0 or above the number of modes.
        """
        if not 0 <= k <= self.n_modes:
            raise ValueError(f"{k} modes requested from a basis of {self.n_modes}; extract more modes")
        return replace(self, eigenvalues=self.eigenvalues[:k], modes=self.modes[:k])

    def to(self, *args: Any, **kwargs: Any) -> "ModalBasis":
        """The basis on another device or in another dtype; arguments as for `torch.Tensor.to`."""
        return ModalBasis(**{name: tensor.to(*args, **kwargs) for name, tensor in self._tensors().items()})

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write a safetensors file atomically, into a folder that exists.

        Raises:
            OSError: The file cannot be written.
        """
        write_tensors(Path(path), FORMAT, VERSION, self._tensors())

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> "ModalBasis":
        """Read a file written by `save`, to the CPU, in its dtype.

        Raises:
            FileNotFoundError: There is no such file.
            ValueError: The file is damaged, has other content or another format version.
        """
        names = [field.name for field in fields(cls)]
        tensors = TensorFile(Path(path), FORMAT, VERSION, names).tensors()
        try:
            return cls(**{name: tensors[name] for name in names})
        except ValueError as error:
            raise ValueError(f"{path}: {error}") from error
