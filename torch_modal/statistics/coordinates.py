"""Linear coordinates of shapes, rotations and strains of triangles from a mean shape, and principal components."""

import torch
from torch import Tensor

from torch_modal.autograd import lasting
from torch_modal.geometry.canonical import size
from torch_modal.geometry.connectivity import Connectivity
from torch_modal.geometry.local_rotations import LocalRotations
from torch_modal.geometry.poisson import Reconstruction
from torch_modal.geometry.rigid import RigidMotion, best_fit
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

# Triangles below this part of the mean area have the rotation of a neighbour, passed on in so many rounds, and no
# strain: their own would be rounding.
SMALLEST_AREA, FLAT_ROUNDS = 1e-9, 8


class BendingCoordinates:
    """Rotation vectors and logarithmic strains of all triangles, seen from a mean shape.

    Sums and multiples of them are shapes again: edges keep their lengths where triangles turn. They are the
    rotation-strain coordinates of Huang et al. 2011 with finite rotations in the place of infinitesimal ones.

    After the columns of the triangles there is one for each piece but the largest, the offset of its centre from the
    motion of the vertices that it follows, and one for each vertex of no face, its displacement; in sizes of the mean.
    E is the number of all columns.

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
        self.size = size(mean.numpy(), faces.numpy())
        loose = self.reconstruction.loose
        used = torch.zeros(len(mean), dtype=torch.bool).index_fill(0, faces.flatten(), True)
        self._unused = torch.nonzero(~used).flatten()
        #: Weights of the vertices in the centre of each piece but the largest. *Shape:* ``(L, V)``.
        self.centres = mean.new_zeros(len(loose), len(mean))
        for row, (piece, _) in zip(self.centres, loose, strict=True):
            row[piece] = self.reconstruction.poisson.shares[piece]
        total = self.reconstruction.areas.sum()
        pieces = mean.new_tensor([float(self.reconstruction.areas[piece].sum() / total) for piece, _ in loose])
        parts = torch.cat([areas / areas.sum(), pieces, mean.new_zeros(len(self._unused))])
        #: Weights of squared coordinates: parts of the area, twice beside the diagonal of strains. *Shape:* ``(6, E)``.
        self.shares = parts * areas.new_tensor([1, 1, 1, 1, 2, 1])[:, None]

    def _frames(self, x: Tensor) -> Frames:
        return frames(sides(x.movedim(-1, 0).contiguous(), self.faces))

    def of(self, shapes: Tensor) -> Tensor:
        """The coordinates of shapes, in the pose in which they fit the mean best. *Shape:* ``(B, V, 3) -> (B, 6, E)``.

        Rotations of up to a full turn, that neighbours share, are distinguished from their opposites.
        """
        found, placed = [], self.aligned(shapes)
        for x in placed:
            rotations = LocalRotations(self.mesh, torch.stack([self.mean, x.detach()]))
            own = self._frames(x[None])
            bending = bending_between(self.frames, own, rotations.turns(self.mean[None], x[None]))
            turn, strain = bending.turn[:, 0], torch.stack(bending.strain)[:, 0].clamp(-MOST_STRAIN, MOST_STRAIN)
            areas = own.doubled_areas[0]
            flat = ~self._has_area | (areas <= SMALLEST_AREA * areas.mean())
            flat = flat | ~(turn.isfinite().all(0) & strain.isfinite().all(0))
            strain, above = torch.where(flat, 0, strain), rotations.ancestors[0]
            for _ in range(FLAT_ROUNDS):
                turn, flat = torch.where(flat, turn[:, above], turn), flat & flat[above]
            found.append(torch.cat([torch.where(flat, 0, turn), strain]))
        on_faces = torch.stack(found) if found else placed.new_zeros(0, 6, len(self.faces))
        beyond = [
            (torch.einsum("v,bvi->bi", row, placed)[:, None] - centre) @ motion.rotation
            for row, (centre, motion) in zip(self.centres, self._followed(placed), strict=True)
        ]
        beyond.append(placed[:, self._unused] - self.mean[self._unused])
        offsets = (torch.cat(beyond, 1) / self.size).mT
        return torch.cat([on_faces, torch.cat([offsets, torch.zeros_like(offsets)], 1)], 2)

    def _followed(self, shapes: Tensor) -> list[tuple[Tensor, RigidMotion]]:
        """Centre and motion of each loose piece, by the vertices that it follows. *Shape:* ``(B, V, 3)``."""
        found = []
        for row, (_, anchors) in zip(self.centres, self.reconstruction.loose, strict=True):
            before = self.mean[anchors].expand(len(shapes), -1, -1)
            motion = best_fit(before, shapes[:, anchors], self.mean.new_ones(len(anchors)))
            found.append((motion.apply((row @ self.mean).expand(len(shapes), 1, -1)), motion))
        return found

    def spread(self, fields: Tensor) -> Tensor:
        """Means of fields on the vertices, for each column. *Shape:* ``(..., V) -> (..., E)``."""
        return torch.cat([fields[..., self.faces].mean(-1), fields @ self.centres.mT, fields[..., self._unused]], -1)

    def carries(self, vertices: Tensor) -> Tensor:
        """Columns beyond those of the triangles that move a vertex, as a mask. *Shape:* ``(n,) -> (n, E - F)``."""
        return torch.cat([self.centres[:, vertices].mT > 0, vertices[:, None] == self._unused], 1)

    def aligned(self, shapes: Tensor) -> Tensor:
        """The shapes in the pose in which they fit the mean best. *Shape:* ``(B, V, 3)``."""
        return best_fit(shapes, self.mean.expand_as(shapes), self.reconstruction.areas).apply(shapes)

    def sides(self, coordinates: Tensor) -> Sides:
        """Target sides of the triangles. *Shape:* ``(B, 6, E)``."""
        rows = coordinates[..., : len(self.faces)].movedim(1, 0)
        return bent_sides(BentTriangles(rows[:3], (rows[3], rows[4], rows[5])), self.frames)

    def shapes(self, coordinates: Tensor) -> Tensor:
        """The shapes of coordinates, in the pose of the mean. *Shape:* ``(B, 6, E) -> (B, V, 3)``."""
        rest = self.mean.mT[:, None].expand(-1, len(coordinates), -1).contiguous()
        found = self.reconstruction(self.sides(coordinates), rest).movedim(0, -1)
        offsets = self.size * coordinates[:, :3, len(self.faces) :].mT
        moves = offsets[:, : len(self.centres)].unbind(1)
        for (piece, _), (_, motion), move in zip(self.reconstruction.loose, self._followed(found), moves, strict=True):
            found = found.index_add(1, piece, (motion.rotation @ move[..., None]).mT.expand(-1, len(piece), -1))
        unused = self.mean[self._unused] + offsets[:, len(moves) :]
        return self.aligned(found).index_copy(1, self._unused, unused)


class Components:
    """Directions in which the shapes of a set vary most, and coordinates along them.

    They are those of rotations and strains of the triangles, weighted by area: a component bends a leg where one of
    displacements would shear it.

    Args:
        coordinates: About the mean.
        bending: Those of the given shapes. *Shape:* ``(K, 6, E)``.
        n: Number of components, at most K - 1.
        origin: Point that was subtracted from the shapes. *Shape:* ``(3,)``.
    """

    @lasting
    def __init__(self, coordinates: BendingCoordinates, bending: Tensor, n: int, origin: Tensor) -> None:
        self._coordinates, self._origin = coordinates, origin
        self._average = bending.mean(0)
        off = ((bending - self._average) * coordinates.shares.sqrt()).flatten(1)
        left, values, _ = torch.linalg.svd(off, full_matrices=False)
        left, values = left[:, :n], values[:n]
        # The sign under which the first shape that is not in the middle lies on the positive side.
        first = left.abs().argmax(0, keepdim=True)
        left = left * torch.where(left.gather(0, first) < 0, -1, 1)
        #: Variance along each, in squared radians (or squared strains). *Shape:* ``(n,)``.
        self.variances = values.square() / max(len(bending) - 1, 1)
        #: Part of the whole variance that each has. *Shape:* ``(n,)``.
        self.shares = values.square() / off.square().sum().clamp_min(torch.finfo(off.dtype).tiny)
        #: Directions of root mean square one over the area. *Shape:* ``(n, 6, E)``.
        self.directions = torch.einsum(
            "kn,kjf->njf", left / values.clamp_min(torch.finfo(off.dtype).tiny), bending - self._average
        )

    def __len__(self) -> int:
        return len(self.directions)

    def coordinates(self, shapes: Tensor) -> Tensor:
        """Coordinates of shapes along the components. *Shape:* ``(..., V, 3) -> (..., n)``."""
        flat = shapes.reshape(shapes.shape[:-2].numel(), *shapes.shape[-2:]).to(self.directions)
        off = (self._coordinates.of(flat) - self._average) * self._coordinates.shares
        found = torch.einsum("bjf,njf->bn", off, self.directions)
        return found.view(*shapes.shape[:-2], len(self)).to(shapes)

    def shapes(self, coordinates: Tensor) -> Tensor:
        """The shapes of coordinates, in the pose of the mean; zeros give the average of rotations and strains.

        *Shape:* ``(..., n) -> (..., V, 3)``.
        """
        flat = coordinates.reshape(coordinates.shape[:-1].numel(), coordinates.shape[-1]).to(self.directions)
        bending = self._average + torch.einsum("bn,njf->bjf", flat, self.directions[: flat.shape[1]])
        found = self._coordinates.shapes(bending) + self._origin
        return found.view(*coordinates.shape[:-1], *found.shape[1:]).to(coordinates)
