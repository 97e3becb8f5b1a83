"""Coordinates of vertices as measures: pulls vertices to places."""

import torch
from torch import Tensor

from torch_modal.energy.term import Mesh, Term


class Position(Term):
    """The coordinates of all vertices of the caller's mesh, one after the other; those wanted are in the reference.

    An element is a vertex, the term's only anchor, which lies at the origin, and one of the three axes.
    """

    sampled = True
    axes: Tensor

    def __init__(self, n_vertices: int) -> None:
        super().__init__()
        axes = torch.eye(3).repeat_interleave(n_vertices, 1)
        self.register_buffer("axes", axes, persistent=False)

    @property
    def anchors(self) -> Tensor:
        """The origin."""
        return self.axes.new_zeros(1, 3)

    def elements(self, mesh: Mesh) -> Tensor:
        """All vertices, three times. *Shape:* ``(3 V, 2)``."""
        vertices = torch.arange(mesh.n_vertices).repeat(3)
        return torch.stack([torch.full_like(vertices, mesh.first_anchor), vertices], 1)

    def measure(self, edge_vectors: Tensor) -> Tensor:
        """The coordinate along the element's axis."""
        return torch.einsum("i...m,im->...m", edge_vectors[0], self.axes.to(edge_vectors))

    measures = measure

    def gradients(self, edge_vectors: Tensor) -> Tensor:
        """The axis."""
        axes = self.axes.to(edge_vectors)
        return axes.reshape(1, 3, *[1] * (edge_vectors.dim() - 3), -1).expand_as(edge_vectors)
