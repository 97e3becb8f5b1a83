"""The rest shapes of a batch, which energies compare with."""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from torch_modal import trees
from torch_modal.energy.energy import Energy, Reference
from torch_modal.energy.shell import N_SHELL_TERMS


class Rests(NamedTuple):
    """The rest shapes of the samples of a batch, with their times or weights, and stiffnesses."""

    shapes: tuple[Tensor, ...]
    """Those of the weights ``1 - t`` and ``t``, or one of each sample, or K. *Shape of each:* ``(P, V, 3)``."""
    which: Tensor | None
    """The pair of each sample; each its own where None. *Shape:* ``(B,)``."""
    t: Tensor
    """*Shape:* ``(B,)``; of K shapes their weights, *shape* ``(B, K)``."""
    stiffness: Sequence[Tensor]
    """Of each term. *Shape of each:* ``(B, M)`` or ``(B, 1)``."""
    anchors: Tensor | None = None
    """Of the terms, where there are some. *Shape:* ``(B, P, 3)``."""

    def reference(self, energy: Energy) -> Reference:
        """What shapes are compared with, of the terms that the stiffnesses belong to."""
        found = trees.picked([energy.rest_of(x) for x in self.shapes], self.which)
        if len(found) == 1 and self.t.dim() == 1:
            return energy.against(found[0], self.stiffness)
        weights = self.t if self.t.dim() > 1 else torch.stack([1 - self.t, self.t], -1)
        return energy.among(found, weights, self.stiffness)

    def pulls(self) -> tuple[Tensor, ...]:
        """The weight of each of the shapes. *Shape of each:* ``(B,)``."""
        return (1 - self.t, self.t) if self.t.dim() == 1 else self.t.unbind(-1)

    def further(self) -> "Rests":
        """The same for the terms beyond Eq. 5 alone."""
        return self._replace(stiffness=self.stiffness[N_SHELL_TERMS:])
