"""Where the terms of an in-between's energy are evaluated: on the coarse mesh, or at the vertices that they name."""

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
from torch_modal.inbetween.columns import Columns
from torch_modal.inbetween.frame import Frame


class Levels(nn.Module):
    """The energies of the modal solve: most terms on the coarse mesh, and those that name vertices at these.

    Args:
        frame: The frame of both bases.
        fine: All terms on the caller's mesh.
        backend: Makes the energy of Eq. 5 on the coarse mesh.
    """

    def __init__(self, frame: Frame, fine: FineEnergy, backend: TorchBackend) -> None:
        super().__init__()
        self.mesh = Mesh.of(frame.coarse.faces, frame.coarse.n_vertices)
        terms = fine.terms
        kinds = [2 if term.sampled else 1 if i >= N_SHELL_TERMS else 0 for i, term in enumerate(terms)]
        members = [[i for i, kind in enumerate(kinds) if kind == level] for level in range(3)]
        #: Which terms each level has: those of Eq. 5, others on the coarse mesh, others at vertices of the fine mesh.
        self.members = [own for own in members if own]
        self.n_anchors = [0 if term.anchors is None else len(term.anchors) for term in terms]
        parts = []
        for own in self.members:
            own_terms = [terms[i] for i in own]
            if own[0] == 0:
                parts.append(backend.coarse_energy(Energy(self.mesh, own_terms), self.mesh))
            else:
                sampled = own_terms[0].sampled
                parts.append(CoarseEnergy(Energy(fine.mesh if sampled else self.mesh, own_terms, sampled)))
        self.parts: Any = nn.ModuleList(parts)
        self._frame, self._fine = (frame,), (fine,)
        #: Whether terms are evaluated at vertices of the fine mesh.
        self.sampled = bool(members[2])

    @property
    def energies(self) -> list[Energy]:
        """The energy of each level."""
        return [part.energy for part in self.parts]

    def modal(self, columns: Columns, anchor: float = 0.0) -> SumOfEnergies:
        """All of them in the amplitudes of a space, anchored at zeros."""
        parts = (
            part.modal(columns.at(part.energy.vertices) if part.energy.sampled else columns.coarse)
            for part in self.parts
        )
        return SumOfEnergies(*parts, anchor=anchor)

    def stiffness(self, values: list[Tensor]) -> list[list[Tensor]]:
        """Stiffnesses of the elements of the fine mesh, on those of each level.

        Args:
            values: Of each term. *Shape of each:* ``(B, M)`` or ``(B, 1)``.
        """
        fine, coarse, found = self._fine[0].energy.parts, self._frame[0].coarse, []
        for energy, members in zip(self.energies, self.members, strict=True):
            own = [values[i] for i in members]
            if not energy.sampled:
                parts = zip(own, members, energy.parts, strict=True)
                own = [
                    coarse_values(value, fine[i], part, coarse.clusters, coarse.n_vertices) for value, i, part in parts
                ]
            found.append(own)
        return found

    def seen(self, x: Tensor, coarse: Tensor) -> list[Tensor]:
        """Fine shapes and their coarse ones as each energy sees them. *Shape:* ``(..., V, 3), (..., V_coarse, 3)``."""
        return [x[..., energy.vertices, :] if energy.sampled else coarse for energy in self.energies]

    def references(self, shapes: Sequence[Tensor], weights: Tensor, stiffness: Sequence[Sequence[Tensor]]) -> list[Any]:
        """References towards K rest shapes of each sample, one for each energy.

        Args:
            shapes: As each energy sees them. *Shape of each:* ``(B, K, V, 3)``.
            weights: *Shape:* ``(B, K)``.
            stiffness: Of :meth:`stiffness`.
        """
        parts = zip(self.parts, shapes, stiffness, strict=True)
        return [part.reference(RestShapes(x, weights, own)) for part, x, own in parts]

    def softened(self, references: Sequence[Any], bases: Sequence[Tensor]) -> list[Any]:
        """References with less bending stiffness at needles of a shape, as each energy sees it."""
        return [part.softened(own, x) for part, own, x in zip(self.parts, references, bases, strict=True)]

    def place(
        self,
        modal: SumOfEnergies,
        bases: Sequence[Tensor],
        references: Sequence[Any],
        extras: Sequence[Tensor | None] | None,
        anchors: Tensor | None,
    ) -> tuple[Placement, ...]:
        """The affine space of each sample, as each energy sees it. *Shape of bases and extras:* ``(B, V, 3)``."""
        extras = [None] * len(bases) if extras is None else extras
        fixed = [self._own_anchors(members, anchors) for members in self.members[: len(bases)]]
        parts = zip(modal.parts, bases, references, extras, fixed, strict=True)
        return tuple(energy.place(base, reference, extra, own) for energy, base, reference, extra, own in parts)

    def _own_anchors(self, members: Sequence[int], anchors: Tensor | None) -> Tensor | None:
        """Those of some of the terms. *Shape:* ``(B, P, 3)``."""
        if anchors is None:
            return None
        each = anchors.split(self.n_anchors, 1)
        return torch.cat([each[i] for i in members], 1) if members else None


def coarse_values(values: Tensor, fine: OnMesh, coarse: OnMesh, clusters: Tensor, n: int) -> Tensor:
    """Values of the elements of the fine mesh on those of the coarse one: means over clusters, then over corners.

    Args:
        values: *Shape:* ``(B, M)``, or ``(B, 1)``, which stays.
        fine: The term on the fine mesh.
        coarse: The same term on the coarse mesh.
        clusters: The coarse vertex of each fine one. *Shape:* ``(V,)``.
        n: How many coarse vertices there are.

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
