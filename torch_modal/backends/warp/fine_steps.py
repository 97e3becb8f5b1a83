"""The local steps by Warp kernels, tested against those in torch."""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torch_modal.autograd import applied, flattened, pushed, recorded, traced
from torch_modal.backends.torch.fine_steps import FurtherDerivatives, FurtherEnergy, relax, step_length
from torch_modal.backends.warp.launch import kernels, launch
from torch_modal.backends.warp.shell import ShellPoint, ShellReference, WarpShell


class WarpSteps(WarpShell):
    """:func:`torch_modal.backends.torch.fine_steps.relax` towards two rest shapes, for the terms of Eq. 5 alone.

    It computes in float64, whatever comes in.
    """

    def forward(self, x: Tensor, to: ShellReference, n_steps: int, n_products: int) -> Tensor:
        """Steps of all vertices.

        Args:
            x: Initial shapes. *Shape:* ``(B, V, 3)``.
            to: The reference.
            n_steps: Newton steps.
            n_products: Iterations of conjugate gradients in each.

        Returns:
            *Shape:* ``(B, V, 3)``.
        """
        if not n_steps:
            return x
        if traced(x):
            return self.oracle(n_steps, n_products, x, *to)
        given = [value.double() for value in (x, *to)]
        keep = torch.is_grad_enabled() and any(value.requires_grad for value in given)
        return applied(_Relaxed, self, n_steps, n_products, [] if keep else None, *given)[0].to(x)

    def _referred(self, rest: Sequence[Tensor]) -> ShellReference:
        """The reference of what :meth:`reference` takes, or that is one."""
        return ShellReference(*rest) if len(rest) == len(ShellReference._fields) else self.reference(*rest)

    def oracle(self, n_steps: int, n_products: int, x: Tensor, *rest: Tensor) -> Tensor:
        """The same by torch."""
        if len(rest) == len(ShellReference._fields):
            return relax(self.energy, x, self.unpacked(ShellReference(*rest)), n_steps, n_products)
        first, second, t, *stiffness = rest
        one, other = (self.energy.rest_of(x) for x in (first, second))
        reference = self.energy.among((one, other), torch.stack([1 - t, t], -1), stiffness)
        return relax(self.energy, x, reference, n_steps, n_products)

    # -------------------------------------------------------------------------------------------------------- the steps
    @torch.no_grad()
    def descend(
        self, x: Tensor, to: ShellReference, others: Sequence["FurtherEnergy"], n_steps: int, n_products: int
    ) -> Tensor:
        """Steps of all vertices with other energies beside Eq. 5; they have no gradient.

        Args:
            x: Where to start, float64. *Shape:* ``(B, V, 3)``.
            to: What Eq. 5 compares with.
            others: The other energies.
            n_steps: Newton steps.
            n_products: Iterations of conjugate gradients in each.

        Returns:
            *Shape:* ``(B, V, 3)``.
        """

        def value(x: Tensor) -> Tensor:
            return sum((other.value(x) for other in others), start=self.value(x, to))

        for _ in range(n_steps):
            at, more = self.at(x, to), [other.at(x) for other in others]
            before = sum((one.value for one in more), start=at.energy)
            for one in more:
                at.gradient.add_(one.gradient)
                at.diagonal.add_(one.diagonal)

            def beyond(direction: Tensor, product: Tensor, form: Tensor, more: list[FurtherDerivatives] = more) -> None:
                for one in more:
                    pushed = one.product(direction)
                    product.add_(pushed)
                    form.add_((pushed * direction).sum((1, 2)))

            solution = self.solved(x, at, to, n_products, beyond=beyond).solution
            length = step_length(before, _slope(at, solution), value(x + solution), solution.abs().amax((1, 2)))
            x = x + length[:, None, None] * solution
        return x

    def steps(
        self, n_steps: int, n_products: int, x: Tensor, *rest: Tensor, kept: "list[_Taken] | None" = None
    ) -> tuple[Tensor, Tensor]:
        """The steps, and the length of each: nothing is recorded. *Shape:* ``(B, V, 3), (n_steps, B)``.

        Args:
            n_steps: How many.
            n_products: Of each.
            x: Where they start. *Shape:* ``(B, V, 3)``.
            rest: What :meth:`reference` takes, or a :class:`ShellReference`.
            kept: Receives what the way back needs.
        """
        to = self._referred(rest)
        lengths = x.new_ones(n_steps, len(x))
        at = self.at(x, to)
        for k in range(n_steps):
            done = self.solved(x, at, to, n_products, keep=kept is not None)
            solution, reached = done.solution, done.reached
            if kept is not None:
                # Detached: the last one's is what is returned, which must not be kept by its own node.
                kept.append(_Taken(x, to, at, done._replace(reached=reached.detach())))
            # The whole step, linearised at once for the next one, is nearly always the one that is taken.
            if k < n_steps - 1:
                there = self.at(reached, to)
                energy = there[0]
            else:
                there, energy = None, self.value(reached, to)
            length = lengths[k] = step_length(at.energy, _slope(at, solution), energy, solution.abs().amax((1, 2)))
            if bool((length < 1).any()):
                reached = x + length[:, None, None] * solution
                there = self.at(reached, to) if k < n_steps - 1 else None
            x = reached
            at = at if there is None else there
        return x, lengths

    def solved(
        self,
        x: Tensor,
        at: ShellPoint,
        to: ShellReference,
        n_products: int,
        keep: bool = False,
        beyond: Callable[[Tensor, Tensor, Tensor], None] | None = None,
    ) -> "_Iterations":
        """Conjugate gradients, fused.

        Args:
            x: Where the step starts. *Shape:* ``(B, V, 3)``.
            at: The energy there; its diagonal is inverted in place.
            to: What is compared with.
            n_products: Iterations.
            keep: Whether each iteration has memory of its own.
            beyond: Adds what there is beyond Eq. 5, of a direction, to its product and the form of both, whose shapes
                are ``(B, V, 3)`` and ``(B,)``.
        """
        module, (b, n) = kernels("steps"), x.shape[:2]
        _, gradient, diagonal, edges, hinges, normal, moment = at
        n_kept = n_products if keep else 1
        kept = torch.empty(3, n_kept, *x.shape, dtype=x.dtype, device=x.device)
        residuals, directions, products = (part.unbind() if keep else [part[0]] * n_products for part in kept)
        solution, reached = torch.empty_like(x), torch.empty_like(x)  # no views, of which forward mode has no tangents
        sizes, swept, forms = scalars = torch.zeros(3, n_products + 1, b, dtype=x.dtype, device=x.device)
        size, sweep, form = (part.unbind() for part in (sizes, swept, forms))
        vertices, records = (b, n), (b, len(self.record))
        given = [gradient, normal, moment, diagonal, n, residuals[0], directions[0], solution, products[0]]
        launch(module.begin, vertices, [*given, size[0], sweep[0]])
        for k in range(n_products):
            direction, product = directions[k], products[k]
            launch(kernels("shell").product, records, [direction, self.record, edges, hinges, n, product, form[k]])
            if beyond is not None:
                beyond(direction, product, form[k])
            if k == n_products - 1:
                given = [x, direction, to.stiffness, sweep[k], size[k], form[k], n, solution, reached]
                launch(module.arrive, vertices, given)
                break
            given = [direction, product, normal, diagonal, to.stiffness, sweep[k], size[k], form[k], n, residuals[k]]
            launch(module.advance, vertices, [*given, solution, residuals[k + 1], size[k + 1]])
            given = [residuals[k + 1], diagonal, normal, size[k], size[k + 1], n, direction, directions[k + 1]]
            launch(module.turn, vertices, [*given, products[k + 1], sweep[k + 1]])
        return _Iterations(solution, reached, kept, scalars)

    # -------------------------------------------------------------------------------------------------- and back again
    def pull_back(
        self,
        n_products: int,
        lengths: Tensor,
        to_x: Tensor,
        x: Tensor,
        *rest: Tensor,
        needed: Sequence[bool],
        kept: "list[_Taken]",
    ) -> tuple[Tensor | None, ...]:
        """Gradients in all that :meth:`steps` takes, of steps of known lengths.

        Args:
            n_products: Of each step.
            lengths: *Shape:* ``(n_steps, B)``.
            to_x: Gradient in the result. *Shape:* ``(B, V, 3)``.
            x: Where the steps started. *Shape:* ``(B, V, 3)``.
            rest: As for :meth:`steps`.
            needed: Which of all these need a gradient.
            kept: What :meth:`steps` kept; if nothing, they are taken once more.
        """
        to = kept[0].to if kept else self._referred(rest)
        for length in [] if kept else lengths:
            at = self.at(x, to)
            kept = [*kept, _Taken(x, to, at, self.solved(x, at, to, n_products, keep=True))]
            x = x + length[:, None, None] * kept[-1].done.solution
        to_reference = ShellReference(*(torch.zeros_like(value) for value in to))
        for length, taken in zip(lengths.flip(0), reversed(kept), strict=True):
            to_x = self._step_back(taken, to_x, length, to_reference)
        if len(rest) == len(ShellReference._fields):
            return to_x, *to_reference
        return to_x, *(self.from_reference(to_reference, *rest) if any(needed[1:]) else [None] * len(rest))

    def _step_back(
        self,
        taken: "_Taken",
        to_reached: Tensor,
        length: Tensor,
        to_reference: ShellReference,
    ) -> Tensor:
        """The gradient at the start of a step from that at its end; the reference's is added to ``to_reference``."""
        x, to, at, done = taken
        module, shell, (b, n) = kernels("steps_adjoint"), kernels("shell"), x.shape[:2]
        vertices, records = (b, n), (b, len(self.record))
        residuals, directions, products = (part.unbind() for part in done.kept)
        size, sweep, form = (part.unbind() for part in done.scalars)
        n_products = len(directions)
        fields = torch.empty_like(done.kept[0])
        to_solution = (length[:, None, None] * to_reached).contiguous()
        to_residual, to_direction, to_normal = torch.zeros(3, *x.shape, dtype=x.dtype, device=x.device)
        to_diagonal = torch.zeros_like(at.diagonal)
        backs = torch.zeros(3, n_products, b, dtype=x.dtype, device=x.device)
        to_length, to_ratio, to_sweep = (part.unbind() for part in backs)
        normal, inverse, stiffness = at.normal, at.diagonal, to.stiffness
        launch(module.back_to_length, vertices, [to_solution, directions[-1], n, to_length[-1]])
        for k in reversed(range(n_products)):
            direction, field, last = directions[k], fields[k], k == n_products - 1
            next_size, to_next_ratio = (None, None) if last else (size[k + 1], to_ratio[k])
            before = (directions[k - 1], products[k - 1], sweep[k - 1], size[k - 1]) if k else [None] * 4
            previous, previous_product, previous_sweep, previous_size = before
            to_own_ratio, to_previous_length = (to_ratio[k - 1], to_length[k - 1]) if k else (None, None)
            given = [to_solution, to_residual, direction, products[k], normal, stiffness, sweep[k], size[k], form[k]]
            given += [next_size, to_length[k], n, field, to_direction, to_sweep[k]]
            launch(module.back_to_direction, vertices, given)
            given = [field, self.record, at.edges, at.hinges, n, to_direction, None]
            launch(shell.product, records, given)
            given = [direction, previous, field, normal, stiffness, sweep[k], to_sweep[k], n, to_direction, to_normal]
            launch(module.back_to_normal, vertices, [*given, to_own_ratio])
            given = [to_solution, to_direction, residuals[k], inverse, previous, previous_product, normal, stiffness]
            given += [previous_sweep, sweep[k], previous_size, size[k], next_size, form[k], to_length[k]]
            given += [to_own_ratio, to_next_ratio, n, to_residual, to_diagonal, to_previous_length]
            launch(module.back_to_residual, vertices, given)
        to_edges, to_hinges = torch.empty_like(at.edges), torch.empty_like(at.hinges)
        given = [done.kept[1], fields, self.record, at.edges, at.hinges, n, b, n_products, to_edges, to_hinges]
        launch(module.back_to_elements, records, given)
        to_x = to_reached.clone()
        # The right side is the gradient's opposite.
        others = to_diagonal, to_edges, to_hinges
        self.from_point(x, at, to, -to_residual, to_x, to_reference, others, to_normal)
        to_reference.stiffness.add_((done.scalars[1, :-1] * backs[2]).sum(0))
        return to_x


def _slope(at: ShellPoint, direction: Tensor) -> Tensor:
    """Derivative of the energy along a direction. *Shape:* ``(B, V, 3) -> (B,)``."""
    return (at.gradient * direction).sum((1, 2)) + at.moment * (at.normal * direction).sum((1, 2))


class _Iterations(NamedTuple):
    """The iterations of conjugate gradients."""

    solution: Tensor
    """*Shape:* ``(B, V, 3)``."""
    reached: Tensor
    """Where the whole step leads. *Shape:* ``(B, V, 3)``."""
    kept: Tensor
    """Residuals, directions, and the Hessian's products with these but for the volume's part; of the last iteration
    alone where they are not kept.

    *Shape:* ``(3, n_products, B, V, 3)``.
    """
    scalars: Tensor
    """Of each iteration: inner products of residuals, volumes swept, inner products of directions with products but
    for the volume's part.

    *Shape:* ``(3, n_products + 1, B)``.
    """


class _Taken(NamedTuple):
    """A step."""

    x: Tensor
    """Where it started. *Shape:* ``(B, V, 3)``."""
    to: ShellReference
    """The reference."""
    at: ShellPoint
    """The energy there, its diagonal inverted."""
    done: _Iterations


class _Relaxed(torch.autograd.Function):
    """Fused steps. Where they are not kept (None), backward takes them once more."""

    @staticmethod
    def forward(
        fused: WarpSteps, n_steps: int, n_products: int, kept: list[_Taken] | None, *given: Tensor
    ) -> tuple[Tensor, Tensor]:
        return fused.steps(n_steps, n_products, *(value.detach().contiguous() for value in given), kept=kept)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: tuple[Tensor, Tensor]) -> None:
        ctx.fused, ctx.n_steps, ctx.n_products, ctx.kept, *given = inputs
        ctx.mark_non_differentiable(output[1])
        ctx.save_for_backward(output[1], *given)
        ctx.save_for_forward(output[1], *given)

    @staticmethod
    def jvp(ctx: Any, *tangents: Tensor | None) -> tuple[Tensor, None]:
        _, *given = ctx.saved_tensors
        return pushed(partial(ctx.fused.oracle, ctx.n_steps, ctx.n_products), given, tangents[4:]), None

    @staticmethod
    def backward(ctx: Any, to_shape: Tensor, _: Tensor) -> tuple[Tensor | None, ...]:
        lengths, *given = ctx.saved_tensors
        # What is differentiated once more, and the lengths of steps that were shortened, are torch's.
        if recorded(to_shape, *given) or bool((lengths < 1).any()):
            run = partial(ctx.fused.oracle, ctx.n_steps, ctx.n_products)
            return (None,) * 4 + torch.func.vjp(run, *given)[1](to_shape)
        given = [lengths, to_shape.contiguous(), *(value.detach().contiguous() for value in given)]
        return (None,) * 4 + ctx.fused.pull_back(
            ctx.n_products, *given, needed=ctx.needs_input_grad[4:], kept=ctx.kept or []
        )

    @staticmethod
    def vmap(
        info: Any, in_dims: tuple[Any, ...], fused: WarpSteps, n_steps: int, n_products: int, kept: Any, *given: Tensor
    ) -> tuple[tuple[Tensor, Tensor], tuple[int, int]]:
        flat = flattened(info.batch_size, in_dims[4:], given)
        x, lengths = _Relaxed.apply(fused, n_steps, n_products, None, *flat)
        lengths = lengths.unflatten(1, (info.batch_size, -1))
        return (x.unflatten(0, (info.batch_size, -1)), lengths), (0, 1)
