"""The damped Gauss-Newton step on modal amplitudes."""

from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from torch_modal.autograd import disable_compile, full_precision
from torch_modal.elastic.minimise import Solution, Status, add_ridge
from torch_modal.elastic.modal import Derivatives

# Parts of a step that are tried side by side.
STEP_LENGTHS = (1.0, 0.5, 0.25, 0.1, 0.03, 0.003)


class Step(NamedTuple):
    """One step of every sample of a batch."""

    amplitudes: Tensor
    """*Shape:* ``(B, n)``."""
    energy: Tensor
    """*Shape:* ``(B,)``."""
    gradient_norm: Tensor
    """Before the step. *Shape:* ``(B,)``."""
    moved: Tensor
    """False where no step was found that does not go uphill. *Shape:* ``(B,)``, bool."""


class GaussNewtonStep(nn.Module):
    """One damped step of every sample of a batch, never uphill.

    The residual at the optimum is large: Gauss-Newton alone gains a digit every six steps there, and the full Hessian
    alone is often indefinite far from it. Both directions are tried, at several step lengths, in one batched evaluation
    of the energy; the lowest wins. A sample where none is lower stays where it is::

        shell = tm.ShellEnergy(faces)
        energy = tm.ModalEnergy(shell, basis.modes)
        placement = energy.place(start, shell.reference_of(rest))  # both (B, V, 3)
        step = tm.GaussNewtonStep(energy)
        a = torch.zeros(len(start), basis.n_modes, dtype=start.dtype)
        for _ in range(10):
            a = step(a, placement).amplitudes
        x = start + torch.tensordot(a, basis.modes, 1)

    Args:
        energy: The energy of the amplitudes.
    """

    def __init__(self, energy: Any) -> None:
        super().__init__()
        self.energy = energy

    @disable_compile
    @full_precision
    def forward(self, a: Tensor, placement: Any) -> Step:
        """Take one step, without a branch that depends on data.

        Args:
            a: Amplitudes. *Shape:* ``(B, n)``.
            placement: What the energy knows of each sample.

        Raises:
            ValueError: The amplitudes have no batch dimension, or several.
        """
        if a.dim() != 2:
            raise ValueError(
                f"amplitudes have the shape (B, n), as the placement has B samples; got {tuple(a.shape)}: of one "
                "sample, pass a[None] and place start[None]"
            )
        derivatives = self.energy.derivatives(a, placement)
        directions = _directions(derivatives)
        steps = torch.cat([length * directions for length in STEP_LENGTHS])
        usable = steps.isfinite().all(-1)
        candidates = a + torch.where(usable[..., None], steps, 0)
        energies = self.energy.value(candidates, placement)
        energies = torch.where(usable & energies.isfinite(), energies, torch.inf)
        lowest, index = energies.min(0)
        best = candidates.gather(0, index[None, :, None].expand(1, *a.shape)).squeeze(0)
        value = self.energy.value(a, placement)
        # At the optimum the energy is flat to rounding while the gradient still has digits to gain.
        moved = lowest <= value + 4 * torch.finfo(value.dtype).eps * value.abs()
        reached, energy = torch.where(moved[:, None], best, a), torch.where(moved, lowest, value)
        return Step(reached, energy, derivatives.gradient.norm(dim=-1), moved)


def _directions(derivatives: Derivatives) -> Tensor:
    """Directions ``-H^-1 g`` of Gauss-Newton and of the full Hessian; NaN where it is not positive definite.

    *Shape:* ``(2, B, n)``.
    """
    hessians = add_ridge(torch.stack([derivatives.gauss_newton, derivatives.hessian]))
    factor, info = torch.linalg.cholesky_ex(hessians)
    definite = info == 0
    if torch.is_grad_enabled():
        # A failed factorisation that is not used would still give NaN gradients.
        eye = torch.eye(hessians.shape[-1], dtype=hessians.dtype, device=hessians.device)
        factor, _ = torch.linalg.cholesky_ex(torch.where(definite[..., None, None], hessians, eye))
    gradient = derivatives.gradient.expand(len(hessians), -1, -1)[..., None]
    direction = -torch.cholesky_solve(gradient, factor).squeeze(-1)
    return torch.where(definite[..., None], direction, torch.nan)


def newton(
    energy: Any,
    a: Tensor,
    placement: Any,
    max_steps: int = 10,
    tolerance: float = 3e-7,
    stop_early: bool = True,
) -> Solution:
    """Minimise by :class:`GaussNewtonStep`: ten of them, as many as the paper takes.

    They reach its relative decrease of 1e-10 in 6 or 7.

    Args:
        energy: The energy of the amplitudes.
        a: Where to start. *Shape:* ``(B, n)``.
        placement: What the energy knows of each sample.
        max_steps: Number of steps at most.
        tolerance: Bound on the gradient norm, relative to the one at the start.
        stop_early: False to take all steps of all samples, without a branch that depends on data.
    """
    step, n_steps, start = GaussNewtonStep(energy), torch.zeros(len(a), dtype=torch.int64, device=a.device), None
    moving = torch.ones_like(n_steps, dtype=torch.bool)
    for _ in range(max_steps):
        reached = step(a, placement)
        start = reached.gradient_norm if start is None else start
        if stop_early:
            moving = moving & reached.moved & (reached.gradient_norm > tolerance * start)
        a, n_steps = torch.where(moving[:, None], reached.amplitudes, a), n_steps + moving
        if stop_early and not moving.any():
            break
    derivatives = energy.derivatives(a, placement, second_order=False)
    norm, value = derivatives.gradient.norm(dim=-1), derivatives.value
    start = norm if start is None else start
    small = norm <= torch.maximum(tolerance * start, derivatives.floor)
    status = torch.where(small, Status.CONVERGED, torch.where(moving, Status.OUT_OF_STEPS, Status.STALLED))
    status = torch.where(norm.isfinite() & value.isfinite(), status, Status.INVALID)
    relative = norm / start.clamp_min(torch.finfo(start.dtype).tiny)
    return Solution(a, value, relative.detach(), n_steps, status)
