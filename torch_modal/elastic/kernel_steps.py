"""Steps of all vertices by kernels, tested against those in torch."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torch_modal import trees
from torch_modal.autograd import is_eager
from torch_modal.elastic.energy import Energy, Reference, RestShapes
from torch_modal.elastic.kernel_energy import KernelEnergy, KernelPoint
from torch_modal.elastic.kernel_terms import by_kernels
from torch_modal.elastic.kernels.function import Operation
from torch_modal.elastic.kernels.launch import kernels, launch
from torch_modal.elastic.steps import (
    FineEnergy,
    FreeEnergy,
    Step,
    SumOfEnergies,
    TermsTowards,
    descend,
    step_length,
)
from torch_modal.elastic.term import Mesh, Term

KernelStep = Step[KernelPoint]


class KernelFineEnergy(FineEnergy):
    """:class:`FineEnergy` by kernels; torch computes terms without kernels, and contacts."""

    def __init__(self, mesh: Mesh, terms: Sequence[Term]) -> None:
        super().__init__(mesh, terms)
        parts = by_kernels(self.energy, mesh)
        #: Numbers of the terms that kernels serve, and of the others.
        self.own = [i for i, part in enumerate(parts) if part is not None]
        self.others = [i for i, part in enumerate(parts) if part is None]
        shell = Energy(mesh, [terms[i] for i in self.own]) if self.others else self.energy
        self.further = Energy(mesh, [terms[i] for i in self.others]) if self.others else None
        self.kernels = KernelEnergy(shell, [term for term in parts if term is not None])

    def relax_chunk(self, x: Tensor, rests: RestShapes, products: Sequence[int], extra: Sequence[FreeEnergy]) -> Tensor:
        """Overrides the base class. With further terms or energies, gradients are left to torch."""
        alone = self.further is None and not extra
        tensors = trees.leaves((x, *rests))  # the start may have no gradient where stiffnesses have one
        recorded = torch.is_grad_enabled() and any(value.requires_grad for value in tensors)
        if not (alone and self.kernels.exact) and (recorded or not is_eager(*tensors)):
            return super().relax_chunk(x, rests, products, extra)
        others = [*extra, *([] if self.further is None else [TermsTowards.of_terms(self.further, self.others, rests)])]
        to = self.kernels.reference(rests._replace(stiffness=[rests.stiffness[i] for i in self.own]), x, relative=True)
        if alone:
            return _Relaxation(self.kernels, products)(x, *to.records)[0].to(x)
        with torch.no_grad():
            return descend(KernelProblem(self.kernels, to, others), x.double().contiguous(), products).to(x)

    def descend_towards(
        self, x: Tensor, reference: Reference, products: Sequence[int], extra: Sequence[FreeEnergy] = ()
    ) -> Tensor:
        """Overrides the base class. Gradients are left to torch."""
        if self.further is not None or (torch.is_grad_enabled() and x.requires_grad) or not is_eager(x):
            return super().descend_towards(x, reference, products, extra)
        problem = KernelProblem(self.kernels, reference.transpose(), extra)
        return descend(problem, x.double().contiguous(), products).to(x)


@dataclass(frozen=True, eq=False)
class KernelProblem:
    """The terms towards a reference, for :func:`torch_modal.elastic.steps.descend`, in float64."""

    kernels: KernelEnergy
    to: Reference
    extra: Sequence[FreeEnergy] = ()

    def value(self, x: Tensor) -> Tensor:
        """*Shape:* ``(B, V, 3) -> (B,)``."""
        return sum((other.value(x) for other in self.extra), start=self.kernels.at(x, self.to, 0).value)

    def at(self, x: Tensor) -> KernelPoint:
        """*Shape:* ``(B, V, 3)``."""
        at = self.kernels.at(x, self.to)
        if not self.extra:
            return at
        others = SumOfEnergies(self.extra).at(x)
        at.gradient.add_(others.gradient)
        at.diagonal.add_(others.diagonal)
        return at._replace(value=at.value + others.value, extra=others.product)

    def newton_direction(self, at: KernelPoint, n_products: int, keep: bool = False) -> tuple[Tensor, ...]:
        """Conjugate gradients, fused.

        Args:
            at: The energy where the step starts.
            n_products: Iterations.
            keep: True to keep the fields of all iterations.

        Returns:
            The solution, *shape* ``(B, V, 3)``; residuals, directions, and the Hessian's products with these but for
            the volume's part, of the last iteration alone where they are not kept, *shape* ``(3, n_products, B, V,
            3)``; three scalars of each iteration (``kernels/steps.py``), *shape* ``(n_products + 1, B, 3)``; and the
            inverse of the diagonal, *shape* ``(B, V, 6)``.
        """
        (b, n), module = at.gradient.shape[:2], kernels("steps")
        n_kept = n_products if keep else 1
        solution, inverse = torch.zeros_like(at.gradient), torch.empty_like(at.diagonal)
        fields, scalars = at.gradient.new_empty(3, n_kept, b, n, 3), at.gradient.new_zeros(n_products + 1, b, 3)
        launch(module.begin, (b, n), [at.gradient, at.normal, at.diagonal, b, n_kept, n, inverse, fields, scalars])
        for k in range(n_products):
            first, out = ((kind * n_kept + k % n_kept) * b * n for kind in (1, 2))
            for one, factors in zip(self.kernels.passes, at.factors, strict=True):
                one.launch("product", b, n, fields, first, *factors, fields, out, scalars, k * b)
            if at.extra is not None:
                pushed = at.extra(fields[1, k % n_kept])
                fields[2, k % n_kept].add_(pushed)
                scalars[k, :, 2].add_((pushed * fields[1, k % n_kept]).sum((1, 2)))
            common = k, n_kept, n, fields, scalars
            launch(module.advance, (b, n), [at.normal, inverse, at.stiffness, *common, solution])
            if k < n_products - 1:
                launch(module.turn, (b, n), [at.normal, inverse, b, *common])
        return solution, fields, scalars, inverse


def _without_constant(records: Sequence[Tensor]) -> Reference:
    """Records as a reference."""
    return Reference(tuple(records), records[0].new_zeros(len(records[0])))


@dataclass(frozen=True, eq=False)
class _Relaxation(Operation[KernelStep]):
    """Steps of all vertices from shapes, towards the records of a reference."""

    kernels: KernelEnergy
    products: Sequence[int]

    def run(self, kept: list[KernelStep] | None, x: Tensor, *records: Tensor) -> tuple[Tensor, ...]:
        problem = KernelProblem(self.kernels, _without_constant(records))
        with torch.no_grad():
            return (descend(problem, x, self.products, kept),)

    def back(
        self, kept: list[KernelStep], grads: Sequence[Tensor], x: Tensor, *records: Tensor
    ) -> tuple[Tensor | None, ...]:
        if not kept:
            self.run(kept, x, *records)
        to_x, to, to_records = grads[0], _without_constant(records), [torch.zeros_like(record) for record in records]
        for step in reversed(kept):
            to_x = self._step_back(step, to, to_x, to_records)
        return to_x, *to_records

    def by_torch(self, x: Tensor, *records: Tensor) -> tuple[Tensor, ...]:
        terms = TermsTowards(self.kernels.energy, _without_constant(records).transpose())
        return (descend(SumOfEnergies([terms]), x, self.products),)

    def _step_back(self, step: KernelStep, to: Reference, to_reached: Tensor, to_records: Sequence[Tensor]) -> Tensor:
        """Gradient at the start of a step from the gradient at its end; gradients of the records are added.

        Args:
            step: What :func:`descend` adds to its list: the start, the energy there, the whole step, its length, and
                the further results of :meth:`KernelProblem.newton_direction`.
            to: The reference.
            to_reached: Gradient at the end. *Shape:* ``(B, V, 3)``.
            to_records: Are added to.
        """
        x, at, solution, length, (fields, scalars, inverse) = step
        to_x, to_solution, to_energy, to_slope = to_reached.clone(), to_reached, None, None
        if bool((length < 1).any()):
            to_solution, to_energy, to_slope = self._length_back(x, at, solution, to, to_x, to_records)
        module, (b, n), n_products = kernels("steps"), x.shape[:2], fields.shape[1]
        values = at.normal, inverse, at.stiffness, fields, scalars
        to_normal, to_inverse, to_stiffness, to_fields, to_scalars = map(torch.zeros_like, values)
        to_factors = [[x if x is None else torch.zeros_like(x) for x in factors] for factors in at.factors]
        for k in reversed(range(n_products)):
            common, received = (k, n_products, n, fields, scalars), (None, None, None, to_fields, to_scalars)
            if k < n_products - 1:
                turned = at.normal, inverse, b, *common
                launch(module.turn, (b, n), turned, [to_normal, to_inverse, None, *received])
            moved = at.normal, inverse, at.stiffness, *common, solution
            # A solution gives its gradient to the one before, which the adjoint of an update in place adds to it.
            to_moved = to_normal, to_inverse, to_stiffness, *received, to_solution.clone()
            launch(module.advance, (b, n), moved, to_moved)
            first, out = ((kind * n_products + k) * b * n for kind in (1, 2))
            for one, factors, to_own in zip(self.kernels.passes, at.factors, to_factors, strict=True):
                multiplied = n, fields, first, *factors, fields, out, scalars, k * b
                adjoints = None, to_fields, None, *to_own, to_fields, None, to_scalars
                one.launch("product", b, *multiplied, adjoints=adjoints)
        to_gradient = torch.zeros_like(x) if to_slope is None else to_slope[:, None, None] * solution
        to_diagonal = torch.zeros_like(at.diagonal)
        begun = at.gradient, at.normal, at.diagonal, b, n_products, n, inverse, fields, scalars
        to_begun = to_gradient, to_normal, to_diagonal, None, None, None, to_inverse, to_fields, to_scalars
        launch(module.begin, (b, n), begun, to_begun)
        further = to_diagonal, to_factors, to_normal, to_stiffness, to_energy
        self.kernels.back(x, at, to, to_gradient, to_x, to_records, *further)
        return to_x

    def _length_back(
        self,
        x: Tensor,
        at: KernelPoint,
        solution: Tensor,
        to: Reference,
        to_x: Tensor,
        to_records: Sequence[Tensor],
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Gradients of the lengths of steps that were shortened: in the solution, the energy before, and the slope.

        Those through the energy after the whole step are added to the gradients in the shape, on entry those at the
        end of the step, and in the records. *Shape:* ``(B, V, 3), (B,), (B,)``.
        """
        to_reached, whole = to_x.clone(), x + solution
        there = self.kernels.at(whole, to, 1)
        with torch.enable_grad():
            values = solution, at.value, there.value, at.slope(solution)
            step, before, after, slope = leaves = [value.detach().requires_grad_() for value in values]
            along = slope + at.slope(step - solution)
            taken = step_length(before, along, after, step.abs().amax((1, 2)))[:, None, None] * step
        to_solution, to_before, to_after, to_slope = torch.autograd.grad(taken, leaves, to_reached)
        self.kernels.back(whole, there, to, torch.zeros_like(to_x), to_x, to_records, to_energy=to_after)
        return to_solution + (to_x - to_reached), to_before, to_slope
