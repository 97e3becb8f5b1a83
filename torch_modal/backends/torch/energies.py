"""Energies of in-betweens towards K rest shapes: on the coarse mesh for the modal solve, and on the caller's mesh."""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from torch_modal.backends.torch.fine_steps import ConvexHessian, FurtherDerivatives, FurtherEnergy, relax
from torch_modal.energy.bend import Bend, fullness
from torch_modal.energy.energy import Energy, Reference
from torch_modal.energy.modal_energy import ModalEnergy
from torch_modal.energy.shell import N_SHELL_TERMS
from torch_modal.energy.term import Mesh, Term

# Vertices of all samples that are relaxed at a time: more would not fit into a processor's caches, or, of a GPU, into
# its memory (6 KB a vertex where gradients are recorded).
CHUNK = 20_000
CHUNK_OF_GPU = 1_000_000


class RestShapes(NamedTuple):
    """K rest shapes of each sample with their weights, and the stiffnesses of the terms."""

    shapes: Tensor
    """*Shape:* ``(B, K, V, 3)``."""
    weights: Tensor
    """*Shape:* ``(B, K)``."""
    stiffness: Sequence[Tensor]
    """One of each term. *Shape of each:* ``(B, M)`` or ``(B, 1)``."""
    anchors: Tensor | None = None
    """Fixed points of the terms, where they have some. *Shape:* ``(B, P, 3)``."""

    def rows(self, some: slice | Tensor) -> "RestShapes":
        """Rest shapes of some of the samples."""
        anchors = None if self.anchors is None else self.anchors[some]
        return RestShapes(self.shapes[some], self.weights[some], [each[some] for each in self.stiffness], anchors)

    def reference(self, energy: Energy) -> Reference:
        """Merge the rest shapes into one reference of an energy, of the terms that the stiffnesses belong to."""
        return energy.among([energy.rest_of(x) for x in self.shapes.unbind(1)], self.weights, self.stiffness)


class CoarseEnergy(nn.Module):
    """An energy of the modal solve.

    Args:
        energy: The energy on the mesh that it is evaluated on.
    """

    def __init__(self, energy: Energy) -> None:
        super().__init__()
        self.energy = energy

    def modal(self, columns: Tensor) -> ModalEnergy:
        """The energy in the amplitudes of columns. *Shape:* ``(n, V, 3)``."""
        return ModalEnergy(self.energy, columns)

    def reference(self, rests: RestShapes) -> Any:
        """The reference towards rest shapes, as :meth:`modal` takes it."""
        return rests.reference(self.energy)

    def softened(self, reference: Any, base: Tensor) -> Any:
        """A reference with less bending stiffness at hinges with a needle.

        The minimiser would turn their normals over, at little cost, and end at the kink where they collapse.

        Args:
            reference: Of :meth:`reference`.
            base: The shape at amplitudes of zero. *Shape:* ``(B, V, 3)``.
        """
        weights = list(reference.weights)
        for i, part in enumerate(self.energy.parts):
            if isinstance(part.term, Bend):
                weights[i] = self.fullness(i, base) * weights[i]
        return reference._replace(weights=tuple(weights))

    def fullness(self, i: int, base: Tensor) -> Tensor:
        """:func:`~torch_modal.energy.bend.fullness` of the hinges of a term. *Shape:* ``(B, V, 3) -> (B, H)``."""
        return fullness(self.energy.parts[i].edge_vectors(base.movedim(-1, 0)))


class FurtherTerms(FurtherEnergy):
    """The terms beyond Eq. 5 as an energy beside it.

    Args:
        energy: Their energy.
        rests: The rest shapes of all terms.
    """

    def __init__(self, energy: Energy, rests: RestShapes) -> None:
        own = rests._replace(stiffness=rests.stiffness[N_SHELL_TERMS:])
        self.energy, self.reference = energy, own.reference(energy)
        self.anchors = None if rests.anchors is None else rests.anchors.movedim(-1, 0)

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


Beside = Callable[[slice, Tensor], Sequence[FurtherEnergy]]
"""Makes energies beside that of the terms, for some of the samples, in the dtype of a tensor."""


class FineEnergy(nn.Module):
    """All terms on the caller's mesh.

    Args:
        mesh: The mesh.
        terms: The terms; those of Eq. 5 come first.
    """

    def __init__(self, mesh: Mesh, terms: Sequence[Term]) -> None:
        super().__init__()
        self.mesh = mesh
        self.energy = Energy(mesh, terms)

    @property
    def terms(self) -> tuple[Term, ...]:
        """The terms; the layer owns them."""
        return tuple(part.term for part in self.energy.parts)

    def relax(
        self, x: Tensor, rests: RestShapes, stages: Sequence[tuple[int, int]], beside: Beside | None = None
    ) -> Tensor:
        """Steps of all vertices, never uphill (:func:`~torch_modal.backends.torch.fine_steps.relax`).

        Args:
            x: Initial shapes. *Shape:* ``(B, V, 3)``.
            rests: The rest shapes.
            stages: Newton steps, and iterations of conjugate gradients in each.
            beside: Energies beside that of the terms.

        Returns:
            *Shape:* ``(B, V, 3)``.
        """
        size, parts = chunk_of(x.shape[1], x.device), []
        for i in range(0, len(x), size):
            some = slice(i, i + size)
            own = x[some]
            parts.append(self.relax_chunk(own, rests.rows(some), stages, () if beside is None else beside(some, own)))
        return torch.cat(parts)

    def relax_chunk(
        self, x: Tensor, rests: RestShapes, stages: Sequence[tuple[int, int]], beside: Sequence[FurtherEnergy]
    ) -> Tensor:
        """:meth:`relax` of samples that fit into the caches, with their own further energies."""
        reference = rests.reference(self.energy)
        for n_steps, n_products in stages:
            x = relax(self.energy, x, reference, n_steps, n_products, rests.anchors, beside)
        return x

    def towards(
        self, x: Tensor, reference: Reference, n_steps: int, n_products: int, beside: Sequence[FurtherEnergy] = ()
    ) -> Tensor:
        """Steps of all vertices towards a reference that is known. *Shape:* ``(B, V, 3)``."""
        return relax(self.energy, x, reference, n_steps, n_products, None, beside)


def chunk_of(n_vertices: int, device: torch.device) -> int:
    """Number of samples of so many vertices that are relaxed at a time."""
    return max(1, (CHUNK if device.type == "cpu" else CHUNK_OF_GPU) // n_vertices)
