"""Poses and amplitudes of modes that bring a shape near to what was seen, from far to near."""

import numpy as np
import torch
from torch import Tensor

from torch_modal.completion.bending import ModalBending, ModalPose
from torch_modal.completion.frames import Frame
from torch_modal.completion.pairs import SLIDE, ObservedPoints, SampledSurface
from torch_modal.geometry.connectivity import Connectivity

# Steps, and the distance from which on pairs lose weight at the first and the last; stiffness of the modes likewise.
STEPS, FAR, NEAR = 12, 20.0, 2.0
# Points of a cloud, and visible places of a surface, that take part in a step, and in one of the pose alone.
N_POINTS, N_RIGID = 1500, 200
STIFF, STIFFER = 1e-2, (1e-4, 1e-3, 1e-2)
# Stiffness of a turn and a move of the whole.
OF_MOTIONS = 1e-2
# Largest move of a vertex in one step.
LARGEST_STEP = 6.0

# Weight of the modes' energy next to what is left unexplained: limbs that crossed explain points as well.
PRIOR = 3e-5
# Loss of score that stiffer modes may have.
GAIN = 1e-3


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

    def score(self, base: Tensor, pose: ModalPose, frame: Frame) -> float:
        """Part that is left unexplained, and a little of the energy of the modes; 0 or more."""
        surface = SampledSurface(self.bending.shape(base, pose).numpy(), self.mesh)
        total = PRIOR * float(self.stiffness[:-6] @ pose.amplitudes**2)
        return total + sum(seen.score(surface, frame.unit) for seen in frame.seen)

    def rigid(self, base: Tensor, frame: Frame) -> tuple[ModalPose, float]:
        """The pose alone, from the centroid of what was seen on, and its score."""
        points = np.concatenate([seen.points for seen in frame.seen])
        start = self.bending.still()._replace(move=torch.from_numpy(np.median(points, 0)) - base.median(0).values)
        pose = self.descend(base, start, frame._replace(soft=1.0), (2 * FAR, FAR), 1.0, rigid=True)
        return pose, self.score(base, pose, frame)

    def descend(
        self,
        base: Tensor,
        pose: ModalPose,
        frame: Frame,
        distances: tuple[float, float] = (FAR, NEAR),
        stiff: float = STIFF,
        n_steps: int = STEPS,
        rigid: bool = False,
    ) -> ModalPose:
        """Gauss-Newton steps, each with new pairs, from far to near and from stiff to soft; no vertex moves far."""
        seen = [one.thin(N_RIGID if rigid else N_POINTS) for one in frame.seen]
        schedule = zip(np.geomspace(*distances, n_steps), np.geomspace(stiff, frame.soft, n_steps), strict=True)
        for k, (far, stiffness) in enumerate(schedule):
            if rigid or k % 2 == 0:
                x, fields = self.bending.linearise(base, pose, rigid)
            else:  # the derivatives of the step before do nearly as well
                x = self.bending.shape(base, pose)
            rows = self._rows(x, fields, seen, float(far))
            products, n = (rows.mT @ rows).double(), fields.shape[-1]
            amplitudes = torch.cat([pose.amplitudes, pose.amplitudes.new_zeros(6)])[-n:]
            prior = float(stiffness) * self.stiffness[-n:]
            matrix, slope = products[:n, :n].clone(), products[:n, n] + prior * amplitudes
            matrix.diagonal().add_(prior + 1e-9 * matrix.diagonal().mean())
            step = -torch.linalg.solve(matrix, slope)
            largest = float((fields @ step).norm(dim=-1).max()) / LARGEST_STEP
            pose = self.bending.step(pose, step / max(1.0, largest), x.mean(0))
        return pose

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

    def _rows(self, x: Tensor, fields: Tensor, seen: list[ObservedPoints], far: float) -> Tensor:
        """Derivatives of the weighted offsets of all pairs, and last the offsets. *Shape:* ``(m, n + 1)``."""
        n, surface, rows = fields.shape[-1], SampledSurface(x.numpy(), self.mesh), []
        columns = fields.flatten(1).float().numpy()  # products of float32: half the time
        for pairs in [one.pair(surface) for one in seen]:
            off = pairs.places @ surface.vertices - pairs.points
            root = (pairs.weights**0.5 / (1 + (off**2).sum(1) / far**2)).astype(np.float32)
            moved = (pairs.places.astype(np.float32) @ columns).reshape(-1, 3, n)
            row = torch.from_numpy(np.concatenate([moved, off[..., None].astype(np.float32)], -1))
            if pairs.normals is not None:
                across = torch.from_numpy(pairs.normals).float()[:, None]
                row = SLIDE**0.5 * row + (1 - SLIDE**0.5) * across.mT * (across @ row)
            rows.append((torch.from_numpy(root)[:, None, None] * row).flatten(0, 1))
        return torch.cat(rows)
