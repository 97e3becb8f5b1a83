"""The paired space of the paper (Eq. 4): one shape near each key-frame, pulled together."""

import copy
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import torch
from torch import Tensor, nn

from torch_modal.energy.linearised import Reference
from torch_modal.energy.shell import ShellEnergy, Stiffness
from torch_modal.nn.frame import Columns, Frame, Pair
from torch_modal.nn.modal_energy import Derivatives, ModalShell, Placement


class PairedPlacement(NamedTuple):
    """The two shapes of each sample and their similarity, a quadratic in the amplitudes."""

    first: Placement
    second: Placement
    linear: Tensor
    """*Shape:* ``(B, n)``."""
    constant: Tensor
    """*Shape:* ``(B,)``."""
    mu: Tensor
    """Weight of the similarity. *Shape:* ``(B,)``."""


class PairedProblem(NamedTuple):
    """The mid-shape of each sample as a minimisation."""

    inputs: tuple[Tensor, ...]
    """What the minimiser depends on, for :meth:`PairedSpace.placement`. *Shape of each:* ``(B, ...)``."""
    pair: Pair


class PairedShell(nn.Module):
    r"""Eq. 4: :math:`d(\bar x_1, x_1) + \mu \|x_1 - x_2\|^2 + d(\bar x_2, x_2)` in the amplitudes of both shapes.

    Args:
        shell: Energy on the coarse mesh.
        ends: Columns of both spaces.
        used: Which of the fine vertices the similarity is taken over. *Shape:* ``(V,)``, bool.
    """

    gap: Tensor
    gap_gram: Tensor

    def __init__(self, shell: ShellEnergy, ends: tuple[Columns, Columns], used: Tensor) -> None:
        super().__init__()
        # Each with a shell of its own: a module that hangs at two places is saved twice.
        self.first = ModalShell(shell, ends[0].coarse)
        self.second = ModalShell(copy.deepcopy(shell), ends[1].coarse)
        gap = (torch.cat([ends[0].fine, -ends[1].fine]) * used[:, None]).flatten(1)
        self.register_buffer("gap", gap)
        self.register_buffer("gap_gram", gap @ gap.mT)

    def split(self, a: Tensor) -> tuple[Tensor, Tensor]:
        """Amplitudes of the two shapes."""
        n = self.first.columns.shape[-1]
        return a[..., :n], a[..., n:]

    def value(self, a: Tensor, placement: PairedPlacement) -> Tensor:
        """Energy at ``a``. *Shape:* ``(..., B, n) -> (..., B)``."""
        a1, a2 = self.split(a)
        similarity = (a * (a @ self.gap_gram + 2 * placement.linear)).sum(-1) + placement.constant
        strain = self.first.value(a1, placement.first) + self.second.value(a2, placement.second)
        return strain + placement.mu * similarity

    def derivatives(self, a: Tensor, placement: PairedPlacement, second_order: bool = True) -> Derivatives:
        """Gradient and Hessians at ``a``; the similarity is quadratic and part of Gauss-Newton's."""
        first, second = (shell.derivatives(part, place, False) for shell, part, place in self._ends(a, placement))
        gradient = torch.cat([first.gradient, second.gradient], -1)
        gradient = gradient + 2 * placement.mu[:, None] * (a @ self.gap_gram + placement.linear)
        similar = 2 * placement.mu[:, None, None] * self.gap_gram
        gauss_newton = _block_diagonal(first.gauss_newton, second.gauss_newton) + similar
        curved = self.second_order(a, placement) if second_order else None
        return Derivatives(gradient, gauss_newton, curved, first.resolution + second.resolution)

    def pull_back(self, a: Tensor, direction: Tensor, placement: PairedPlacement) -> PairedPlacement:
        """Gradient of ``direction . dE/da`` in all that the placement holds. *Shape:* ``(B, n), (B, n)``."""
        first, second = (
            shell.pull_back(part, along, place)
            for (shell, part, place), along in zip(self._ends(a, placement), self.split(direction), strict=True)
        )
        to_mu = 2 * (direction * (a @ self.gap_gram + placement.linear)).sum(-1)
        to_linear = 2 * placement.mu[:, None] * direction
        return PairedPlacement(first, second, to_linear, torch.zeros_like(placement.constant), to_mu)

    def second_order(self, a: Tensor, placement: PairedPlacement) -> Tensor:
        """What the full Hessian has more than Gauss-Newton's. *Shape:* ``(B, n, n)``."""
        return _block_diagonal(*(shell.second_order(part, place) for shell, part, place in self._ends(a, placement)))

    def _ends(self, a: Tensor, placement: PairedPlacement) -> Iterator[tuple[ModalShell, Tensor, Placement]]:
        return zip((self.first, self.second), self.split(a), (placement.first, placement.second), strict=True)


class PairedSpace(nn.Module):
    """Mid-shapes as the mean of ``x_1 = x_a + Phi_a a_1`` and ``x_2 = x_b + Phi_b a_2`` that minimise Eq. 4.

    The two spaces barely meet, so that a small ``mu`` returns the linear mean and a large one distorts: this is the
    paper's method, kept for comparison; the joint space is the better choice.

    Args:
        frame: Frame of the two bases.
        shell: Energy on the frame's coarse mesh.
        modes: Modes of both ends, in the frame. *Shape of each:* ``(k, V, 3)``.
    """

    def __init__(self, frame: Frame, shell: ShellEnergy, modes: Sequence[Tensor]) -> None:
        super().__init__()
        self.frame = frame
        self.first, self.second = (frame.elastic_columns(end) for end in modes)
        self.energy = PairedShell(shell, (self.first, self.second), frame.weights > 0)

    @property
    def n_unknowns(self) -> int:
        """Number of amplitudes."""
        return len(self.energy.gap)

    def problem(self, pair: Pair, t: Tensor, mu: Tensor, alpha: Tensor, beta: Tensor, gamma: Tensor) -> PairedProblem:
        """Set up the mid-shapes of a batch; Eq. 4 knows the time 1/2 only. *Shape of each:* ``(B,)``."""
        coarse = (self.frame.coarsen(x) for x in (pair.first, pair.second))
        apart = ((pair.first - pair.second) * (self.frame.weights > 0)[:, None]).flatten(1)
        return PairedProblem((*coarse, apart @ self.energy.gap.mT, (apart**2).sum(-1), t, mu, alpha, beta, gamma), pair)

    def placement(
        self, first: Tensor, second: Tensor, linear: Tensor, constant: Tensor, t: Tensor, mu: Tensor, *stiffness: Tensor
    ) -> PairedPlacement:
        """The minimisation on the coarse mesh, from the inputs of a problem."""
        places = []
        for shell, coarse in ((self.energy.first, first), (self.energy.second, second)):
            rest = shell.shell.rest(coarse, Stiffness(*stiffness))
            places.append(Placement(coarse, None, [Reference(rest, torch.ones_like(t))]))
        return PairedPlacement(places[0], places[1], linear, constant, mu)

    @staticmethod
    def guess(*inputs: Tensor) -> None:
        """Where the minimisation may start: at zeros, which are the key-frames, as in the paper."""

    @staticmethod
    def require(
        first: Tensor, second: Tensor, linear: Tensor, constant: Tensor, t: Tensor, mu: Tensor, *stiffness: Tensor
    ) -> None:
        """The time 1/2.

        Raises:
            ValueError: Another time.
        """
        if bool((t != 0.5).any()):
            raise ValueError("the paired space (Eq. 4) is defined at t = 1/2 only; use space='joint' for other times")

    def lift(self, a: Tensor, problem: PairedProblem) -> Tensor:
        """The fine mid-shape of given amplitudes. *Shape:* ``(B, n) -> (B, V, 3)``."""
        a1, a2 = self.energy.split(a)
        first = problem.pair.first + self.first.combine(a1)
        second = problem.pair.second + self.second.combine(a2)
        return 0.5 * (first + second)


def _block_diagonal(first: Tensor, second: Tensor) -> Tensor:
    """*Shape:* ``(B, m, m), (B, n, n) -> (B, m + n, m + n)``."""
    m, n = first.shape[-1], second.shape[-1]
    return torch.cat([nn.functional.pad(first, (0, n)), nn.functional.pad(second, (m, 0))], -2)
