"""Dihedral angles, the second term of Eq. 5."""

import torch
from torch import Tensor

from torch_modal.elastic import formulas
from torch_modal.elastic.term import Formulas, Mesh, PeriodicTerm, Term, wrap_angle

NEEDLE = 0.2**2
"""Square of the altitude of a triangle over its longest side at which its fullness is a half, in the modal solve; an
equilateral one has 0.75."""
NEEDLE_OF_STEPS = 0.3**2
"""The same for the steps of all vertices."""


class SquaredBend(Term):
    r"""Dihedral angles: :math:`\beta \sum_h (\theta_h - \bar\theta_h)^2 \bar l_h^2 / \bar A_h`, the second of Eq. 5.

    The angle is the signed one between the normals of the two triangles of a hinge, 0 where flat, in ``(-pi, pi]``; the
    edge vectors are those of a row of :attr:`~torch_modal.geometry.connectivity.Connectivity.hinges`. Differences are
    wrapped: the energy has a kink where an angle differs by half a turn.
    """

    formula = staticmethod(formulas.hinge_angle)

    def elements(self, mesh: Mesh) -> Tensor:
        """All hinges."""
        return mesh.hinges

    def weights(self, edge_vectors: Tensor, measures: Tensor) -> Tensor:
        """Square of the edge over the area of both triangles."""
        return formulas.hinge_weight(edge_vectors, measures, measures)

    def difference(self, measures: Tensor, rest: Tensor) -> Tensor:
        """The short way round."""
        return wrap_angle(measures - rest)

    def linearise(self, edge_vectors: Tensor) -> tuple[Tensor, Tensor]:
        """Angles, and their gradients in closed form, zero where a triangle is collapsed.

        By ``torch.func``, an in-between in torch takes 1.2 to 1.4 times as long.
        """
        (cosine, sine), gradients = formulas.linearised_phase(edge_vectors)
        return torch.atan2(sine, cosine), gradients


class Bend(PeriodicTerm, SquaredBend):
    r"""Dihedral angles: :math:`\beta \sum_h f(\theta_h - \bar\theta_h) \bar l_h^2 / \bar A_h`, smooth at half a turn.

    :class:`~torch_modal.elastic.term.PeriodicTerm` has the function ``f``, which is the square of Eq. 5 below a radian.
    """

    own_formulas = Formulas(
        "bend",
        3,
        formulas.hinge_phase,
        formulas.linearised_phase,
        weight=formulas.hinge_weight,
        fullness=formulas.hinge_fullness,
        periodic=True,
        gives_phase=True,
    )

    def softening(self, start: Tensor, rest: Tensor, weights: Tensor | None) -> Tensor:
        """Less stiffness at needles: their gradient has no bound, and minimisers would turn their normals over.

        The factor is the fullness, or its ratio to the fullness of the rest shapes.
        """
        if weights is None:
            return formulas.hinge_fullness(start, NEEDLE)
        usual = (weights[..., None] * formulas.hinge_fullness(rest, NEEDLE_OF_STEPS)).sum(1)
        return formulas.softness(formulas.hinge_fullness(start, NEEDLE_OF_STEPS), usual)
