"""The joint space: one unknown shape in the sum of both modal spaces and the difference of the key-frames."""

from typing import NamedTuple

import torch
from torch import Tensor, nn

from torch_modal.nn.frame import Frame, Pair
from torch_modal.nn.modal_shell import ModalShell, Placement, Reference
from torch_modal.nn.shell import ShellEnergy


class JointProblem(NamedTuple):
    """The in-between of each sample as a minimisation."""

    placement: Placement
    """On the coarse mesh."""
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
    """

    def __init__(self, frame: Frame, shell: ShellEnergy) -> None:
        super().__init__()
        self.frame = frame
        self.columns = frame.elastic_columns(torch.cat(frame.modes))
        self.energy = ModalShell(shell, self.columns.coarse)

    @property
    def n_unknowns(self) -> int:
        """Number of amplitudes."""
        return len(self.columns.fine) + 1

    def problem(self, pair: Pair, t: Tensor) -> JointProblem:
        """Set up the in-betweens of a batch at the times ``t``, *shape* ``(B,)``."""
        base = torch.lerp(pair.first, pair.second, t[:, None, None])
        difference = self._difference(pair)
        rest = self.energy.shell.rest
        references = [
            Reference(rest(self.frame.coarsen(pair.first)), 1 - t),
            Reference(rest(self.frame.coarsen(pair.second)), t),
        ]
        placement = Placement(self.frame.coarsen(base), self.frame.coarsen(difference), references)
        return JointProblem(placement, base, difference)

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
