"""The energy of a modal solve, on the mesh that it is evaluated on."""

from collections.abc import Sequence
from typing import Any

from torch import Tensor, nn

from torch_modal.backends.torch.rests import Rests
from torch_modal.energy.bend import Bend, fullness
from torch_modal.energy.energy import Energy
from torch_modal.energy.modal_energy import ModalEnergy


class CoarseEnergy(nn.Module):
    """An energy of which a modal solve takes references between two shapes.

    Args:
        energy: Of some of the terms.
    """

    def __init__(self, energy: Energy) -> None:
        super().__init__()
        self.energy = energy

    def modal(self, columns: Tensor) -> ModalEnergy:
        """The energy in the amplitudes of columns. *Shape:* ``(n, V, 3)``."""
        return ModalEnergy(self.energy, columns)

    def between(
        self, first: Tensor, second: Tensor, which: Tensor | None, t: Tensor, stiffness: Sequence[Tensor]
    ) -> Any:
        """What :meth:`modal` compares with, at times between two rest shapes.

        Args:
            first: Rest shapes of the weight ``1 - t``. *Shape:* ``(P, V, 3)``.
            second: Rest shapes of the weight ``t``. *Shape:* ``(P, V, 3)``.
            which: The pair of each sample; each its own where None. *Shape:* ``(B,)``.
            t: *Shape:* ``(B,)``.
            stiffness: Of each term. *Shape of each:* ``(B, M)`` or ``(B, 1)``.
        """
        return Rests((first, second), which, t, stiffness).reference(self.energy)

    def among(self, shapes: Tensor, weights: Tensor, stiffness: Sequence[Tensor]) -> Any:
        """The same towards K rest shapes of each sample.

        Args:
            shapes: *Shape:* ``(B, K, V, 3)``.
            weights: *Shape:* ``(B, K)``.
            stiffness: As there.
        """
        return Rests(shapes.unbind(1), None, weights, stiffness).reference(self.energy)

    def softened(self, reference: Any, base: Tensor) -> Any:
        """A reference with less bending stiffness at hinges with a needle.

        The minimiser would turn their normals over, at little cost, and come to rest at the kink where they collapse.

        Args:
            reference: Of :meth:`between` or :meth:`among`.
            base: The shape at amplitudes of zero. *Shape:* ``(B, V, 3)``.
        """
        weights = list(reference.weights)
        for i, part in enumerate(self.energy.parts):
            if isinstance(part.term, Bend):
                weights[i] = self.fullness(i, base) * weights[i]
        return reference._replace(weights=tuple(weights))

    def fullness(self, i: int, base: Tensor) -> Tensor:
        """That of the hinges of a term. *Shape:* ``(B, V, 3) -> (B, H)``."""
        return fullness(self.energy.parts[i].edge_vectors(base.movedim(-1, 0)))
