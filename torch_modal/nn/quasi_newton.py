"""Quasi-Newton steps from Gauss-Newton's Hessian at the start, and Newton steps where they do not converge.

The start is near the minimum as a rule. One Hessian and a dozen gradients then take less time than the three or four
Hessians of a Newton method, and need no second-order term.
"""

from typing import Any, NamedTuple

import torch
from torch import Tensor

from torch_modal.nn import trees
from torch_modal.nn.gauss_newton import ENERGY_ROUNDING, AmplitudeEnergy, GaussNewtonStep
from torch_modal.nn.solver import Solution, Status, minimise

# Evaluations of the gradient at most. Samples that need more are better served by Newton steps.
MOST_EVALUATIONS = 60

# The energy falls by at least this part of what the slope promises (Armijo's condition).
SUFFICIENT = 1e-4

# Steps shorter than this part of the quasi-Newton step make no progress worth an evaluation.
SHORTEST = 0.02


class _State(NamedTuple):
    """What is known of each sample."""

    row: Tensor
    """Which sample of the batch it is. *Shape:* ``(B,)``."""
    a: Tensor
    """*Shape:* ``(B, n)``."""
    energy: Tensor
    """*Shape:* ``(B,)``."""
    bound: Tensor
    """The energy and its rounding. *Shape:* ``(B,)``."""
    gradient: Tensor
    """*Shape:* ``(B, n)``."""
    inverse: Tensor
    """The approximate inverse of the Hessian. *Shape:* ``(B, n, n)``."""
    length: Tensor
    """Of the next step, relative to the quasi-Newton step. *Shape:* ``(B,)``."""
    goal: Tensor
    """The gradient norm at which it has converged. *Shape:* ``(B,)``."""
    active: Tensor
    """Whether it has further to go. *Shape:* ``(B,)``, bool."""
    n_steps: Tensor
    """Steps taken. *Shape:* ``(B,)``, int64."""
    placement: Any
    """What the energy knows of each sample."""


def descend(
    step: GaussNewtonStep,
    a: Tensor,
    placement: Any,
    max_steps: int = 80,
    tolerance: float = 1e-8,
    energy: Tensor | None = None,
) -> Solution:
    """Minimise by the BFGS method, whose first Hessian is Gauss-Newton's, then by Newton steps what did not converge.

    A step is taken if the energy falls; otherwise the next one is half as long. A sample's result does not depend on
    its batch. Arguments as for :func:`torch_modal.nn.solver.minimise`.
    """
    energy = step.energy.value(a, placement) if energy is None else energy
    derivatives = step.energy.derivatives(a, placement, second_order=False)
    start = derivatives.gradient.norm(dim=-1)
    goal = torch.maximum(tolerance * start, step.floor(derivatives))
    factor, info = torch.linalg.cholesky_ex(step.ridged(derivatives.gauss_newton))
    regular = (info == 0) & start.isfinite() & energy.isfinite()
    eye = torch.eye(a.shape[-1], dtype=factor.dtype, device=a.device)
    state = _State(
        torch.arange(len(a), device=a.device),
        a,
        energy,
        energy + _rounding(energy),
        derivatives.gradient,
        torch.cholesky_inverse(torch.where(regular[:, None, None], factor, eye)),
        torch.ones_like(start),
        goal,
        regular & (start > goal),
        torch.zeros_like(info, dtype=torch.int64),
        placement,
    )
    whole = found, reached, norm, n_steps = a.clone(), energy.clone(), start.clone(), state.n_steps.clone()
    for _ in range(min(MOST_EVALUATIONS, max_steps)):
        n_active = int(state.active.sum())
        if not n_active:
            break
        if 2 * n_active <= len(state.row):
            _put(whole, state)
            state = trees.rows(state, torch.nonzero(state.active).flatten())
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
    parts = state.a, state.energy, state.gradient.norm(dim=-1), state.n_steps
    for values, own in zip(whole, parts, strict=True):
        values[state.row] = own


def _advanced(energy: AmplitudeEnergy, state: _State) -> _State:
    """One evaluation: a step where the energy falls, a shorter one next where it does not."""
    gradient, inverse, active = state.gradient, state.inverse, state.active
    move = torch.bmm(inverse, gradient[..., None]).squeeze(-1) * torch.where(active, -state.length, 0)[:, None]
    there = state.a + move
    value, slope = energy.value_and_gradient(there, state.placement)
    expected = (move * gradient).sum(-1)
    better = active & (value <= state.bound + SUFFICIENT * expected)
    change = slope - gradient
    length = torch.ones_like(state.length)
    if not bool(better.all()):
        taken = better[:, None]
        there, move, change = torch.where(taken, there, state.a), move * taken, torch.where(taken, change, 0)
        value, slope = torch.where(better, value, state.energy), torch.where(taken, slope, gradient)
        length = torch.where(better, length, 0.5 * state.length)
        active = active & (length >= SHORTEST)
    # The update keeps the inverse positive definite where the gradient grows along the step; elsewhere it is left out.
    pushed = torch.bmm(inverse, change[..., None]).squeeze(-1)
    curvature = (change * move).sum(-1, keepdim=True)
    share = torch.where(curvature > 0, 1 / curvature, 0)
    other = share * ((0.5 + 0.5 * share * (change * pushed).sum(-1, keepdim=True)) * move - pushed)
    update = torch.bmm(move[:, :, None], other[:, None])
    return state._replace(
        a=there,
        energy=value,
        bound=value + _rounding(value),
        gradient=slope,
        inverse=inverse.add_(update).add_(update.mT),
        length=length,
        active=active & (slope.norm(dim=-1) > state.goal),
        n_steps=state.n_steps + better,
    )


def _rounding(energy: Tensor) -> Tensor:
    """How far an energy may rise by rounding alone. *Shape:* ``(B,)``."""
    return ENERGY_ROUNDING * torch.finfo(energy.dtype).eps * energy.abs()
