"""The damped Gauss-Newton step on modal amplitudes."""

from typing import Generic, NamedTuple

import torch
from torch import Tensor, nn

from torch_modal.autograd import disable_compile, full_precision, is_eager, without_saved_tensor_hooks
from torch_modal.elastic.modal import AmplitudeEnergy, Derivatives, Placed

# Part of the decrease that Newton's step promises, from which on it is taken without a search.
SUFFICIENT = 0.25

# Parts of both steps that are tried side by side otherwise.
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
    gradient: Tensor
    """After the step. *Shape:* ``(B, n)``."""
    gain: Tensor
    """Decrease that Newton's step promised; infinite where the Hessian is not positive definite. *Shape:* ``(B,)``."""


class GaussNewtonStep(nn.Module, Generic[Placed]):
    """One damped step of every sample of a batch, never uphill beyond rounding.

    The residual at the optimum is large: Gauss-Newton alone gains a digit every six steps there, while the full Hessian
    doubles the digits, and is often indefinite far from it. Newton's step is taken where it gains enough; otherwise
    both directions are tried, at several step lengths, and the lowest energy wins. A sample where none is lower stays
    where it is::

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

    def __init__(self, energy: AmplitudeEnergy[Placed]) -> None:
        super().__init__()
        self.energy = energy

    @disable_compile
    @full_precision
    @without_saved_tensor_hooks
    def forward(self, a: Tensor, placement: Placed, at: Derivatives | None = None) -> Step:
        """Take one step; where tensors are traced, without a branch that depends on data.

        Args:
            a: Amplitudes. *Shape:* ``(B, n)``.
            placement: The data of the energy for each sample.
            at: The derivatives there, if known.

        Raises:
            ValueError: The amplitudes have no batch dimension, or several.
        """
        if a.dim() != 2:
            raise ValueError(
                f"amplitudes have the shape (B, n), as the placement has B samples; got {tuple(a.shape)}: of one "
                "sample, pass a[None] and place start[None]"
            )
        at = self.energy.derivatives(a, placement) if at is None else at
        norm, newton = at.gradient.norm(dim=-1), _direction(at.gradient, at.hessian)
        definite = newton.isfinite().all(-1)
        gain = torch.where(definite, -0.5 * (at.gradient * newton).sum(-1), torch.inf)
        reached = a + torch.where(definite[:, None], newton, 0)
        energy, gradient = self.energy.value_and_gradient(reached, placement)
        fall = at.value - energy
        # Near the optimum the energy is flat to rounding while the gradient still has digits to gain.
        gains = (fall >= SUFFICIENT * gain) | ((fall >= -at.rounding) & (gradient.norm(dim=-1) < norm))
        good = definite & gains
        found = Step(reached, energy, norm, good, gradient, gain)
        if is_eager(good) and bool(good.all()):
            return found
        other = self._search(a, placement, at, newton)
        chosen = [torch.where(good.view(-1, *[1] * (x.dim() - 1)), x, y) for x, y in zip(found, other, strict=True)]
        return Step(*chosen)._replace(gradient_norm=norm, gain=gain)

    def _search(self, a: Tensor, placement: Placed, at: Derivatives, newton: Tensor) -> Step:
        """The lowest of several lengths of both directions."""
        directions = torch.stack([newton, _direction(at.gradient, at.gauss_newton)])
        steps = torch.cat([length * directions for length in STEP_LENGTHS])
        usable = steps.isfinite().all(-1)
        candidates = a + torch.where(usable[..., None], steps, 0)
        energies = self.energy.value(candidates, placement)
        lowest, index = torch.where(usable & energies.isfinite(), energies, torch.inf).min(0)
        best = candidates.gather(0, index[None, :, None].expand(1, *a.shape)).squeeze(0)
        moved = lowest < at.value - at.rounding
        best = torch.where(moved[:, None], best, a)
        energy, gradient = self.energy.value_and_gradient(best, placement)
        return Step(best, energy, at.value, moved, gradient, at.value)


def _direction(gradient: Tensor, hessian: Tensor) -> Tensor:
    """The direction ``-H^-1 g``; NaN where the Hessian is not positive definite. *Shape:* ``(B, n), (B, n, n)``."""
    hessian = add_ridge(hessian)
    factor, info = torch.linalg.cholesky_ex(hessian)
    definite = (info == 0)[:, None]
    if torch.is_grad_enabled():
        # A failed factorisation that is not used would still give NaN gradients.
        eye = torch.eye(hessian.shape[-1], dtype=hessian.dtype, device=hessian.device)
        factor, _ = torch.linalg.cholesky_ex(torch.where(definite[..., None], hessian, eye))
    return torch.where(definite, -torch.cholesky_solve(gradient[..., None], factor).squeeze(-1), torch.nan)


def add_ridge(hessian: Tensor) -> Tensor:
    """A Hessian with a ridge relative to its mean diagonal, for directions without stiffness. *Shape:* ``(..., n, n)``.

    Coincident key-frames cause these, which would break the factorisation.
    """
    size = hessian.diagonal(dim1=-2, dim2=-1).mean(-1)
    ridge = (1e-12 if hessian.dtype == torch.float64 else 1e-6) * size.abs() + torch.finfo(size.dtype).tiny
    return hessian + torch.diag_embed(ridge[..., None].expand(hessian.shape[:-1]))
