"""Edge lengths, the first term of Eq. 5."""

from functools import cache
from typing import no_type_check

import torch
from torch import Tensor

from torch_modal.elastic.term import KernelFunctions, Mesh, Term, square
from torch_modal.geometry.vectors import inverse, norm, tiny

# Eq. 5 divides by rest lengths: edges without one, as a part of the mean, have no say.
MIN_RELATIVE_LENGTH = 1e-6

# Strain over which the tension of an edge sets in.
STRAIN_OF_TENSION = 1e-3


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

    def linearise(self, edge_vectors: Tensor) -> tuple[Tensor, Tensor]:
        """Lengths and unit vectors, 0 where there is no length."""
        length, squared = self.measure(edge_vectors), (edge_vectors * edge_vectors).sum((0, 1))
        return length, edge_vectors * inverse(length, squared <= tiny(edge_vectors))

    def tension(self, edge_vectors: Tensor, slope: Tensor, curvature: Tensor) -> Tensor:
        """Transverse stiffness of a stretched string; smoothly near zero under compression."""
        length = norm(edge_vectors[0])
        width = STRAIN_OF_TENSION * curvature * length
        return 0.5 * (slope + (slope * slope + width * width + torch.finfo(slope.dtype).tiny).sqrt()) / length

    def kernel_functions(self, n: int) -> KernelFunctions | None:
        """Functions of edges; of a class that inherits from this one, its own."""
        return kernel_functions() if type(self) is Stretch else super().kernel_functions(n)


@cache
@no_type_check
def kernel_functions() -> KernelFunctions:
    """Edges as above, for kernels."""
    import warp as wp

    real, edge = wp.float64, wp.types.matrix(shape=(1, 3), dtype=wp.float64)
    slack, shortest = wp.constant(real(STRAIN_OF_TENSION)), wp.constant(real(MIN_RELATIVE_LENGTH))
    tiny_square, tiniest = wp.constant(real(tiny(torch.empty(0, dtype=torch.float64)))), wp.constant(real(2.0**-1022))

    @wp.func
    def measure(x: edge):
        return wp.sqrt(wp.max(wp.dot(x[0], x[0]), tiny_square))

    @wp.func
    def linearise(x: edge):
        length = measure(x)
        return length, wp.matrix_from_rows((real(1.0) / length) * x[0])

    @wp.func
    def weight(x: edge, length: real, mean: real):
        result = real(0.0)
        if length > shortest * mean:
            result = real(1.0) / length
        return result

    @wp.func
    def across(length: real, slope: real, stiffness: real):
        width = slack * stiffness * length
        return real(0.5) / length * (slope + wp.sqrt(slope * slope + width * width + tiniest))

    return KernelFunctions(
        "stretch", 1, square(), measure, linearise, weight=weight, uses_mean=True, across=across, even=True
    )
