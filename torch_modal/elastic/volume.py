"""The enclosed volume, the third term of Eq. 5."""

import torch
from torch import Tensor

from torch_modal.elastic import formulas
from torch_modal.elastic.formulas import MIN_RELATIVE_VOLUME
from torch_modal.elastic.term import Formulas, Mesh, Term
from torch_modal.geometry.connectivity import Connectivity, double_areas
from torch_modal.geometry.inspect import OPEN, open_part, volume_of


class Volume(Term):
    r"""Enclosed volume: :math:`\gamma\, (v - \bar v)^2 / \bar v^2`, the third term of Eq. 5.

    It is the sum of the tetrahedra from the centroid to all faces, so that an open surface may be moved too.
    """

    total = True
    formula, linearised = staticmethod(formulas.tetrahedron), staticmethod(formulas.linearised_tetrahedron)
    own_formulas = Formulas(
        "volume", 1, formulas.sum_of_total, formulas.linearised_sum_of_total, weight=formulas.weight_of_volume
    )

    def elements(self, mesh: Mesh) -> Tensor:
        """The centre and each face."""
        return torch.cat([torch.full_like(mesh.faces[:, :1], mesh.centre), mesh.faces], 1)

    def weights(self, edge_vectors: Tensor, measures: Tensor) -> Tensor:
        """One over the square of the volume."""
        p, q, r = edge_vectors
        return formulas.volume_weight(measures, formulas.triangle_area(q - p, r - p).sum(-1, keepdim=True))


def encloses(x: Tensor, mesh: Connectivity) -> bool:
    """True for a shape that encloses a volume: it has small holes at most, and is not flat. *Shape:* ``(V, 3)``."""
    points = x.detach().cpu().double().numpy()
    if open_part(points, mesh) > OPEN:
        return False
    area = double_areas(points, mesh.faces).sum() / 2
    volume = volume_of(points, mesh.faces, mesh.used)
    return bool(abs(volume) > MIN_RELATIVE_VOLUME * area**1.5)
