"""The paired space of the paper (Eq. 4): one shape near each key-frame, pulled together."""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import torch
from torch import Tensor, nn

from torch_modal import trees
from torch_modal.backends.torch.alignment import Pair
from torch_modal.energy.modal_energy import Derivatives, Placement, SumOfEnergies
from torch_modal.inbetween.columns import Columns
from torch_modal.inbetween.frame import Frame
from torch_modal.inbetween.levels import Levels


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


class PairedProblem(NamedTuple):
    """The mid-shape of each sample as a minimisation."""

    placement: PairedPlacement
    """The inputs that the minimiser depends on."""
    start: None
    """At zeros, which are the key-frames, as in the paper."""
    first: Tensor
    """*Shape:* ``(B, V, 3)``."""
    second: Tensor
    """*Shape:* ``(B, V, 3)``."""
    starts: tuple[Tensor, ...]
    """Linear interpolation, which the result must not be worse than. *Shape of each:* ``(B, V, 3)``."""


class PairedEnergy(nn.Module):
    r"""Eq. 4: :math:`d(\bar x_1, x_1) + \mu \|x_1 - x_2\|^2 + d(\bar x_2, x_2)` in the amplitudes of both shapes.

    Args:
        energies: The energy of either shape in its own amplitudes.
        ends: Columns of both spaces.
        used: Which of the fine vertices the similarity is taken over. *Shape:* ``(V,)``, bool.
    """

    gap: Tensor
    gap_gram: Tensor

    def __init__(self, energies: Sequence[SumOfEnergies], ends: Sequence[Columns], used: Tensor) -> None:
        super().__init__()
        self.first, self.second = energies
        self.n_first = len(ends[0])
        gap = (torch.cat([ends[0].fine, -ends[1].fine]) * used[:, None]).flatten(1)
        self.register_buffer("gap", gap, persistent=False)
        self.register_buffer("gap_gram", gap @ gap.mT, persistent=False)

    def split(self, a: Tensor) -> tuple[Tensor, Tensor]:
        """Amplitudes of the two shapes."""
        return a[..., : self.n_first], a[..., self.n_first :]

    def value(self, a: Tensor, placement: PairedPlacement) -> Tensor:
        """Energy at ``a``. *Shape:* ``(..., B, n) -> (..., B)``."""
        a1, a2 = self.split(a)
        similarity = (a * (a @ self.gap_gram + 2 * placement.linear)).sum(-1) + placement.constant
        strain = self.first.value(a1, placement.first) + self.second.value(a2, placement.second)
        return strain + placement.mu * similarity

    def derivatives(self, a: Tensor, placement: PairedPlacement, second_order: bool = True) -> Derivatives:
        """Gradient and Hessians at ``a``; the similarity is quadratic and part of Gauss-Newton's."""
        first, second = (energy.derivatives(part, place, False) for energy, part, place in self._ends(a, placement))
        gradient = torch.cat([first.gradient, second.gradient], -1)
        gradient = gradient + 2 * placement.mu[:, None] * (a @ self.gap_gram + placement.linear)
        similar = 2 * placement.mu[:, None, None] * self.gap_gram
        gauss_newton = _block_diagonal(first.gauss_newton, second.gauss_newton) + similar
        curved = self.second_order(a, placement) if second_order else None
        return Derivatives(gradient, gauss_newton, curved, first.resolution + second.resolution)

    def value_and_gradient(self, a: Tensor, placement: PairedPlacement) -> tuple[Tensor, Tensor]:
        """Energy and gradient at ``a``. *Shape:* ``(B, n) -> (B,), (B, n)``."""
        first, second = (energy.value_and_gradient(part, place) for energy, part, place in self._ends(a, placement))
        similar = a @ self.gap_gram + placement.linear
        similarity = (a * (similar + placement.linear)).sum(-1) + placement.constant
        value = first[0] + second[0] + placement.mu * similarity
        return value, torch.cat([first[1], second[1]], -1) + 2 * placement.mu[:, None] * similar

    def pull_back(self, a: Tensor, direction: Tensor, placement: PairedPlacement) -> PairedPlacement:
        """Gradient of ``direction . dE/da`` in all that the placement holds. *Shape:* ``(B, n), (B, n)``."""
        first, second = (
            tuple(energy.pull_back(part, along, place))
            for (energy, part, place), along in zip(self._ends(a, placement), self.split(direction), strict=True)
        )
        to_mu = 2 * (direction * (a @ self.gap_gram + placement.linear)).sum(-1)
        to_linear = 2 * placement.mu[:, None] * direction
        return PairedPlacement(first, second, to_linear, torch.zeros_like(placement.constant), to_mu)

    def second_order(self, a: Tensor, placement: PairedPlacement) -> Tensor:
        """The second-order term of the full Hessian. *Shape:* ``(B, n, n)``."""
        return _block_diagonal(*(energy.second_order(part, place) for energy, part, place in self._ends(a, placement)))

    def _ends(
        self, a: Tensor, placement: PairedPlacement
    ) -> Iterator[tuple[SumOfEnergies, Tensor, tuple[Placement, ...]]]:
        return zip((self.first, self.second), self.split(a), (placement.first, placement.second), strict=True)


class PairedSpace(nn.Module):
    """Mid-shapes as the mean of ``x_1 = x_a + Phi_a a_1`` and ``x_2 = x_b + Phi_b a_2`` that minimise Eq. 4.

    The two spaces barely meet, so that a small ``mu`` returns the linear mean and a large one distorts: this is the
    paper's method, kept for comparison; the joint space is the better choice.

    Args:
        frame: Frame of the two bases.
        levels: The energies of the modal solve.
        modes: Modes of both ends. *Shape of each:* ``(k, V, 3)``.
    """

    def __init__(self, frame: Frame, levels: Levels, modes: Sequence[Tensor]) -> None:
        super().__init__()
        self.frame, self.levels = frame, levels
        self.first, self.second = (frame.elastic_columns(end) for end in frame.modes(*modes))
        ends = (self.first, self.second)
        self.energy = PairedEnergy([levels.modal(end) for end in ends], ends, frame.weights > 0)

    @property
    def n_unknowns(self) -> int:
        """Number of amplitudes."""
        return len(self.energy.gap)

    def problem(
        self,
        pair: Pair,
        index: Tensor | None,
        t: Tensor,
        stiffness: list[list[Tensor]],
        mu: Tensor,
        anchors: Tensor | None,
    ) -> PairedProblem:
        """Set up the mid-shapes of a batch; Eq. 4 knows the time 1/2 only. Arguments as for the joint space."""
        ends = (pair.first, pair.second)
        first, second = trees.picked(ends, index)

        def place(x: Tensor, modal: SumOfEnergies) -> tuple[Placement, ...]:
            seen = self.levels.seen(x, self.frame.coarsen(x))
            references = self.levels.references([own[:, None] for own in seen], torch.ones_like(t)[:, None], stiffness)
            return self.levels.place(modal, seen, references, None, anchors)

        places = place(first, self.energy.first), place(second, self.energy.second)
        difference = ((first - second) * (self.frame.weights > 0)[:, None]).flatten(1)
        placement = PairedPlacement(places[0], places[1], difference @ self.energy.gap.mT, (difference**2).sum(-1), mu)
        return PairedProblem(placement, None, first, second, (torch.lerp(first, second, t[:, None, None]),))

    @staticmethod
    def require(t: Tensor) -> None:
        """The time 1/2.

        Raises:
            ValueError: Another time.
        """
        if bool((t != 0.5).any()):
            raise ValueError("the paired space (Eq. 4) is defined at t = 1/2 only; use space='joint' for other times")

    def lift(self, a: Tensor, problem: PairedProblem) -> Tensor:
        """The fine mid-shape of given amplitudes. *Shape:* ``(B, n) -> (B, V, 3)``."""
        a1, a2 = self.energy.split(a)
        return 0.5 * (problem.first + self.first.combine(a1) + problem.second + self.second.combine(a2))


def _block_diagonal(first: Tensor, second: Tensor) -> Tensor:
    """*Shape:* ``(B, m, m), (B, n, n) -> (B, m + n, m + n)``."""
    m, n = first.shape[-1], second.shape[-1]
    return torch.cat([nn.functional.pad(first, (0, n)), nn.functional.pad(second, (m, 0))], -2)
