"""The joint space: one unknown shape in the sum of both modal spaces and the difference of the key-frames."""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor, nn

from torch_modal.nn.frame import Frame, Pair
from torch_modal.nn.guess import LocalRotations
from torch_modal.nn.linearised import Reference
from torch_modal.nn.modal_shell import ModalShell, Placement
from torch_modal.nn.shell import Measures, Rest, ShellEnergy, Stiffness


class JointProblem(NamedTuple):
    """The in-between of each sample as a minimisation."""

    inputs: tuple[Tensor, ...]
    """What the minimiser depends on, for :meth:`JointSpace.placement`. *Shape of each:* ``(B, ...)``."""
    base: Tensor
    """Linear interpolation on the fine mesh. *Shape:* ``(B, V, 3)``."""
    difference: Tensor
    """The fine column of the last amplitude. *Shape:* ``(B, V, 3)``."""


class JointSpace(nn.Module):
    r"""In-betweens ``x(a) = (1-t) x_a + t x_b + [Phi_a, Phi_b, x_b - x_a] a``.

    What is minimised is :math:`(1-t)\, d(x_a, x) + t\, d(x_b, x)`, with Eq. 5 for ``d``. Linear interpolation is
    ``a = 0``, so that the energy of the result is never above its.

    Args:
        frame: Frame of the two bases.
        shell: Energy on the frame's coarse mesh.
        modes: Modes of both ends, in the frame. *Shape of each:* ``(k, V, 3)``.
        references: Shapes that the modes belong to, in the frame. *Shape:* ``(2, V, 3)``.
    """

    def __init__(self, frame: Frame, shell: ShellEnergy, modes: Sequence[Tensor], references: Tensor) -> None:
        super().__init__()
        self.frame = frame
        self.columns = frame.elastic_columns(torch.cat(list(modes)))
        self.energy = ModalShell(shell, self.columns.coarse)
        self.rotations = LocalRotations(shell, self.energy.edge_columns, frame.coarsen(references))

    @property
    def n_unknowns(self) -> int:
        """Number of amplitudes."""
        return len(self.columns.fine) + 1

    def problem(self, pair: Pair, t: Tensor, mu: Tensor, alpha: Tensor, beta: Tensor, gamma: Tensor) -> JointProblem:
        """Set up the in-betweens of a batch at the times ``t``; ``mu`` plays no part. *Shape of each:* ``(B,)``."""
        base = torch.lerp(pair.first, pair.second, t[:, None, None])
        difference = self._difference(pair)
        coarse = (self.frame.coarsen(x) for x in (pair.first, pair.second, difference))
        return JointProblem((*coarse, t, alpha, beta, gamma), base, difference)

    def placement(self, first: Tensor, second: Tensor, difference: Tensor, t: Tensor, *stiffness: Tensor) -> Placement:
        """The minimisation on the coarse mesh, from the inputs of a problem."""
        # Both at once: what a single sample costs is the number of operations.
        measures, weights = self.energy.shell.rest(torch.stack([first, second]), Stiffness(*stiffness))
        references = [
            Reference(Rest(Measures(*(m[i] for m in measures)), Measures(*(w[i] for w in weights))), pull)
            for i, pull in enumerate((1 - t, t))
        ]
        return Placement(torch.lerp(first, second, t[:, None, None]), difference, references)

    def guess(self, first: Tensor, second: Tensor, difference: Tensor, t: Tensor, *stiffness: Tensor) -> Tensor:
        """Where the minimisation may start, from the inputs of a problem. *Shape:* ``(B, n)``."""
        return self.rotations(self.energy.shell, self.energy.edge_columns, first, second, difference, t)

    @staticmethod
    def require(first: Tensor, second: Tensor, difference: Tensor, t: Tensor, *stiffness: Tensor) -> None:
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
