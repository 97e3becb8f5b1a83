"""Bodies that bend far, and thin and hollow ones: surfaces with motions in closed form, so that in-betweens are known.

A body is a surface at rest along the x axis and a motion of space. The key-frames are the motion's ends, and the motion
half-way is the true in-between: every motion here turns its body by an angle that grows evenly with time, and keeps the
lengths along its centre line (bar, limb) or everywhere (sheet).
"""

from collections.abc import Callable
from functools import cache, partial
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import trimesh
from numpy.typing import NDArray

from helpers.solids import as_mesh, box
from torch_modal.geometry.inspect import volume_of

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
Motion = Callable[[FloatArray, float], FloatArray]


class Body(NamedTuple):
    """A surface and how it moves."""

    rest: FloatArray
    """Straight; the first key-frame, but for the gutter. *Shape:* ``(V, 3)``."""
    faces: IntArray
    """Wound counterclockwise seen from outside. *Shape:* ``(F, 3)``."""
    motion: Motion
    """Where points near the body at rest are at a time in [0, 1]. *Shape:* ``(n, 3), () -> (n, 3)``."""

    def pose(self, time: float) -> FloatArray:
        """The surface at a time. *Shape:* ``(V, 3)``."""
        return self.motion(self.rest, time)


# ------------------------------------------------------------------------------------------------------------- motions


def bend(points: FloatArray, time: float, angle: float, start: float, stop: float) -> FloatArray:
    """The x axis bent to an arc of ``angle`` (in its whole) between two places; straight, and rigid, before and after.

    Lengths on the axis do not change. Points at the height ``y`` come nearer to each other by ``1 - y angle / length``.
    """
    x, y, z = points.T
    angle = angle * time
    turn = angle * np.clip((x - start) / (stop - start), 0, 1)
    radius = (stop - start) / angle if angle else np.inf
    # Where the axis goes; the limit of no angle is taken by the sine of half of it.
    half = np.sinc(turn / (2 * np.pi)) * np.clip(x - start, 0, stop - start)  # chord of the arc
    past, before = np.maximum(x - stop, 0), np.minimum(x, start)
    along = before + half * np.cos(turn / 2) + past * np.cos(turn)
    across = half * np.sin(turn / 2) + past * np.sin(turn)
    if (y >= radius)[(x > start) & (x < stop)].any():
        raise ValueError(f"an arc of the radius {radius:g} folds a body that is {y.max():g} high on its inner side")
    return np.stack([along - y * np.sin(turn), across + y * np.cos(turn), z], axis=1)


def twist(points: FloatArray, time: float, angle: float, start: float, stop: float) -> FloatArray:
    """Sections turned about the x axis, by ``angle`` from one end to the other."""
    x, y, z = points.T
    turn = angle * time * (x - start) / (stop - start)
    c, s = np.cos(turn), np.sin(turn)
    return np.stack([x, c * y - s * z, s * y + c * z], axis=1)


# ------------------------------------------------------------------------------------------------------------ surfaces


def bar_surface(cells: tuple[int, int, int], size: tuple[float, float, float]) -> tuple[FloatArray, IntArray]:
    """A box along x, centred on the axis, its vertices spread evenly."""
    vertices, faces = as_mesh(box(cells, size))
    return vertices - [0, size[1] / 2, size[2] / 2], faces


def turned_surface(profile: FloatArray, spacing: float) -> tuple[FloatArray, IntArray]:
    """A profile turned about the x axis, in triangles of about one size.

    Args:
        profile: Corners ``(x, r)``; the first and the last lie on the axis. *Shape:* ``(n, 2)``.
        spacing: Length of an edge, about.
    """
    points = []
    for start, stop in pairwise(profile):
        n = max(1, round(np.linalg.norm(stop - start) / spacing))
        points.append(start + (stop - start) * np.arange(n)[:, None] / n)
    line = np.concatenate([*points, profile[-1:]])
    vertices, rings, n_vertices = [], [], 0
    for x, r in line:
        n = max(8, round(2 * np.pi * r / spacing)) if r > 0 else 1
        angle = 2 * np.pi * np.arange(n) / n
        vertices.append(np.stack([np.full(n, x), r * np.cos(angle), r * np.sin(angle)], axis=1))
        rings.append(np.arange(n_vertices, n_vertices + n))
        n_vertices += n
    faces = np.concatenate([_stitched(a, b) for a, b in pairwise(rings)])
    points = np.concatenate(vertices)
    return points, faces if volume_of(points, faces) > 0 else faces[:, ::-1].copy()


def _stitched(a: IntArray, b: IntArray) -> IntArray:
    """Triangles between two rings that both start at the angle 0. *Shape:* ``(n,), (m,) -> (·, 3)``."""
    i = j = 0
    n, m = (len(ring) if len(ring) > 1 else 0 for ring in (a, b))
    faces = []
    while i < n or j < m:
        # The ring that lags behind goes on, so that both come round together.
        if j == m or (i < n and (i + 1) * m <= (j + 1) * n):
            faces.append((a[i], a[(i + 1) % n], b[j % max(m, 1)]))
            i += 1
        else:
            faces.append((a[i % max(n, 1)], b[(j + 1) % m], b[j]))
            j += 1
    return np.array(faces)


def sheet_surface(cells: tuple[int, int], size: tuple[float, float]) -> tuple[FloatArray, IntArray]:
    """A flat rectangle in y = 0 from x = 0, with a boundary."""
    nx, nz = cells
    x, z = np.meshgrid(np.linspace(0, size[0], nx + 1), np.linspace(0, size[1], nz + 1), indexing="ij")
    corner = (np.arange(nx)[:, None] * (nz + 1) + np.arange(nz)).reshape(-1)
    a, b, c, d = corner, corner + nz + 1, corner + nz + 2, corner + 1
    faces = np.concatenate([np.stack([a, c, b], axis=1), np.stack([a, d, c], axis=1)])
    return np.stack([x, np.zeros_like(x), z - size[1] / 2], axis=-1).reshape(-1, 3), faces


def twisted_plate(thickness: float) -> tuple[FloatArray, FloatArray, IntArray]:
    """A plate of two sheets and a rim, flat and twisted by 60 degrees, and its faces.

    The sheets are cut along other diagonals, so that the twist moves them through each other if the plate is thin.
    """
    u, v = np.meshgrid(np.linspace(-1, 1, 9), np.linspace(-0.5, 0.5, 6), indexing="ij")
    sheets = [np.stack([u, v, np.full_like(u, z)], -1).reshape(-1, 3) for z in (0.5 * thickness, -0.5 * thickness)]
    grid = np.arange(u.size).reshape(u.shape)
    a, b, c, d = (part.reshape(-1) for part in (grid[:-1, :-1], grid[1:, :-1], grid[1:, 1:], grid[:-1, 1:]))
    top = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
    bottom = np.concatenate([np.stack([a, d, b], 1), np.stack([b, d, c], 1)]) + u.size
    loop = np.concatenate([grid[:, 0], grid[-1, 1:], grid[-2::-1, -1], grid[0, -2:0:-1]])
    after = np.roll(loop, -1)
    rim = [np.stack([loop, loop + u.size, after + u.size], 1), np.stack([loop, after + u.size, after], 1)]
    flat = np.concatenate(sheets)
    x, y, z = flat.T
    angle = -np.pi / 6 * x
    turned = np.stack([x, np.cos(angle) * y - np.sin(angle) * z, np.sin(angle) * y + np.cos(angle) * z], 1)
    return flat, turned, np.concatenate([top, bottom, *rim])


def limbs(level: int) -> tuple[FloatArray, IntArray]:
    """A ball with five bumps of different length and place: nothing about it is symmetric."""
    ball = trimesh.creation.icosphere(subdivisions=level)
    points = np.array(ball.vertices)
    bumps = np.array([[1, 0.2, 0.1], [-0.3, 1, 0.2], [-0.2, -1, 0.5], [0.1, 0.3, 1], [-1, 0, -0.6]])
    bumps /= np.linalg.norm(bumps, axis=1, keepdims=True)
    radius = 1 + np.exp(14 * (points @ bumps.T - 1)) @ np.array([2.4, 1.9, 1.5, 1.1, 2.0])
    return points * radius[:, None], np.array(ball.faces, dtype=np.int64)


# -------------------------------------------------------------------------------------------------------------- bodies

BAR = 4.0
LIMB = 5.0


def _vessel() -> tuple[FloatArray, IntArray]:
    """A bottle with an open neck."""
    outer = np.array([[0, 0], [0, 0.9], [0.1, 1.0], [3.2, 1.0], [3.7, 0.5], [4.2, 0.5]])
    inner = np.array([[4.2, 0.44], [3.67, 0.44], [3.17, 0.94], [0.13, 0.94], [0.06, 0.87], [0.06, 0]])
    return turned_surface(np.concatenate([outer, inner]), 0.14)


def _ball_with_limb(radius: float, spacing: float) -> tuple[FloatArray, IntArray]:
    """A ball of radius 1 with a limb of another, which ends round."""
    ball, root = np.linspace(np.pi, np.arcsin(radius), 40), np.linspace(np.pi / 2, 0, 4)[1:]
    profile = [[np.cos(a), np.sin(a)] for a in ball] + [[LIMB, radius]]
    profile += [[LIMB + radius * np.cos(a), radius * np.sin(a)] for a in root]
    profile[0][1] = profile[-1][1] = 0.0
    return turned_surface(np.array(profile), spacing)


def _rod() -> tuple[FloatArray, IntArray]:
    """Fifty times longer than wide."""
    root = np.linspace(np.pi / 2, 0, 4)
    end = np.stack([BAR + 0.04 * np.cos(root), 0.04 * np.sin(root)], axis=1)
    profile = np.concatenate([np.stack([BAR - end[::-1, 0], end[::-1, 1]], axis=1), end])
    profile[0, 1] = profile[-1, 1] = 0.0
    return turned_surface(profile, 0.03)


_bar = partial(bar_surface, (52, 13, 13), (BAR, 1.0, 1.0))

_BENT = {
    "bar bent": (_bar, bend, 0.0, BAR),
    "bar twisted": (_bar, twist, 0.0, BAR),
    "vessel bent": (_vessel, bend, 0.3, 3.2),
    "limb bent": (partial(_ball_with_limb, 0.1, 0.085), bend, 1.5, LIMB),
    "wire bent": (partial(_ball_with_limb, 0.025, 0.045), bend, 1.5, LIMB),
    "rod bent": (_rod, bend, 0.0, BAR),
    "gutter rolled": (partial(sheet_surface, (72, 36), (BAR, 2.0)), bend, 0.0, BAR),
}
GUTTER = 1 / 3
"""How far the gutter, a sheet, is rolled already at the first key-frame: a flat one has no inside to be filled."""


@cache
def body(name: str) -> Body:
    """One of the bodies, of 2,000 to 4,000 vertices, by what is moved, how, and by how many degrees in its whole.

    Raises:
        ValueError: There is no such body.
    """
    kind, _, degrees = name.rpartition(" ")
    if kind not in _BENT or not degrees.isdigit():
        raise ValueError(f"there is no body {name!r}; there are, with an angle, {', '.join(_BENT)}")
    make, bending, start, stop = _BENT[kind]
    motion = partial(bending, angle=np.radians(int(degrees)), start=start, stop=stop)
    return Body(*make(), partial(_later, motion) if kind.startswith("gutter") else motion)


def _later(motion: Motion, points: FloatArray, time: float) -> FloatArray:
    """The motion without its first part."""
    return motion(points, GUTTER + (1 - GUTTER) * time)
