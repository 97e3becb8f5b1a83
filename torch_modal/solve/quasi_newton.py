"""Quasi-Newton steps from Gauss-Newton's Hessian at the start, and Newton steps where they do not converge.

The start is near the minimum as a rule. One Hessian and a dozen gradients then take less time than the three or four
Hessians of a Newton method, and need no second-order term.
"""

from typing import Any, NamedTuple

import torch
from torch import Tensor

from torch_modal import trees
from torch_modal.solve.gauss_newton import ENERGY_ROUNDING, AmplitudeEnergy, GaussNewtonStep
from torch_modal.solve.solver import Solution, Status, minimise

# Evaluations of the gradient at most. Samples that need more are better served by Newton steps.
MOST_EVALUATIONS = 60

# Steps shorter than this part of the quasi-Newton step make no progress worth an evaluation.
SHORTEST = 0.02


class _State(NamedTuple):
    """The state of each sample. Vectors have a last dimension of 1, for matrix products."""

    row: Tensor
    """Which sample of the batch it is. *Shape:* ``(B,)``."""
    a: Tensor
    """*Shape:* ``(B, n, 1)``."""
    energy: Tensor
    """*Shape:* ``(B,)``."""
    gradient: Tensor
    """*Shape:* ``(B, n, 1)``."""
    norm: Tensor
    """Of the gradient. *Shape:* ``(B,)``."""
    inverse: Tensor
    """The approximate inverse of the Hessian. *Shape:* ``(B, n, n)``."""
    length: Tensor
    """Of the next step, relative to the quasi-Newton step; 0 of converged samples. *Shape:* ``(B,)``."""
    goal: Tensor
    """The gradient norm at which it has converged. *Shape:* ``(B,)``."""
    n_steps: Tensor
    """Steps taken. *Shape:* ``(B,)``, int64."""
    placement: Any
    """The arguments of the energy for each sample."""


def descend(
    step: GaussNewtonStep,
    a: Tensor,
    placement: Any,
    max_steps: int = 80,
    tolerance: float = 3e-7,
    energy: Tensor | None = None,
) -> Solution:
    """Minimise by BFGS from the Gauss-Newton Hessian, then by Newton steps where that does not converge.

    A step is taken if the energy falls; otherwise the next one is half as long. A converged sample takes one more step,
    whose gradient is not evaluated: the gradient norm of the solution is the one before. A sample's result does not
    depend on its batch. Arguments as for :func:`torch_modal.solve.solver.minimise`.
    """
    energy = step.energy.value(a, placement) if energy is None else energy
    derivatives = step.energy.derivatives(a, placement, second_order=False)
    start = derivatives.gradient.norm(dim=-1)
    goal = torch.maximum(tolerance * start, step.floor(derivatives))
    factor, info = torch.linalg.cholesky_ex(step.ridged(derivatives.gauss_newton))
    regular = (info == 0) & start.isfinite() & energy.isfinite()
    eye = torch.eye(a.shape[-1], dtype=factor.dtype, device=a.device)
    inverse = torch.cholesky_inverse(torch.where(regular[:, None, None], factor, eye))
    length = (regular & (start > goal)).to(start)
    n_steps = torch.zeros_like(info, dtype=torch.int64)
    rows = torch.arange(len(a), device=a.device)
    gradient = derivatives.gradient[..., None]
    state = _State(rows, a[..., None], energy, gradient, start, inverse, length, goal, n_steps, placement)
    whole = found, reached, norm, n_steps = a.clone(), energy.clone(), start.clone(), n_steps.clone()
    for _ in range(min(MOST_EVALUATIONS, max_steps)):
        n_active = int(torch.count_nonzero(state.length))
        if not n_active:
            break
        if 2 * n_active <= len(state.row):
            _put(whole, state)
            state = trees.rows(state, torch.nonzero(state.length).flatten())
        state = _advanced(step.energy, state)
    _put(whole, state)
    left = torch.nonzero(~(norm <= goal)).flatten()
    status = torch.where(norm <= goal, Status.CONVERGED, Status.OUT_OF_STEPS)
    if len(left):
        some, energies, norms, counts = trees.rows((placement, reached, start, n_steps), left)
        rest = minimise(step, found[left], some, max_steps, tolerance, energies, norms, counts)
        found[left], reached[left], norm[left] = rest.amplitudes, rest.energy, rest.gradient_norm * start[left]
        n_steps[left], status[left] = rest.n_steps, rest.status
    return Solution(found, reached, norm / start.clamp_min(torch.finfo(start.dtype).tiny), n_steps, status)


def _put(whole: tuple[Tensor, ...], state: _State) -> None:
    """Write the amplitudes, energies, gradient norms and numbers of steps of some samples into those of all."""
    last = torch.baddbmm(state.a, state.inverse, state.gradient, alpha=-1)
    # At a start that has converged there is nothing to gain, and perhaps only rounding to follow.
    ended = ((state.norm <= state.goal) & (state.n_steps > 0))[:, None, None]
    parts = torch.where(ended, last, state.a).squeeze(-1), state.energy, state.norm, state.n_steps
    for values, own in zip(whole, parts, strict=True):
        values[state.row] = own


def _advanced(energy: AmplitudeEnergy, state: _State) -> _State:
    """One evaluation: a step where the energy falls, a shorter one next where it does not."""
    a, gradient, inverse, length = state.a, state.gradient, state.inverse, state.length
    move = torch.bmm(inverse, gradient).mul_(-length[:, None, None])
    there = a + move
    value, slope = energy.value_and_gradient(there.squeeze(-1), state.placement)
    slope = slope[..., None]
    # Energies are sums of squares. They may rise by their rounding.
    better = (length > 0) & (value <= state.energy * (1 + ENERGY_ROUNDING * torch.finfo(value.dtype).eps))
    change = slope - gradient
    if bool(better.all()):
        length = torch.ones_like(length)
    else:
        taken = better[:, None, None]
        there, move, change = torch.where(taken, there, a), move * taken, torch.where(taken, change, 0)
        value, slope = torch.where(better, value, state.energy), torch.where(taken, slope, gradient)
        shorter = torch.where(length > SHORTEST, 0.5 * length, 0)
        length = torch.where(better, 1, shorter)
    # The update keeps the inverse positive definite where the gradient grows along the step; elsewhere it is left out.
    pushed, across = torch.bmm(inverse, change), change.mT
    curvature = torch.bmm(across, move)
    share = torch.where(curvature > 0, curvature.reciprocal(), 0)
    half = torch.bmm(across, pushed).mul_(share).add_(1).mul_(0.5)
    other, scaled = torch.addcmul(pushed, half, move, value=-1), move * share
    norm = torch.linalg.vector_norm(slope, dim=(1, 2))
    return state._replace(
        a=there,
        energy=value,
        gradient=slope,
        norm=norm,
        inverse=inverse.baddbmm_(scaled, other.mT, alpha=-1).baddbmm_(other, scaled.mT, alpha=-1),
        length=length * (norm > state.goal),
        n_steps=state.n_steps + better,
    )
