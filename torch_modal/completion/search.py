"""Poses and amplitudes of modes that bring a shape near to what was seen, from far to near."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from scipy import sparse
from scipy.spatial import cKDTree
from torch import Tensor

from torch_modal.arrays import BoolArray, FloatArray
from torch_modal.completion.bending import ModalBending, ModalPose
from torch_modal.completion.pairs import SLIDE, Cloud, Pairs, SampledSurface
from torch_modal.geometry.connectivity import Connectivity, farthest_apart

# Steps, and the distance from which on pairs lose weight at the first and the last; stiffness of the modes likewise.
STEPS, FAR, NEAR = 12, 20.0, 2.0
# Points of a cloud, and visible places of a surface, that take part in a step, and in one of the pose alone.
N_POINTS, N_RIGID = 800, 200
STIFF, SOFT, STIFFER = 1e-2, 3e-5, (1e-4, 1e-3, 1e-2)
# Stiffness of a turn and a move of the whole.
OF_MOTIONS = 1e-2
# Largest move of a vertex in one step.
LARGEST_STEP = 6.0

# Weight of the modes' energy next to what is left unexplained: limbs that crossed explain points as well.
PRIOR = 3e-5
# Distance at which half of a miss counts, at least, and at which points are unexplained; parts of a cloud that make a
# group.
HALF, REACH, PART_OF_GROUP = 1.0, 2.0, 300
# Ends of limbs that are tried for a group, of how many, how far away, with which weight; rounds of such trials; and the
# gain that they need.
N_TRIED, N_TIPS, MOST_AWAY, WEIGHT, ROUNDS, GAIN = 3, 12, 40.0, 3.0, 3, 1e-3
# Smallest and largest length of a limb that is tried.
LIMBS = 8.0, 30.0


class Seen(NamedTuple):
    """Everything that was seen at one time."""

    clouds: list[Cloud]
    markers: list[Pairs]
    soft: float
    """Stiffness of the modes that it leaves."""
    unit: float
    """Distance at which half of a miss counts."""

    def thin(self, n: int) -> "Seen":
        """With so many points of each cloud, chosen at random, always the same."""
        return self._replace(clouds=[cloud.thin(n) for cloud in self.clouds])


class PoseSearch:
    """Fits modal deformations of shapes, at a size of 100, to clouds and to known places.

    Args:
        bending: The deformations.
        eigenvalues: Of the modes. *Shape:* ``(k,)``.
    """

    def __init__(self, bending: ModalBending, eigenvalues: Tensor) -> None:
        self.bending = bending
        self.mesh = Connectivity(bending.faces.numpy(), len(bending.reference))
        relative = eigenvalues / eigenvalues[:1]
        self.stiffness = torch.cat([relative, relative.new_full((6,), OF_MOTIONS)])
        x, (i, j) = bending.reference.numpy(), self.mesh.edges.T
        lengths = np.maximum(np.linalg.norm(x[i] - x[j], axis=1), 1e-9)
        graph = sparse.coo_matrix((lengths, (i, j)), shape=(len(x), len(x)))
        #: Ends of limbs, and the distances along the surface from each. *Shape:* ``(n,), (n, V)``.
        self.tips, self.from_tips = farthest_apart((graph + graph.T).tocsr(), self.mesh.used, N_TIPS)

    def surface(self, base: Tensor, pose: ModalPose) -> SampledSurface:
        """The deformed shape."""
        return SampledSurface(self.bending.shape(base, pose).numpy(), self.mesh)

    def score(self, base: Tensor, pose: ModalPose, seen: Seen) -> float:
        """Part that is left unexplained, and a little of the energy of the modes; 0 or more."""
        surface = self.surface(base, pose)
        total = PRIOR * float(self.stiffness[:-6] @ pose.amplitudes**2)
        for own in seen.markers:
            off = (own.distances(surface.vertices) / seen.unit) ** 2
            total += float(own.weights @ (off / (1 + off)))
        return total + sum(cloud.score(surface, seen.unit) for cloud in seen.clouds)

    def rigid(self, base: Tensor, seen: Seen) -> ModalPose:
        """The pose alone, from the centroid of what was seen on."""
        points = np.concatenate([*(cloud.points for cloud in seen.clouds), *(pairs.points for pairs in seen.markers)])
        pose = self.bending.still()
        pose.move = torch.from_numpy(np.median(points, 0)) - base.median(0).values
        seen = seen.thin(N_RIGID)
        for far in np.geomspace(2 * FAR, FAR, STEPS):
            pose, _ = self._step(base, pose, seen, float(far), 1.0, rigid=True)
        return pose

    def descend(
        self,
        base: Tensor,
        pose: ModalPose,
        seen: Seen,
        n_steps: int = STEPS,
        far: float = FAR,
        stiff: float = STIFF,
    ) -> ModalPose:
        """Gauss-Newton steps, each with new pairs, from far to near and from stiff to soft."""
        distances, stiffnesses = np.geomspace(far, NEAR, n_steps), np.geomspace(stiff, seen.soft, n_steps)
        seen, fields = seen.thin(N_POINTS), None
        for k, (distance, stiffness) in enumerate(zip(distances, stiffnesses, strict=True)):
            known = fields if k % 2 else None
            pose, fields = self._step(base, pose, seen, float(distance), float(stiffness), known=known)
        return pose

    def fit(self, starts: Sequence[tuple[Tensor, ModalPose]], seen: Seen) -> tuple[int, ModalPose, float]:
        """The number of the best of several starts, its pose after limbs were tried, and its score."""
        tried = [(k, self.descend(*one, seen)) for k, one in enumerate(starts)]
        tried += [(k, start) for k, (_, start) in enumerate(starts)]  # never worse than these
        scores = [self.score(starts[k][0], pose, seen) for k, pose in tried]
        best = min(scores)
        k, pose = tried[scores.index(best)]
        base = starts[k][0]
        for _ in range(ROUNDS):
            others = [self._try_limb(base, pose, seen, *one) for one in self._limbs(base, pose, seen)]
            scores = [self.score(base, other, seen) for other in others]
            if not others or min(scores) > best - GAIN:
                break
            best, pose = min(scores), others[int(np.argmin(scores))]
        return k, pose, best

    def stiffen(self, base: Tensor, pose: ModalPose, seen: Seen) -> ModalPose:
        """The pose of the stiffest modes that explain as much: where little moves, soft ones would follow the noise."""
        best = self.score(base, pose, seen)
        for stiff in STIFFER:
            if stiff <= seen.soft:
                continue
            other = self.descend(base, pose, seen._replace(soft=stiff), STEPS // 3, 2 * NEAR, stiff)
            score = self.score(base, other, seen)
            if score <= best + GAIN:
                best, pose = min(best, score), other
        return pose

    def _limbs(self, base: Tensor, pose: ModalPose, seen: Seen) -> list[tuple[Cloud, FloatArray, int]]:
        """Groups of points that nothing explains, each with the end of a limb that might."""
        surface, limbs = self.surface(base, pose), []
        for cloud in seen.clouds:
            for group in cloud.unexplained_groups(surface, REACH, max(4, len(cloud.points) // PART_OF_GROUP))[:2]:
                points = cloud.points[group]
                away = np.linalg.norm(surface.vertices[self.tips] - points.mean(0), axis=1)
                nearest = np.argsort(away)[:N_TRIED]
                limbs += [(cloud, points, int(tip)) for tip in nearest if away[tip] < MOST_AWAY]
        return limbs

    def _try_limb(
        self, base: Tensor, pose: ModalPose, seen: Seen, cloud: Cloud, points: FloatArray, tip: int
    ) -> ModalPose:
        """A pose in which a limb explains points that nothing explained; its former pairs are released."""
        extent = 2 * float(np.percentile(np.linalg.norm(points - points.mean(0), axis=1), 90))
        limb = self.from_tips[tip] < np.clip(extent, *LIMBS)
        vertices = np.flatnonzero(limb)
        x = self.bending.shape(base, pose).numpy()[vertices]
        shift, fields, thinned = points.mean(0) - x.mean(0), None, seen.thin(N_POINTS)
        for k in range(STEPS // 2):
            nearest = vertices[cKDTree(x + (shift if k == 0 else 0)).query(points)[1]]
            places = sparse.identity(len(limb), format="csr")[nearest]
            weights = np.full(len(points), WEIGHT / len(cloud.points))
            springs = Pairs(places, points, None, weights, np.arange(len(points)))
            target = thinned._replace(markers=[*seen.markers, springs])
            known = fields if k % 2 else None
            pose, fields = self._step(base, pose, target, MOST_AWAY, seen.soft, limb, known=known)
            x = self.bending.shape(base, pose).numpy()[vertices]
        return self.descend(base, pose, seen, STEPS // 2, FAR / 3, 10 * seen.soft)

    def _step(
        self,
        base: Tensor,
        pose: ModalPose,
        seen: Seen,
        far: float,
        stiffness: float,
        released: BoolArray | None = None,
        rigid: bool = False,
        known: Tensor | None = None,
    ) -> tuple[ModalPose, Tensor]:
        """A Gauss-Newton step towards pairs, found here, and markers; no vertex moves far. Also its derivatives.

        Those of the step before, where they are given, do nearly as well.
        """
        if known is None:
            x, fields = self.bending.linearise(base, pose, rigid)
        else:
            x, fields = self.bending.shape(base, pose), known
        matrix, slope = self._normal_equations(x, fields, pose, seen, far, stiffness, released)
        step = -torch.linalg.solve(matrix, slope)
        largest = float((fields @ step).norm(dim=-1).max()) / LARGEST_STEP
        return self.bending.step(pose, step / max(1.0, largest), x.mean(0)), fields

    def _normal_equations(
        self,
        x: Tensor,
        fields: Tensor,
        pose: ModalPose,
        seen: Seen,
        far: float,
        stiffness: float,
        released: BoolArray | None,
    ) -> tuple[Tensor, Tensor]:
        """Matrix and gradient of a Gauss-Newton step. *Shape:* ``(n, n), (n,)``."""
        n, surface, rows = fields.shape[-1], SampledSurface(x.numpy(), self.mesh), []
        columns = fields.flatten(1).float().numpy()  # products of float32: half the time
        for own in [*(pairs for cloud in seen.clouds for pairs in cloud.pairs(surface, released)), *seen.markers]:
            off = own.places @ surface.vertices - own.points
            root = (own.weights**0.5 / (1 + (off**2).sum(1) / far**2)).astype(np.float32)
            moved = (own.places.astype(np.float32) @ columns).reshape(-1, 3, n)
            row = torch.from_numpy(np.concatenate([moved, off[..., None].astype(np.float32)], -1))
            if own.normals is not None:
                across = torch.from_numpy(own.normals).float()[:, None]
                row = SLIDE**0.5 * row + (1 - SLIDE**0.5) * across.mT * (across @ row)
            rows.append((torch.from_numpy(root)[:, None, None] * row).flatten(0, 1))
        row = torch.cat(rows)
        products = (row.mT @ row).double()
        amplitudes = torch.cat([pose.amplitudes, pose.amplitudes.new_zeros(6)])[-n:]
        prior = stiffness * self.stiffness[-n:]
        matrix, slope = products[:n, :n].clone(), products[:n, n] + prior * amplitudes
        matrix.diagonal().add_(prior + 1e-9 * matrix.diagonal().mean())
        return matrix, slope
