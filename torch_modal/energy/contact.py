r"""The contact term: vertices stay in front of the faces that hold them.

With the distance :math:`g` of a vertex from the plane of a face, along the face's normal, the energy is
:math:`\sum_m k A_m \min(g_m - \bar g_m, 0)^2`, with the area ``A`` around the vertex and the gap :math:`\bar g` that is
wanted. It is zero, with its first derivative, where the gap is kept.
"""

import torch
from torch import Tensor

from torch_modal.energy.term import Mesh, Term
from torch_modal.geometry.vectors import cross, inverse, norm

GAP = 0.15
"""The distance that is kept, at a size of 100."""
STIFFNESS = 3000.0
"""``k``, at that size; stretching has 500."""


class Contact(Term):
    """Distances of vertices from the planes of faces, one-sided.

    Args:
        elements: A face and the vertex in front of it. *Shape:* ``(M, 4)``.
        stiffness: As for :class:`Term`.
        gap: Distance that is kept.
    """

    sampled = True
    one_sided = True
    elements_: Tensor

    def __init__(self, elements: Tensor, stiffness: float | Tensor = STIFFNESS, gap: float = GAP) -> None:
        super().__init__(stiffness)
        self.register_buffer("elements_", elements)
        self.gap = gap

    def elements(self, mesh: Mesh) -> Tensor:
        """As given."""
        return self.elements_

    def measure(self, edge_vectors: Tensor) -> Tensor:
        """Height of the vertex over the plane of the face."""
        side, other, to_vertex = edge_vectors
        doubled = cross(side, other)
        length = norm(doubled)
        return (doubled * to_vertex).sum(0) * inverse(length, length <= 0)

    measures = measure

    def at_rest(self, measures: Tensor) -> Tensor:
        """The gap."""
        return torch.full_like(measures, self.gap)

    def difference(self, measures: Tensor, rest: Tensor) -> Tensor:
        """The missing distance; zero where the gap is kept."""
        return (measures - rest).clamp_max(0)

    def gradients(self, edge_vectors: Tensor) -> Tensor:
        """The unit normal for the vertex; the sides of the face turn it."""
        side, other, to_vertex = edge_vectors
        doubled = cross(side, other)
        length = norm(doubled)
        per_length = inverse(length, length <= 0)
        normal = doubled * per_length
        within = (to_vertex - (normal * to_vertex).sum(0) * normal) * per_length
        return torch.stack([cross(other, within), cross(within, side), normal])
