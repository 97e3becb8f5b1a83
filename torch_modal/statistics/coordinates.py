"""Linear coordinates of shapes: rotations and strains of triangles from a mean shape."""

import torch
from torch import Tensor

from torch_modal.geometry.canonical import size
from torch_modal.geometry.connectivity import Connectivity
from torch_modal.geometry.local_rotations import LocalRotations
from torch_modal.geometry.poisson import Reconstruction
from torch_modal.geometry.rigid import best_fit
from torch_modal.geometry.triangle_frames import Sides, bend_sides, bend_slopes, bending_between, frames_of

# Only triangles without area have logarithmic strains beyond this, a factor of 3,000.
MOST_STRAIN = 8.0

# Triangles below this part of the mean area have the rotation of a neighbour, passed on in so many rounds, and no
# strain: their own would be rounding.
SMALLEST_AREA, FLAT_ROUNDS = 1e-9, 8


class BendingCoordinates:
    """Rotation vectors and logarithmic strains of all triangles, seen from a mean shape.

    Sums and multiples of them are shapes again: edges keep their lengths where triangles turn. They are the
    rotation-strain coordinates of Huang et al. 2011 with finite instead of infinitesimal rotations.

    After the columns of the triangles there is one for each piece but the largest, the offset of its centre from the
    motion of the vertices that it follows, in sizes of the mean. E is the number of all columns. Vertices of no face
    stay where the mean has them. The mean is float64 on the CPU. *Shape:* ``(V, 3), (F, 3)``.
    """

    def __init__(self, mean: Tensor, faces: Tensor) -> None:
        self.mean, self.faces = mean, faces
        self.mesh = Connectivity(faces.numpy(), len(mean))
        self.reconstruction = Reconstruction(mean, faces)
        self.frames = frames_of(mean[None], faces)
        areas = 0.5 * self.frames.twice_areas[0]
        self._has_area = areas > SMALLEST_AREA * areas.mean()
        self.size = size(mean.numpy(), faces.numpy())
        loose = self.reconstruction.loose
        #: Weights of the vertices in the centre of each piece but the largest. *Shape:* ``(L, V)``.
        self.centres = mean.new_zeros(len(loose), len(mean))
        for row, (piece, _) in zip(self.centres, loose, strict=True):
            row[piece] = self.reconstruction.poisson.shares[piece]
        total = self.reconstruction.areas.sum()
        pieces = mean.new_tensor([float(self.reconstruction.areas[piece].sum() / total) for piece, _ in loose])
        #: Weights of squared coordinates: parts of the area, twice off the diagonal of strains. *Shape:* ``(6, E)``.
        self.shares = torch.cat([areas / areas.sum(), pieces]) * areas.new_tensor([1, 1, 1, 1, 2, 1])[:, None]

    def of(self, shapes: Tensor) -> Tensor:
        """Coordinates of shapes, in the pose in which they fit the mean best. *Shape:* ``(B, V, 3) -> (B, 6, E)``.

        Rotations of up to a full turn, that neighbours share, are distinguished from their opposites.
        """
        columns, placed = [], self.align(shapes)
        for x in placed:
            rotations = LocalRotations(self.mesh, torch.stack([self.mean, x.detach()]))
            seen = frames_of(x[None], self.faces)
            turn, strain = bending_between(self.frames, seen, rotations.quaternions(self.frames, seen))
            turn, strain = turn[:, 0], strain[:, 0].clamp(-MOST_STRAIN, MOST_STRAIN)
            areas = seen.twice_areas[0]
            flat = ~self._has_area | (areas <= SMALLEST_AREA * areas.mean())
            flat = flat | ~(turn.isfinite().all(0) & strain.isfinite().all(0))
            strain, above = torch.where(flat, 0, strain), rotations.ancestors[0]
            for _ in range(FLAT_ROUNDS):
                turn, flat = torch.where(flat, turn[:, above], turn), flat & flat[above]
            columns.append(torch.cat([torch.where(flat, 0, turn), strain]))
        on_faces = torch.stack(columns) if columns else placed.new_zeros(0, 6, len(self.faces))
        offsets = placed.new_zeros(len(placed), 6, len(self.centres))
        rest = self.mean.expand_as(placed)
        for i, motion in enumerate(self.reconstruction.follow(rest, placed)):
            offset = self.centres[i, None] @ (placed - motion.apply(rest)) @ motion.rotation
            offsets[:, :3, i] = offset[:, 0] / self.size
        return torch.cat([on_faces, offsets], 2)

    def spread(self, fields: Tensor) -> Tensor:
        """Means of fields on the vertices, for each column. *Shape:* ``(..., V) -> (..., E)``."""
        return torch.cat([fields[..., self.faces].mean(-1), fields @ self.centres.mT], -1)

    def align(self, shapes: Tensor) -> Tensor:
        """The shapes in the pose in which they fit the mean best. *Shape:* ``(B, V, 3)``."""
        return best_fit(shapes, self.mean.expand_as(shapes), self.reconstruction.areas).apply(shapes)

    def sides(self, coordinates: Tensor) -> Sides:
        """Target sides of the triangles. *Shape:* ``(B, 6, E)``."""
        rows = coordinates[..., : len(self.faces)].movedim(1, 0)
        return bend_sides(rows[:3], rows[3:], self.frames)

    def slopes(self, coordinates: Tensor) -> Sides:
        """Derivatives of :meth:`sides` in the coordinates of each triangle. *Shape:* ``(1, 6, E) -> (3, 6, F)``."""
        rows = coordinates[..., : len(self.faces)].movedim(1, 0)
        axes = torch.eye(3).to(rows)[..., None, None]
        first, second = bend_slopes(rows[:3], rows[3:], self.frames, axes)
        return first[:, :, 0], second[:, :, 0]

    def shapes(self, coordinates: Tensor) -> Tensor:
        """The shapes of coordinates, in any pose. *Shape:* ``(B, 6, E) -> (B, V, 3)``."""
        rest = self.mean.expand(len(coordinates), -1, -1)
        shapes = self.reconstruction(self.sides(coordinates), rest)
        moves = (self.size * coordinates[:, :3, len(self.faces) :]).unbind(2)
        motions = self.reconstruction.follow(rest, shapes)
        for (piece, _), motion, move in zip(self.reconstruction.loose, motions, moves, strict=True):
            shapes = shapes.index_add(1, piece, (motion.rotation @ move[..., None]).mT.expand(-1, len(piece), -1))
        return shapes
