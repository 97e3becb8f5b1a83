"""Steps of all vertices by Warp kernels, tested against those in torch."""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torch_modal.autograd import plain
from torch_modal.elastic.energy import Energy, Reference, RestShapes
from torch_modal.elastic.kernels.function import fused
from torch_modal.elastic.kernels.launch import kernels, launch
from torch_modal.elastic.shell import N_SHELL_TERMS
from torch_modal.elastic.steps import FineEnergy, FurtherEnergy, FurtherTerms, relax, step_length
from torch_modal.elastic.term import Mesh, Term
from torch_modal.elastic.warp_shell import ShellPoint, ShellReference, WarpShell


class WarpFineEnergy(FineEnergy):
    """:class:`FineEnergy` whose terms of Eq. 5 are those of kernels; further ones, and contacts, are torch's."""

    def __init__(self, mesh: Mesh, terms: Sequence[Term]) -> None:
        super().__init__(mesh, terms)
        shell, others = terms[:N_SHELL_TERMS], terms[N_SHELL_TERMS:]
        self.shell = Energy(mesh, shell) if others else self.energy
        self.further = Energy(mesh, others) if others else None
        self.steps = WarpSteps(self.shell, mesh)

    def relax_chunk(
        self, x: Tensor, rests: RestShapes, stages: Sequence[tuple[int, int]], beside: Sequence[FurtherEnergy]
    ) -> Tensor:
        """Overrides the base class. With further terms or energies, gradients are left to torch."""
        alone = self.further is None and not beside
        if not alone and ((torch.is_grad_enabled() and x.requires_grad) or not plain(x)):
            return super().relax_chunk(x, rests, stages, beside)
        others = [*beside, *([] if self.further is None else [FurtherTerms(self.further, rests)])]
        to, moved = self.steps.reference(rests, x, relative=True), x
        for n_steps, n_products in stages:
            if alone:
                moved = self.steps(moved, to, n_steps, n_products)
            else:
                moved = self.steps.descend(moved.double().contiguous(), to, others, n_steps, n_products)
        return moved.to(x)

    def towards(
        self, x: Tensor, reference: Reference, n_steps: int, n_products: int, beside: Sequence[FurtherEnergy] = ()
    ) -> Tensor:
        """Overrides the base class. Gradients are left to torch."""
        gradient = torch.is_grad_enabled() and x.requires_grad
        if self.further is not None or gradient or not plain(x):
            return super().towards(x, reference, n_steps, n_products, beside)
        to = self.steps.packed(reference)
        return self.steps.descend(x.double().contiguous(), to, list(beside), n_steps, n_products).to(x)


class WarpSteps(WarpShell):
    """:func:`torch_modal.elastic.steps.relax` for the terms of Eq. 5 alone, in float64."""

    def forward(self, x: Tensor, to: ShellReference, n_steps: int, n_products: int) -> Tensor:
        """Steps of all vertices: some Newton steps, with some conjugate gradients in each. *Shape:* ``(B, V, 3)``."""
        return fused(_Relaxed(self, n_steps, n_products), x, *to[:3])[0].to(x) if n_steps else x

    @torch.no_grad()
    def descend(
        self, x: Tensor, to: ShellReference, others: Sequence[FurtherEnergy], n_steps: int, n_products: int
    ) -> Tensor:
        """Steps with other energies beside Eq. 5, without gradient. Arguments as for :meth:`forward`, in float64."""
        for _ in range(n_steps):
            at, more = self.at(x, to), [other.at(x) for other in others]
            before = sum((one.value for one in more), start=at.energy)
            for one in more:
                at.gradient.add_(one.gradient)
                at.diagonal.add_(one.diagonal)
            solution = self.solved(x, at, to, n_products, beside=[one.product for one in more])[0]
            after = sum((other.value(x + solution) for other in others), start=self.value(x + solution, to))
            length = step_length(before, _slope(at, solution), after, solution.abs().amax((1, 2)))
            x = x + length[:, None, None] * solution
        return x

    def steps(
        self, x: Tensor, to: ShellReference, n_steps: int, n_products: int, taken: "list[_Taken] | None" = None
    ) -> Tensor:
        """The steps, of which nothing is recorded. Those that are taken go to the list. *Shape:* ``(B, V, 3)``."""
        at = self.at(x, to)
        for k in range(n_steps):
            solution, *kept = self.solved(x, at, to, n_products, keep=taken is not None)
            reached = x + solution
            # The whole step, linearised at once for the next one, is nearly always the one that is taken.
            there = self.at(reached, to) if k < n_steps - 1 else None
            energy = self.value(reached, to) if there is None else there.energy
            length = step_length(at.energy, _slope(at, solution), energy, solution.abs().amax((1, 2)))
            if taken is not None:
                taken.append(_Taken(x, at, solution, length, *kept))
            if bool((length < 1).any()):
                reached = x + length[:, None, None] * solution
                there = None if there is None else self.at(reached, to)
            x, at = reached, at if there is None else there
        return x

    def solved(
        self,
        x: Tensor,
        at: ShellPoint,
        to: ShellReference,
        n_products: int,
        keep: bool = False,
        beside: Sequence[Callable[[Tensor], Tensor]] = (),
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Conjugate gradients, fused.

        Args:
            x: Where the step starts. *Shape:* ``(B, V, 3)``.
            at: The energy there; its diagonal is inverted in place.
            to: The reference.
            n_products: Iterations.
            keep: Whether each iteration has memory of its own.
            beside: Further products with directions. *Shape of each:* ``(B, V, 3) -> (B, V, 3)``.

        Returns:
            The solution, *shape* ``(B, V, 3)``; residuals, directions, and the Hessian's products with these but for
            the volume's part, of the last iteration alone where they are not kept, *shape* ``(3, n_products, B, V,
            3)``; three scalars of each iteration (``kernels/steps.py``), *shape* ``(n_products + 1, B, 3)``.
        """
        module, (b, n), n_kept = kernels("steps"), x.shape[:2], n_products if keep else 1
        kept, scalars, solution = (
            x.new_empty(3, n_kept, *x.shape),
            x.new_zeros(n_products + 1, b, 3),
            torch.empty_like(x),
        )
        inverse, factors, results = at.diagonal, at.factors, [kept, scalars, solution]
        launch(module.begin, (b, n), [at.gradient, at.normal, at.moment, inverse, n_kept, n, *results])
        for k in range(n_products):
            first = k % n_kept * b * n
            given = [self.constants, kept, n_kept * b * n + first, factors, kept, 2 * n_kept * b * n + first]
            launch(kernels("shell").product, (b, self.n_edges), [*given, scalars, k * b])
            for one in beside:
                pushed = one(kept[1, k % n_kept])
                kept[2, k % n_kept].add_(pushed)
                scalars[k, :, 2].add_((pushed * kept[1, k % n_kept]).sum((1, 2)))
            launch(module.advance, (b, n), [at.normal, inverse, to.stiffness, k, n_kept, n, *results])
            if k < n_products - 1:
                launch(module.turn, (b, n), [at.normal, inverse, b, k, n_kept, n, *results[:2]])
        return solution, kept, scalars

    def step_back(self, step: "_Taken", to: ShellReference, to_reached: Tensor, to_reference: ShellReference) -> Tensor:
        """The gradient at the start of a step from that at its end; the reference's is added.

        Args:
            step: The step.
            to: The reference.
            to_reached: Gradient in the shapes at the end. *Shape:* ``(B, V, 3)``.
            to_reference: Is added to.
        """
        x, at, solution, length, kept, scalars = step
        to_x, to_solution, to_energy, to_slope = to_reached.clone(), to_reached, None, None
        if bool((length < 1).any()):
            to_solution, to_energy, to_slope = self._length_back(step, to, to_x, to_reference)
        module, (b, n), n_products = kernels("steps"), x.shape[:2], kept.shape[1]
        force, (residual, direction, to_volume) = torch.empty_like(kept[0]), x.new_zeros(3, *x.shape)
        to_diagonal, received = torch.zeros_like(at.diagonal), x.new_zeros(n_products, b, 3)
        launch(module.inner, (b, n), [to_solution, kept[1, -1], n, received[-1]])
        for k in reversed(range(n_products)):
            common = [at.normal, to.stiffness, k, n_products, n, kept, scalars]
            given = [*common, to_solution, residual, force, direction, received]
            launch(module.back_to_direction, (b, n), given)
            given = [self.constants, force, k * b * n, at.factors, direction, 0, None, 0]
            launch(kernels("shell").product, (b, self.n_edges), given)
            launch(module.back_to_normal, (b, n), [*common, force, direction, to_volume, received])
            given = [*common, at.diagonal, to_solution, direction, residual, to_diagonal, received]
            launch(module.back_to_residual, (b, n), given)
        to_factors = torch.empty_like(at.factors)
        given = [self.constants, kept, force, at.factors, b, n_products, to_factors]
        launch(module.back_to_factors, (b, self.n_edges), given)
        # The right side is the gradient's opposite.
        to_gradient = -residual if to_slope is None else to_slope[:, None, None] * solution - residual
        others = to_diagonal, to_factors
        self.from_point(x, at, to, to_gradient, to_x, to_reference, others, to_volume, to_energy)
        to_reference.stiffness.add_((scalars[:-1, :, 1] * received[..., 2]).sum(0))
        return to_x

    def _length_back(
        self, step: "_Taken", to: ShellReference, to_x: Tensor, to_reference: ShellReference
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Gradients of the lengths of steps that were shortened: in the solution, the energy before, and the slope.

        Those through the energy after the whole step are added to the gradients in the shape, on entry those at the
        end of the step, and in the reference. *Shape:* ``(B, V, 3), (B,), (B,)``.
        """
        to_reached, at, whole = to_x.clone(), step.at, step.x + step.solution
        there = self.at(whole, to)
        with torch.enable_grad():
            given = step.solution, at.energy, there.energy, _slope(at, step.solution)
            solution, before, after, slope = leaves = [value.detach().requires_grad_() for value in given]
            along = slope + _slope(at, solution - step.solution)
            length = step_length(before, along, after, solution.abs().amax((1, 2)))
            taken = length[:, None, None] * solution
        to_solution, to_before, to_after, to_slope = torch.autograd.grad(taken, leaves, to_reached)
        nothing = torch.zeros_like(to_x)
        self.from_point(whole, there, to, nothing, to_x, to_reference, to_energy=to_after)
        return to_solution + (to_x - to_reached), to_before, to_slope


def _slope(at: ShellPoint, direction: Tensor) -> Tensor:
    """Derivative of the energy along a direction. *Shape:* ``(B, V, 3) -> (B,)``."""
    return (at.gradient * direction).sum((1, 2)) + at.moment * (at.normal * direction).sum((1, 2))


class _Taken(NamedTuple):
    """A step."""

    x: Tensor
    """Where it started. *Shape:* ``(B, V, 3)``."""
    at: ShellPoint
    """The energy there, its diagonal inverted."""
    solution: Tensor
    """The whole step. *Shape:* ``(B, V, 3)``."""
    length: Tensor
    """*Shape:* ``(B,)``."""
    kept: Tensor
    """Of :meth:`WarpSteps.solved`, of all iterations."""
    scalars: Tensor
    """Likewise."""


class _Relaxed:
    """Steps of all vertices from shapes, towards the tensors of a reference but for its constant."""

    n_results = n_differentiable = 1

    def __init__(self, shell: WarpSteps, n_steps: int, n_products: int) -> None:
        self.shell, self.n_steps, self.n_products = shell, n_steps, n_products

    def run(self, kept: list[Any] | None, x: Tensor, *to: Tensor) -> tuple[Tensor, ...]:
        """See :class:`~torch_modal.elastic.kernels.function.Operation`."""
        return (self.shell.steps(x, self._reference(*to), self.n_steps, self.n_products, kept),)

    def back(self, kept: list[Any], grads: Sequence[Tensor], x: Tensor, *to: Tensor) -> tuple[Tensor | None, ...]:
        """See :class:`~torch_modal.elastic.kernels.function.Operation`."""
        if not kept:
            self.run(kept, x, *to)
        to_x, reference = grads[0], self._reference(*to)
        to_reference = ShellReference(*map(torch.zeros_like, reference))
        for step in reversed(kept):
            to_x = self.shell.step_back(step, reference, to_x, to_reference)
        return to_x, *to_reference[:3]

    def by_torch(self, x: Tensor, *to: Tensor) -> tuple[Tensor, ...]:
        """See :class:`~torch_modal.elastic.kernels.function.Operation`."""
        reference = self.shell.unpacked(self._reference(*to))
        return (relax(self.shell.energy, x, reference, self.n_steps, self.n_products),)

    @staticmethod
    def _reference(elements: Tensor, stiffness: Tensor, volume: Tensor) -> ShellReference:
        return ShellReference(elements, stiffness, volume, torch.zeros_like(volume))
