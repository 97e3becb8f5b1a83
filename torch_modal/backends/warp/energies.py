"""Eq. 5 of the modal solve and of the steps of all vertices by Warp kernels."""

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from torch_modal.autograd import traced, transformed
from torch_modal.backends.torch.energies import CoarseEnergy, FineEnergy, FurtherTerms, RestShapes
from torch_modal.backends.torch.fine_steps import FurtherEnergy
from torch_modal.backends.warp.fine_steps import WarpSteps
from torch_modal.backends.warp.modal_energy import WarpModalEnergy
from torch_modal.backends.warp.shell import WarpShell
from torch_modal.energy.energy import Energy, Reference
from torch_modal.energy.shell import N_SHELL_TERMS
from torch_modal.energy.term import Mesh, Term


class WarpCoarseEnergy(CoarseEnergy):
    """:class:`~torch_modal.backends.torch.energies.CoarseEnergy` of the terms of Eq. 5."""

    def __init__(self, energy: Energy, mesh: Mesh) -> None:
        super().__init__(energy)
        self.shell = WarpShell(energy, mesh)

    def modal(self, columns: Tensor) -> WarpModalEnergy:
        """Overrides the base class."""
        return WarpModalEnergy(self.shell, columns)

    def reference(self, rests: RestShapes) -> Any:
        """Overrides the base class."""
        return self.shell.reference(rests)

    def softened(self, reference: Any, base: Tensor) -> Any:
        """Overrides the base class."""
        edges, hinges = reference.elements.split([2, 5], -1)
        full = self.fullness(1, base).to(hinges)
        factors = torch.ones_like(hinges[..., 0]).index_copy(1, self.shell.interior, full)
        return reference._replace(elements=torch.cat([edges, factors[..., None] * hinges], -1))


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
        if not alone and ((torch.is_grad_enabled() and x.requires_grad) or traced(x) or transformed(x)):
            return super().relax_chunk(x, rests, stages, beside)
        others = [*beside, *([] if self.further is None else [FurtherTerms(self.further, rests)])]
        to, moved = self.steps.reference(rests), x
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
        if self.further is not None or gradient or traced(x) or transformed(x):
            return super().towards(x, reference, n_steps, n_products, beside)
        to = self.steps.packed(reference)
        return self.steps.descend(x.double().contiguous(), to, list(beside), n_steps, n_products).to(x)
