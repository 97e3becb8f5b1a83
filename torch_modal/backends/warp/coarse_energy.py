"""Eq. 5 of a modal solve by Warp kernels."""

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from torch_modal import trees
from torch_modal.backends.torch.coarse_energy import CoarseEnergy
from torch_modal.backends.warp.modal_energy import WarpModalEnergy, merged_reference, shell_reference
from torch_modal.backends.warp.shell import ShellReference, WarpShell
from torch_modal.energy.energy import Energy
from torch_modal.energy.term import Mesh


class WarpCoarseEnergy(CoarseEnergy):
    """:class:`CoarseEnergy` of the terms of Eq. 5."""

    def __init__(self, energy: Energy, mesh: Mesh) -> None:
        super().__init__(energy)
        self.mesh, self.shell = mesh, WarpShell(energy, mesh)

    def modal(self, columns: Tensor) -> WarpModalEnergy:
        """As in the base class."""
        return WarpModalEnergy(self.shell, self.mesh, columns)

    def between(
        self, first: Tensor, second: Tensor, which: Tensor | None, t: Tensor, stiffness: Sequence[Tensor]
    ) -> Any:
        """As in the base class."""
        return shell_reference(self.shell, *trees.picked((first, second), which), t, *stiffness)

    def among(self, shapes: Tensor, weights: Tensor, stiffness: Sequence[Tensor]) -> Any:
        """As in the base class."""
        return merged_reference(self.shell, shapes, weights, *stiffness)

    def softened(self, reference: Any, base: Tensor) -> Any:
        """As in the base class."""
        if not isinstance(reference, ShellReference):
            return super().softened(reference, base)
        full = self.fullness(1, base).to(reference.bend)
        factors = torch.ones_like(reference.bend[..., 0]).index_copy(1, self.shell.interior, full)
        weights, others = reference.bend.split([1, 6], -1)
        return reference._replace(bend=torch.cat([factors[..., None] * weights, others], -1))
