"""The enclosed volume, the third term of Eq. 5."""

import torch
from torch import Tensor

from torch_modal.elastic.term import Mesh, Term
from torch_modal.geometry.connectivity import Connectivity, double_areas
from torch_modal.geometry.inspect import OPEN, open_part, signed_volume
from torch_modal.geometry.vectors import cross, norm

# Eq. 5 divides by the rest volume, which has this bound for flat bodies, as a part of (surface area)^(3/2); a sphere
# has 0.094.
MIN_RELATIVE_VOLUME = 1e-6


class Volume(Term):
    r"""Enclosed volume: :math:`\gamma\, (v - \bar v)^2 / \bar v^2`, the third term of Eq. 5.

    It is the sum of the tetrahedra from the centroid to all faces, so that an open surface may be moved too.
    """

    total = True

    def elements(self, mesh: Mesh) -> Tensor:
        """The centre and each face, of a surface that cones from its boundary to the centre have closed."""
        chain = torch.tensor(mesh.connectivity.boundary_chain)
        centre = torch.full_like(chain[:, :1], mesh.centre)
        closed = torch.cat([mesh.faces, torch.cat([chain.flip(1), centre], 1)])
        return torch.cat([torch.full_like(closed[:, :1], mesh.centre), closed], 1)

    def measure(self, edge_vectors: Tensor) -> Tensor:
        """Signed volume of a tetrahedron."""
        p, q, r = edge_vectors
        return (p * cross(q, r)).sum(0) / 6

    measures = measure

    def weights(self, edge_vectors: Tensor, measures: Tensor) -> Tensor:
        """One over the square of the volume."""
        p, q, r = edge_vectors
        surface = 0.5 * norm(cross(q - p, r - p)).sum(-1, keepdim=True)
        return torch.maximum(measures.abs(), MIN_RELATIVE_VOLUME * surface**1.5) ** -2

    def gradients(self, edge_vectors: Tensor) -> Tensor:
        """Sixths of cross products."""
        p, q, r = edge_vectors
        return torch.stack([cross(q, r), cross(r, p), cross(p, q)]) / 6

    def hessians(self, edge_vectors: Tensor) -> Tensor:
        """``p.(q x r)`` has the block ``-[r]`` between ``p`` and ``q``."""
        zero = torch.zeros_like(edge_vectors[0, 0])
        p, q, r = (
            torch.stack([zero, z, -y, -z, zero, x, y, -x, zero]).unflatten(0, (3, 3)) for x, y, z in edge_vectors / 6
        )
        none = torch.zeros_like(p)
        rows = (none, r, -q), (-r, none, p), (q, -p, none)
        return torch.stack([torch.stack(row, 1) for row in rows])


def encloses(x: Tensor, mesh: Connectivity) -> bool:
    """True for a shape that encloses a volume: it has small holes at most, and is not flat. *Shape:* ``(V, 3)``."""
    points = x.detach().cpu().double().numpy()
    if open_part(points, mesh) > OPEN:
        return False
    area = double_areas(points, mesh.faces).sum() / 2
    volume = signed_volume(points - points[mesh.used].mean(0), mesh.faces)
    return bool(abs(volume) > MIN_RELATIVE_VOLUME * area**1.5)
