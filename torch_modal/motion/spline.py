"""The smooth motion through key-frames: splines of triangle rotations and sizes, then one Poisson solve."""

from itertools import pairwise
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from torch_modal.autograd import full_precision
from torch_modal.elastic.backend import TorchBackend
from torch_modal.elastic.minimise import Solution
from torch_modal.geometry.canonical import own_order
from torch_modal.geometry.connectivity import Connectivity
from torch_modal.geometry.local_rotations import Trajectory, quaternions_from_first, weights_per_length
from torch_modal.geometry.poisson import Poisson
from torch_modal.geometry.rigid import best_rotation, centroid
from torch_modal.geometry.rotations import exp, log
from torch_modal.geometry.triangle_frames import frames_of
from torch_modal.geometry.vectors import pick
from torch_modal.inbetween.alignment import KeyframeAlignment, Pose
from torch_modal.motion.cubics import Cubics, Scheme, cubics, offset

# Strains are relative to the mean size of a triangle, of which the smallest is this part of the mean.
SMALLEST = 1e-9

# Change of a velocity by the limit from which on an Explanation counts it, relative to the velocity and a hundredth,
# below which a triangle is at rest.
LIMITED = 1e-3


class Knots(NamedTuple):
    """Key-frames of L motions and the velocities there; N intervals, of which a cycle has as many as key-frames."""

    usable: Tensor
    """False for motions with a key-frame that is not finite, a point, or a mirror image. *Shape:* ``(L,)``, bool."""
    shapes: Tensor
    """Centred, scaled, and turned on to each other in a row. *Shape:* ``(N + 1, L, V, 3)``."""
    rotations: Tensor
    """From these shapes to the caller's. *Shape:* ``(N + 1, L, 3, 3)``."""
    centres: Tensor
    """Centroids in the caller's coordinates. *Shape:* ``(N + 1, L, 3)``."""
    triangles: Cubics
    """Steps by :meth:`~torch_modal.geometry.local_rotations.LocalRotations.step`. *Shape of each:* ``(N, 6, L, F)``."""
    vertices: Cubics
    """Positions of the shapes. *Shape of each:* ``(N, L, V, 3)``."""
    turns: Cubics
    """Rotations of the caller's shapes, axis times angle. *Shape of each:* ``(N, L, 3)``."""
    moves: Cubics
    """Positions of the centroids. *Shape of each:* ``(N, L, 3)``."""


class Explanation(NamedTuple):
    """Causes of sudden changes in a motion, at given times."""

    interval: Tensor
    """The interval between key-frames, from 0 on; other cubics begin at each. *Shape:* ``(...)``, int64."""
    fraction: Tensor
    """Time within the interval; at 0 and 1 the shape is the key-frame itself. *Shape:* ``(...)``."""
    limited: Tensor
    """Part of the triangles with a limited velocity at the key-frames before and after, where their acceleration jumps.
    *Shape:* ``(..., 2)``."""
    even: Tensor
    """True where velocities jump at both key-frames: triangles turn evenly in this interval, as pairs alone, or because
    parts turn by more than a full turn. *Shape:* ``(...)``, bool."""
    turns: Tensor
    """Angles by which the whole shape turns within the interval, and the triangle that turns most relative to it, in
    radians. Near half a turn, and near a full turn, small changes of the key-frames change the way round.
    *Shape:* ``(..., 2)``."""
    displacement: Tensor
    """Largest distance by which contact or further terms moved a vertex off the spline, in the caller's units.
    *Shape:* ``(...)``."""
    solution: Solution
    """From :meth:`Path.solve`: ``status``, ``n_steps``, ``start_weights`` and, with contact, ``n_crossing``."""


class Spline(nn.Module):
    """Shapes of a motion through key-frames.

    Every triangle turns and stretches along a cubic with continuous velocities (:mod:`torch_modal.motion.cubics`), and
    so does the rigid motion; a Poisson system makes shapes of the triangles. An interval in which parts turn by more
    than a full turn has no single axis of each triangle: there, triangles turn evenly from one shape to the other.

    Args:
        mesh: The connectivity.
        references: Shapes near the key-frames, float64 on the CPU. *Shape:* ``(K, V, 3)``.
        times: Of the key-frames; of a cycle one more, when the first comes again. *Shape:* ``(K,)`` or ``(K + 1,)``.
        scheme: The path scheme.
        backend: Makes the parts.
    """

    times: Tensor

    def __init__(
        self, mesh: Connectivity, references: Tensor, times: Tensor, scheme: Scheme | None, backend: TorchBackend
    ) -> None:
        super().__init__()
        n = len(references)
        self.scheme, self.cyclic = scheme, len(times) > n
        order = own_order([x.numpy() for x in references], mesh.faces)  # as of in-betweens, whose frame contact shares
        self.alignment = KeyframeAlignment(references[order], mesh, backend)
        self.register_buffer("times", times.clone(), persistent=False)
        self.poisson = Poisson(mesh, weights_per_length(mesh, references))
        first = backend.rotations(mesh, references[:2])
        #: Local rotations of each interval. The tree of the first serves all in which neighbours have the same
        #: quaternion sign by it, and so by every tree, and in which nothing goes beyond a full turn.
        self.rotations: Any = nn.ModuleList([first])
        one, other = torch.tensor(mesh.face_neighbours).unbind(1)
        for i in range(1, len(times) - 1):
            ends = references[[i, (i + 1) % n]]
            frames = [frames_of(x[None], first.faces) for x in ends]
            plain = not first.beyond_a_turn and not first.turns_beyond(first.off_mean(quaternions_from_first(frames)))
            if plain:
                turns = first.quaternions(*frames)[:, 0]
                plain = bool(((pick(turns, one) * pick(turns, other)).sum(0) >= 0).all())
            self.rotations.append(first if plain else backend.rotations(mesh, ends))

    @full_precision
    def knots(self, keyframes: Tensor) -> Knots:
        """The velocities at all key-frames. *Shape:* ``(L, K, V, 3)``."""
        weights, reference = self.alignment.weights, self.alignment.reference
        x, usable = self.alignment.replace_unusable(keyframes.mT)
        x = x.mT.movedim(1, 0)
        x = torch.cat([x, x[:1]]) if self.cyclic else x
        centres = centroid(x, weights)
        centred = x - centres[..., None, :]
        weighted = (centred * weights[:, None]).mT
        turns = [best_rotation(reference.mT @ weighted[0].mT)]
        back = best_rotation(weighted[:-1] @ centred[1:])  # from each key-frame to the one before
        for step in back:
            turns.append(turns[-1] @ step)
        rotations = torch.stack(turns).mT
        shapes = self.alignment.scale * centred @ rotations
        every = shapes.detach().movedim(0, 1)
        usable = usable.all(1) & ~self.alignment.find_mirrored(every, torch.ones_like(every[..., 0, 0])).any(1)
        durations = self.times.diff()

        def fit_cubics(steps: Tensor, dim: int = -1) -> Cubics:
            def squared_norm(v: Tensor) -> Tensor:
                total = v.square().sum(dim, keepdim=True)
                return total + v[:, 4:5].square() if dim == 1 else total  # the off-diagonal entry counts twice

            return cubics(steps, durations, self.cyclic, squared_norm, self.scheme)

        frames = [frames_of(shape, self.rotations[0].faces) for shape in shapes]
        steps = [each.step(*ends) for each, ends in zip(self.rotations, pairwise(frames), strict=True)]
        unit = torch.stack([each.size for each in frames]).mean(0)
        unit = torch.maximum(unit, SMALLEST * unit.mean(-1, keepdim=True))
        unit = torch.cat([torch.ones_like(unit)[None].expand(3, -1, -1), unit[None].expand(3, -1, -1)])
        triangles = Cubics(*(unit * cubic for cubic in fit_cubics(torch.stack(steps) / unit, 1)))
        vertices, moves = fit_cubics(shapes.diff(dim=0)), fit_cubics(centres.diff(dim=0))
        return Knots(usable, shapes, rotations, centres, triangles, vertices, fit_cubics(log(back.mT)), moves)

    def trajectory(self, knots: Knots, i: int) -> Trajectory:
        """The cubics of the triangles in one interval."""
        start = frames_of(knots.shapes[i], self.rotations[i].faces)
        return Trajectory(
            start.e1, start.e2, start.normal, torch.stack(start[3:]), *(cubic[i] for cubic in knots.triangles)
        )

    def straight(self, knots: Knots, i: int, which: Tensor, u: Tensor) -> Tensor:
        """Shapes whose vertices move along cubics. Arguments as for :meth:`forward`."""
        return knots.shapes[i][which] + knots.vertices.along(i, which, u)

    def forward(
        self,
        knots: Knots,
        i: int,
        which: Tensor,
        u: Tensor,
        straight: Tensor | None = None,
        bending: Tensor | None = None,
    ) -> Tensor:
        """Shapes of one interval, in the coordinates of the knots' shapes.

        Args:
            knots: From :meth:`knots`.
            i: The interval.
            which: The motion of each shape. *Shape:* ``(B,)``.
            u: Times, 0 to 1. *Shape:* ``(B,)``.
            straight: Shapes that give the centres of the pieces. Default: from :meth:`straight`.
                *Shape:* ``(B, V, 3)``.
            bending: Turns and strains of the triangles beforehand, of one motion. *Shape:* ``(6, B, F)``.

        Returns:
            *Shape:* ``(B, V, 3)``.
        """
        rotations = self.rotations[i]
        straight = self.straight(knots, i, which, u) if straight is None else straight
        if bending is not None:
            edges = rotations.edges_with_bending(self.trajectory(knots, i), u, bending)
        elif rotations.beyond_a_turn:
            ends = knots.shapes[i : i + 2, which].movedim(0, 1)
            edges = rotations(ends, torch.stack([1 - u, u], -1))
        else:
            edges = rotations.edges_along(self.trajectory(knots, i), which, u)
        return self.poisson.forward_or_near(self.poisson.right_hand_side(edges), straight)

    def explain(self, knots: Knots) -> tuple[Tensor, Tensor]:
        """Masks of the velocities that are limited at both ends of each interval, and its :attr:`Explanation.turns`.

        *Shape:* ``(N, 2, L, F), (N, 2, L)``.
        """
        step, *ends = knots.triangles
        free = torch.stack(cubics(step, self.times.diff(), self.cyclic, torch.zeros_like)[1:])  # without the limit
        change, speed = (x.norm(dim=2) for x in (torch.stack(ends) - free, step + free))
        limited = (change > LIMITED * (speed + 0.01)).transpose(0, 1) & (self.scheme is None)
        if not self.cyclic:
            limited[0, 0] = limited[-1, 1] = False
        turns = torch.stack([knots.turns.step.norm(dim=-1), step[:, :3].norm(dim=1).amax(-1)], 1)
        return limited, turns

    def pose(self, knots: Knots, i: int, which: Tensor, u: Tensor) -> Pose:
        """The poses at times of one interval. Arguments as for :meth:`forward`."""
        wide = u[:, None]
        start = knots.rotations[i][which]
        step, first, last = ((cubic[i][which][:, None] @ start).squeeze(1) for cubic in knots.turns)
        end = (knots.turns.last[i][which] + knots.turns.step[i][which])[:, None] @ knots.rotations[i + 1][which]
        last = end.squeeze(1) - step
        rotation = start @ exp(wide * step) @ exp(offset(first, last, wide))
        return Pose(rotation, knots.centres[i][which] + knots.moves.along(i, which, u))
