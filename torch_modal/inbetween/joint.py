"""The joint space: one unknown shape in the sum of the modal spaces of all bases."""

from collections.abc import Sequence
from functools import reduce
from typing import Any

import torch
from torch import Tensor, nn

from torch_modal.elastic.energy import AssembledTerm, Energy, RestShapes
from torch_modal.elastic.modal import AmplitudeEnergy, Derivatives, ModalEnergy, Placement
from torch_modal.elastic.steps import FineEnergy
from torch_modal.inbetween.coarse import CoarseMesh


class JointSpace(AmplitudeEnergy[Sequence[Placement]]):
    r"""In-betweens ``x(a) = base + U a`` of least :math:`\sum_k w_k\, d(x_k, x) + \tfrac{1}{2} \rho\, |a|^2`.

    The basis is orthonormal under vertex weights that add up to one, so that the anchor ``rho`` holds the mean squared
    distance from the base: without it, the minimiser jumps between far minima of almost the same energy.

    Terms are evaluated on the coarse mesh, except those that name vertices of the caller's mesh. A placement has one
    part for each of these kinds that there is.

    Args:
        coarse: The coarse mesh.
        fine: All terms on the caller's mesh.
        basis: Directions of the subspace, ``U``, on the fine and on the coarse mesh, where they are orthonormal under
            the weights of the vertices. *Shape:* ``(n, V, 3), (n, V_coarse, 3)``.
        anchor: ``rho``.
    """

    fine: FineEnergy
    basis: Tensor
    coarse_basis: Tensor

    def __init__(self, coarse: CoarseMesh, fine: FineEnergy, basis: tuple[Tensor, Tensor], anchor: float = 0.0) -> None:
        super().__init__()
        self.register_buffer("basis", basis[0], persistent=False)
        self.register_buffer("coarse_basis", basis[1], persistent=False)
        terms = [summand.term for summand in fine.energy.parts]
        members = [[i for i, term in enumerate(terms) if term.sampled == kind] for kind in (False, True)]
        #: The terms of each part.
        self.members = [numbers for numbers in members if numbers]
        parts = []
        for numbers in self.members:
            sampled = terms[numbers[0]].sampled
            energy = Energy(fine.mesh if sampled else coarse.mesh, [terms[i] for i in numbers], sampled)
            parts.append(ModalEnergy(energy, self.basis[:, energy.vertices] if sampled else self.coarse_basis))
        self.parts: Sequence[ModalEnergy] = nn.ModuleList(parts)  # type: ignore[assignment]
        self.coarse, self.anchor = coarse, anchor
        self.__dict__["fine"] = fine  # not registered here: it belongs to the solver

    # ----------------------------------------------------------------------------------------------- the affine space
    def place(self, base: Tensor, rests: RestShapes, mu: Tensor | None = None, soften: bool = True) -> list[Placement]:
        """The affine space of each sample, as each energy sees it, and the reference there.

        Args:
            base: The shape at amplitudes of zero. *Shape:* ``(B, V, 3)``.
            rests: The key-frames, or other rest shapes. *Shape:* ``(B, K, V, 3)``.
            mu: Not used.
            soften: True for less bending stiffness at needles of the base.
        """
        coarse, placed = self.coarse, []
        on_coarse, on_fine = (coarse.restrict(base), coarse.restrict(rests.shapes)), (base, rests.shapes)
        for part, members in zip(self.parts, self.members, strict=True):
            energy, (_, _, stiffness, anchors) = part.energy, rests.of_terms(self.fine.energy, members)
            if energy.sampled:
                part_base, shapes = (x[..., energy.vertices, :] for x in on_fine)
            else:
                part_base, shapes = on_coarse
                pairs = zip(stiffness, (self.fine.energy.parts[i] for i in members), energy.parts, strict=True)
                stiffness = [coarse_values(*pair, coarse.clusters, coarse.n_vertices) for pair in pairs]
            reference = RestShapes(shapes, rests.weights, stiffness).reference(energy, part_base if soften else None)
            placed.append(part.place(part_base, reference, anchors))
        return placed

    def lift(self, a: Tensor, base: Tensor) -> Tensor:
        """The fine shape of amplitudes. *Shape:* ``(B, n), (B, V, 3) -> (B, V, 3)``."""
        return torch.addmm(base.flatten(1), a, self.basis.flatten(1)).view_as(base)

    # ------------------------------------------------------------------------------------ the energy in the amplitudes
    @property
    def n_amplitudes(self) -> int:
        """Number of amplitudes, n."""
        return len(self.basis)

    def value(self, a: Tensor, placement: Sequence[Placement]) -> Tensor:
        """Energy at ``a``. *Shape:* ``(..., B, n) -> (..., B)``."""
        energies = [part.value(a, at) for part, at in zip(self.parts, placement, strict=True)]
        return reduce(torch.add, energies) + 0.5 * self.anchor * a.square().sum(-1)

    def derivatives(self, a: Tensor, placement: Sequence[Placement], second_order: bool = True) -> Derivatives:
        """Energy, gradient and Hessians at ``a``. *Shape:* ``(B, n)``."""
        parts = [part.derivatives(a, at, second_order) for part, at in zip(self.parts, placement, strict=True)]
        sums: list[Any] = [None if each[0] is None else reduce(torch.add, each) for each in zip(*parts, strict=True)]
        value, gradient, gauss_newton, *others = sums
        value, eye = value + 0.5 * self.anchor * a.square().sum(-1), torch.eye(a.shape[-1]).to(gauss_newton)
        return Derivatives(value, gradient + self.anchor * a, gauss_newton + self.anchor * eye, *others)


def coarse_values(values: Tensor, fine: AssembledTerm, coarse: AssembledTerm, clusters: Tensor, n: int) -> Tensor:
    """Values of fine elements on the coarse elements: means over clusters, then over corners.

    Args:
        values: *Shape:* ``(B, M)``, or ``(B, 1)``, which stays.
        fine: The term on the fine mesh.
        coarse: The same term on the coarse mesh.
        clusters: The coarse vertex of each fine one. *Shape:* ``(V,)``.
        n: Number of coarse vertices.

    Returns:
        *Shape:* ``(B, M_coarse)``.
    """
    if values.shape[-1] == 1:
        return values
    owners = clusters[fine.corners].flatten()
    sums = values.new_zeros(len(values), n).index_add(1, owners, values.repeat(1, len(fine.corners)))
    counts = values.new_zeros(n).index_add(0, owners, values.new_ones(len(owners)))
    # A cluster without elements of its own uses the global mean.
    means = torch.where(counts > 0, sums / counts.clamp_min(1), values.mean(1, keepdim=True))
    return means[:, coarse.corners].mean(1)
