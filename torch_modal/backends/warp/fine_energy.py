"""The energy on the caller's mesh, and steps of all its vertices by Warp kernels."""

from collections.abc import Sequence

import torch
from torch import Tensor

from torch_modal import trees
from torch_modal.autograd import traced, transformed
from torch_modal.backends.torch.fine_energy import Beside, FineEnergy, chunk_of
from torch_modal.backends.torch.fine_steps import FurtherEnergy, FurtherTerms
from torch_modal.backends.torch.rests import Rests
from torch_modal.backends.warp.fine_steps import WarpSteps
from torch_modal.backends.warp.modal_energy import merged_reference
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
            chunk = chunk_of(x.shape[-2], x.device)
            if rests.t.dim() > 1:
                to = merged_reference(self.steps, torch.stack(rests.shapes, 1), rests.t, *rests.stiffness)
                for n_steps, n_products in stages:
                    x = self.steps.towards(x, to, n_steps, n_products, chunk)
                return x
            ends = trees.picked((rests.shapes[0], rests.shapes[-1]), rests.which)
            for n_steps, n_products in stages:
                x = self.steps(x, *ends, rests.t, rests.stiffness, n_steps, n_products, chunk)
            return x
        if (torch.is_grad_enabled() and x.requires_grad) or traced(x) or transformed(x):
            return super().relax(x, rests, stages, beside)
        parts = []
        for own, some in self.chunks(rests):
            some = trees.mapped(some, lambda value: value.double().contiguous())
            moved = x[own].double().contiguous()
            others = [] if beside is None else list(beside(own, moved))
            if self.further is not None:
                others.append(FurtherTerms(self.further, some.further()))
            shell = some.stiffness[:N_SHELL_TERMS]
            if some.t.dim() > 1:
                to = merged_reference(self.steps, torch.stack(some.shapes, 1), some.t, *shell)
            else:
                to = self.steps.reference(some.shapes[0], some.shapes[-1], some.t, *shell)
            for n_steps, n_products in stages:
                moved = self.steps.descend(moved, to, others, n_steps, n_products)
            parts.append(moved)
        return torch.cat(parts).to(x)

    def towards(
        self, x: Tensor, reference: Reference, n_steps: int, n_products: int, beside: Sequence[FurtherEnergy] = ()
    ) -> Tensor:
        """As in the base class. Gradients are left to torch."""
        recorded = torch.is_grad_enabled() and x.requires_grad
        if self.further is not None or recorded or traced(x) or transformed(x):
            return super().towards(x, reference, n_steps, n_products, beside)
        to = self.steps.packed(reference)
        return self.steps.descend(x.double().contiguous(), to, list(beside), n_steps, n_products).to(x)
