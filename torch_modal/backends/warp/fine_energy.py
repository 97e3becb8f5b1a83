"""The energy on the caller's mesh, and steps of all its vertices by Warp kernels."""

from collections.abc import Sequence

import torch
from torch import Tensor

from torch_modal import trees
from torch_modal.autograd import traced, transformed
from torch_modal.backends.torch.fine_energy import Beside, FineEnergy, Rests, chunk_of
from torch_modal.backends.torch.fine_steps import ConvexHessian, FurtherDerivatives, FurtherEnergy
from torch_modal.backends.warp.fine_steps import WarpSteps
from torch_modal.energy.energy import Energy, Reference
from torch_modal.energy.shell import N_SHELL_TERMS
from torch_modal.energy.term import Mesh, Term


class WarpFineEnergy(FineEnergy):
    """:class:`FineEnergy` whose terms of Eq. 5 are those of kernels; further ones, and contacts, are torch's."""

    def __init__(self, mesh: Mesh, terms: Sequence[Term]) -> None:
        super().__init__(mesh, terms)
        shell, others = terms[:N_SHELL_TERMS], terms[N_SHELL_TERMS:]
        self.shell = Energy(mesh, shell) if others else self.energy
        self.further = Energy(mesh, others) if others else None
        self.steps = WarpSteps(self.shell, mesh)

    def volumes(self, first: Tensor, second: Tensor) -> Tensor:
        """As in the base class."""
        given = [x.detach() for x in (first, second)]
        if any(traced(x) or transformed(x) for x in given):
            return super().volumes(first, second)
        return self.steps.volumes(*(x.double().contiguous() for x in given))

    def relax(self, x: Tensor, rests: Rests, stages: Sequence[tuple[int, int]], beside: Beside | None = None) -> Tensor:
        """As in the base class. With further terms or energies, gradients are left to torch."""
        if self.further is None and beside is None:
            ends = trees.picked((rests.shapes[0], rests.shapes[-1]), rests.which)
            chunk = chunk_of(x.shape[-2], x.device)
            for n_steps, n_products in stages:
                x = self.steps(x, *ends, rests.t, rests.stiffness, n_steps, n_products, chunk)
            return x
        if (torch.is_grad_enabled() and x.requires_grad) or traced(x) or transformed(x):
            return super().relax(x, rests, stages, beside)
        parts = []
        for own, some in self.chunks(rests):
            shapes, _, t, stiffness, anchors = trees.mapped(some, lambda value: value.double().contiguous())
            first, second, moved = shapes[0], shapes[-1], x[own].double().contiguous()
            others = [] if beside is None else list(beside(own, moved))
            if self.further is not None:
                one, other = (self.further.rest_of(x) for x in (first, second))
                reference = self.further.between(one, other, t, stiffness[N_SHELL_TERMS:])
                others.append(FurtherTerms(self.further, reference, anchors))
            to = self.steps.reference(first, second, t, *stiffness[:N_SHELL_TERMS])
            for n_steps, n_products in stages:
                moved = self.steps.descend(moved, to, others, n_steps, n_products)
            parts.append(moved)
        return torch.cat(parts).to(x)


class FurtherTerms(FurtherEnergy):
    """Terms in torch as an energy beside Eq. 5.

    Args:
        energy: Of these terms.
        reference: What shapes are compared with.
        anchors: Of the terms, where there are some. *Shape:* ``(B, P, 3)``.
    """

    def __init__(self, energy: Energy, reference: Reference, anchors: Tensor | None) -> None:
        self.energy, self.reference = energy, reference
        self.anchors = None if anchors is None else anchors.movedim(-1, 0)

    def _extended(self, x: Tensor) -> Tensor:
        return self.energy.extend(x.movedim(-1, 0).contiguous(), self.anchors)

    def value(self, x: Tensor) -> Tensor:
        """*Shape:* ``(B, V, 3) -> (B,)``."""
        return self.energy.value(self._extended(x), self.reference)

    def at(self, x: Tensor) -> FurtherDerivatives:
        """*Shape:* ``(B, V, 3)``."""
        energy, n = self.energy, x.shape[1]
        at = energy.linearise(self._extended(x), self.reference)
        hessian = ConvexHessian(energy, at)
        packed = hessian.diagonal().flatten(0, 1)[[0, 1, 2, 4, 5, 8], ..., :n].movedim(0, -1)

        def product(field: Tensor) -> Tensor:
            rows = energy.extend(field.movedim(-1, 0).contiguous())
            return energy.fold(hessian(rows)).movedim(0, -1)

        gradient = energy.fold(energy.gradient(at)).movedim(0, -1)
        return FurtherDerivatives(energy.value_at(at, self.reference), gradient, packed, product)
