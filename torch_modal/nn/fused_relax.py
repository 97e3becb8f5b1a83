"""The local steps by kernels of NVIDIA Warp, where that is installed; torch's are what they are tested against."""

from collections.abc import Sequence
from functools import partial
from typing import Any

import torch
from torch import Tensor

from torch_modal.geometry.functions import applied, traced
from torch_modal.nn.adjoint import flattened
from torch_modal.nn.fused_shell import FusedShell, ShellPoint, ShellReference
from torch_modal.nn.launch import kernels, launch, pulled_back
from torch_modal.nn.relax import STEP_LENGTHS, conjugate_gradients, inverse_of_symmetric, relax


class FusedRelax(FusedShell):
    """:func:`torch_modal.nn.relax.relax` towards two rest shapes, for the terms of Eq. 5 alone.

    It computes in float64, whatever comes in.
    """

    def forward(
        self,
        x: Tensor,
        first: Tensor,
        second: Tensor,
        t: Tensor,
        stiffness: Sequence[Tensor],
        n_steps: int,
        n_products: int,
        chunk: int,
    ) -> Tensor:
        """Steps of all vertices.

        Args:
            x: Where to start. *Shape:* ``(B, V, 3)``.
            first: Rest shapes of the weight ``1 - t``. *Shape:* ``(B, V, 3)``.
            second: Rest shapes of the weight ``t``. *Shape:* ``(B, V, 3)``.
            t: *Shape:* ``(B,)``.
            stiffness: Of each term. *Shape of each:* ``(B, M)`` or ``(B, 1)``.
            n_steps: Newton steps.
            n_products: Iterations of conjugate gradients in each.
            chunk: Samples at a time: more do not fit into caches.

        Returns:
            *Shape:* ``(B, V, 3)``.
        """
        if not n_steps:
            return x
        if traced(x):
            return self.oracle(n_steps, n_products, x, first, second, t, *stiffness)
        given = [value.double() for value in (x, first, second, t, *stiffness)]
        parts = [
            applied(_Relaxed, self, n_steps, n_products, *(value[i : i + chunk] for value in given))[0]
            for i in range(0, len(x), chunk)
        ]
        return torch.cat(parts).to(x)

    def oracle(self, n_steps: int, n_products: int, x: Tensor, first: Tensor, second: Tensor, *rest: Tensor) -> Tensor:
        """The same by torch."""
        t, *stiffness = rest
        one, other = (self.energy.rest(self.energy.extend(x.movedim(-1, 0).contiguous())) for x in (first, second))
        return relax(self.energy, x, self.energy.between(one, other, t, stiffness), n_steps, n_products)

    # -------------------------------------------------------------------------------------------------------- the steps
    def steps(self, n_steps: int, n_products: int, x: Tensor, *rest: Tensor) -> tuple[Tensor, Tensor]:
        """The steps, and the length of each: nothing is recorded. *Shape:* ``(B, V, 3), (n_steps, B)``."""
        to = self.reference(*rest)
        lengths = x.new_zeros(n_steps, len(x))
        at = self.at(x, to)
        for k in range(n_steps):
            solution, reached = self._solved(x, at, to, n_products)
            # The whole step, linearised at once for the next one, is nearly always the one that is taken.
            if k < n_steps - 1:
                there = self.at(reached, to)
                energy = there[0]
            else:
                there, energy = None, self.value(reached, to)
            length = torch.where(energy < at[0], 1.0, 0.0).to(x)
            if not bool(length.all()):
                length = self._shortened(x, solution, at[0], length, to)
                reached = x + length[:, None, None] * solution
                there = self.at(reached, to) if k < n_steps - 1 else None
            x, lengths[k] = reached, length
            at = at if there is None else there
        return x, lengths

    def _shortened(self, x: Tensor, solution: Tensor, before: Tensor, length: Tensor, to: ShellReference) -> Tensor:
        for shorter in STEP_LENGTHS[1:]:
            downhill = (length == 0) & (self.value(x + shorter * solution, to) < before)
            length = torch.where(downhill, shorter, length)
            if bool(length.all()):
                break
        return length

    def _solved(self, x: Tensor, at: ShellPoint, to: ShellReference, n_products: int) -> tuple[Tensor, Tensor]:
        """Conjugate gradients, fused. *Shape:* ``(B, V, 3)`` each: the step, and where it leads."""
        module, (b, n) = kernels("steps"), x.shape[:2]
        _, gradient, diagonal, edges, hinges, normal, moment = at
        residual, direction, solution, product, reached = torch.empty(5, *x.shape, dtype=x.dtype, device=x.device)
        size, swept, form = torch.zeros(3, n_products + 1, b, dtype=x.dtype, device=x.device)
        vertices, records = (b, n), (b, len(self.record))
        given = [gradient, normal, moment, diagonal, n, residual, direction, solution, product, size[0], swept[0]]
        launch(module.begin, vertices, given)
        for k in range(n_products):
            launch(kernels("shell").product, records, [direction, self.record, edges, hinges, n, product, form[k]])
            if k == n_products - 1:
                given = [x, direction, to.stiffness, swept[k], size[k], form[k], n, solution, reached]
                launch(module.arrive, vertices, given)
                break
            given = [direction, product, normal, diagonal, to.stiffness, swept[k], size[k], form[k], n]
            launch(module.advance, vertices, [*given, solution, residual, size[k + 1]])
            given = [residual, diagonal, normal, size[k], size[k + 1], n, direction, product, swept[k + 1]]
            launch(module.turn, vertices, given)
        return solution, reached

    def recorded(self, n_products: int, lengths: Tensor, x: Tensor, *rest: Tensor) -> Tensor:
        """The same steps of known lengths, by kernels that autograd can go back through. *Shape:* ``(B, V, 3)``."""
        to = self.reference(*rest)
        for length in lengths:
            at = self.at(x, to)
            right = -(at.gradient + at.moment[:, None, None] * at.normal)
            product, precondition = partial(self._product, at, to), partial(_applied, _inverse(at.diagonal))
            solution = conjugate_gradients(product, precondition, _dot, right, n_products)
            x = x + length[:, None, None] * solution
        return x

    def _product(self, at: ShellPoint, to: ShellReference, field: Tensor) -> Tensor:
        """The convex Hessian times a field. *Shape:* ``(B, V, 3)``."""
        given = [field, self.record, at.edges, at.hinges, self.n_vertices, None, None]
        found, _ = self._run(kernels("shell").product, {5: tuple(field.shape), 6: (len(field),)}, given)
        return found + to.stiffness[:, None, None] * _dot(at.normal, field) * at.normal


def _dot(a: Tensor, b: Tensor) -> Tensor:
    """*Shape:* ``(B, V, 3), (B, V, 3) -> (B, 1, 1)``."""
    return (a * b).sum((1, 2))[:, None, None]


def _applied(inverse: Tensor, residual: Tensor) -> Tensor:
    """*Shape:* ``(B, V, 3, 3), (B, V, 3) -> (B, V, 3)``."""
    return (inverse @ residual[..., None]).squeeze(-1)


def _inverse(packed: Tensor) -> Tensor:
    """Inverses of symmetric matrices, as :func:`torch_modal.nn.relax.inverse_of_symmetric`. *Shape:* ``(..., 6)``."""
    xx, xy, xz, yy, yz, zz = packed.unbind(-1)
    rows = torch.stack([xx, xy, xz, xy, yy, yz, xz, yz, zz]).unflatten(0, (3, 3))
    return inverse_of_symmetric(rows).movedim((0, 1), (-2, -1))


class _Relaxed(torch.autograd.Function):
    """Fused steps. Backward takes them once more, recorded: nothing is kept in between but the input."""

    @staticmethod
    def forward(fused: FusedRelax, n_steps: int, n_products: int, *given: Tensor) -> tuple[Tensor, Tensor]:
        return fused.steps(n_steps, n_products, *(value.detach().contiguous() for value in given))

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: tuple[Tensor, Tensor]) -> None:
        ctx.fused, ctx.n_steps, ctx.n_products, *given = inputs
        ctx.mark_non_differentiable(output[1])
        ctx.save_for_backward(output[1], *given)

    @staticmethod
    def backward(ctx: Any, to_shape: Tensor, _: Tensor) -> tuple[Tensor | None, ...]:
        lengths, *given = ctx.saved_tensors
        if torch.is_grad_enabled():  # torch differentiates its own code once more
            run = partial(ctx.fused.oracle, ctx.n_steps, ctx.n_products)
        else:
            run = partial(ctx.fused.recorded, ctx.n_products, lengths)
            given = [value.detach().contiguous() for value in given]
        return (None,) * 3 + pulled_back(run, given, to_shape, ctx.needs_input_grad[3:])

    @staticmethod
    def vmap(
        info: Any, in_dims: tuple[Any, ...], fused: FusedRelax, n_steps: int, n_products: int, *given: Tensor
    ) -> tuple[tuple[Tensor, Tensor], tuple[int, int]]:
        flat = flattened(info.batch_size, in_dims[3:], given)
        x, lengths = _Relaxed.apply(fused, n_steps, n_products, *flat)
        lengths = lengths.unflatten(1, (info.batch_size, -1))
        return (x.unflatten(0, (info.batch_size, -1)), lengths), (0, 1)
