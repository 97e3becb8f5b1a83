"""The paired space of the paper (Eq. 4): one shape near each key-frame, pulled together."""

from typing import NamedTuple

import torch
from torch import Tensor, nn

from torch_modal.elastic.energy import RestShapes
from torch_modal.elastic.modal import AmplitudeEnergy, Derivatives, Placement
from torch_modal.inbetween.joint import JointSpace


class PairedPlacement(NamedTuple):
    """The two shapes of each sample and their similarity, a quadratic in the amplitudes."""

    first: tuple[Placement, ...]
    second: tuple[Placement, ...]
    linear: Tensor
    """*Shape:* ``(B, n)``."""
    constant: Tensor
    """*Shape:* ``(B,)``."""
    mu: Tensor
    """Weight of the similarity. *Shape:* ``(B,)``."""


class PairedSpace(AmplitudeEnergy[PairedPlacement]):
    r"""Mid-shapes as the mean of ``x_1 = x_a + Phi_a a_1`` and ``x_2 = x_b + Phi_b a_2`` that minimise Eq. 4.

    .. math:: d(\bar x_1, x_1) + \mu \|x_1 - x_2\|^2 + d(\bar x_2, x_2)

    The similarity is taken over the coarse vertices, like the distances: ``mu`` does not depend on the resolution. The
    two spaces barely meet, so that a small ``mu`` returns the linear mean and a large one distorts: this is the paper's
    method, a baseline that nothing replaces; the joint space is the better choice.

    Args:
        first: The space of the first shape.
        second: The space of the second.
    """

    gap: Tensor
    gap_gram: Tensor

    def __init__(self, first: JointSpace, second: JointSpace) -> None:
        super().__init__()
        self.first, self.second = first, second
        gap = torch.cat([first.coarse_basis, -second.coarse_basis]).flatten(1)
        self.register_buffer("gap", gap, persistent=False)
        self.register_buffer("gap_gram", gap @ gap.mT, persistent=False)

    def place(self, base: Tensor, rests: RestShapes, mu: Tensor) -> PairedPlacement:
        """The two shapes of each sample, each with its key-frame as base and as rest shape.

        Args:
            base: Not used.
            rests: The key-frames. *Shape:* ``(B, 2, V, 3)``.
            mu: *Shape:* ``(B,)``.
        """
        placed = []
        for k, space in enumerate((self.first, self.second)):
            rest = rests._replace(shapes=rests.shapes[:, k : k + 1], weights=torch.ones_like(rests.weights[:, :1]))
            placed.append(tuple(space.place(rests.shapes[:, k], rest, soften=False)))
        difference = self.first.coarse.restrict(rests.shapes[:, 0] - rests.shapes[:, 1]).flatten(1)
        linear = difference @ self.gap.to(difference).mT
        return PairedPlacement(placed[0], placed[1], linear, (difference**2).sum(-1), mu)

    def lift(self, a: Tensor, keyframes: Tensor) -> tuple[Tensor, Tensor]:
        """The fine shapes ``x_1`` and ``x_2``. *Shape:* ``(B, n), (B, 2, V, 3) -> (B, V, 3)`` each."""
        a1, a2 = self.split(a)
        return self.first.lift(a1, keyframes[:, 0]), self.second.lift(a2, keyframes[:, 1])

    # ------------------------------------------------------------------------------------ the energy in the amplitudes
    @property
    def n_amplitudes(self) -> int:
        """Number of amplitudes of both."""
        return len(self.gap)

    def split(self, a: Tensor) -> tuple[Tensor, Tensor]:
        """Amplitudes of the two shapes."""
        n = self.first.n_amplitudes
        return a[..., :n], a[..., n:]

    def value(self, a: Tensor, placement: PairedPlacement) -> Tensor:
        """Energy at ``a``. *Shape:* ``(..., B, n) -> (..., B)``."""
        a1, a2 = self.split(a)
        strain = self.first.value(a1, placement.first) + self.second.value(a2, placement.second)
        return strain + self._similarity(a, placement)[0]

    def derivatives(self, a: Tensor, placement: PairedPlacement, second_order: bool = True) -> Derivatives:
        """Energy, gradient and Hessians at ``a``; the similarity is quadratic and part of Gauss-Newton's."""
        ends = zip((self.first, self.second), self.split(a), (placement.first, placement.second), strict=True)
        first, second = (space.derivatives(a_k, place, second_order) for space, a_k, place in ends)
        similarity, slope = self._similarity(a, placement)
        value, gradient = first.value + second.value + similarity, torch.cat([first.gradient, second.gradient], -1)
        similar = 2 * placement.mu[:, None, None] * self.gap_gram.to(a)
        gauss_newton = _block_diagonal(first.gauss_newton, second.gauss_newton) + similar
        curved = None
        if first.second_order is not None and second.second_order is not None:
            curved = _block_diagonal(first.second_order, second.second_order)
        return Derivatives(value, gradient + slope, gauss_newton, curved, first.resolution + second.resolution)

    def _similarity(self, a: Tensor, placement: PairedPlacement) -> tuple[Tensor, Tensor]:
        """The energy of the similarity and its gradient. *Shape:* ``(..., B, n) -> (..., B), (..., B, n)``."""
        grown = a @ self.gap_gram.to(a)
        value = (a * (grown + 2 * placement.linear)).sum(-1) + placement.constant
        return placement.mu * value, 2 * placement.mu[:, None] * (grown + placement.linear)


def _block_diagonal(first: Tensor, second: Tensor) -> Tensor:
    """*Shape:* ``(B, m, m), (B, n, n) -> (B, m + n, m + n)``."""
    m, n = first.shape[-1], second.shape[-1]
    return torch.cat([nn.functional.pad(first, (0, n)), nn.functional.pad(second, (m, 0))], -2)
