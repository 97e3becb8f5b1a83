"""Edge lengths, the first term of Eq. 5."""

import torch
from torch import Tensor

from torch_modal.elastic.term import Mesh, Term
from torch_modal.geometry.vectors import inverse, norm, tiny

# Eq. 5 divides by rest lengths: edges without one, as a part of the mean, have no say.
MIN_RELATIVE_LENGTH = 1e-6

# Strain over which the tension of an edge sets in.
SLACK = 1e-3


class Stretch(Term):
    r"""Edge lengths: :math:`\alpha \sum_e (l_e - \bar l_e)^2 / \bar l_e`, the first term of Eq. 5."""

    def elements(self, mesh: Mesh) -> Tensor:
        """All edges."""
        return mesh.edges

    def measure(self, edge_vectors: Tensor) -> Tensor:
        """The length."""
        return norm(edge_vectors[0])

    measures = measure

    def weights(self, edge_vectors: Tensor, measures: Tensor) -> Tensor:
        """One over the length."""
        return inverse(measures, measures <= MIN_RELATIVE_LENGTH * measures.mean(-1, keepdim=True))

    def gradients(self, edge_vectors: Tensor) -> Tensor:
        """Unit vectors, 0 where there is no length."""
        squared = (edge_vectors * edge_vectors).sum(1, keepdim=True)
        return edge_vectors * inverse(squared.sqrt(), squared <= tiny(edge_vectors))

    def hessians(self, edge_vectors: Tensor) -> Tensor:
        """The projector across the edge over the length, 0 where there is none."""
        edge = edge_vectors[0]
        squared = (edge * edge).sum(0)
        per_length = inverse(squared.sqrt(), squared <= tiny(edge))
        unit = edge * per_length
        eye = torch.eye(3, dtype=edge.dtype, device=edge.device).reshape(3, 3, *[1] * (edge.dim() - 1))
        return ((eye - unit[:, None] * unit) * per_length)[None, :, None]

    def tension(self, edge_vectors: Tensor, slope: Tensor, curvature: Tensor) -> Tensor:
        """Transverse stiffness of a stretched string; smoothly near zero under compression."""
        length = norm(edge_vectors[0])
        width = SLACK * curvature * length
        return 0.5 * (slope + (slope * slope + width * width + torch.finfo(slope.dtype).tiny).sqrt()) / length
