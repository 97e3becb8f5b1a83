"""Gradients of a minimiser: by the implicit function theorem, or through a fixed number of steps."""

import warnings
from collections.abc import Callable
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torch_modal import trees
from torch_modal.autograd import applied, flattened, transposed
from torch_modal.solve.gauss_newton import GaussNewtonStep
from torch_modal.solve.quasi_newton import descend
from torch_modal.solve.solver import Solution, Status


class ConvergenceWarning(UserWarning):
    """A minimisation stopped before its gradient vanished, or has no gradient where it stopped."""


class Minimisation(NamedTuple):
    """The step, its limits, and the report of a minimisation."""

    step: GaussNewtonStep
    max_steps: int
    tolerance: float
    guessed: bool
    """Whether the start is a guess, which may be worse than zeros."""
    require: Callable[[Tensor], None]
    """Raises where there is no minimum at some of the times."""
    report: Callable[[Solution], None] | None
    """Receives the solution."""


class _ArgMin(torch.autograd.Function):
    r"""Amplitudes :math:`a^*(\theta)` at which :math:`\partial E / \partial a = 0`, for placements :math:`\theta`.

    Backward solves with the full Hessian: :math:`\bar\theta = -(\partial_\theta \partial_a E)^T H^{-1} \bar a`. Forward
    mode is its transpose. With ``2 J^T J`` in its place the gradient is wrong wherever a residual remains at the
    optimum, and here much of it does. Only the solution is kept: memory does not grow with the number of steps. Samples
    that did not converge have no such gradient; theirs is zero.
    """

    @staticmethod
    def forward(
        minimisation: Minimisation,
        tree: Any,
        usable: Tensor,
        times: Tensor,
        start: Tensor,
        *tensors: Tensor,
    ) -> tuple[Tensor, ...]:
        minimisation.require(times)
        placement = trees.filled(tree, tensors)
        if minimisation.guessed:
            # Never a start that is worse than linear interpolation: what comes out must not be, either.
            zeros = torch.zeros_like(start)
            start, _ = minimisation.step.lowest(zeros, torch.stack([zeros, start]), placement)
        limits = minimisation.max_steps, minimisation.tolerance
        solution = descend(minimisation.step, start, placement, *limits)
        solution = solution._replace(status=torch.where(usable, solution.status, Status.INVALID))
        if minimisation.report is not None:
            minimisation.report(solution)
        return tuple(value for value in solution if value is not None)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: tuple[Tensor, ...]) -> None:
        minimisation, tree, _, _, _, *tensors = inputs
        amplitudes, *diagnostics = output
        ctx.mark_non_differentiable(*diagnostics)
        ctx.minimisation, ctx.tree = minimisation, tree
        ctx.n_diagnostics = len(diagnostics)
        ctx.save_for_backward(amplitudes, diagnostics[-1], *tensors)
        ctx.save_for_forward(amplitudes, diagnostics[-1], *tensors)

    @staticmethod
    def jvp(ctx: Any, *tangents: Tensor | None) -> tuple[Tensor | None, ...]:
        amplitudes, _, *tensors = ctx.saved_tensors
        pull_back = _adjoint(ctx.minimisation.step, ctx.tree, *ctx.saved_tensors)
        moved = transposed(pull_back, torch.zeros_like(amplitudes), tensors, tangents[5:])
        return moved, *(None,) * ctx.n_diagnostics

    @staticmethod
    def backward(ctx: Any, to_amplitudes: Tensor, *_: Tensor) -> tuple[Tensor | None, ...]:
        pull_back = _adjoint(ctx.minimisation.step, ctx.tree, *ctx.saved_tensors)
        return (None,) * 5 + pull_back(to_amplitudes)

    @staticmethod
    def vmap(
        info: Any, in_dims: tuple[Any, ...], minimisation: Minimisation, tree: Any, *tensors: Tensor | None
    ) -> tuple[tuple[Tensor, ...], tuple[int, ...]]:
        known = [i for i, tensor in enumerate(tensors) if tensor is not None]
        flat: list[Tensor | None] = [None] * len(tensors)
        dims = [in_dims[-len(tensors) :][i] for i in known]
        for i, tensor in zip(known, flattened(info.batch_size, dims, [tensors[i] for i in known]), strict=True):
            flat[i] = tensor
        output = _ArgMin.apply(minimisation, tree, *flat)
        return tuple(value.unflatten(0, (info.batch_size, -1)) for value in output), (0,) * len(output)


def _adjoint(
    step: Any, tree: Any, amplitudes: Tensor, status: Tensor, *tensors: Tensor
) -> Callable[[Tensor], tuple[Tensor, ...]]:
    """From gradients in the amplitudes, ``(B, n)``, to those in the tensors of the placement: linear.

    Args:
        step: Of the minimisation.
        tree: Skeleton of the placement.
        amplitudes: That were found. *Shape:* ``(B, n)``.
        status: *Shape:* ``(B,)``.
        tensors: Of the placement.
    """
    placement = trees.filled(tree, tensors)
    converged = (status == Status.CONVERGED)[:, None]
    derivatives = step.energy.derivatives(amplitudes, placement)
    hessian = step.ridged(derivatives.gauss_newton + derivatives.second_order)
    eye = torch.eye(hessian.shape[-1], dtype=hessian.dtype, device=hessian.device)
    matrix = torch.where(converged[..., None], hessian, eye)

    def pull_back(to_amplitudes: Tensor) -> tuple[Tensor, ...]:
        adjoint, info = torch.linalg.solve_ex(matrix, to_amplitudes)
        singular = (info != 0)[:, None]
        _warn_of_singular(singular)
        adjoint = torch.where(converged & ~singular, adjoint, 0)
        to_placement = step.energy.pull_back(amplitudes, adjoint, placement)
        return tuple(-gradient for gradient in trees.leaves(to_placement))

    return pull_back


def _warn_of_singular(singular: Tensor) -> None:
    try:
        number = int(singular.sum())
    except RuntimeError:  # under vmap there is no number to see
        return
    if number:
        warnings.warn(
            f"the Hessian of {number} in-betweens is singular: no gradient flows through their amplitudes",
            ConvergenceWarning,
            stacklevel=2,
        )


def solve_implicit(
    minimisation: Minimisation, placement: Any, start: Tensor, usable: Tensor, times: Tensor
) -> Solution:
    """Minimise; gradients of the amplitudes by the implicit function theorem.

    Args:
        minimisation: What is minimised.
        placement: What the energy depends on: nested tuples of tensors. *Shape of each:* ``(B, ...)``.
        start: Where to start, unless zeros have a lower energy. *Shape:* ``(B, n)``.
        usable: False for samples whose status is ``INVALID`` whatever comes out. *Shape:* ``(B,)``.
        times: Checked before all else. *Shape:* ``(B,)``.
    """
    tensors = trees.leaves(placement)
    # Kernels compute in float64, whatever goes in and comes out.
    batched = (usable, times, start.detach().to(tensors[0].dtype), *tensors)
    found = applied(_ArgMin, minimisation, trees.skeleton(placement), *batched)
    return Solution(*(value.to(start.dtype) if value.is_floating_point() else value for value in found))


def solve_unrolled(
    minimisation: Minimisation, placement: Any, start: Tensor, usable: Tensor, times: Tensor
) -> Solution:
    """Take exactly ``max_steps`` steps from zeros; gradients flow back through all of them.

    Nothing here depends on data but what is computed: no early end, no report, no choice of where to start.
    Arguments as for :func:`solve_implicit`.
    """
    step = minimisation.step
    a = torch.zeros_like(start)
    first = None
    for _ in range(minimisation.max_steps):
        taken = step(a, placement)
        first = taken.gradient_norm if first is None else first
        a = taken.amplitudes
    derivatives = step.energy.derivatives(a, placement, second_order=False)
    norm = derivatives.gradient.norm(dim=-1)
    first = norm if first is None else first
    found = norm <= torch.maximum(minimisation.tolerance * first, step.floor(derivatives))
    status = torch.where(found, Status.CONVERGED, Status.OUT_OF_STEPS)
    status = torch.where(usable & norm.isfinite(), status, Status.INVALID)
    relative = norm / first.clamp_min(torch.finfo(first.dtype).tiny)
    steps = torch.full_like(status, minimisation.max_steps)
    return Solution(a, step.energy.value(a, placement), relative.detach(), steps, status)
