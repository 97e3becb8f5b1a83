"""Poses and amplitudes of modes that bring a shape near to what was seen, from far to near."""

from collections.abc import Callable
from functools import partial

import numpy as np
import torch
from scipy import sparse
from scipy.spatial import cKDTree
from torch import Tensor

from torch_modal.arrays import BoolArray, FloatArray
from torch_modal.completion.bending import ModalBending, ModalPose
from torch_modal.completion.frames import Frame
from torch_modal.completion.pairs import SLIDE, ObservedPoints, SampledSurface
from torch_modal.geometry.connectivity import Connectivity, edge_graph, farthest_apart
from torch_modal.geometry.rigid import infinitesimal_motions
from torch_modal.threads import run

# Steps, and the distance from which on pairs lose weight at the first and the last; stiffness of the modes likewise.
STEPS, FAR, NEAR = 12, 20.0, 2.0
# Steps of all starts, after which the score at this distance chooses those that take the others.
ALL, FIRST, REST, N_KEPT, AFTER_FIRST = slice(None), slice(4), slice(4, None), 2, 8.0
# Modes in the first steps from a template alone.
N_SOFT = 24
# Points of a cloud, and visible places of a surface, that take part in a step, and in one of the pose alone.
N_POINTS, N_RIGID = 800, 200
STIFF, STIFFER = 1e-2, (1e-4, 1e-3, 1e-2)
# Stiffness of a turn and a move of the whole.
OF_MOTIONS = 1e-2
# Largest move of a vertex in one step.
LARGEST_STEP = 6.0

# Weight of the modes' energy next to what is left unexplained: limbs that crossed explain points as well.
PRIOR = 3e-5
# Distance at which points are unexplained; part of a cloud that makes a group.
REACH, PART_OF_GROUP = 2.0, 300
# Distance of a group from all other points beyond which it belongs to no limb.
ISOLATED = 15.0
# Ends of limbs that are tried for a group, of how many, how far away, with which weight; rounds of such trials; and the
# gain that they need, which stiffer modes may lose.
N_TRIED, N_TIPS, MOST_AWAY, WEIGHT, ROUNDS, GAIN = 3, 12, 40.0, 3.0, 3, 1e-3
# Smallest and largest length of a limb that is tried.
LIMBS = 8.0, 30.0
UNTURNED = torch.eye(3, dtype=torch.float64)


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
        graph = edge_graph(bending.reference.numpy(), self.mesh.edges)
        #: Ends of limbs, and the distances along the surface from each. *Shape:* ``(n,), (n, V)``.
        self.tips, self.from_tips = farthest_apart(graph, self.mesh.used, N_TIPS)

    def surface(self, base: Tensor, pose: ModalPose) -> SampledSurface:
        """The deformed shape."""
        return SampledSurface(self.bending.shape(base, pose).numpy(), self.mesh)

    def score(self, base: Tensor, pose: ModalPose, frame: Frame) -> float:
        """Part that is left unexplained, and a little of the energy of the modes; 0 or more."""
        total = PRIOR * float(self.stiffness[:-6] @ pose.amplitudes**2)
        return total + frame.score(self.surface(base, pose))

    def place(self, body: SampledSurface, frame: Frame, turn: Tensor = UNTURNED) -> tuple[ModalPose, float]:
        """The best of rigid poses from a turn about the centroid of what was seen on, with and without stray clusters.

        And its score. *Shape of a turn:* ``(3, 3)``.
        """
        base = torch.from_numpy(body.vertices)
        main, starts = frame._replace(seen=[one.main_part(ISOLATED) for one in frame.seen]), []
        parted = sum(len(one.points) for one in main.seen) < sum(len(one.points) for one in frame.seen)
        for every in (main, frame)[: 1 + parted]:
            centre = np.median(np.concatenate([seen.points for seen in every.seen]), 0)
            move = torch.from_numpy(centre) - turn @ base.median(0).values
            starts.append(self._move(body, self.bending.still()._replace(rotation=turn, move=move), every))
        pose = min(starts, key=lambda pose: main.seen_from(pose).score(body))
        return pose, frame.seen_from(pose).score(body)

    def _move(self, body: SampledSurface, pose: ModalPose, frame: Frame) -> ModalPose:
        """The pose after rigid steps from far to near: the body stays, and what was seen moves towards it."""
        base = torch.from_numpy(body.vertices)
        centre = base.mean(0)
        fields = infinitesimal_motions(base - centre).movedim(0, -1)
        frame = frame._replace(seen=[one.thin(N_RIGID) for one in frame.seen], soft=1.0)
        for far in np.geomspace(2 * FAR, FAR, STEPS):
            rows = self._rows(body, fields, frame.seen_from(pose).seen, float(far), None)
            step = pose.rotation @ self._step(rows, fields, pose, 1.0).view(2, 3, 1)
            pose = self.bending.step(pose, step.flatten(), pose.rotation @ centre + pose.move)
        return pose

    def descend(
        self,
        base: Tensor,
        pose: ModalPose,
        frame: Frame,
        distances: tuple[float, float] = (FAR, NEAR),
        stiff: float = STIFF,
        n_steps: int = STEPS,
        part: slice = ALL,
        n_modes: int | None = None,
        released: BoolArray | None = None,
        springs: Callable[[FloatArray, int], ObservedPoints] | None = None,
    ) -> ModalPose:
        """Gauss-Newton steps, each with new pairs, from far to near and from stiff to soft; no vertex moves far."""
        seen = [one.thin(N_POINTS) for one in frame.seen]
        schedule = zip(np.geomspace(*distances, n_steps), np.geomspace(stiff, frame.soft, n_steps), strict=True)
        for k, (far, stiffness) in enumerate(list(schedule)[part]):
            if k % 2 == 0:
                x, fields = self.bending.linearise(base, pose, n_modes)
            else:  # the derivatives of the step before do nearly as well
                x = self.bending.shape(base, pose)
            pulled = [*seen, springs(x.numpy(), k)] if springs else seen
            rows = self._rows(SampledSurface(x.numpy(), self.mesh), fields, pulled, float(far), released)
            pose = self.bending.step(pose, self._step(rows, fields, pose, float(stiffness)), x.mean(0))
        return pose

    def _step(self, rows: Tensor, fields: Tensor, pose: ModalPose, stiffness: float) -> Tensor:
        """The Gauss-Newton step of weighted rows, and of the modes' energy. *Shape:* ``(m, n + 1) -> (n,)``."""
        products, n = (rows.mT @ rows).double(), fields.shape[-1]
        amplitudes = torch.cat([pose.amplitudes[: n - 6], pose.amplitudes.new_zeros(6)])
        prior = stiffness * torch.cat([self.stiffness[: n - 6], self.stiffness[-6:]])
        matrix, slope = products[:n, :n].clone(), products[:n, n] + prior * amplitudes
        matrix.diagonal().add_(prior + 1e-9 * matrix.diagonal().mean())
        step = -torch.linalg.solve(matrix, slope)
        return step / max(1.0, float((fields @ step).norm(dim=-1).max()) / LARGEST_STEP)

    def stiffen(self, base: Tensor, pose: ModalPose, frame: Frame) -> ModalPose:
        """The pose of the stiffest modes that explain as much: where little moves, soft ones would follow the noise."""
        best = self.score(base, pose, frame)
        for stiff in STIFFER:
            if stiff <= frame.soft:
                continue
            other = self.descend(base, pose, frame._replace(soft=stiff), (2 * NEAR, NEAR), stiff, STEPS // 3)
            score = self.score(base, other, frame)
            if score <= best + GAIN:
                best, pose = min(best, score), other
        return pose

    def move_limbs(self, base: Tensor, pose: ModalPose, frame: Frame, best: float) -> tuple[ModalPose, float]:
        """The pose, and its score, after limbs were moved to points that nothing explained, where that helps."""
        for _ in range(ROUNDS):
            others = run([partial(self._try_limb, base, pose, frame, *limb) for limb in self._limbs(base, pose, frame)])
            if not others or min(score for _, score in others) > best - GAIN:
                break
            pose, best = min(others, key=lambda one: one[1])
        return pose, best

    def _limbs(self, base: Tensor, pose: ModalPose, frame: Frame) -> list[tuple[FloatArray, FloatArray, int]]:
        """Groups of points that nothing explains, their weights, and the end of a limb that might."""
        surface, limbs = self.surface(base, pose), []
        for cloud in [one for one in frame.seen if one.places is None]:
            least = max(4, len(cloud.points) // PART_OF_GROUP)
            for group in cloud.find_unexplained(surface, REACH, least, ISOLATED)[:2]:
                points = cloud.points[group]
                away = np.linalg.norm(surface.vertices[self.tips] - points.mean(0), axis=1)
                nearest = np.argsort(away)[:N_TRIED]
                weights = WEIGHT * cloud.weights[group]
                limbs += [(points, weights, int(tip)) for tip in nearest if away[tip] < MOST_AWAY]
        return limbs

    def _try_limb(
        self, base: Tensor, pose: ModalPose, frame: Frame, points: FloatArray, weights: FloatArray, tip: int
    ) -> tuple[ModalPose, float]:
        """A pose, and its score, in which a limb explains points that nothing explained; its pairs are released."""
        extent = 2 * float(np.percentile(np.linalg.norm(points - points.mean(0), axis=1), 90))
        limb = self.from_tips[tip] < np.clip(extent, *LIMBS)
        vertices = np.flatnonzero(limb)

        def springs(x: FloatArray, k: int) -> ObservedPoints:
            shift = 0 if k else points.mean(0) - x[vertices].mean(0)
            nearest = vertices[cKDTree(x[vertices] + shift).query(points)[1]]
            places = sparse.identity(len(limb), format="csr")[nearest]
            return ObservedPoints(points, None, weights, np.arange(len(points)), 0.0, places)

        distances = MOST_AWAY, MOST_AWAY
        pose = self.descend(base, pose, frame, distances, frame.soft, STEPS // 2, released=limb, springs=springs)
        pose = self.descend(base, pose, frame, (FAR / 3, NEAR), 10 * frame.soft, STEPS // 2)
        return pose, self.score(base, pose, frame)

    def _rows(
        self,
        surface: SampledSurface,
        fields: Tensor,
        seen: list[ObservedPoints],
        far: float,
        released: BoolArray | None,
    ) -> Tensor:
        """Derivatives of the weighted offsets of all pairs, and last the offsets. *Shape:* ``(m, n + 1)``."""
        n, rows = fields.shape[-1], []
        columns = fields.flatten(1).float().numpy()  # products of float32: half the time
        for pairs in [pairs for one in seen for pairs in one.pairs(surface, released)]:
            off = pairs.places @ surface.vertices - pairs.points
            root = (pairs.weights**0.5 / (1 + (off**2).sum(1) / far**2)).astype(np.float32)
            moved = (pairs.places.astype(np.float32) @ columns).reshape(-1, 3, n)
            row = torch.from_numpy(np.concatenate([moved, off[..., None].astype(np.float32)], -1))
            if pairs.normals is not None:
                across = torch.from_numpy(pairs.normals).float()[:, None]
                row = SLIDE**0.5 * row + (1 - SLIDE**0.5) * across.mT * (across @ row)
            rows.append((torch.from_numpy(root)[:, None, None] * row).flatten(0, 1))
        return torch.cat(rows)
