"""Edge lengths, the first term of Eq. 5."""

from torch import Tensor

from torch_modal.elastic import formulas
from torch_modal.elastic.term import Formulas, Mesh, Term


class Stretch(Term):
    r"""Edge lengths: :math:`\alpha \sum_e (l_e - \bar l_e)^2 / \bar l_e`, the first term of Eq. 5."""

    formula, linearised = staticmethod(formulas.edge_length), staticmethod(formulas.linearised_length)
    own_formulas = Formulas(
        "stretch",
        1,
        formulas.edge_length,
        formulas.linearised_length,
        weight=formulas.length_weight,
        tension=formulas.tension,
        uses_mean=True,
        even=True,
    )

    def elements(self, mesh: Mesh) -> Tensor:
        """All edges."""
        return mesh.edges

    def weights(self, edge_vectors: Tensor, measures: Tensor) -> Tensor:
        """One over the length."""
        return formulas.length_weight(edge_vectors, measures, measures.mean(-1, keepdim=True))

    def tension(self, edge_vectors: Tensor, slope: Tensor, curvature: Tensor) -> Tensor:
        """Transverse stiffness of a stretched string; smoothly near zero under compression."""
        return formulas.tension(self.measures(edge_vectors), slope, curvature)
