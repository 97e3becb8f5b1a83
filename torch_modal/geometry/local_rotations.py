"""Means of shapes by local rotations: between two of them, every triangle turns at constant speed."""

import warnings
from collections.abc import Sequence
from functools import reduce
from math import cos
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from torch_modal.errors import MeshWarning
from torch_modal.geometry.connectivity import Connectivity, spanning_forest
from torch_modal.geometry.poisson import Poisson
from torch_modal.geometry.rotations import arc, conjugate, mean, product, quaternion, rotate, rotate_by, signs_of_mean
from torch_modal.geometry.triangle_frames import Frames, edge_means, frames_of, stretch, transform, twice_areas
from torch_modal.geometry.vectors import pick

# The tree along which turns are compared avoids slivers, whose normals mean little: one with an altitude of this part
# of its longest side counts like a turn of one radian against its neighbour.
SLIVER = 0.02

# Neighbours whose rotations are alike to so many radians, but a full turn apart, are torn; in folds of bodies none are.
# Above this part of the area there is a warning.
LIKE_ROTATIONS = 0.5
PART_TORN = 1e-3

# Rotations follow each other along the tree where more than this part of the area of a piece turns by more than this
# angle, in radians, from its mean. Half a turn would be a full one from side to side; the rest is noise. Of fists, 1 %
# turns by half a turn.
BEYOND = np.radians(200)
PART_BEYOND = 0.05

# Edges without a length count like one of this part of the mean.
SHORTEST_PART = 1e-9


class Trajectory(NamedTuple):
    """Cubics of the triangles between two shapes of a motion. Components first."""

    e1: Tensor
    """The frames of the shape at 0. *Shape:* ``(3, P, F)``."""
    e2: Tensor
    normal: Tensor
    size: Tensor
    """Entries of the stretch at 0. *Shape:* ``(3, P, F)``."""
    step: Tensor
    """To the shape at 1, of :meth:`LocalRotations.step`. *Shape:* ``(6, P, F)``."""
    first: Tensor
    """Difference of the velocity at the start from the step. *Shape:* ``(6, P, F)``."""
    last: Tensor
    """Difference of the velocity at the end from the step. *Shape:* ``(6, P, F)``."""


class LocalRotations(nn.Module):
    r"""Edge vectors between two shapes whose triangles turn at constant speed.

    Between the key-frames the frame of a triangle (:class:`Frames`) turns by ``R``; its stretch is the rest. At the
    time ``t`` its sides are :math:`R^t\, ((1-t) S_a + t R^T S_b)`; an edge takes the mean of its triangles by area.
    Where linear interpolation shrinks what turns, this does not. ``R`` alone does not tell a turn of 200 degrees from
    one of -160. But neighbours turn alike: the signs of quaternions are passed on along a spanning tree, which tells up
    to a full turn. Where the references turn by more from side to side, as a sheet that rolls up does,
    each triangle follows its parent in the tree.

    Args:
        mesh: The connectivity.
        references: Shapes near the key-frames, two or more. The tree follows from the rotations between all of them,
            and avoids triangles that are slivers in any. *Shape:* ``(K, V, 3)``.
    """

    reference: Tensor
    faces: Tensor
    sides: Tensor
    side_signs: Tensor
    areas: Tensor
    ancestors: Tensor
    piece: Tensor
    middle: Tensor

    def __init__(self, mesh: Connectivity, references: Tensor) -> None:
        super().__init__()
        self.register_buffer("faces", torch.tensor(mesh.faces), persistent=False)
        every = [frames_of(x[None], self.faces) for x in references]
        slenderness = reduce(torch.minimum, [x.slenderness for x in every]).squeeze(0)
        quaternions = quaternions_from_first(every)
        parents, piece = self._tree(quaternions, slenderness, mesh)
        ancestors = [parents]
        while 2 ** len(ancestors) < len(parents):
            ancestors.append(ancestors[-1][ancestors[-1]])
        self.register_buffer("sides", torch.tensor(mesh.sides), persistent=False)
        self.register_buffer("side_signs", torch.tensor(mesh.signs).to(references), persistent=False)
        #: The first reference, from which rotations of more than two shapes are measured. *Shape:* ``(1, V, 3)``.
        self.register_buffer("reference", references[:1].clone(), persistent=False)
        #: Twice the summed areas of the triangles in the references. *Shape:* ``(F,)``.
        self.register_buffer("areas", torch.cat([x.twice_areas for x in every]).sum(0), persistent=False)
        #: By 1, 2, 4, ... generations, as many as any tree needs. *Shape:* ``(J, F)``.
        self.register_buffer("ancestors", torch.stack(ancestors), persistent=False)
        self.register_buffer("piece", piece, persistent=False)
        self.n_edges, self.n_pieces = len(mesh.edges), int(piece.max()) + 1
        self._warn_of_tears(quaternions, mesh)
        off = self.off_mean(quaternions)
        #: True where parts turn by more than a full turn from each other.
        self.beyond_a_turn = self.turns_beyond(off)
        order = np.lexsort((off, piece))
        middles = torch.from_numpy(order[np.unique(piece[order], return_index=True)[1]])
        #: The triangle of each piece that turns like its mean, for all triangles. *Shape:* ``(F,)``.
        self.register_buffer("middle", middles[piece], persistent=False)

    def _warn_of_tears(self, quaternions: Tensor, mesh: Connectivity) -> None:
        """Warn where neighbours are a full turn apart with any tree. *Shape:* ``(4, K, F)``."""
        one, other = torch.tensor(mesh.face_neighbours).unbind(1)
        quaternions = quaternions * LocalRotations.sign(
            self, quaternions.movedim(0, -1), self.areas.expand(quaternions.shape[1], -1)
        )
        torn = ((pick(quaternions, one) * pick(quaternions, other)).sum(0) < -cos(LIKE_ROTATIONS / 2)).any(0)
        if float((pick(self.areas, one) + pick(self.areas, other))[torn].sum()) > PART_TORN * float(self.areas.sum()):
            message = (
                "around the mesh, key-frames turn by a full turn from each other, as a ring does that is twisted: no "
                "choice of rotations is continuous, and in-betweens are distorted along a line"
            )
            warnings.warn(message, MeshWarning, stacklevel=2)

    @staticmethod
    def _tree(quaternions: Tensor, slenderness: Tensor, mesh: Connectivity) -> tuple[Tensor, Tensor]:
        """The parent of each triangle, and its piece. *Shape:* ``(4, K, F), (F,) -> (F,)`` each."""
        one, other = torch.tensor(mesh.face_neighbours).unbind(1)
        # Between two shapes, neighbours turn by as much from each other as these rotations of the shapes do.
        across = product(conjugate(pick(quaternions, one)), pick(quaternions, other))
        pairs = ((x[:, None] * across[:, i:]).sum(0).abs() for i, x in enumerate(across.unbind(1)[:-1], 1))
        alike = reduce(torch.minimum, (cosines.amin(0) for cosines in pairs)).clamp_max(1)
        slenderness = torch.minimum(pick(slenderness, one), pick(slenderness, other))
        costs = 2 * torch.arccos(alike) + SLIVER / slenderness.clamp_min(SLIVER / 1e3)
        parents, piece = spanning_forest(len(mesh.faces), mesh.face_neighbours, costs.numpy())
        return torch.from_numpy(parents), torch.from_numpy(piece)

    def forward(self, shapes: Tensor, weights: Tensor) -> Tensor:
        """Edge vectors of the weighted mean of K shapes, components first.

        The rotation of a triangle is the weighted mean of its rotations in the shapes, and its stretch the weighted
        sum. An edge takes the mean of its triangles by their areas in the references.

        Args:
            shapes: They turn by less than a full turn from each other, unless the references do. *Shape:*
                ``(B, K, V, 3)``.
            weights: They add up to one. *Shape:* ``(B, K)``.

        Returns:
            *Shape:* ``(3, B, E)``.
        """
        # From one of two shapes: the way from a third to a triangle that collapses in one has no bounded gradient.
        start = frames_of(shapes[:, 0] if shapes.shape[1] == 2 else self.reference, self.faces)
        frames = Frames(*(x.unflatten(-2, weights.shape) for x in frames_of(shapes.flatten(0, 1), self.faces)))
        quaternions = _quaternion_between(Frames(*(x[..., None, :] for x in start)), frames)
        if not self.beyond_a_turn:
            signs = self.sign(
                quaternions.detach().flatten(1, 2).movedim(0, -1), frames.twice_areas.detach().flatten(0, 1)
            )
            # A triangle that is a point has no frame and a quaternion of 0.5: with the other sign it would make a whole
            # turn, whose axis has no derivative.
            signs = torch.where(quaternions.detach().square().sum(0) < 0.5, 1.0, signs.view(quaternions.shape[1:]))
            quaternions = signs * quaternions
            mean_quaternion = mean(
                self._agree(quaternions.detach(), weights.detach()) * quaternions, weights[..., None]
            )
        else:
            mean_quaternion = self._mean_along_tree(quaternions, weights[..., None])
        xx, xy, yy = ((weights[..., None] * x).sum(-2) for x in frames[3:])
        first, second = (rotate(mean_quaternion, start.world(*side)) for side in transform(xx, xy, xy, yy))
        areas = self.areas.expand(len(weights), -1).repeat(1, 3)
        return edge_means((first, second), areas, self.sides, self.side_signs, self.n_edges)

    def right_hand_side(self, shapes: Tensor, weights: Tensor, poisson: Poisson) -> Tensor:
        """:meth:`Poisson.right_hand_side` of these edge vectors. *Shape:* ``(B, K, V, 3), (B, K) -> (B, V, 3)``."""
        return poisson.right_hand_side(self(shapes, weights))

    def _agree(self, quaternions: Tensor, weights: Tensor) -> Tensor:
        """Signs for the pieces of K shapes, with which they turn the short way from each other.

        *Shape:* ``(4, B, K, F), (B, K) -> (B, K, F)``.
        """
        zero = weights.new_zeros(*weights.shape, self.n_pieces)
        rows = (self.areas * (quaternions * one[..., None, :]).sum(0) for one in quaternions.unbind(2))
        products = torch.stack([zero.index_add(-1, self.piece, row) for row in rows], -1).movedim(2, 1)
        return pick(signs_of_mean(products, weights[:, None]).mT, self.piece)

    def _mean_along_tree(self, quaternions: Tensor, weights: Tensor) -> Tensor:
        r"""Weighted means of rotations of more than a full turn, each relative to the one of the parent.

        A triangle turns by :math:`T(t) = T_p(t)\, (R_p^T R)^t` with its parent ``p``: no power is one of a rotation of
        half a turn or more. The middle of the piece turns the short way. *Shape:* ``(4, B, K, F), (B, K, 1)``.
        """
        followed = mean(self._from_parents(quaternions), weights)
        for ancestors in self.ancestors:
            followed = product(pick(followed, ancestors), followed)
        middle = mean(torch.where(quaternions[0] < 0, -quaternions, quaternions), weights)
        return product(pick(product(middle, conjugate(followed)), self.middle), followed)

    def _from_parents(self, quaternions: Tensor) -> Tensor:
        """Rotations from the parents, the short way round; none of roots. *Shape:* ``(4, ..., F)``."""
        step = product(conjugate(pick(quaternions, self.ancestors[0])), quaternions)
        return torch.where(step[0] < 0, -step, step)

    def turns_beyond(self, off: Tensor) -> bool:
        """True where parts of a piece turn by more than a full turn from each other, by :meth:`off_mean`."""
        total = torch.bincount(self.piece, self.areas)
        return bool((torch.bincount(self.piece, self.areas * (off > BEYOND)) > PART_BEYOND * total).any())

    def off_mean(self, quaternions: Tensor) -> Tensor:
        """Largest angle of each triangle from the mean of its piece, between any two shapes.

        *Shape:* of :func:`quaternions_from_first`, ``(4, K, F) -> (F,)``.
        """
        winding = 2 * arc(self._from_parents(quaternions))
        for ancestors in self.ancestors:
            winding = winding + pick(winding, ancestors)
        total = torch.bincount(self.piece, self.areas)
        sums = winding.new_zeros(*winding.shape[:2], len(total)).index_add(-1, self.piece, self.areas * winding)
        off = winding - pick(sums / total, self.piece)
        spans = [(off[:, i:] - off[:, i - 1 : i]).norm(dim=0).amax(0) for i in range(1, off.shape[1])]
        return torch.stack(spans).amax(0)

    def step(self, a: Frames, b: Frames) -> Tensor:
        """The step of each triangle from one shape to another.

        Axis times angle in the coordinates of the frame, which are the same in both frames, then the growth of the
        entries of the stretch. *Shape:* ``(6, B, F)``.
        """
        growth = [y - x for x, y in zip(a[3:], b[3:], strict=True)]
        return torch.stack([*a.coordinates(2 * arc(self.quaternions(a, b))), *growth])

    def edges_along(self, trajectory: Trajectory, which: Tensor, t: Tensor) -> Tensor:
        """Edge vectors of shapes on the trajectories of P pairs; of each the pair and the time are given.

        *Shape:* ``(B,), (B,) -> (3, B, E)``.
        """
        return self.edges_with_bending(Trajectory._make(values.index_select(-2, which) for values in trajectory), t)

    def edges_with_bending(self, trajectory: Trajectory, t: Tensor, bending: Tensor | None = None) -> Tensor:
        """Edge vectors of shapes on trajectories, whose triangles may be strained and turned beforehand.

        Trajectories are of one pair, or of a pair for each shape. Bending is in coordinates of the triangles: axis
        times angle, then strain. *Shape:* ``(B,), (6, B, F) -> (3, B, E)``.
        """
        u = t[:, None]
        straight = u * trajectory.step
        bent = u * (1 - u) * ((1 - u) * trajectory.first - u * trajectory.last)
        xx, xy, yy = trajectory.size + (straight + bent)[3:]
        flat = torch.zeros_like(xx)

        def place(x: Tensor, y: Tensor) -> Tensor:
            side = torch.stack([x, y, flat])
            side = side if bending is None else rotate_by(bending[:3], side)
            x, y, z = rotate_by(straight[:3], rotate_by(bent[:3], side))
            return x * trajectory.e1 + y * trajectory.e2 + z * trajectory.normal

        # At a key-frame, the intervals on both sides weigh alike: velocities of edges are continuous.
        areas = torch.lerp(twice_areas(*trajectory.size), twice_areas(*(trajectory.size + trajectory.step[3:])), u)
        first, second = transform(xx, xy, xy, yy) if bending is None else stretch(bending[3:], xx, xy, yy)
        wanted = place(*first), place(*second)
        return edge_means(wanted, areas.repeat(1, 3), self.sides, self.side_signs, self.n_edges)

    def quaternions(self, a: Frames, b: Frames) -> Tensor:
        """Quaternions between frames, whose signs tell the way round. *Shape:* ``(4, B, F)``."""
        quaternions = _quaternion_between(a, b)
        areas = (a.twice_areas + b.twice_areas).detach()
        return self.sign(quaternions.detach().movedim(0, -1), areas) * quaternions

    def sign(self, quaternions: Tensor, areas: Tensor) -> Tensor:
        """A sign for the quaternion of each triangle. *Shape:* ``(B, F, 4), (B, F) -> (B, F)``."""
        quaternions = quaternions.movedim(-1, 0)
        signs = torch.where((quaternions * pick(quaternions, self.ancestors[0])).sum(0) < 0, -1.0, 1.0).to(areas)
        for ancestors in self.ancestors:
            signs = signs * pick(signs, ancestors)
        # Of both senses of a whole piece, the one in which most of it turns by less than half a turn.
        vote = torch.zeros_like(areas).index_add(1, self.piece, areas * signs * quaternions[0])
        return torch.where(pick(vote, self.piece) < 0, -signs, signs)


def weights_per_length(mesh: Connectivity, references: Tensor) -> Tensor:
    """Weights of edges where edge vectors are fitted: one over their mean lengths. *Shape:* ``(K, V, 3) -> (E,)``."""
    first, second = torch.tensor(mesh.edges).unbind(1)
    lengths = reduce(torch.add, ((x[second] - x[first]).norm(dim=-1) for x in references)) / len(references)
    return 1 / lengths.clamp_min(SHORTEST_PART * lengths.mean())


def quaternions_from_first(every: Sequence[Frames]) -> Tensor:
    """Quaternions of the rotations from the first shape to each. *Shape:* ``(4, K, F)``."""
    return torch.cat([_quaternion_between(every[0], x) for x in every], 1)


def _quaternion_between(a: Frames, b: Frames) -> Tensor:
    """Quaternions of the rotations between the frames of triangles. *Shape:* ``(4, B, F)``."""
    return quaternion(b.e1[:, None] * a.e1 + b.e2[:, None] * a.e2 + b.normal[:, None] * a.normal)
