"""Minimisation in modal amplitudes by damped Newton steps."""

from enum import IntEnum
from typing import NamedTuple

import torch
from torch import Tensor

from torch_modal import trees
from torch_modal.autograd import without_saved_tensor_hooks
from torch_modal.elastic.gauss_newton import GaussNewtonStep, add_ridge
from torch_modal.elastic.modal import AmplitudeEnergy, Placed

# A Hessian is kept as long as each step leaves at most this part of the gradient: a new one costs ten gradients.
SHRINKAGE = 0.5


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
    """Of the amplitudes; 0 where none are minimised. *Shape:* ``(B,)``."""
    gradient_norm: Tensor
    """Relative to the gradient norm at the start. *Shape:* ``(B,)``."""
    n_steps: Tensor
    """Newton steps taken, each with a Hessian of its own. *Shape:* ``(B,)``, int64."""
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


@without_saved_tensor_hooks
def minimise(
    energy: AmplitudeEnergy[Placed], a: Tensor, placement: Placed, max_steps: int = 80, tolerance: float = 3e-7
) -> Solution:
    """Minimise by :class:`~torch_modal.elastic.gauss_newton.GaussNewtonStep`, and by further steps with its Hessian.

    The first Hessian is Gauss-Newton's, at a fifth of the cost of the full one. Each is kept as long as the gradient
    shrinks to :data:`SHRINKAGE`. A converged sample takes one more step, whose gradient is not evaluated: the gradient
    norm of the solution is the one before. A sample's result does not depend on its batch.

    Args:
        energy: The energy of the amplitudes: a :class:`~torch_modal.elastic.modal.ModalEnergy`, or what has its
            methods ``value``, ``value_and_gradient`` and ``derivatives``.
        a: Where to start. *Shape:* ``(B, n)``.
        placement: The data of the energy for each sample: nested tuples of tensors. *Shape of each:* ``(B, ...)``.
        max_steps: Number of Hessians at most.
        tolerance: Bound on the gradient norm, relative to the one at the start.
    """
    step, at = GaussNewtonStep(energy), energy.derivatives(a, placement, second_order=False)
    a, value, start = a.clone(), at.value.clone(), at.gradient.norm(dim=-1)
    goal, norm = torch.maximum(tolerance * start, at.floor), start.clone()
    n_steps = torch.zeros(len(a), dtype=torch.int64, device=a.device)
    status = torch.full_like(n_steps, Status.OUT_OF_STEPS)
    active = (start > goal) & start.isfinite() & value.isfinite()
    for k in range(max_steps):
        rows = torch.nonzero(active).flatten()
        if not len(rows):
            break
        some = trees.rows(placement, rows)
        at = energy.derivatives(a[rows], some) if k else trees.rows(at, rows)
        reached = step(a[rows], some, at)
        x, energies, gradients = reached.amplitudes, reached.energy, reached.gradient
        sizes = gradients.norm(dim=-1)
        factors, info = torch.linalg.cholesky_ex(add_ridge(at.hessian))
        shrinks = reached.moved & (info == 0) & (sizes <= SHRINKAGE * norm[rows])
        while len(on := torch.nonzero(shrinks & (sizes > goal[rows])).flatten()):
            there = x[on] - torch.cholesky_solve(gradients[on, :, None], factors[on]).squeeze(-1)
            e, gradient = energy.value_and_gradient(there, trees.rows(some, on))
            size = gradient.norm(dim=-1)
            good = (size <= SHRINKAGE * sizes[on]) & (e <= energies[on] + at.rounding[on])
            shrinks[on], on = good, on[good]
            x[on], energies[on], gradients[on], sizes[on] = there[good], e[good], gradient[good], size[good]
        ended = ((sizes <= goal[rows]) & (info == 0))[:, None]
        x = torch.where(ended, x - torch.cholesky_solve(gradients[..., None], factors).squeeze(-1), x)
        # Steps cannot be compared where the rest of the gain is below the rounding of the energy.
        stuck, drowned = ~reached.moved & (k > 0), reached.gain <= at.rounding
        status[rows[stuck]] = torch.where(drowned, Status.CONVERGED, Status.STALLED)[stuck]
        a[rows], value[rows], norm[rows] = x, energies, sizes
        n_steps[rows] += reached.moved
        active[rows] = (sizes > goal[rows]) & ~stuck
    status = torch.where(norm <= goal, Status.CONVERGED, status)
    status = torch.where(norm.isfinite() & value.isfinite(), status, Status.INVALID)
    return Solution(a, value, norm / start.clamp_min(torch.finfo(start.dtype).tiny), n_steps, status)
