"""Steps of all vertices by kernels, tested against those in torch."""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torch_modal import trees
from torch_modal.autograd import is_eager
from torch_modal.elastic.energy import Energy, Reference, RestShapes
from torch_modal.elastic.kernel_energy import KernelEnergy, KernelPoint, Target
from torch_modal.elastic.kernel_terms import by_kernels, has_kernels
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
        served = [has_kernels(part) for part in self.energy.parts]
        #: Numbers of the terms with kernels, and of the others.
        self.own, self.others = ([i for i, one in enumerate(served) if one == own] for own in (True, False))
        shell = Energy(mesh, [terms[i] for i in self.own]) if self.others else self.energy
        self.further = Energy(mesh, [terms[i] for i in self.others]) if self.others else None
        self.kernels = KernelEnergy(shell, [by_kernels(part, mesh) for part in shell.parts])

    def relax_chunk(self, x: Tensor, rests: RestShapes, products: Sequence[int], extra: Sequence[FreeEnergy]) -> Tensor:
        """Overrides the base class. With further terms or energies, gradients are left to torch."""
        alone = self.further is None and not extra
        tensors = trees.leaves((x, *rests))  # the start may have no gradient where stiffnesses have one
        recorded = torch.is_grad_enabled() and any(value.requires_grad for value in tensors)
        if not (alone and self.kernels.exact) and (recorded or not is_eager(*tensors)):
            return super().relax_chunk(x, rests, products, extra)
        own, others = rests, [*extra]
        if self.further is not None:
            own, further = (rests.of_terms(self.energy, numbers) for numbers in (self.own, self.others))
            others.append(TermsTowards(self.further, further.reference(self.further), further.anchors))
        target = self.kernels.target(own, x, relative=True)
        if alone:
            return _Relaxation(self.kernels, products)(x, target.anchors, *target.records)[0].to(x)
        with torch.no_grad():
            problem = KernelProblem(self.kernels, target._replace(anchors=target.anchors.double()), others)
            return descend(problem, x.double().contiguous(), products).to(x)

    def descend_towards(
        self, x: Tensor, reference: Reference, products: Sequence[int], extra: Sequence[FreeEnergy] = ()
    ) -> Tensor:
        """Overrides the base class. Gradients are left to torch."""
        if self.further is not None or (torch.is_grad_enabled() and x.requires_grad) or not is_eager(x):
            return super().descend_towards(x, reference, products, extra)
        records = [record.mT.contiguous() for record in reference.records]
        problem = KernelProblem(self.kernels, Target(self.kernels.no_anchors(x).double(), records), extra)
        return descend(problem, x.double().contiguous(), products).to(x)


@dataclass(frozen=True, eq=False)
class KernelProblem:
    """The terms towards a target, for :func:`torch_modal.elastic.steps.descend`, in float64."""

    kernels: KernelEnergy
    target: Target
    extra: Sequence[FreeEnergy] = ()

    def value(self, x: Tensor) -> Tensor:
        """*Shape:* ``(B, V, 3) -> (B,)``."""
        return sum((other.value(x) for other in self.extra), start=self.kernels.at(x, self.target, 0).value)

    def at(self, x: Tensor) -> KernelPoint:
        """*Shape:* ``(B, V, 3)``."""
        at = self.kernels.at(x, self.target)
        if not self.extra:
            return at
        others = SumOfEnergies(self.extra).at(x)
        at.gradient.add_(others.gradient)
        at.diagonal.add_(others.diagonal)
        return at._replace(value=at.value + others.value, extra=others.product)

    def newton_direction(self, at: KernelPoint, n_products: int, keep: bool = False) -> tuple[Tensor, ...]:
        """Conjugate gradients, fused; the fields of all iterations are kept if wanted.

        Returns:
            The solution, *shape* ``(B, V, 3)``; residuals, directions, and the Hessian's products with these but for
            the totals' parts, of the last iteration alone where they are not kept, *shape* ``(3, n_products, B, V,
            3)``; two scalars of each iteration, *shape* ``(n_products + 1, B, 2)``, and one of each total
            (``kernels/steps.py``), *shape* ``(n_products + 1, T, B)``; and the inverse of the diagonal, *shape* ``(B,
            V, 6)``.
        """
        (b, n), module = at.gradient.shape[:2], kernels("steps")
        solution, inverse = torch.zeros_like(at.gradient), torch.empty_like(at.diagonal)
        fields = at.gradient.new_empty(3, n_products if keep else 1, b, n, 3)
        scalars = at.gradient.new_zeros(n_products + 1, b, 2)
        swept = at.gradient.new_zeros(n_products + 1, *at.stiffness.shape)
        each = _iterations(fields, scalars, swept)
        launch(module.begin, (b, n), [at.gradient, at.normals, at.diagonal, n, inverse, *each[0]])
        for one, other in itertools.pairwise(each):
            _, field, product, sums, _ = one
            self.kernels.add_products(field, at.factors, product, sums)
            if at.extra is not None:
                pushed = at.extra(field)
                product.add_(pushed)
                sums[:, 1].add_((pushed * field).sum((1, 2)))
            residual = None if other is each[-1] else other[0]
            launch(module.advance, (b, n), [at.normals, inverse, at.stiffness, n, *one, residual, other[3], solution])
            if residual is not None:
                launch(module.turn, (b, n), [at.normals, inverse, n, field, sums, *other])
        return solution, fields, scalars, swept, inverse


def _iterations(fields: Tensor, scalars: Tensor, swept: Tensor) -> list[Sequence[Tensor]]:
    """Residual, direction, product and scalars of each iteration; all share the fields if one is kept."""
    kinds = (kind.unbind() for kind in fields.unbind())
    n = len(scalars)
    return [*zip(*(kind * n if len(kind) == 1 else kind + kind[-1:] for kind in kinds), scalars, swept, strict=True)]


@dataclass(frozen=True, eq=False)
class _Relaxation(Operation[KernelStep]):
    """Steps of all vertices from shapes, towards anchors and the records of terms."""

    kernels: KernelEnergy
    products: Sequence[int]

    def run(self, kept: list[KernelStep] | None, x: Tensor, anchors: Tensor, *records: Tensor) -> tuple[Tensor, ...]:
        with torch.no_grad():
            return (descend(KernelProblem(self.kernels, Target(anchors, records)), x, self.products, kept),)

    def back(
        self, kept: list[KernelStep], grads: Sequence[Tensor], x: Tensor, anchors: Tensor, *records: Tensor
    ) -> tuple[Tensor | None, ...]:
        if not kept:
            self.run(kept, x, anchors, *records)
        to_x, target = grads[0], Target(anchors, records)
        to_target = trees.map_leaves(target, torch.zeros_like)
        for step in reversed(kept):
            to_x = self._step_back(step, target, to_x, to_target)
        return to_x, to_target.anchors, *to_target.records

    def by_torch(self, x: Tensor, anchors: Tensor, *records: Tensor) -> tuple[Tensor, ...]:
        reference = Reference(tuple(record.mT for record in records), x.new_zeros(len(x)))
        terms = TermsTowards(self.kernels.energy, reference, anchors)
        return (descend(SumOfEnergies([terms]), x, self.products),)

    def _step_back(self, step: KernelStep, target: Target, to_reached: Tensor, to_target: Target) -> Tensor:
        """Gradient at the start of a step from the gradient at its end; gradients of the target are added.

        The step is what :func:`descend` adds to its list. *Shape:* ``(B, V, 3) -> (B, V, 3)``.
        """
        x, at, solution, length, (*kept, inverse) = step
        to_x, to_solution, to_at = to_reached.clone(), to_reached, trees.map_leaves(at, torch.zeros_like)
        if bool((length < 1).any()):
            to_solution = self._length_back(x, at, solution, target, to_x, to_target, to_at)
        module, (b, n), to_inverse = kernels("steps"), x.shape[:2], torch.zeros_like(inverse)
        each, to_each = _iterations(*kept), _iterations(*map(torch.zeros_like, kept))
        for k in reversed(range(len(each) - 1)):
            (one, other), (to_one, to_other), residual, to_residual = each[k : k + 2], to_each[k : k + 2], None, None
            field, sums, to_field, to_sums = one[1], one[3], to_one[1], to_one[3]
            if k < len(each) - 2:
                residual, to_residual = other[0], to_other[0]
                turned, to_turned = (n, field, sums, *other), (None, to_field, to_sums, *to_other)
                launch(module.turn, (b, n), [at.normals, inverse, *turned], [to_at.normals, to_inverse, *to_turned])
            moved = at.normals, inverse, at.stiffness, n, *one, residual, other[3], solution
            # A solution gives its gradient to the one before, which the adjoint of an update in place adds to it.
            received = to_residual, to_other[3], to_solution.clone()
            to_moved = to_at.normals, to_inverse, to_at.stiffness, None, *to_one, *received
            launch(module.advance, (b, n), moved, to_moved)
            self.kernels.add_products_back(field, at.factors, to_field, to_at.factors, to_one[2], to_sums)
        begun = at.gradient, at.normals, at.diagonal, n, inverse, *each[0]
        to_begun = to_at.gradient, to_at.normals, to_at.diagonal, None, to_inverse, *to_each[0]
        launch(module.begin, (b, n), begun, to_begun)
        self.kernels.back(x, target, at, to_x, to_target, to_at)
        return to_x

    def _length_back(
        self,
        x: Tensor,
        at: KernelPoint,
        solution: Tensor,
        target: Target,
        to_x: Tensor,
        to_target: Target,
        to_at: KernelPoint,
    ) -> Tensor:
        """Gradient in the solution of steps that were shortened. *Shape:* ``(B, V, 3)``.

        Gradients through the energy after the whole step are added to those of the target and the shape, on entry those
        at the end of the step; gradients in the energy before, and in its gradient, are written.
        """
        to_reached, whole = to_x.clone(), x + solution
        there = self.kernels.at(whole, target, 1)
        with torch.enable_grad():
            values = solution, at.value, there.value, at.slope(solution)
            step, before, after, slope = leaves = [value.detach().requires_grad_() for value in values]
            along = slope + at.slope(step - solution)
            taken = step_length(before, along, after, step.abs().amax((1, 2)))[:, None, None] * step
        to_solution, to_before, to_after, to_slope = torch.autograd.grad(taken, leaves, to_reached)
        to_there = trees.map_leaves(there, torch.zeros_like)._replace(value=to_after)
        self.kernels.back(whole, target, there, to_x, to_target, to_there)
        to_at.value.copy_(to_before)
        to_at.gradient.copy_(to_slope[:, None, None] * solution)
        return to_solution + (to_x - to_reached)
