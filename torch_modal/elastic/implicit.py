"""Gradients of a minimiser by the implicit function theorem."""

from collections.abc import Callable
from contextlib import suppress
from typing import Any, Protocol

import torch
from torch import Tensor

from torch_modal import trees
from torch_modal.autograd import (
    Context,
    InDims,
    VmapInfo,
    Vmapped,
    apply_function,
    apply_merged,
    apply_transpose,
    is_double_backward,
)
from torch_modal.elastic.gauss_newton import add_ridge
from torch_modal.elastic.minimise import Solution, Status, minimise
from torch_modal.elastic.modal import AmplitudeEnergy, Placed
from torch_modal.threads import warn

Inverse = Callable[..., Callable[[Tensor], Tensor]]
Limits = tuple[Callable[..., Solution], int, float, Inverse]
"""The method, its limits, and the inverse of the Hessian."""


class ImplicitEnergy(Protocol[Placed]):
    """An energy in amplitudes whose minimiser is differentiated."""

    @property
    def n_amplitudes(self) -> int:
        """Number of amplitudes, n."""

    def value_and_gradient(self, a: Tensor, placement: Placed) -> tuple[Tensor, Tensor]:
        """*Shape:* ``(B, n) -> (B,), (B, n)``."""


class ConvergenceWarning(UserWarning):
    """A minimisation stopped before its gradient vanished, or has no gradient where it stopped."""


class _ArgMin(torch.autograd.Function):
    r"""Amplitudes :math:`a^*(\theta)` at which :math:`\partial E / \partial a = 0`, for placements :math:`\theta`.

    Backward solves with the full Hessian: :math:`\bar\theta = -(\partial_\theta \partial_a E)^T H^{-1} \bar a`. Forward
    mode is its transpose. With ``2 J^T J`` in its place the gradient is wrong wherever a residual remains at the
    optimum, and here much of it does. Only the solution is kept: memory does not grow with the number of steps. Samples
    that did not converge have no such gradient; theirs is zero.
    """

    @staticmethod
    def forward(
        energy: ImplicitEnergy[Placed], limits: Limits, tree: object, usable: Tensor, *tensors: Tensor
    ) -> tuple[Tensor, ...]:
        method, max_steps, tolerance, _ = limits
        start = usable.new_zeros(len(usable), energy.n_amplitudes, dtype=tensors[0].dtype)
        solution = method(energy, start, trees.fill(tree, tensors), max_steps, tolerance)
        solution = solution._replace(status=torch.where(usable, solution.status, Status.INVALID))
        return tuple(value for value in solution if value is not None)

    @staticmethod
    def setup_context(ctx: Context, inputs: tuple[Any, ...], output: tuple[Tensor, ...]) -> None:
        ctx.energy, (*_, ctx.inverse), ctx.tree, _, *tensors = inputs
        amplitudes, *diagnostics = output
        ctx.mark_non_differentiable(*diagnostics)
        ctx.n_diagnostics = len(diagnostics)
        ctx.save_for_backward(amplitudes, diagnostics[-1], *tensors)
        ctx.save_for_forward(amplitudes, diagnostics[-1], *tensors)

    @staticmethod
    def jvp(ctx: Context, *tangents: Tensor | None) -> tuple[Tensor | None, ...]:
        amplitudes, _, *tensors = ctx.saved_tensors
        pull_back = _adjoint(ctx)
        moved = apply_transpose(pull_back, torch.zeros_like(amplitudes), tensors, tangents[4:])
        return moved, *(None,) * ctx.n_diagnostics

    @staticmethod
    def backward(ctx: Context, to_amplitudes: Tensor, *_: Tensor) -> tuple[Tensor | None, ...]:
        pull_back = _adjoint(ctx)
        return (None,) * 4 + pull_back(to_amplitudes)

    @staticmethod
    def vmap(
        info: VmapInfo, in_dims: InDims, energy: ImplicitEnergy[Placed], limits: Limits, tree: object, *x: Tensor
    ) -> Vmapped:
        return apply_merged(_ArgMin, (energy, limits, tree), info, in_dims, x)


def _adjoint(ctx: Context) -> Callable[[Tensor], tuple[Tensor, ...]]:
    """From gradients in the amplitudes, ``(B, n)``, to gradients in the tensors of the placement: linear."""
    energy, tree, (amplitudes, status, *tensors) = ctx.energy, ctx.tree, ctx.saved_tensors
    solve = ctx.inverse(energy, amplitudes, trees.fill(tree, tensors), status == Status.CONVERGED)

    def slope(*tensors: Tensor) -> Tensor:
        return energy.value_and_gradient(amplitudes, trees.fill(tree, tensors))[1]

    def pull_back(to_amplitudes: Tensor) -> tuple[Tensor, ...]:
        adjoint = solve(to_amplitudes)
        if is_double_backward(adjoint, *tensors):
            return tuple(torch.func.vjp(slope, *tensors)[1](-adjoint))
        with torch.enable_grad():  # by kernels, which the tensors of a transform would not reach
            leaves = [x.detach().requires_grad_() for x in tensors]
            return torch.autograd.grad(slope(*leaves), leaves, -adjoint, allow_unused=True, materialize_grads=True)

    return pull_back


class _Minimiser(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Context, minimiser: Tensor, points: Tensor, pull_back: Callable[[Tensor], Tensor]) -> Tensor:
        ctx.pull_back = pull_back
        return minimiser.clone()

    @staticmethod
    def backward(ctx: Context, grad: Tensor) -> tuple[None, Tensor, None]:
        if is_double_backward(grad):
            raise RuntimeError(
                "shapes that were found from points have first derivatives only; take the gradient without create_graph"
            )
        return None, ctx.pull_back(grad), None


def minimiser_of(points: Tensor, minimiser: Tensor, pull_back: Callable[[Tensor], Tensor]) -> Tensor:
    """A minimiser as a function of points, with first derivatives.

    Args:
        points: They may require a gradient. *Shape:* ``(n, 3)``.
        minimiser: A constant.
        pull_back: The gradient in the points, from the gradient in the minimiser, by the implicit function theorem.
    """
    return _Minimiser.apply(minimiser.detach(), points, pull_back)  # type: ignore[no-any-return]


def dense_inverse(
    energy: AmplitudeEnergy[Placed], amplitudes: Tensor, placement: Placed, converged: Tensor
) -> Callable[[Tensor], Tensor]:
    """Products with the inverse of the full Hessian; zero for samples that did not converge. *Shape:* ``(B, n)``."""
    hessian = add_ridge(energy.derivatives(amplitudes, placement).hessian)
    eye = torch.eye(hessian.shape[-1], dtype=hessian.dtype, device=hessian.device)
    matrix = torch.where(converged[:, None, None], hessian, eye)

    def solve(right: Tensor) -> Tensor:
        solution, info = torch.linalg.solve_ex(matrix, right)
        singular = (info != 0)[:, None]
        with suppress(RuntimeError):  # under vmap there is no number to see
            if number := int(singular.sum()):
                what = "the Hessian of {} in-betweens is singular: no gradient flows through their amplitudes"
                warn(what, number, ConvergenceWarning)
        return torch.where(converged[:, None] & ~singular, solution, 0)

    return solve


def solve_implicit(
    energy: ImplicitEnergy[Placed],
    placement: Placed,
    usable: Tensor,
    max_steps: int,
    tolerance: float,
    method: Callable[..., Solution] = minimise,
    inverse: Inverse = dense_inverse,
) -> Solution:
    """Minimise from zeros; gradients of the amplitudes by the implicit function theorem.

    Args:
        energy: The energy of the amplitudes, as the method and the inverse need it.
        placement: What the energy depends on: nested tuples of tensors. *Shape of each:* ``(B, ...)``.
        usable: False for samples whose status is ``INVALID`` whatever comes out. *Shape:* ``(B,)``.
        max_steps: Of :func:`~torch_modal.elastic.minimise.minimise`.
        tolerance: Likewise.
        method: Minimises, with the arguments of :func:`~torch_modal.elastic.minimise.minimise`.
        inverse: Gives products with the inverse of the Hessian, with the arguments of :func:`dense_inverse`.
    """
    limits, tree = (method, max_steps, tolerance, inverse), trees.skeleton(placement)
    return Solution(*apply_function(_ArgMin, energy, limits, tree, usable, *trees.leaves(placement)))
