"""The joint space: one unknown shape in the sum of both modal spaces and the difference of the key-frames."""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor, nn

from torch_modal.energy.linearised import energy_of, references_between
from torch_modal.energy.shell import ShellEnergy
from torch_modal.nn.blend import RotationBlend
from torch_modal.nn.frame import Frame, Pair
from torch_modal.nn.guess import Guess
from torch_modal.nn.modal_energy import ModalShell, Placement


class JointProblem(NamedTuple):
    """The in-between of each sample as a minimisation."""

    inputs: tuple[Tensor, ...]
    """What the minimiser depends on, for :meth:`JointSpace.placement`. *Shape of each:* ``(B, ...)``."""
    base: Tensor
    """The fine shape that the modes are added to. *Shape:* ``(B, V, 3)``."""
    difference: Tensor
    """The fine column of the last amplitude. *Shape:* ``(B, V, 3)``."""


class JointSpace(nn.Module):
    r"""In-betweens ``x(a) = base + [Phi_a, Phi_b, x_b - x_a] a``.

    What is minimised is :math:`(1-t)\, d(x_a, x) + t\, d(x_b, x)`, with Eq. 5 for ``d``. The base is linear
    interpolation, or the blend by local rotations where that has less energy, so that the energy of the result is never
    above that of linear interpolation.

    Args:
        frame: Frame of the two bases.
        shell: Energy on the frame's coarse mesh.
        modes: Modes of both ends, in the frame. *Shape of each:* ``(k, V, 3)``.
        references: Shapes that the modes belong to, in the frame. *Shape:* ``(2, V, 3)``.
        rotations: Whether there is a blend by local rotations.
    """

    def __init__(
        self, frame: Frame, shell: ShellEnergy, modes: Sequence[Tensor], references: Tensor, rotations: bool
    ) -> None:
        super().__init__()
        self.frame = frame
        self.columns = frame.elastic_columns(torch.cat(list(modes)))
        self.energy = ModalShell(shell, self.columns.coarse)
        # With the blend as the base there is nothing left to guess.
        self.blend = RotationBlend(ShellEnergy(frame.faces), references) if rotations else None
        self.first_guess = None if rotations else Guess(shell, self.energy.edge_columns, frame.coarsen(references))

    @property
    def n_unknowns(self) -> int:
        """Number of amplitudes."""
        return len(self.columns.fine) + 1

    def problem(self, pair: Pair, t: Tensor, mu: Tensor, alpha: Tensor, beta: Tensor, gamma: Tensor) -> JointProblem:
        """Set up the in-betweens of a batch at the times ``t``; ``mu`` plays no part. *Shape of each:* ``(B,)``."""
        base, difference = torch.lerp(pair.first, pair.second, t[:, None, None]), self._difference(pair)
        first, second, coarse_base, coarse_difference = (
            self.frame.coarsen(x) for x in (pair.first, pair.second, base, difference)
        )
        if self.blend is not None:
            blend = self.blend(pair.first, pair.second, t)
            coarse_blend = self.frame.coarsen(blend)
            with torch.no_grad():
                shell = self.energy.shell
                references = references_between(shell, first, second, t, alpha, beta, gamma)
                energies = [energy_of(shell, shell.measure(x), references) for x in (coarse_base, coarse_blend)]
            better = (energies[1] < energies[0])[:, None, None]
            base, coarse_base = torch.where(better, blend, base), torch.where(better, coarse_blend, coarse_base)
        return JointProblem((first, second, coarse_difference, coarse_base, t, alpha, beta, gamma), base, difference)

    def placement(
        self, first: Tensor, second: Tensor, difference: Tensor, base: Tensor, t: Tensor, *stiffness: Tensor
    ) -> Placement:
        """The minimisation on the coarse mesh, from the inputs of a problem."""
        return Placement(base, difference, references_between(self.energy.shell, first, second, t, *stiffness))

    def guess(
        self, first: Tensor, second: Tensor, difference: Tensor, base: Tensor, t: Tensor, *stiffness: Tensor
    ) -> Tensor | None:
        """Where the minimisation may start, from the inputs of a problem; None: at zeros. *Shape:* ``(B, n)``."""
        if self.first_guess is None:
            return None
        return self.first_guess(self.energy.shell, self.energy.edge_columns, first, second, difference, t)

    @staticmethod
    def require(first: Tensor, second: Tensor, difference: Tensor, base: Tensor, t: Tensor, *stiffness: Tensor) -> None:
        """Times in [0, 1].

        Raises:
            ValueError: Others: outside, one of the two pulls would be negative.
        """
        outside = ~((t >= 0) & (t <= 1))
        if bool(outside.any()):
            raise ValueError(f"t lies in [0, 1], from key-frame to key-frame; got {float(t[outside][0])}")

    def lift(self, a: Tensor, problem: JointProblem) -> Tensor:
        """The fine shape of given amplitudes. *Shape:* ``(B, n) -> (B, V, 3)``."""
        return problem.base + self.columns.combine(a[:, :-1]) + a[:, -1, None, None] * problem.difference

    def _difference(self, pair: Pair) -> Tensor:
        """The part of ``x_b - x_a`` that the modes do not have, of length one. *Shape:* ``(B, V, 3)``."""
        frame = self.frame
        own = frame.remove(frame.remove(pair.second - pair.first, frame.rigid), self.columns)
        squared = (frame.coarsen(own) ** 2 * frame.coarse_weights[:, None]).sum((-1, -2), keepdim=True)
        # Coincident key-frames leave no difference: its column is then zero, not a quotient of rounding errors.
        rounding = 1e3 * torch.finfo(own.dtype).eps * pair.first.abs().amax((-1, -2), keepdim=True)
        return own * (squared + rounding**2).rsqrt()
