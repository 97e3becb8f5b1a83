"""Spacetime interpolation by modes (Hildebrandt et al. 2012), which the paper compares with itself in Figure 1.

``python examples/paper/run.py --parts 1`` measures it.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from helpers.shapes import fraction
from torch import Tensor

import torch_modal as tm
from torch_modal.geometry.connectivity import Connectivity
from torch_modal.geometry.local_rotations import LocalRotations
from torch_modal.geometry.poisson import Reconstruction
from torch_modal.geometry.rigid import best_fit
from torch_modal.geometry.rotations import rotate_by
from torch_modal.geometry.triangle_frames import bend, bending_between, edge_means, frames_of, sides, stretch
from torch_modal.geometry.vectors import cross

N_MODES = 50
DAMPING = 0.1
"""Over what is critical, of all modes."""


class WarpedModes:
    """Amplitudes of modes as shapes: rotation-strain coordinates (Huang et al. 2011) on the triangles of a surface.

    The gradient of a displacement is the sum of a rotation's logarithm and a strain; the triangles of the shape are
    strained, then rotated. Displacements have no rigid motion, and shapes are near others, *shape* ``(K, V, 3)``.
    """

    def __init__(self, basis: tm.ModalBasis, faces: Tensor, others: Tensor) -> None:
        self.basis, self.faces, rest = basis, faces, basis.reference[None]
        mesh = Connectivity(faces.numpy(), rest.shape[1])
        self.rotations = LocalRotations(mesh, torch.cat([rest, others]))
        self.own = frames_of(rest, faces)
        self.sides = sides(rest.movedim(-1, 0), faces)
        self.reconstruction = Reconstruction(rest[0], faces)
        self._weights = self.reconstruction.poisson.weights.sqrt()
        turns = torch.linalg.cross(torch.eye(3).to(rest)[:, None], rest - rest.mean(1, keepdim=True))
        first, second = self.reconstruction.edges.T
        columns = torch.cat([basis.modes, turns]).movedim(-1, 0)
        self._fit = torch.linalg.pinv(self._flat(columns[..., second] - columns[..., first]).T)

    def _flat(self, edges: Tensor) -> Tensor:
        """Weighted edge vectors in a row. *Shape:* ``(3, B, E) -> (B, 3E)``."""
        return (edges * self._weights).movedim(0, 1).flatten(1)

    def amplitudes(self, shapes: Tensor) -> Tensor:
        """Amplitudes whose gradients are nearest to those of shapes. *Shape:* ``(B, V, 3) -> (B, k)``."""
        own, frames = self.own, frames_of(shapes, self.faces)
        turn, strain = bending_between(own, frames, self.rotations.quaternions(own, frames))
        moved = []
        for (x, y), rest in zip(stretch(strain, *own[3:]), self.sides, strict=True):
            moved.append(own.world(x, y) - rest + cross(turn, rest.expand_as(turn)))
        r = self.reconstruction
        edges = edge_means((moved[0], moved[1]), r.weights, r.sides, r.signs.to(turn), len(r.edges))
        return (self._flat(edges) @ self._fit.T)[:, : self.basis.n_modes]

    def shapes(self, amplitudes: Tensor) -> Tensor:
        """Shapes of amplitudes. *Shape:* ``(B, k) -> (B, V, 3)``."""
        moved = torch.tensordot(amplitudes, self.basis.modes, 1).movedim(-1, 0).contiguous()
        displaced = sides(moved, self.faces)
        turn, _ = bend(displaced, self.own)
        pairs = zip(self.sides, displaced, strict=True)
        first, second = (rotate_by(turn, rest + u - cross(turn, rest.expand_as(u))) for rest, u in pairs)
        return self.reconstruction((first, second), moved.movedim(0, -1) + self.basis.reference)


class LeastForce:
    r"""Motions of least force of damped oscillators, :math:`\min \int (\ddot q + 2 \delta \dot q + \lambda q)^2 dt`.

    In closed form through given values (the wiggly splines of Kass and Anderson 2008). Between two nodes the force is
    the optimal control from one state ``z = (q, q')`` to the other; the velocities at the nodes minimise the sum. Ends
    have the mean velocity of their interval, cycles have none.

    From the positive lambda and delta, the times of the nodes, of a cycle one more, and the values. *Shape:* ``(k,),
    (k,), (N + 1,), (K, k)``.
    """

    def __init__(self, eigenvalues: Tensor, damping: Tensor, times: Tensor, values: Tensor) -> None:
        self.generator = values.new_zeros(len(eigenvalues), 2, 2)
        self.generator[:, 0, 1], self.generator[:, 1, 0], self.generator[:, 1, 1] = 1, -eigenvalues, -2 * damping
        self.stationary = torch.diag_embed(torch.stack([1 / (4 * damping * eigenvalues), 1 / (4 * damping)], -1))
        self.times, (n, k) = times, values.shape
        h = times.diff()
        self.last = (torch.arange(len(h)) + 1) % n
        matrix = values.new_zeros(k, n, 2, n, 2)
        forward, gramian = self.transition(h)
        self.cost = torch.linalg.inv(gramian)
        for i, j in enumerate(self.last):
            a, p = forward[i], self.cost[i]
            for row, column, block in ((i, i, a.mT @ p @ a), (i, j, -a.mT @ p), (j, i, -p @ a), (j, j, p)):
                matrix[:, row, :, column] += block
        velocities = values.new_zeros(n, k)
        free = torch.arange(n)
        if len(h) < n:
            velocities[0], velocities[-1] = (values[1] - values[0]) / h[0], (values[-1] - values[-2]) / h[-1]
            free = free[1:-1]
        pull = torch.einsum("kncmd,mkd->nkc", matrix, torch.stack([values, velocities], -1))[free, :, 1]
        rows = matrix[:, free][:, :, 1][:, :, free, 1]
        velocities[free] -= torch.linalg.solve(rows, pull.T[..., None])[..., 0].T
        #: At the nodes. *Shape:* ``(K, k, 2)``.
        self.states = torch.stack([values, velocities], -1)

    def transition(self, s: Tensor) -> tuple[Tensor, Tensor]:
        """States a time later without force, and the controllability Gramian. *Shape:* ``(B,) -> (B, k, 2, 2)``."""
        forward = torch.matrix_exp(s[:, None, None, None] * self.generator)
        return forward, self.stationary - forward @ self.stationary @ forward.mT

    def within(self, i: int, t: Tensor) -> Tensor:
        """Values in the interval ``i``. *Shape:* ``(B,) -> (B, k)``."""
        start, end = self.states[i, ..., None], self.states[self.last[i], ..., None]
        whole, _ = self.transition(self.times.diff()[i : i + 1])
        (first, gramian), (rest, _) = self.transition(t - self.times[i]), self.transition(self.times[i + 1] - t)
        return (first @ start + gramian @ rest.mT @ self.cost[i] @ (end - whole[0] @ start))[..., 0, 0]


def spacetime(
    keyframes: Tensor,
    faces: Tensor,
    times: Tensor,
    *,
    cyclic: bool = False,
    bases: Sequence[tm.ModalBasis] | None = None,
    n_modes: int = N_MODES,
    pitch: float = 0.03,
) -> Tensor:
    """Interactive spacetime control of deformable objects (Hildebrandt et al. 2012), as far as it interpolates.

    In each interval, the modes of its first key-frame are independent damped oscillators, which pass through all
    key-frames with the least force (:class:`LeastForce`); amplitudes become shapes by :class:`WarpedModes`. Key-frames
    are met in the sense of least squares, as far as the modes reach.

    Args:
        keyframes: At the times 0, 1, 2, ... *Shape:* ``(K, V, 3)``, float64.
        faces: Vertex indices. *Shape:* ``(F, 3)``.
        times: Of the shapes. *Shape:* ``(T,)``.
        cyclic: True where the last key-frame leads on to the first.
        bases: Modes of the key-frames. Default: ``n_modes`` of each.
        pitch: Oscillations of the lowest mode from one key-frame to the next. The default is near the limit of 0, where
            amplitudes are cubic splines: it had the least errors.

    Returns:
        *Shape:* ``(T, V, 3)``.
    """
    n, times = len(keyframes), times.to(keyframes)
    bases = bases or tm.extract_bases(keyframes, faces, n_modes, progress=False)
    key_times, weights = torch.arange(n + cyclic).to(keyframes), torch.ones_like(keyframes[0, :, 0])
    interval = times.floor().long().clamp(0, len(key_times) - 2)
    found = keyframes.new_empty(len(times), *keyframes.shape[1:])
    for i in interval.unique().tolist():
        aligned = best_fit(keyframes, keyframes[i], weights).apply(keyframes)
        modes = WarpedModes(bases[i], faces, aligned)
        frequencies = 2 * torch.pi * pitch * (bases[i].eigenvalues / bases[i].eigenvalues[0]).sqrt()
        motion = LeastForce(frequencies**2, DAMPING * frequencies, key_times, modes.amplitudes(aligned))
        own, last = interval == i, (i + 1) % n
        shapes, u = modes.shapes(motion.within(i, times[own])), times[own] - i
        # Modes have no rigid motion: it follows the geodesic.
        straight = torch.lerp(aligned[i], aligned[last], u[:, None, None])
        rigid = fraction(best_fit(keyframes[i], keyframes[last], weights), u)
        found[own] = rigid.apply(best_fit(shapes, straight, weights).apply(shapes))
    return found
