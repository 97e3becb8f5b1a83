"""Linear coordinates of shapes: how every triangle turns and stretches from a mean shape."""

import torch
from torch import Tensor

from torch_modal.geometry.connectivity import Connectivity
from torch_modal.geometry.local_rotations import LocalRotations
from torch_modal.geometry.poisson import Reconstruction
from torch_modal.geometry.rigid import best_fit
from torch_modal.geometry.triangle_frames import (
    BentTriangles,
    Frames,
    Sides,
    bending_between,
    bent_sides,
    frames,
    sides,
)

# Logarithmic strains beyond this, a factor of 3,000, are those of triangles without area.
MOST_STRAIN = 8.0

# Triangles smaller than this part of the mean have no coordinates: theirs would be rounding.
SMALLEST_AREA = 1e-9


class BendingCoordinates:
    """Rotation vectors and logarithmic strains of all triangles, seen from a mean shape.

    Sums and multiples of them are shapes again: edges keep their lengths where triangles turn. They are the
    rotation-strain coordinates of Huang et al. 2011 with finite rotations in the place of infinitesimal ones.

    Args:
        mean: The shape whose coordinates are zero, float64 on the CPU. *Shape:* ``(V, 3)``.
        faces: Vertex indices. *Shape:* ``(F, 3)``.
    """

    def __init__(self, mean: Tensor, faces: Tensor) -> None:
        self.mean, self.faces = mean, faces
        self.mesh = Connectivity(faces.numpy(), len(mean))
        self.reconstruction = Reconstruction(mean, faces)
        self.frames = self._frames(mean[None])
        areas = 0.5 * self.frames.doubled_areas[0]
        self._has_area = areas > SMALLEST_AREA * areas.mean()
        #: Weights of squared coordinates: parts of the area, twice beside the diagonal of strains. *Shape:* ``(6, F)``.
        self.shares = areas / areas.sum() * areas.new_tensor([1, 1, 1, 1, 2, 1])[:, None]

    def _frames(self, x: Tensor) -> Frames:
        return frames(sides(x.movedim(-1, 0).contiguous(), self.faces))

    def of(self, shapes: Tensor) -> Tensor:
        """The coordinates of shapes, in the pose in which they fit the mean best. *Shape:* ``(B, V, 3) -> (B, 6, F)``.

        Rotations of up to a full turn, that neighbours share, are distinguished from their opposites.
        """
        found = []
        for x in self.aligned(shapes):
            pair = torch.stack([self.mean, x.detach()])
            turns = LocalRotations(self.mesh, pair).turns(self.mean[None], x[None])
            bending = bending_between(self.frames, self._frames(x[None]), turns)
            strain = torch.stack(bending.strain).clamp(-MOST_STRAIN, MOST_STRAIN)
            found.append(torch.cat([bending.turn, strain])[:, 0])
        return torch.where(self._has_area, torch.stack(found), 0)

    def aligned(self, shapes: Tensor) -> Tensor:
        """The shapes in the pose in which they fit the mean best. *Shape:* ``(B, V, 3)``."""
        return best_fit(shapes, self.mean.expand_as(shapes), self.reconstruction.areas).apply(shapes)

    def sides(self, coordinates: Tensor) -> Sides:
        """The sides that triangles ask for. *Shape:* ``(B, 6, F)``."""
        rows = coordinates.movedim(1, 0)
        return bent_sides(BentTriangles(rows[:3], (rows[3], rows[4], rows[5])), self.frames)

    def shapes(self, coordinates: Tensor) -> Tensor:
        """The shapes of coordinates, in the pose of the mean. *Shape:* ``(B, 6, F) -> (B, V, 3)``."""
        rest = self.mean.mT[:, None].expand(-1, len(coordinates), -1).contiguous()
        found = self.reconstruction(self.sides(coordinates), rest).movedim(0, -1)
        return self.aligned(found)
