"""Energies beside Eq. 5 in steps of all vertices by kernels: own terms, contacts, pulls."""

from collections.abc import Callable
from typing import NamedTuple, Protocol

from torch import Tensor

from torch_modal.backends.torch.fine_steps import ConvexHessian
from torch_modal.energy.energy import Energy, Reference


class FurtherDerivatives(NamedTuple):
    """An energy beside Eq. 5 at given shapes."""

    value: Tensor
    """*Shape:* ``(B,)``."""
    gradient: Tensor
    """*Shape:* ``(B, V, 3)``."""
    diagonal: Tensor
    """The blocks of its convex Hessian's diagonal, packed. *Shape:* ``(B, V, 6)``."""
    product: Callable[[Tensor], Tensor]
    """With the convex Hessian. *Shape:* ``(B, V, 3) -> (B, V, 3)``."""


class FurtherEnergy(Protocol):
    """An energy that steps of all vertices take beside Eq. 5."""

    def value(self, x: Tensor) -> Tensor:
        """*Shape:* ``(B, V, 3) -> (B,)``."""

    def at(self, x: Tensor) -> FurtherDerivatives:
        """*Shape:* ``(B, V, 3)``."""


class FurtherTerms:
    """Terms in torch as such an energy.

    Args:
        energy: Of these terms.
        reference: What shapes are compared with.
        anchors: Of the terms, where there are some. *Shape:* ``(B, P, 3)``.
    """

    def __init__(self, energy: Energy, reference: Reference, anchors: Tensor | None) -> None:
        self.energy, self.reference = energy, reference
        self.anchors = None if anchors is None else anchors.movedim(-1, 0)

    def _extended(self, x: Tensor) -> Tensor:
        return self.energy.extend(x.movedim(-1, 0).contiguous(), self.anchors)

    def value(self, x: Tensor) -> Tensor:
        """*Shape:* ``(B, V, 3) -> (B,)``."""
        return self.energy.value(self._extended(x), self.reference)

    def at(self, x: Tensor) -> FurtherDerivatives:
        """*Shape:* ``(B, V, 3)``."""
        energy, n = self.energy, x.shape[1]
        at = energy.linearise(self._extended(x), self.reference)
        hessian = ConvexHessian(energy, at)
        packed = hessian.diagonal().flatten(0, 1)[[0, 1, 2, 4, 5, 8], ..., :n].movedim(0, -1)

        def product(field: Tensor) -> Tensor:
            rows = energy.extend(field.movedim(-1, 0).contiguous())
            return energy.fold(hessian(rows)).movedim(0, -1)

        gradient = energy.fold(energy.gradient(at)).movedim(0, -1)
        return FurtherDerivatives(energy.value_at(at, self.reference), gradient, packed, product)
