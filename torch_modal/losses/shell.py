"""Eq. 5 between a predicted shape and a rest shape, free of units and of resolution."""

from typing import NamedTuple

import torch
from torch import Tensor

from torch_modal.autograd import outside_inference_mode
from torch_modal.elastic import formulas
from torch_modal.elastic.energy import Rest
from torch_modal.elastic.shell import ShellEnergy
from torch_modal.geometry.canonical import CANONICAL_SIZE
from torch_modal.geometry.connectivity import Connectivity
from torch_modal.geometry.vectors import inverse, pick
from torch_modal.keyframes.arrays import as_faces

BEND, VOLUME = 1e-6, 1e-4
"""Stiffnesses relative to a stretching stiffness of one: about the paper's at a size of 100 and 5,000 vertices."""

# Smallest rest volume, as a part of (surface area)^(3/2), by which changes are divided; a sphere has 0.094.
SMALLEST_VOLUME = 0.01


class ShellTerms(NamedTuple):
    """The three terms of :class:`ShellLoss`, without stiffnesses."""

    stretch: Tensor
    """Mean squared strain of the edges. *Shape:* ``(...)``."""
    bend: Tensor
    """Squared change of curvature, summed over the surface. *Shape:* ``(...)``."""
    volume: Tensor
    """Squared relative change of the volume. *Shape:* ``(...)``."""


class ShellLoss(ShellEnergy):
    r"""Eq. 5 as a loss: stretch, bend and inflation of a predicted shape relative to a rest shape.

    .. math::
        \alpha \sum_e \frac{A_e}{A} \frac{(l_e - \bar l_e)^2}{\bar l_e^2}
        + \beta \sum_e (\theta_e - \bar\theta_e)^2 \frac{\bar l_e^2}{\bar A_e}
        + \gamma \frac{(v - \bar v)^2}{\bar v^2}

    :math:`A_e` is a third of the area of the faces at an edge, at rest, :math:`A` the total area, and :math:`\bar A_e`
    the area of both faces of a hinge. So the loss has no unit, and neither rigid motions nor a common scale of both
    shapes change it. A mesh that approaches a smooth surface has a limit as it is refined. If the triangles of a
    faceted surface are cut into four, the first and the last term stay, and the second, which is infinite for a crease,
    doubles.

    The rest shape is a template, the last frame, a neighbour in latent space, or the target itself. Gradients reach
    both shapes, and may be differentiated again.

    Args:
        faces: Vertex indices. *Shape:* ``(F, 3)``.
        alpha: Stretching stiffness, as for :class:`torch_modal.ShellEnergy`.
        beta: Bending stiffness: half a square of the thickness over the size.
        gamma: Volume stiffness; nothing in open surfaces, which enclose none.
    """

    sides: Tensor

    @outside_inference_mode
    def __init__(
        self, faces: Tensor, alpha: float | Tensor = 1.0, beta: float | Tensor = BEND, gamma: float | Tensor = VOLUME
    ) -> None:
        super().__init__(faces, alpha, beta, gamma)
        mesh = Connectivity(as_faces(faces))
        #: Open surfaces have no volume.
        self.closed = len(mesh.boundary_edges) == 0
        self.register_buffer("sides", torch.tensor(mesh.sides), persistent=False)

    def rest(self, x_rest: Tensor) -> Rest:
        """Measures and weights of rest shapes. *Shape:* ``(..., V, 3)``."""
        rows = self._rows(x_rest)
        (length, angle, volume), (per_length, bend, _) = self.energy.rest(rows)
        first, second, third = (pick(rows, corner) for corner in self.faces.T)
        areas = formulas.triangle_area(second - first, third - first)
        area = areas.sum(-1, keepdim=True)
        thirds = (areas / 3).repeat(*[1] * (areas.dim() - 1), 3)
        shares = torch.zeros_like(length).index_add(-1, self.sides, thirds) * inverse(area, area <= 0)
        if self.closed:
            smallest = SMALLEST_VOLUME * area**1.5
            to_volume = inverse(torch.maximum(volume.abs(), smallest), smallest <= 0).square()
        else:
            to_volume = torch.zeros_like(volume)
        return Rest((length, angle, volume), (shares * per_length.square(), bend, to_volume))

    def terms_of(self, x: Tensor, x_rest: Tensor) -> ShellTerms:
        """The three terms on their own. Arguments as for :meth:`forward`."""
        self._check(x, x_rest)
        scale = self.scale(x_rest)
        rows, rest = self._rows(scale * x), self.rest(scale * x_rest)
        terms = []
        for summand, measures, weights in zip(self.energy.parts, rest.measures, rest.weights, strict=True):
            off = summand.term.difference(summand.measures(summand.edge_vectors(rows)), measures)
            terms.append((weights * off.square()).sum(-1))
        return ShellTerms(*terms)

    def forward(self, x: Tensor, x_rest: Tensor) -> Tensor:
        """The loss of each shape.

        Args:
            x: Predicted shapes. *Shape:* ``(..., V, 3)``.
            x_rest: Rest shapes, broadcast against ``x``. *Shape:* ``(..., V, 3)``.

        Returns:
            *Shape:* ``(...)``.

        Raises:
            ValueError: Shapes that do not belong to the faces.
        """
        self._check(x, x_rest)
        scale = self.scale(x_rest)
        return super().forward(scale * x, scale * x_rest)

    def scale(self, x_rest: Tensor) -> Tensor:
        """Scale to a common size, as squares of areas underflow in float32. *Shape:* ``(..., V, 3) -> (..., 1, 1)``."""
        used = x_rest.detach()[..., : self.energy.n_vertices, :]
        extent = (used.amax(-2) - used.amin(-2)).norm(dim=-1)[..., None, None]
        return CANONICAL_SIZE * inverse(extent, extent <= 0)

    def _check(self, *shapes: Tensor) -> None:
        n = self.energy.n_vertices
        for x in shapes:
            if x.dim() < 2 or x.shape[-1] != 3 or x.shape[-2] < n or not x.is_floating_point():
                raise ValueError(
                    f"shapes are floating-point of (..., V, 3), with the {n} vertices that the faces name or more; got "
                    f"{tuple(x.shape)} of {x.dtype}"
                )
