"""Steps of all vertices by kernels, tested against those in torch."""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torch_modal import trees
from torch_modal.autograd import is_eager
from torch_modal.elastic.energy import Energy, Reference, RestShapes
from torch_modal.elastic.kernel_energy import KernelEnergy, KernelPoint
from torch_modal.elastic.kernel_terms import by_kernels, serves
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
        served = [serves(part) for part in self.energy.parts]
        #: Numbers of the terms that kernels serve, and of the others.
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
        to = self.kernels.reference(own, x, relative=True)
        anchors = self.kernels.no_anchors(x) if own.anchors is None else own.anchors
        if alone:
            return _Relaxation(self.kernels, products)(x, anchors, *to.records)[0].to(x)
        with torch.no_grad():
            problem = KernelProblem(self.kernels, to, anchors.double(), others)
            return descend(problem, x.double().contiguous(), products).to(x)

    def descend_towards(
        self, x: Tensor, reference: Reference, products: Sequence[int], extra: Sequence[FreeEnergy] = ()
    ) -> Tensor:
        """Overrides the base class. Gradients are left to torch."""
        if self.further is not None or (torch.is_grad_enabled() and x.requires_grad) or not is_eager(x):
            return super().descend_towards(x, reference, products, extra)
        problem = KernelProblem(self.kernels, reference.transpose(), self.kernels.no_anchors(x).double(), extra)
        return descend(problem, x.double().contiguous(), products).to(x)


@dataclass(frozen=True, eq=False)
class KernelProblem:
    """The terms towards a reference, for :func:`torch_modal.elastic.steps.descend`, in float64."""

    kernels: KernelEnergy
    to: Reference
    anchors: Tensor
    extra: Sequence[FreeEnergy] = ()

    def value(self, x: Tensor) -> Tensor:
        """*Shape:* ``(B, V, 3) -> (B,)``."""
        return sum((other.value(x) for other in self.extra), start=self.kernels.at(x, self.anchors, self.to, 0).value)

    def at(self, x: Tensor) -> KernelPoint:
        """*Shape:* ``(B, V, 3)``."""
        at = self.kernels.at(x, self.anchors, self.to)
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


def _without_constant(records: Sequence[Tensor]) -> Reference:
    """Records as a reference."""
    return Reference(tuple(records), records[0].new_zeros(len(records[0])))


@dataclass(frozen=True, eq=False)
class _Relaxation(Operation[KernelStep]):
    """Steps of all vertices from shapes, towards the records of a reference."""

    kernels: KernelEnergy
    products: Sequence[int]

    def run(self, kept: list[KernelStep] | None, x: Tensor, anchors: Tensor, *records: Tensor) -> tuple[Tensor, ...]:
        problem = KernelProblem(self.kernels, _without_constant(records), anchors)
        with torch.no_grad():
            return (descend(problem, x, self.products, kept),)

    def back(
        self, kept: list[KernelStep], grads: Sequence[Tensor], x: Tensor, anchors: Tensor, *records: Tensor
    ) -> tuple[Tensor | None, ...]:
        if not kept:
            self.run(kept, x, anchors, *records)
        to_x, to, to_anchors = grads[0], _without_constant(records), torch.zeros_like(anchors)
        to_records = [torch.zeros_like(record) for record in records]
        for step in reversed(kept):
            to_x = self._step_back(step, anchors, to, to_x, to_anchors, to_records)
        return to_x, to_anchors, *to_records

    def by_torch(self, x: Tensor, anchors: Tensor, *records: Tensor) -> tuple[Tensor, ...]:
        terms = TermsTowards(self.kernels.energy, _without_constant(records).transpose(), anchors)
        return (descend(SumOfEnergies([terms]), x, self.products),)

    def _step_back(
        self,
        step: KernelStep,
        anchors: Tensor,
        to: Reference,
        to_reached: Tensor,
        to_anchors: Tensor,
        to_records: Sequence[Tensor],
    ) -> Tensor:
        """Gradient at the start of a step from the gradient at its end; gradients of the records are added.

        Args:
            step: What :func:`descend` adds to its list: the start, the energy there, the whole step, its length, and
                the further results of :meth:`KernelProblem.newton_direction`.
            anchors: Fixed points of the terms. *Shape:* ``(B, P, 3)``.
            to: The reference.
            to_reached: Gradient at the end. *Shape:* ``(B, V, 3)``.
            to_anchors: Is added to.
            to_records: Are added to.
        """
        x, at, solution, length, (*kept, inverse) = step
        to_x, to_solution, to_energy, to_slope = to_reached.clone(), to_reached, None, None
        if bool((length < 1).any()):
            to_solution, to_energy, to_slope = self._length_back(
                x, anchors, at, solution, to, to_x, to_anchors, to_records
            )
        module, (b, n) = kernels("steps"), x.shape[:2]
        to_normals, to_inverse, to_stiffness = map(torch.zeros_like, (at.normals, inverse, at.stiffness))
        to_factors = [[x if x is None else torch.zeros_like(x) for x in factors] for factors in at.factors]
        each, to_each = _iterations(*kept), _iterations(*map(torch.zeros_like, kept))
        for k in reversed(range(len(each) - 1)):
            (one, other), (to_one, to_other), residual, to_residual = each[k : k + 2], to_each[k : k + 2], None, None
            field, sums, to_field, to_sums = one[1], one[3], to_one[1], to_one[3]
            if k < len(each) - 2:
                residual, to_residual = other[0], to_other[0]
                turned, to_turned = (n, field, sums, *other), (None, to_field, to_sums, *to_other)
                launch(module.turn, (b, n), [at.normals, inverse, *turned], [to_normals, to_inverse, *to_turned])
            moved = at.normals, inverse, at.stiffness, n, *one, residual, other[3], solution
            # A solution gives its gradient to the one before, which the adjoint of an update in place adds to it.
            received = to_residual, to_other[3], to_solution.clone()
            launch(module.advance, (b, n), moved, [to_normals, to_inverse, to_stiffness, None, *to_one, *received])
            self.kernels.add_products_back(field, at.factors, to_field, to_factors, to_one[2], to_sums)
        to_gradient = torch.zeros_like(x) if to_slope is None else to_slope[:, None, None] * solution
        to_diagonal = torch.zeros_like(at.diagonal)
        begun = at.gradient, at.normals, at.diagonal, n, inverse, *each[0]
        to_begun = to_gradient, to_normals, to_diagonal, None, to_inverse, *to_each[0]
        launch(module.begin, (b, n), begun, to_begun)
        further = to_diagonal, to_factors, to_normals, to_stiffness, to_energy
        self.kernels.back(x, anchors, at, to, to_gradient, to_x, to_anchors, to_records, *further)
        return to_x

    def _length_back(
        self,
        x: Tensor,
        anchors: Tensor,
        at: KernelPoint,
        solution: Tensor,
        to: Reference,
        to_x: Tensor,
        to_anchors: Tensor,
        to_records: Sequence[Tensor],
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Gradients of the lengths of steps that were shortened: in the solution, the energy before, and the slope.

        Those through the energy after the whole step are added to the gradients in the shape, on entry those at the
        end of the step, and in the records. *Shape:* ``(B, V, 3), (B,), (B,)``.
        """
        to_reached, whole = to_x.clone(), x + solution
        there = self.kernels.at(whole, anchors, to, 1)
        with torch.enable_grad():
            values = solution, at.value, there.value, at.slope(solution)
            step, before, after, slope = leaves = [value.detach().requires_grad_() for value in values]
            along = slope + at.slope(step - solution)
            taken = step_length(before, along, after, step.abs().amax((1, 2)))[:, None, None] * step
        to_solution, to_before, to_after, to_slope = torch.autograd.grad(taken, leaves, to_reached)
        received = torch.zeros_like(to_x), to_x, to_anchors, to_records
        self.kernels.back(whole, anchors, there, to, *received, to_energy=to_after)
        return to_solution + (to_x - to_reached), to_before, to_slope
