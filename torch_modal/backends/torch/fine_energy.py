"""The energy on the caller's mesh, and steps of all its vertices."""

from collections.abc import Callable, Iterator, Sequence

import torch
from torch import Tensor, nn

from torch_modal import trees
from torch_modal.backends.torch.fine_steps import FurtherEnergy, relax
from torch_modal.backends.torch.rests import Rests
from torch_modal.energy.energy import Energy, Reference
from torch_modal.energy.term import Mesh, Term
from torch_modal.geometry.vectors import cross, pick

# Vertices of all samples that are relaxed at a time: more would not fit into a processor's caches, or, of a GPU, into
# its memory (6 KB a vertex where gradients are recorded).
CHUNK = 20_000
CHUNK_OF_GPU = 1_000_000

Beside = Callable[[slice, Tensor], Sequence[FurtherEnergy]]
"""Makes energies beside that of the terms, for some of the samples, in the dtype of a tensor."""


class FineEnergy(nn.Module):
    """All terms on the caller's mesh.

    Args:
        mesh: The mesh.
        terms: The terms; those of Eq. 5 come first.
    """

    faces: Tensor

    def __init__(self, mesh: Mesh, terms: Sequence[Term]) -> None:
        super().__init__()
        self.mesh = mesh
        self.energy = Energy(mesh, terms)
        self.register_buffer("faces", mesh.faces, persistent=False)

    @property
    def terms(self) -> tuple[Term, ...]:
        """The terms; the layer owns them."""
        return tuple(part.term for part in self.energy.parts)

    def volumes(self, first: Tensor, second: Tensor) -> Tensor:
        """Signed volumes of pairs of closed shapes. *Shape:* ``(P, V, 3), (P, V, 3) -> (P, 2)``."""
        rows = [x.detach().movedim(-1, 0).contiguous() for x in (first, second)]
        corners = ([pick(x, corner) for corner in self.faces.unbind(1)] for x in rows)
        return torch.stack([(a * cross(b, c)).sum((0, -1)) for a, b, c in corners], -1) / 6

    def relax(self, x: Tensor, rests: Rests, stages: Sequence[tuple[int, int]], beside: Beside | None = None) -> Tensor:
        """Steps of all vertices, never uphill (:func:`~torch_modal.backends.torch.fine_steps.relax`).

        Args:
            x: Where to start. *Shape:* ``(B, V, 3)``.
            rests: What is compared with.
            stages: Newton steps, and iterations of conjugate gradients in each.
            beside: Energies beside that of the terms.

        Returns:
            *Shape:* ``(B, V, 3)``.
        """
        parts = []
        for own, some in self.chunks(rests):
            moved, reference = x[own], some.reference(self.energy)
            further = () if beside is None else beside(own, moved)
            for n_steps, n_products in stages:
                moved = relax(self.energy, moved, reference, n_steps, n_products, some.anchors, further)
            parts.append(moved)
        return torch.cat(parts)

    def towards(
        self, x: Tensor, reference: Reference, n_steps: int, n_products: int, beside: Sequence[FurtherEnergy] = ()
    ) -> Tensor:
        """The same towards a reference. *Shape:* ``(B, V, 3)``."""
        return relax(self.energy, x, reference, n_steps, n_products, None, beside)

    def chunks(self, rests: Rests) -> Iterator[tuple[slice, Rests]]:
        """Samples that are relaxed at a time, each with its own rest shapes."""
        size = chunk_of(self.mesh.n_vertices, rests.t.device)
        for i in range(0, len(rests.t), size):
            own = slice(i, i + size)
            of = own if rests.which is None else rests.which[own]
            shapes = tuple(trees.rows(rests.shapes, of))
            t, stiffness, anchors = trees.rows((rests.t, rests.stiffness, rests.anchors), own)
            yield own, Rests(shapes, None, t, stiffness, anchors)


def chunk_of(n_vertices: int, device: torch.device) -> int:
    """How many samples of so many vertices are relaxed at a time."""
    return max(1, (CHUNK if device.type == "cpu" else CHUNK_OF_GPU) // n_vertices)
