"""Gradients of a minimiser: by the implicit function theorem, or through a fixed number of steps."""

from collections.abc import Callable
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.func import grad

from torch_modal.nn.solver import GaussNewtonStep, Solution, Status, minimise


class Minimisation(NamedTuple):
    """What is minimised, and how far."""

    step: GaussNewtonStep
    placement: Callable[..., Any]
    """From the inputs to what the energy knows of each sample."""
    guess: Callable[..., Tensor | None]
    """Amplitudes to start from, from the inputs; None for zeros."""
    require: Callable[..., None]
    """Raises where the inputs have no solution."""
    n_unknowns: int
    max_steps: int
    tolerance: float
    least_gain: float
    report: Callable[[Solution], None] | None
    """Told how it went."""


class _ArgMin(torch.autograd.Function):
    r"""Amplitudes :math:`a^*(\theta)` at which :math:`\partial E / \partial a = 0`.

    Backward solves with the full Hessian: :math:`\bar\theta = -(\partial_\theta \partial_a E)^T H^{-1} \bar a`. With
    ``2 J^T J`` in its place the gradient is wrong wherever a residual remains at the optimum, and here much of it does.
    Only the solution is kept: memory does not grow with the number of steps. Samples that did not converge have no
    such gradient; theirs is zero.
    """

    @staticmethod
    def forward(minimisation: Minimisation, usable: Tensor, *inputs: Tensor) -> tuple[Tensor, ...]:
        minimisation.require(*inputs)
        placement = minimisation.placement(*inputs)
        start = inputs[0].new_zeros(len(inputs[0]), minimisation.n_unknowns)
        guess = minimisation.guess(*inputs)
        if guess is not None:
            # Never a start that is worse than linear interpolation: what comes out must not be, either.
            start, _ = minimisation.step.lowest(start, torch.stack([torch.zeros_like(guess), guess]), placement)
        limits = minimisation.max_steps, minimisation.tolerance, minimisation.least_gain
        solution = minimise(minimisation.step, start, placement, *limits)
        solution = solution._replace(status=torch.where(usable, solution.status, Status.INVALID))
        if minimisation.report is not None:
            minimisation.report(solution)
        return tuple(solution)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: tuple[Tensor, ...]) -> None:
        minimisation, _, *tensors = inputs
        amplitudes, *diagnostics = output
        ctx.mark_non_differentiable(*diagnostics)
        ctx.minimisation = minimisation
        ctx.save_for_backward(amplitudes, diagnostics[-1], *tensors)

    @staticmethod
    def backward(ctx: Any, grad_amplitudes: Tensor, *_: Tensor) -> tuple[Tensor | None, ...]:
        minimisation = ctx.minimisation
        amplitudes, status, *inputs = ctx.saved_tensors
        energy = minimisation.step.energy
        converged = status == Status.CONVERGED
        placement = minimisation.placement(*inputs)
        derivatives = energy.derivatives(amplitudes, placement, second_order=True)
        hessian = minimisation.step.ridged(derivatives.gauss_newton + derivatives.second_order)
        hessian = torch.where(converged[:, None, None], hessian, torch.eye(len(hessian[0])).to(hessian))
        adjoint = torch.linalg.solve(hessian, grad_amplitudes)
        adjoint = torch.where(converged[:, None], adjoint, 0)

        wanted = [i for i, needed in enumerate(ctx.needs_input_grad[2:]) if needed]

        to_placement = _tensors(energy.pull_back(amplitudes, adjoint, placement))

        def slope(*variables: Tensor) -> Tensor:
            """The energy's slope along the adjoint, of all samples, up to what does not change with the inputs."""
            changed = list(inputs)
            for i, variable in zip(wanted, variables, strict=True):
                changed[i] = variable
            moved = _tensors(minimisation.placement(*changed))
            return sum((g * value).sum() for g, value in zip(to_placement, moved, strict=True))  # type: ignore

        grads: list[Tensor | None] = [None] * len(inputs)
        if wanted:
            found = grad(slope, argnums=tuple(range(len(wanted))))(*(inputs[i] for i in wanted))
            for i, value in zip(wanted, found, strict=True):
                grads[i] = -torch.where(converged.reshape(-1, *[1] * (value.dim() - 1)), value, 0)
        return (None, None, *grads)

    @staticmethod
    def vmap(
        info: Any, in_dims: tuple[Any, ...], minimisation: Minimisation, *tensors: Tensor
    ) -> tuple[tuple[Tensor, ...], tuple[int, ...]]:
        n = info.batch_size
        flat = []
        for tensor, dim in zip(tensors, in_dims[1:], strict=True):
            batched = tensor.expand(n, *tensor.shape) if dim is None else tensor.movedim(dim, 0)
            flat.append(batched.flatten(0, 1))
        output = _ArgMin.apply(minimisation, *flat)  # usable is the first of them
        return tuple(value.unflatten(0, (n, -1)) for value in output), (0,) * len(output)


def _tensors(tree: Any) -> list[Tensor]:
    """The tensors in nested tuples and lists, in order."""
    if isinstance(tree, Tensor):
        return [tree]
    return [tensor for part in tree or () for tensor in _tensors(part)]


def solve_implicit(minimisation: Minimisation, usable: Tensor, inputs: tuple[Tensor, ...]) -> Solution:
    """Minimise; gradients of the amplitudes by the implicit function theorem.

    Args:
        minimisation: What is minimised.
        usable: False for samples whose status is ``INVALID`` whatever comes out. *Shape:* ``(B,)``.
        inputs: What the energy depends on. *Shape of each:* ``(B, ...)``.
    """
    return Solution(*_ArgMin.apply(minimisation, usable, *inputs))


def solve_unrolled(minimisation: Minimisation, usable: Tensor, inputs: tuple[Tensor, ...]) -> Solution:
    """Take exactly ``max_steps`` steps; gradients flow back through all of them.

    Nothing here depends on data but what is computed: no early end, no report, no choice of where to start.

    Args:
        minimisation: What is minimised.
        usable: False for samples whose status is ``INVALID`` whatever comes out. *Shape:* ``(B,)``.
        inputs: What the energy depends on. *Shape of each:* ``(B, ...)``.
    """
    step = minimisation.step
    placement = minimisation.placement(*inputs)
    a = inputs[0].new_zeros(len(inputs[0]), minimisation.n_unknowns)
    start = None
    for _ in range(minimisation.max_steps):
        taken = step(a, placement)
        start = taken.gradient_norm if start is None else start
        a = taken.amplitudes
    derivatives = step.energy.derivatives(a, placement, second_order=False)
    norm = derivatives.gradient.norm(dim=-1)
    start = norm if start is None else start
    status = torch.where(
        norm <= torch.maximum(minimisation.tolerance * start, step.floor(derivatives)),
        Status.CONVERGED,
        Status.OUT_OF_STEPS,
    )
    status = torch.where(usable & norm.isfinite(), status, Status.INVALID)
    relative = norm / start.clamp_min(torch.finfo(start.dtype).tiny)
    steps = torch.full_like(status, minimisation.max_steps)
    return Solution(a, step.energy.value(a, placement), relative.detach(), steps, status)
