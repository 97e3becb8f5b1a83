"""Minimisation in modal amplitudes by quasi-Newton steps from Gauss-Newton's Hessian.

The start is near the minimum as a rule. One Hessian and a dozen gradients then take less time than the three or four
Hessians of a Newton method, and need no second-order term.
"""

from enum import IntEnum
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torch_modal import trees
from torch_modal.elastic.energy import energy_rounding

# Evaluations of the gradient with one Hessian of Gauss and Newton. Samples that need more get another.
MOST_EVALUATIONS = 40

# Steps shorter than this part of the quasi-Newton step make no progress worth an evaluation.
SHORTEST_STEP = 0.02


class Status(IntEnum):
    """End of the minimisation of a sample."""

    CONVERGED = 0
    """The gradient is within the tolerance, or as small as rounding lets it be."""
    OUT_OF_STEPS = 1
    """There was more to gain."""
    STALLED = 2
    """No step went downhill any more."""
    INVALID = 3
    """No in-between exists: NaN or infinite entries, no size, or one key-frame of a closed mesh is a mirror image."""
    FELL_BACK = 4
    """The minimiser is worse than its start, which is returned: the blend by local rotations, or linear
    interpolation. Gradients belong to the returned shape, amplitudes and energy to the minimiser."""


class Solution(NamedTuple):
    """Result of :func:`minimise`, one value per sample."""

    amplitudes: Tensor
    """*Shape:* ``(B, n)``."""
    energy: Tensor
    """*Shape:* ``(B,)``."""
    gradient_norm: Tensor
    """Relative to the gradient norm at the start. *Shape:* ``(B,)``."""
    n_steps: Tensor
    """Steps taken. *Shape:* ``(B,)``, int64."""
    status: Tensor
    """A :class:`Status` for each. *Shape:* ``(B,)``, int64."""
    n_crossing: Tensor | None = None
    """With contact, the pairs of triangles of parts that still go through each other. *Shape:* ``(B,)``, int64."""
    distortion_ratio: Tensor | None = None
    """Largest ratio of the minimiser's distortion to a start's; starts count as strained by 2 % at least.
    From 1.1 on the shape is blended into its start, from 1.2 on (paths: 2 and 3) replaced by it. *Shape:* ``(B,)``."""
    start_weights: Tensor | None = None
    """Parts, 0 to 1, of the starts in the shape: the blend by local rotations, and linear interpolation; of a smooth
    path, the spline of the vertices. *Shape:* ``(B, 2)``, or ``(B, 1)``."""

    @property
    def usable(self) -> Tensor:
        """True where the shape converged, or is what it started from. *Shape:* ``(B,)``, bool."""
        return self.converged | (self.status == Status.FELL_BACK)

    @property
    def converged(self) -> Tensor:
        """True where the gradient is within the tolerance. *Shape:* ``(B,)``, bool."""
        return self.status == Status.CONVERGED


class State(NamedTuple):
    """The state of each sample. Vectors have a last dimension of 1, for matrix products."""

    row: Tensor
    """Which sample of the batch it is. *Shape:* ``(B,)``."""
    a: Tensor
    """*Shape:* ``(B, n, 1)``."""
    there: Tensor
    """Amplitudes after the next step. *Shape:* ``(B, n, 1)``."""
    energy: Tensor
    """*Shape:* ``(B,)``."""
    gradient: Tensor
    """*Shape:* ``(B, n, 1)``."""
    norm: Tensor
    """Norm of the gradient. *Shape:* ``(B,)``."""
    inverse: Tensor
    """The approximate inverse of the Hessian. *Shape:* ``(B, n, n)``."""
    length: Tensor
    """Length of the next step, relative to the quasi-Newton step; 0 for converged samples. *Shape:* ``(B,)``."""
    goal: Tensor
    """The gradient norm at which it has converged. *Shape:* ``(B,)``."""
    rounding: Tensor
    """Energy error due to rounding of positions, over the root of the energy. *Shape:* ``(B,)``."""
    n_steps: Tensor
    """Steps taken. *Shape:* ``(B,)``, int64."""
    placement: Any
    """The arguments of the energy for each sample."""


def minimise(energy: Any, a: Tensor, placement: Any, max_steps: int = 80, tolerance: float = 3e-7) -> Solution:
    """Minimise by BFGS from the Gauss-Newton Hessian.

    A step is taken if the energy falls; otherwise the next one is half as long. A converged sample takes one more step,
    whose gradient is not evaluated: the gradient norm of the solution is the one before. Samples that have not
    converged after :data:`MOST_EVALUATIONS` start again where they are, with the Hessian there. A sample's result does
    not depend on its batch.

    Args:
        energy: The energy of the amplitudes: a :class:`~torch_modal.elastic.modal.ModalEnergy`, or what has its
            methods ``derivatives`` and ``value_and_gradient``.
        a: Where to start. *Shape:* ``(B, n)``.
        placement: What the energy knows of each sample: nested tuples of tensors. *Shape of each:* ``(B, ...)``.
        max_steps: Evaluations of the gradient at most.
        tolerance: Bound on the gradient norm, relative to the one at the start.
    """
    best, norm, n_steps = a.clone(), a.new_zeros(len(a)), torch.zeros(len(a), dtype=torch.int64, device=a.device)
    reached, start, goal, below_rounding = norm, norm, norm, norm > 0
    rows, update = torch.arange(len(a), device=a.device), getattr(energy, "quasi_newton", bfgs_update)
    for used in range(0, max(max_steps, 1), MOST_EVALUATIONS):
        some = placement if len(rows) == len(a) else trees.rows(placement, rows)
        derivatives = energy.derivatives(best[rows], some, second_order=False)
        factor, info = torch.linalg.cholesky_ex(add_ridge(derivatives.gauss_newton))
        if bool(info.any()):  # too singular for single precision
            exact = energy.derivatives(best[rows], some).gauss_newton
            exact = torch.where((info != 0)[:, None, None], exact, derivatives.gauss_newton)
            derivatives = derivatives._replace(gauss_newton=exact)
            factor, info = torch.linalg.cholesky_ex(add_ridge(exact))
        own_norm = derivatives.gradient.norm(dim=-1)
        if not used:
            reached, start = derivatives.value.clone(), own_norm.clone()
            goal = torch.maximum(tolerance * own_norm, derivatives.floor)
        regular = (info == 0) & own_norm.isfinite() & reached[rows].isfinite()
        if not bool(regular.all()):
            factor = torch.where(regular[:, None, None], factor, torch.eye(a.shape[-1]).to(a))
        inverse = torch.cholesky_inverse(factor).contiguous()
        length, before = (regular & (own_norm > goal[rows])).to(a), n_steps[rows]
        stiffest = derivatives.gauss_newton.diagonal(dim1=-2, dim2=-1).amax(-1)
        rounding = derivatives.resolution / stiffest.clamp_min(torch.finfo(a.dtype).tiny).sqrt()
        here, slope = best[rows, :, None], derivatives.gradient[..., None]
        there = here - length[:, None, None] * torch.bmm(inverse, slope)
        rest_of_state = reached[rows], slope, own_norm, inverse, length, goal[rows], rounding, before.clone(), some
        state = State(rows, here, there, *rest_of_state)
        whole = best, reached, norm, n_steps, below_rounding
        for _ in range(min(MOST_EVALUATIONS, max_steps - used)):
            n_active = int(torch.count_nonzero(state.length))
            if not n_active:
                break
            if 2 * n_active <= len(state.row):
                _put(whole, state)
                state = trees.rows(state, torch.nonzero(state.length).flatten())
            state = update(state, *energy.value_and_gradient(state.there.squeeze(-1), state.placement))
        _put(whole, state)
        # A Hessian at the new place may help the others, if they have moved.
        rows = rows[(norm[rows] > goal[rows]) & ~below_rounding[rows] & (n_steps[rows] > before)]
        if not len(rows):
            break
    status = torch.full_like(n_steps, Status.STALLED)
    status[rows] = Status.OUT_OF_STEPS
    status = torch.where((norm <= goal) | below_rounding, Status.CONVERGED, status)
    status = torch.where(norm.isfinite() & reached.isfinite(), status, Status.INVALID)
    return Solution(best, reached, norm / start.clamp_min(torch.finfo(start.dtype).tiny), n_steps, status)


def _put(whole: tuple[Tensor, ...], state: State) -> None:
    """Write amplitudes, energies, gradient norms and numbers of steps of some samples into the tensors of the batch.

    The last tensor is True where the remaining gain is below the rounding of the energy: steps cannot be compared then.
    """
    step = torch.bmm(state.inverse, state.gradient)
    # A start that has converged takes no last step, which would follow rounding.
    ended = ((state.norm <= state.goal) & (state.n_steps > 0))[:, None, None]
    gain = 0.5 * (state.gradient * step).sum((1, 2))
    below_rounding = gain <= energy_rounding(gain.dtype) * state.energy.abs()
    a = torch.where(ended, state.a - step, state.a).squeeze(-1)
    for values, new_values in zip(whole, (a, state.energy, state.norm, state.n_steps, below_rounding), strict=True):
        values[state.row] = new_values


def bfgs_update(state: State, value: Tensor, slope: Tensor) -> State:
    """The state after an evaluation at its next place: a step where the energy falls, else a shorter one next.

    *Shape:* ``(B,), (B, n)``.
    """
    a, there, gradient, inverse, length = state.a, state.there, state.gradient, state.inverse, state.length
    slope = slope[..., None]
    norm = torch.linalg.vector_norm(slope, dim=(1, 2))
    # Energies are sums of squares. They may rise by their rounding, and where the gradient falls, by the effect of the
    # rounding of positions.
    bound = state.energy * (1 + energy_rounding(value.dtype))
    bound = torch.where(norm < state.norm, bound + state.rounding * state.energy.clamp_min(0).sqrt(), bound)
    better = (length > 0) & (value <= bound)
    taken = better[:, None, None]
    move, change = torch.where(taken, there - a, 0), torch.where(taken, slope - gradient, 0)
    a, gradient = torch.where(taken, there, a), torch.where(taken, slope, gradient)
    value, norm = torch.where(better, value, state.energy), torch.where(better, norm, state.norm)
    length = torch.where(better, 1, torch.where(length > SHORTEST_STEP, 0.5 * length, 0)) * (norm > state.goal)
    # The update keeps the inverse positive definite where the gradient grows along the step; elsewhere it is left out.
    pushed, across = torch.bmm(inverse, change), change.mT
    curvature = torch.bmm(across, move)
    share = torch.where(curvature > 0, curvature.reciprocal(), 0)
    half = torch.bmm(across, pushed).mul_(share).add_(1).mul_(0.5)
    other, scaled = torch.addcmul(pushed, half, move, value=-1), move * share
    inverse = inverse.baddbmm_(scaled, other.mT, alpha=-1).baddbmm_(other, scaled.mT, alpha=-1)
    return state._replace(
        a=a,
        there=a - length[:, None, None] * torch.bmm(inverse, gradient),
        energy=value,
        gradient=gradient,
        norm=norm,
        inverse=inverse,
        length=length,
        n_steps=state.n_steps + better,
    )


def add_ridge(hessian: Tensor) -> Tensor:
    """A Hessian with a ridge relative to its mean diagonal, for directions without stiffness. *Shape:* ``(..., n, n)``.

    Such are those of coincident key-frames, which would break the factorisation.
    """
    size = hessian.diagonal(dim1=-2, dim2=-1).mean(-1)
    ridge = (1e-12 if hessian.dtype == torch.float64 else 1e-6) * size.abs() + torch.finfo(size.dtype).tiny
    return hessian + torch.diag_embed(ridge[..., None].expand(hessian.shape[:-1]))
