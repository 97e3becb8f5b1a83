"""The energy of the modal solve: most terms on the coarse mesh, and those that name vertices at these."""

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor, nn

from torch_modal.backends.torch.backend import TorchBackend
from torch_modal.backends.torch.energies import CoarseEnergy, FineEnergy, RestShapes
from torch_modal.energy.energy import Energy, OnMesh
from torch_modal.energy.modal_energy import Placement, SumOfEnergies
from torch_modal.energy.shell import N_SHELL_TERMS
from torch_modal.energy.term import Mesh
from torch_modal.inbetween.coarse import CoarseMesh
from torch_modal.inbetween.subspace import SubspaceBasis


class MultilevelEnergy(nn.Module):
    """Energies of the terms of Eq. 5, of others on the coarse mesh, and of others at vertices of the fine mesh.

    Args:
        coarse: The coarse mesh.
        fine: All terms on the caller's mesh.
        backend: Makes the energy of Eq. 5 on the coarse mesh.
    """

    def __init__(self, coarse: CoarseMesh, fine: FineEnergy, backend: TorchBackend) -> None:
        super().__init__()
        mesh, terms = Mesh.of(coarse.faces, coarse.n_vertices), fine.terms
        kinds = [2 if term.sampled else 1 if i >= N_SHELL_TERMS else 0 for i, term in enumerate(terms)]
        members = [[i for i, kind in enumerate(kinds) if kind == level] for level in range(3)]
        #: The terms of each level.
        self.members = [own for own in members if own]
        self.n_anchors = [0 if term.anchors is None else len(term.anchors) for term in terms]
        parts = []
        for own in self.members:
            own_terms = [terms[i] for i in own]
            if own[0] == 0:
                parts.append(backend.coarse_energy(Energy(mesh, own_terms), mesh))
            else:
                sampled = own_terms[0].sampled
                parts.append(CoarseEnergy(Energy(fine.mesh if sampled else mesh, own_terms, sampled)))
        self.parts: Any = nn.ModuleList(parts)
        self.coarse, self._fine = coarse, (fine,)

    def modal(self, basis: SubspaceBasis, anchor: float = 0.0) -> SumOfEnergies:
        """All of them in the amplitudes of a subspace, anchored at zeros."""
        each = zip(self.parts, self._seen(basis.fine, basis.coarse), strict=True)
        return SumOfEnergies(*(part.modal(directions) for part, directions in each), anchor=anchor)

    def place(self, modal: SumOfEnergies, base: Tensor, rests: RestShapes, soften: bool) -> tuple[Placement, ...]:
        """The affine space of each sample, as each energy sees it, and the reference there.

        Args:
            modal: Of :meth:`modal`.
            base: The shape at amplitudes of zero. *Shape:* ``(B, V, 3)``.
            rests: The rest shapes on the fine mesh.
            soften: True for less bending stiffness at needles of the base.
        """
        restrict = self.coarse.restrict
        bases = self._seen(base, restrict(base))
        shapes = self._seen(rests.shapes, restrict(rests.shapes))
        placed = []
        for part, energy, members, own, seen in zip(self.parts, modal.parts, self.members, bases, shapes, strict=True):
            anchors = rests.anchors
            if anchors is not None:
                each = anchors.split(self.n_anchors, 1)
                anchors = torch.cat([each[i] for i in members], 1)
            stiffness = self._stiffness(part.energy, members, rests.stiffness)
            reference = part.reference(RestShapes(seen, rests.weights, stiffness))
            reference = part.softened(reference, own) if soften else reference
            placed.append(energy.place(own, reference, anchors))
        return tuple(placed)

    def _seen(self, x: Tensor, coarse: Tensor) -> list[Tensor]:
        """Fine and coarse shapes or displacements as each energy sees them. *Shape:* ``(..., V, 3)``."""
        return [x[..., part.energy.vertices, :] if part.energy.sampled else coarse for part in self.parts]

    def _stiffness(self, energy: Energy, members: Sequence[int], values: Sequence[Tensor]) -> list[Tensor]:
        """Stiffnesses of the elements of the fine mesh on those of a level. *Shape of each:* ``(B, M)``, ``(B, 1)``."""
        own = [values[i] for i in members]
        if energy.sampled:
            return own
        fine, coarse = self._fine[0].energy.parts, self.coarse
        parts = zip(own, members, energy.parts, strict=True)
        return [coarse_values(value, fine[i], part, coarse.clusters, coarse.n_vertices) for value, i, part in parts]


def coarse_values(values: Tensor, fine: OnMesh, coarse: OnMesh, clusters: Tensor, n: int) -> Tensor:
    """Values of the elements of the fine mesh on those of the coarse one: means over clusters, then over corners.

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
    # A cluster without elements of its own knows the mean only.
    means = torch.where(counts > 0, sums / counts.clamp_min(1), values.mean(1, keepdim=True))
    return means[:, coarse.corners].mean(1)
