"""Discrete-shell energy of Eq. 5: edge lengths, dihedral angles and enclosed volume."""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor, nn

from torch_modal.autograd import outside_inference_mode
from torch_modal.elastic.bend import SquaredBend
from torch_modal.elastic.energy import Energy, Reference, Rest
from torch_modal.elastic.stretch import Stretch
from torch_modal.elastic.term import Mesh, Term
from torch_modal.elastic.volume import Volume
from torch_modal.keyframes.arrays import as_faces

ALPHA, BETA, GAMMA = 500.0, 10.0, 1000.0
"""The paper's stiffnesses. Eq. 5 is not scale-invariant: they are meant for shapes of `CANONICAL_SIZE`."""


class Measures(NamedTuple):
    """The measures of Eq. 5 on a shape."""

    length: Tensor
    """Edge lengths. *Shape:* ``(..., E)``."""
    angle: Tensor
    """Signed dihedral angles in radians, 0 where flat. *Shape:* ``(..., H)``."""
    volume: Tensor
    """Signed volume enclosed with the centroid. *Shape:* ``(...,)``."""


class ShellEnergy(nn.Module):
    r"""Discrete-shell energy between a shape and a rest shape (Eq. 5 of the paper).

    .. math::
        d(\bar x, x) = \alpha \sum_e \frac{(\bar l_e - l_e)^2}{\bar l_e}
            + \beta \sum_e (\bar\theta_e - \theta_e)^2 \frac{\bar l_e^2}{\bar A_e}
            + \gamma \frac{(\bar v - v)^2}{\bar v^2}

    Angle differences are wrapped. The volume is taken relative to the centroid, so that the energy of an open surface
    does not change with a translation either. The three terms scale differently with size: the defaults are meant
    for shapes whose radius of gyration, times ``2 sqrt(3)``, is about 100. That is about the diagonal of the box.

    Args:
        faces: Vertex indices. *Shape:* ``(F, 3)``.
        alpha: Stretching stiffness: a number, or a tensor or parameter whose last dimension counts the edges, or is 1,
            and whose others broadcast against the shapes. *Shape:* ``()``, ``(..., E)`` or ``(..., 1)``.
        beta: Bending stiffness, likewise with the hinges. *Shape:* ``()``, ``(..., H)`` or ``(..., 1)``.
        gamma: Volume stiffness. *Shape:* ``()`` or ``(..., 1)``.
        terms: Further terms; the energy is the sum of all. Their anchors are in the coordinates of the shapes.
    """

    faces: Tensor

    @outside_inference_mode
    def __init__(
        self,
        faces: Tensor,
        alpha: float | Tensor = ALPHA,
        beta: float | Tensor = BETA,
        gamma: float | Tensor = GAMMA,
        terms: tuple[Term, ...] = (),
    ) -> None:
        super().__init__()
        self.register_buffer("faces", torch.from_numpy(as_faces(faces)), persistent=False)
        self.terms: Sequence[Term] = nn.ModuleList(  # type: ignore[assignment]
            [Stretch(alpha), SquaredBend(beta), Volume(gamma), *terms]
        )
        self.energy = Energy(Mesh.of(self.faces, int(self.faces.max()) + 1), [*self.terms])

    def _rows(self, x: Tensor) -> Tensor:
        """Vertices of faces, components first, extended, float32 or more. *Shape:* ``(..., V, 3) -> (3, ..., V)``."""
        rows = x[..., : self.energy.n_vertices, :].movedim(-1, 0).contiguous()
        rows = rows.to(torch.promote_types(rows.dtype, torch.float32))
        anchors = self.energy.anchors
        if anchors is not None:
            anchors = anchors.to(rows).mT.reshape(3, *[1] * (rows.dim() - 2), -1)
        return self.energy.extend(rows, anchors)

    def rest(self, x_rest: Tensor) -> Rest:
        """Measures and weights of rest shapes. *Shape:* ``(..., V, 3)``."""
        return self.energy.rest(self._rows(x_rest))

    def reference_of(self, x_rest: Tensor) -> Reference:
        """Rest shapes as references, with the stiffnesses. *Shape:* ``(..., V, 3)``."""
        return self.energy.reference_of(self.rest(x_rest), self.stiffness)

    def measure(self, x: Tensor) -> Measures:
        """Lengths, angles and volume of shapes. *Shape:* ``(..., V, 3)``."""
        rows = self._rows(x)
        length, angle, volume = (term.measures(term.edge_vectors(rows)) for term in list(self.energy.parts)[:3])
        return Measures(length, angle, volume[..., 0])

    def residuals(self, x: Tensor, x_rest: Tensor) -> Tensor:
        """The terms of Eq. 5 whose squares sum to the energy: E stretching, H bending, one volume, then further terms.

        Args:
            x: Vertex positions. *Shape:* ``(..., V, 3)``.
            x_rest: Rest positions, broadcast against ``x``. *Shape:* ``(..., V, 3)``.

        Returns:
            *Shape:* ``(..., E + H + 1)``.
        """
        rows, rest = self._rows(x), self.rest(x_rest)
        parts = [
            (factor * weights).sqrt() * summand.term.difference(summand.measures(summand.edge_vectors(rows)), measures)
            for summand, measures, weights, factor in zip(self.energy.parts, *rest, self.stiffness, strict=True)
        ]
        lead = torch.broadcast_tensors(*(summand[..., :1] for summand in parts))[0].shape[:-1]
        return torch.cat([summand.expand(*lead, -1) for summand in parts], -1)

    def forward(self, x: Tensor, x_rest: Tensor) -> Tensor:
        """Energy of Eq. 5.

        Args:
            x: Vertex positions. *Shape:* ``(..., V, 3)``.
            x_rest: Rest positions, broadcast against ``x``. *Shape:* ``(..., V, 3)``.

        Returns:
            *Shape:* ``(...,)``.
        """
        return self.energy.value(self._rows(x), self.reference_of(x_rest))

    @property
    def stiffness(self) -> list[float | Tensor]:
        """The stiffness of each term."""
        return [term.stiffness for term in self.terms]
