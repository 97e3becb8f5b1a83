"""Bodies of many kinds, made by code or taken from packages and samples, and a motion whose middle is known.

Each body is a function under ``@body(kind, ...)`` that gives vertices and faces. Nothing is downloaded; where data that
is kept beside the project is absent, its bodies are left out, with a word.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from functools import partial
from typing import NamedTuple

import igl
import numpy as np
import pyvista
import trimesh
from cases import DATA
from numpy.typing import NDArray
from pyvista import examples
from trimesh import creation

from torch_modal.data.samples import load_sample
from torch_modal.io.read import read_mesh

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
Surface = tuple[FloatArray, IntArray]

ANGLE = np.radians(60.0)


class WildBody(NamedTuple):
    """A surface, and what is claimed of it."""

    name: str
    kind: str
    make: Callable[[], Surface]
    closed: bool | None
    """Whether each edge belongs to two faces of opposite senses; None where nothing is claimed."""
    contact: bool
    """Whether it belongs to the smaller set that is tried with contact."""


BODIES: dict[str, WildBody] = {}


def add(name: str, kind: str, make: Callable[[], Surface], closed: bool | None = True, contact: bool = False) -> None:
    """Put a body into ``BODIES``."""
    BODIES[name] = WildBody(name, kind, make, closed, contact)


# ----------------------------------------------------------------------------------------------------------- the motion


def bent_and_twisted(vertices: FloatArray, faces: IntArray, time: float) -> FloatArray:
    """The body at a time in [0, 1]: its long principal axis bent and twisted evenly, by 60 degrees each at 1.

    Bending and twist are constant along the axis, and in the section's own frame, so the axis becomes a helix and keeps
    its length. All strains of the rod grow in proportion to the time, hence the half-way shape is the true in-between
    of rest and end. It bends towards the side where the body is thinnest. *Shape:* ``(V, 3)``.
    """
    used = vertices[np.unique(faces)]
    centre = used.mean(0)
    axes = np.linalg.svd(used - centre, full_matrices=False)[2]  # long, middle, thin
    axes[2] = np.cross(axes[0], axes[1])
    x, y, z = ((vertices - centre) @ axes.T).T
    along = (used - centre) @ axes[0]
    length = np.ptp(along)
    # The curve x(s) and its frame R(s) of R' = R [w], x' = R e_1 with a constant w: one exponential of a screw.
    w = np.array([1.0, 1.0, 0.0]) * ANGLE * time / length
    speed = np.linalg.norm(w)
    k = np.array([[0, -w[2], w[1]], [w[2], 0, -w[0]], [-w[1], w[0], 0]])
    s = (x - along.mean())[:, None, None]
    sin = s * np.sinc(speed * s / np.pi)  # sin(speed s) / speed, without the division at rest
    half = s * np.sinc(speed * s / (2 * np.pi)) / 2
    cos = 2 * half**2  # (1 - cos(speed s)) / speed^2
    rotation = np.eye(3) + sin * k + cos * (k @ k)
    rest = (s - sin) / speed**2 if speed else 0 * s
    curve = (s * np.eye(3) + cos * k + rest * (k @ k))[:, :, 0]
    offset = np.stack([0 * y, y, z], axis=1)
    moved = curve + along.mean() * np.array([1.0, 0, 0]) + np.einsum("nij,nj->ni", rotation, offset)
    return moved @ axes + centre


# -------------------------------------------------------------------------------------------------------------- helpers


def of(mesh: trimesh.Trimesh) -> Surface:
    """A mesh of trimesh, its vertices merged."""
    mesh.merge_vertices()
    return np.array(mesh.vertices, dtype=np.float64), np.array(mesh.faces, dtype=np.int64)


def of_vtk(mesh: pyvista.DataSet) -> Surface:
    """A mesh of pyvista."""
    surface = mesh.extract_surface(algorithm="dataset_surface").triangulate().clean(tolerance=1e-6)
    return np.array(surface.points, dtype=np.float64), np.array(surface.regular_faces, dtype=np.int64)


def joined(*parts: Surface) -> Surface:
    """Several surfaces as one, nothing merged."""
    starts = np.cumsum([0, *(len(v) for v, _ in parts)])
    return np.concatenate([v for v, _ in parts]), np.concatenate(
        [f + n for (_, f), n in zip(parts, starts, strict=False)]
    )


def welded(vertices: FloatArray, faces: IntArray) -> Surface:
    """Equal positions made one vertex; faces that lost a corner are gone."""
    position, number = np.unique(np.round(vertices, 9), axis=0, return_inverse=True)
    faces = number.reshape(-1)[faces]
    return position, faces[(faces != np.roll(faces, 1, axis=1)).all(1)]


def stretched(surface: Surface, *factors: float) -> Surface:
    """Along x, y, z."""
    return surface[0] * np.array(factors), surface[1]


def moved(surface: Surface, *by: float) -> Surface:
    """By a vector."""
    return surface[0] + np.array(by), surface[1]


def split(surface: Surface, times: int) -> Surface:
    """Each face in four, so many times."""
    for _ in range(times):
        surface = of(trimesh.Trimesh(*surface, process=False).subdivide())
    return surface


def ball(level: int = 3, radius: float = 1.0) -> Surface:
    """A sphere of 20 * 4^level faces."""
    return of(creation.icosphere(subdivisions=level, radius=radius))


def block(size: tuple[float, float, float], times: int = 3) -> Surface:
    """A box of 12 * 4^times faces."""
    return split(of(creation.box(extents=size)), times)


def patch(function: Callable[[FloatArray, FloatArray], Iterable[FloatArray]], n: int, m: int) -> Surface:
    """A grid over [0, 1]^2, not welded."""
    u, v = (grid.ravel() for grid in np.meshgrid(np.linspace(0, 1, n), np.linspace(0, 1, m), indexing="ij"))
    index = np.arange(n * m).reshape(n, m)
    a, b, c, d = (part.ravel() for part in (index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]))
    faces = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
    return np.stack([np.broadcast_to(part, u.shape) for part in function(u, v)], axis=1).astype(np.float64), faces


def turned(profile: list[tuple[float, float]], n: int = 24) -> Surface:
    """A profile (r, z) turned about z: closed where it starts and ends on the axis."""
    return of(creation.revolve(np.array(profile), sections=n))


def level_set(function: Callable[..., FloatArray], size: tuple[float, float, float], step: float) -> Surface:
    """Where a function is 0 within a box about the origin: positive outside."""
    # No corner of the grid lies in a plane of symmetry, where edges of no length would come out.
    axes = [
        np.arange(-half - shift * step, half + step, step) for half, shift in zip(size, (0.31, 0.17, 0.43), strict=True)
    ]
    z, y, x = np.meshgrid(*axes[::-1], indexing="ij")
    grid = np.stack([x.ravel(), y.ravel(), z.ravel()], axis=1)
    found = igl.marching_cubes(function(*grid.T), grid, *(len(axis) for axis in axes), 0.0)
    vertices, faces = (np.array(part) for part in found[:2])
    surface = welded(vertices.astype(np.float64), faces.astype(np.int64))
    volume = trimesh.Trimesh(*surface, process=False).volume
    return surface if volume > 0 else (surface[0], surface[1][:, ::-1].copy())


def limbs(
    segments: list[tuple[FloatArray, FloatArray, float, float]], blend: float = 0.03
) -> Callable[..., FloatArray]:
    """Distance to a smooth union of cones with round ends: from, to, radius there and there."""

    def distance(x: FloatArray, y: FloatArray, z: FloatArray) -> FloatArray:
        points = np.stack([x, y, z], axis=1)
        total = np.zeros(len(points))
        for a, b, r_a, r_b in segments:
            a, b = np.asarray(a, float), np.asarray(b, float)
            place = np.clip((points - a) @ (b - a) / max((b - a) @ (b - a), 1e-12), 0, 1)
            far = np.linalg.norm(points - a - place[:, None] * (b - a), axis=1) - (r_a + place * (r_b - r_a))
            total += np.exp(np.clip(-far / blend, -60, 60))
        return -blend * np.log(np.maximum(total, 1e-30))

    return distance


def fewer(surface: Surface, n: int) -> Surface:
    """Decimated to so many faces."""
    return of(trimesh.Trimesh(*surface, process=False).simplify_quadric_decimation(face_count=n))


def noisy(surface: Surface, part: float, seed: int = 0) -> Surface:
    """Vertices moved by this part of the mean edge."""
    vertices, faces = surface
    edge = np.linalg.norm(vertices[faces[:, 0]] - vertices[faces[:, 1]], axis=1).mean()
    return vertices + part * edge * np.random.default_rng(seed).standard_normal(vertices.shape), faces


def circle(n: int, radius: float, phase: float = 0.0) -> list[FloatArray]:
    """Points about the origin in the plane of x and y."""
    angles = 2 * np.pi * np.arange(n) / n + phase
    return [radius * np.array([np.cos(a), np.sin(a), 0.0]) for a in angles]


# ---------------------------------------------------------------------------------------------------------------- plain


def _plain() -> None:
    kind = "plain"
    add("sphere", kind, ball)
    add("ellipsoid", kind, lambda: stretched(ball(), 3, 1, 0.6), contact=True)
    add("capsule", kind, lambda: of(creation.capsule(height=4, radius=0.5, count=(20, 20))))
    add("cylinder", kind, lambda: fewer(split(of(creation.cylinder(radius=0.4, height=4, sections=24)), 3), 2400))
    add("cone", kind, lambda: turned([(0, 0), *[(0.8 * (1 - k / 20), 3 * k / 20) for k in range(20)], (0, 3)]))
    add("torus", kind, lambda: of(creation.torus(1, 0.3, 40, 20)))
    add("box", kind, lambda: block((4, 1, 1)))
    add("cube", kind, lambda: block((1, 1, 1)))
    add(
        "pear",
        kind,
        lambda: turned([(0, 0), *[(np.sin(a) * (1.3 + np.cos(a)), 2 * a) for a in np.linspace(0.1, 3, 30)], (0, 6.3)]),
    )
    add("superellipsoid", kind, lambda: stretched(_super_ellipsoid(0.3), 2.5, 1, 1))
    add("blob", kind, lambda: _blob(3))
    add(
        "bottle",
        kind,
        lambda: turned([(0, 0), (0.5, 0), *[(0.5, k / 6) for k in range(1, 13)], (0.2, 2.4), (0.2, 3), (0, 3)], 32),
    )


def _super_ellipsoid(power: float) -> Surface:
    vertices, faces = ball(4)
    return np.sign(vertices) * np.abs(vertices) ** power, faces


def _blob(level: int, seed: int = 1) -> Surface:
    vertices, faces = ball(level)
    random = np.random.default_rng(seed)
    waves = sum(
        a * np.sin(vertices @ k) for a, k in zip(random.normal(0, 0.12, 8), 3 * random.normal(size=(8, 3)), strict=True)
    )
    return vertices * (1 + np.asarray(waves))[:, None] * np.array([2, 1, 1]), faces


# ---------------------------------------------------------------------------------------------------------------- limbs


def _limbs() -> None:
    kind = "thin limbs"
    tail = [(1.01 * np.sin(a), -np.cos(a)) for a in np.linspace(0.12, 3.05, 24)]
    for radius in (0.06, 0.02, 0.008):
        rope = [(radius, z) for z in np.linspace(1.05, 5, 60)]
        add(
            f"balloon, tail {radius}",
            kind,
            partial(turned, [(0, -1), *tail, *rope, (0, 5)], 16),
            contact=radius == 0.06,
        )
    arms = [([0, 0, 0], 0.9 * p, 0.1, 0.03) for p in circle(8, 1)]
    add(
        "octopus",
        kind,
        lambda: fewer(level_set(limbs([([0, 0, 0], [0, 0, 0.3], 0.3, 0.35), *arms]), (1.2, 1.2, 0.8), 0.025), 4000),
        contact=True,
    )
    add(
        "starfish",
        kind,
        lambda: level_set(limbs([([0, 0, 0], p, 0.15, 0.06) for p in circle(5, 1)]), (1.2, 1.2, 0.4), 0.04),
    )
    add("spider", kind, lambda: fewer(level_set(limbs(_spider()), (1.2, 1.2, 0.7), 0.025), 3000), contact=True)
    add("tree", kind, lambda: fewer(level_set(limbs(_tree(4), 0.015), (1.4, 1.4, 1.4), 0.03), 5000))
    add("figure", kind, lambda: fewer(level_set(limbs(_figure()), (1.1, 0.5, 1.2), 0.03), 3000))
    add("figure, 600 faces", kind, lambda: fewer(level_set(limbs(_figure()), (1.1, 0.5, 1.2), 0.03), 600))
    add("snake", kind, lambda: _tube(lambda u: np.stack([3 * u, 0.4 * np.sin(9 * u), 0 * u], 1), 0.06, 160, 10))
    add(
        "coil",
        kind,
        lambda: _tube(lambda u: np.stack([2 * u, 0.5 * np.cos(30 * u), 0.5 * np.sin(30 * u)], 1), 0.05, 240, 8),
        contact=True,
    )
    add("hair", kind, lambda: _tube(lambda u: np.stack([4 * u, 0.1 * u**2, 0 * u], 1), 0.005, 200, 6))


def _spider() -> list[tuple]:
    legs = []
    for p in circle(8, 1, 0.2):
        knee = 0.6 * p + [0, 0, 0.35]
        legs += [(0.15 * p, knee, 0.035, 0.03), (knee, p - [0, 0, 0.3], 0.03, 0.025)]
    return [([0, 0, 0], [0.15, 0, 0], 0.2, 0.15), ([-0.35, 0, 0], [-0.4, 0, 0.05], 0.25, 0.2), *legs]


def _tree(depth: int) -> list[tuple]:
    random, found = np.random.default_rng(3), []

    def grow(start: FloatArray, way: FloatArray, radius: float, left: int) -> None:
        end = start + way
        found.append((start, end, radius, 0.75 * radius))
        for _ in range(2 * (left > 0)):
            turn = way + 0.75 * np.linalg.norm(way) * random.normal(size=3)
            grow(end, 0.7 * np.linalg.norm(way) * turn / np.linalg.norm(turn), 0.65 * radius, left - 1)

    grow(np.array([0, 0, -1.2]), np.array([0, 0, 0.8]), 0.13, depth)
    return found


def _figure() -> list[tuple]:
    sides = [1, -1]
    arms = [
        part
        for s in sides
        for part in (
            ([0.2 * s, 0, 0.45], [0.55 * s, 0, 0.4], 0.09, 0.07),
            ([0.55 * s, 0, 0.4], [0.95 * s, 0, 0.4], 0.07, 0.05),
        )
    ]
    legs = [([0.12 * s, 0, -0.2], [0.2 * s, 0, -1.05], 0.13, 0.07) for s in sides]
    return [([0, 0, 0.4], [0, 0, -0.15], 0.22, 0.2), ([0, 0, 0.85], [0, 0, 0.88], 0.17, 0.15), *arms, *legs]


def _tube(curve: Callable[[FloatArray], FloatArray], radius: float, n: int, m: int) -> Surface:
    """A closed tube round a curve over [0, 1], its ends caps of one vertex."""
    line = curve(np.linspace(0, 1, n))
    along = np.gradient(line, axis=0)
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    side = np.cross(along, [0.123, 0.456, 0.9])
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    other = np.cross(along, side)
    angles = 2 * np.pi * np.arange(m) / m
    rings = line[:, None] + radius * (
        np.cos(angles)[:, None] * side[:, None] + np.sin(angles)[:, None] * other[:, None]
    )
    index = np.arange(n * m).reshape(n, m)
    a, b = index[:-1].ravel(), np.roll(index, -1, 1)[:-1].ravel()
    c, d = np.roll(index, -1, 1)[1:].ravel(), index[1:].ravel()
    first, last = n * m, n * m + 1
    caps = [
        np.stack([np.full(m, first), np.roll(index[0], -1), index[0]], 1),
        np.stack([np.full(m, last), index[-1], np.roll(index[-1], -1)], 1),
    ]
    faces = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1), *caps])
    return np.concatenate([rings.reshape(-1, 3), line[:1], line[-1:]]), faces


# --------------------------------------------------------------------------------------------------------------- pieces


def _pieces() -> None:
    kind = "many pieces"
    add("two balls", kind, lambda: joined(ball(2), moved(ball(2), 2.5, 0, 0)))
    add("two balls, overlapping", kind, lambda: joined(ball(2), moved(ball(2), 1.2, 0, 0)))
    add("ball in a ball", kind, lambda: joined(ball(3), ball(2, 0.5)))
    add("chain of 12", kind, lambda: joined(*[moved(_link(k % 2), 1.3 * k, 0, 0) for k in range(12)]), contact=True)
    add("41 balls", kind, lambda: _cloud(41, 2), contact=True)
    add(
        "41 bones",
        kind,
        lambda: joined(
            *[
                moved(stretched(ball(1), 0.3, 0.06, 0.06), 0.4 * (k % 10), 0.3 * (k // 10), 0.2 * np.sin(k))
                for k in range(41)
            ]
        ),
    )
    add(
        "100 tetrahedra",
        kind,
        lambda: joined(
            *[
                moved((v, f), *(4 * np.random.default_rng(k).random(3) * [2, 1, 1]))
                for k in range(100)
                for v, f in [_tetrahedron()]
            ]
        ),
    )
    add("feathered bird", kind, _bird)
    add("ball and a crumb", kind, lambda: joined(ball(3), moved(ball(0, 0.01), 1.3, 0, 0)))
    add(
        "ball and ten crumbs",
        kind,
        lambda: joined(stretched(ball(3), 2, 1, 1), *[moved(ball(0, 0.02), *(1.4 * p)) for p in circle(10, 1)]),
    )
    add("stack of plates", kind, lambda: joined(*[moved(block((2, 1, 0.05), 2), 0, 0, 0.15 * k) for k in range(8)]))
    add(
        "ball and sheets",
        kind,
        lambda: joined(stretched(ball(3), 2, 1, 1), *[_sheet_at(k) for k in range(5)]),
        closed=False,
    )


def _link(turned_: int) -> Surface:
    vertices, faces = stretched(of(creation.torus(0.6, 0.12, 24, 10)), 1.5, 1, 1)
    return (vertices[:, [0, 2, 1]] * [1, -1, 1], faces) if turned_ else (vertices, faces)


def _cloud(n: int, level: int) -> Surface:
    random = np.random.default_rng(5)
    return joined(
        *[
            moved(ball(level, r), *p)
            for r, p in zip(random.uniform(0.15, 0.4, n), random.normal(size=(n, 3)) * [2, 0.8, 0.8], strict=True)
        ]
    )


def _tetrahedron() -> Surface:
    return np.array([[0.0, 0, 0], [0.3, 0, 0], [0, 0.3, 0], [0, 0, 0.3]]), np.array(
        [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]
    )


def _bird() -> Surface:
    """A low-poly body, two legs and forty feathers as thin closed plates."""
    random = np.random.default_rng(8)
    body = stretched(ball(1), 1, 0.6, 0.6)
    parts = [body, moved(ball(0, 0.3), 1.1, 0, 0.5), moved(stretched(ball(0), 0.05, 0.05, 0.5), 0, 0.3, -0.9)]
    for _ in range(38):
        plate = block((0.5, 0.12, 0.01), 0)
        direction = random.normal(size=3)
        direction /= np.linalg.norm(direction)
        turn = trimesh.geometry.align_vectors([1, 0, 0], direction)[:3, :3]
        parts.append((plate[0] @ turn.T + direction * [1.1, 0.7, 0.7], plate[1]))
    return joined(*parts)


def _sheet_at(k: int) -> Surface:
    return moved(patch(lambda u, v: (u, 0.5 * v, 0.1 * np.sin(3 * u)), 8, 5), -1 + 0.4 * k, 1.2, 0.2 * k)


# -------------------------------------------------------------------------------------------------------- thin and open


def _thin() -> None:
    kind = "thin shells"
    for thickness in (0.05, 0.01, 0.001):
        add(f"plate {thickness}", kind, partial(_plate, thickness), contact=thickness == 0.01)
    add("wavy plate", kind, lambda: _thick(lambda u, v: (3 * u, v, 0.15 * np.sin(9 * u)), 0.01, 40, 12))
    add(
        "disc",
        kind,
        lambda: turned(
            [
                (0, 0),
                *[(r, 0) for r in np.linspace(0.1, 1, 10)],
                *[(r, 0.01) for r in np.linspace(1, 0.1, 10)],
                (0, 0.01),
            ],
            40,
        ),
    )
    add(
        "cup with walls",
        kind,
        lambda: turned(
            [
                (0, 0),
                (0.5, 0),
                *[(0.5 + 0.02 * k, 0.1 * k) for k in range(1, 13)],
                *[(0.46 + 0.02 * k, 0.1 * k) for k in range(12, 0, -1)],
                (0.46, 0.04),
                (0, 0.04),
            ],
            32,
        ),
        contact=True,
    )
    add("tube with walls", kind, lambda: of(creation.annulus(0.45, 0.5, 3, sections=24)))
    add("fine tube with walls", kind, lambda: split(of(creation.annulus(0.47, 0.5, 3, sections=24)), 2))
    add("hollow ball", kind, lambda: _hollow(ball(3), 0.97))
    add(
        "ribbon",
        kind,
        lambda: _thick(
            lambda u, v: (2 * u, 0.3 * (v - 0.5) * np.cos(3 * u), 0.3 * (v - 0.5) * np.sin(3 * u)), 0.005, 60, 6
        ),
    )
    add("needle", kind, lambda: stretched(ball(3), 1, 0.01, 0.01))


def _plate(thickness: float) -> Surface:
    return _thick(lambda u, v: (2 * u, v, 0 * u), thickness, 30, 15)


def _thick(function: Callable, thickness: float, n: int, m: int) -> Surface:
    """Both sides of a grid, joined along its rim."""
    top, faces = patch(function, n, m)
    normals = trimesh.Trimesh(top, faces, process=False).vertex_normals
    index = np.arange(n * m).reshape(n, m)
    rim = np.concatenate([index[:-1, 0], index[-1, :-1], index[:0:-1, -1], index[0, :0:-1]])
    following, shift = np.roll(rim, -1), n * m
    wall = np.concatenate(
        [np.stack([rim, rim + shift, following], 1), np.stack([following, rim + shift, following + shift], 1)]
    )
    return np.concatenate([top + normals * thickness / 2, top - normals * thickness / 2]), np.concatenate(
        [faces, faces[:, ::-1] + shift, wall]
    )


def _hollow(surface: Surface, part: float) -> Surface:
    return joined(surface, (part * surface[0], surface[1][:, ::-1]))


def _open() -> None:
    kind = "open"
    flat = partial(add, kind=kind, closed=False)
    flat("hemisphere", make=lambda: _hemisphere(3))
    flat(
        "cup",
        make=lambda: turned([(0, 0), (0.5, 0), *[(0.5 + 0.02 * k, 0.1 * k) for k in range(1, 15)]], 32),
        contact=True,
    )
    flat(
        "open cylinder",
        make=lambda: welded(*patch(lambda u, v: (np.cos(2 * np.pi * v), np.sin(2 * np.pi * v), 4 * u), 30, 24)),
    )
    flat("curved sheet", make=lambda: patch(lambda u, v: (3 * u, v, 0.5 * np.sin(2 * u)), 40, 14))
    flat("flat sheet", make=lambda: patch(lambda u, v: (3 * u, v, 0 * u), 40, 14))
    flat("saddle", make=lambda: patch(lambda u, v: (2 * u, v, (u - 0.5) ** 2 - (v - 0.5) ** 2), 30, 20))
    flat("hills", make=lambda: of_vtk(pyvista.ParametricRandomHills(u_res=40, v_res=30, w_res=30)))
    flat("Enneper", make=lambda: of_vtk(pyvista.ParametricEnneper(u_res=40, v_res=40, w_res=10)))
    flat("Moebius strip", make=lambda: of_vtk(pyvista.ParametricMobius(u_res=40, v_res=12, w_res=10)))
    flat(
        "helicoid",
        make=lambda: patch(lambda u, v: (4 * u, (v - 0.5) * np.cos(6 * u), (v - 0.5) * np.sin(6 * u)), 50, 10),
    )
    flat("sieve", make=lambda: _sieve(0.3))
    flat(
        "skirt",
        make=lambda: patch(
            lambda u, v: (
                (0.3 + u) * np.cos(2 * np.pi * v),
                (0.3 + u) * np.sin(2 * np.pi * v),
                2 * u + 0.1 * u * np.sin(40 * v),
            ),
            20,
            60,
        ),
    )
    flat("airplane", make=lambda: of_vtk(pyvista.read(f"{examples.dir_path}/airplane.ply")), contact=True)


def _hemisphere(level: int) -> Surface:
    vertices, faces = ball(level)
    faces = faces[vertices[faces].mean(1)[:, 2] > 0]
    used, faces = np.unique(faces, return_inverse=True)
    return vertices[used] * [1.5, 1, 1], faces.reshape(-1, 3)


def _sieve(part: float) -> Surface:
    vertices, faces = patch(lambda u, v: (3 * u, v, 0.2 * np.sin(3 * u)), 50, 18)
    return vertices, faces[np.random.default_rng(4).random(len(faces)) > part / 2]


# --------------------------------------------------------------------------------------------------------- non-manifold


def _non_manifold() -> None:
    broken = partial(add, kind="non-manifold", closed=False)
    broken("boxes at an edge", make=lambda: welded(*joined(block((1, 1, 3), 2), moved(block((1, 1, 3), 2), 1, 1, 0))))
    broken(
        "boxes at a corner",
        make=lambda: welded(*joined(block((1, 1, 1), 2), moved(block((1, 1, 1), 2), 1, 1, 1))),
        closed=True,
    )
    broken("box with inner wall", make=lambda: welded(*joined(block((2, 1, 1), 2), _wall())))
    broken("T of sheets", make=lambda: welded(*joined(_page(0), _page(1), _page(2))))
    broken("book of five pages", make=lambda: welded(*joined(*[_page(k, 5) for k in range(5)])), contact=True)
    broken("bow-tie of cones", make=_bow_tie, closed=True)
    broken("repeated faces", make=lambda: (ball(2)[0] * [2, 1, 1], np.concatenate([ball(2)[1], ball(2)[1][:30]])))
    broken("mixed winding", make=lambda: _mixed_winding())
    broken("triangle soup", make=lambda: _soup(stretched(ball(2), 2, 1, 1)))
    broken("Klein bottle", make=lambda: of_vtk(pyvista.ParametricKlein(u_res=40, v_res=30, w_res=30)))
    broken("Roman surface", make=lambda: of_vtk(pyvista.ParametricRoman(u_res=30, v_res=30, w_res=30)))
    broken("ball with a fin", make=lambda: _fin())


def _wall() -> Surface:
    return patch(lambda u, v: (0 * u, u - 0.5, v - 0.5), 5, 5)


def _page(k: int, n: int = 3) -> Surface:
    angle = 2 * np.pi * k / n
    return patch(lambda u, v: (3 * u, v * np.cos(angle), v * np.sin(angle)), 24, 8)


def _bow_tie() -> Surface:
    cone = of(creation.cone(radius=0.6, height=1.5, sections=16))
    return welded(
        *joined(
            moved(split(cone, 2), 0, 0, -1.5),
            (split(cone, 2)[0] * [1, 1, -1] + [0, 0, 1.5], split(cone, 2)[1][:, ::-1]),
        )
    )


def _mixed_winding() -> Surface:
    vertices, faces = stretched(ball(3), 2, 1, 1)
    faces = faces.copy()
    faces[::3] = faces[::3, ::-1]
    return vertices, faces


def _soup(surface: Surface) -> Surface:
    vertices, faces = surface
    return vertices[faces].reshape(-1, 3), np.arange(3 * len(faces)).reshape(-1, 3)


def _fin() -> Surface:
    vertices, faces = stretched(ball(3), 2, 1, 1)
    edges = trimesh.Trimesh(vertices, faces, process=False).edges_unique
    ridge = edges[(np.abs(vertices[edges][:, :, 1]) < 1e-9).all(1) & (vertices[edges][:, :, 2] > 0).all(1)]
    ends, number = np.unique(ridge, return_inverse=True)
    number = number.reshape(-1, 2) + len(vertices)
    fin = np.concatenate(
        [np.column_stack([ridge, number[:, 1]]), np.column_stack([ridge[:, 0], number[:, 1], number[:, 0]])]
    )
    return np.concatenate([vertices, vertices[ends] + [0, 0, 0.5]]), np.concatenate([faces, fin])


# ----------------------------------------------------------------------------------------------------------- high genus


def _genus() -> None:
    kind = "high genus"

    def ball_of(pattern: Callable[..., FloatArray], scale: float) -> Callable[..., FloatArray]:
        return lambda x, y, z: np.maximum(
            pattern(scale * x, scale * y, scale * z), np.sqrt((x / 1.6) ** 2 + y**2 + z**2) - 1
        )

    def gyroid(x: FloatArray, y: FloatArray, z: FloatArray) -> FloatArray:
        return np.abs(np.sin(x) * np.cos(y) + np.sin(y) * np.cos(z) + np.sin(z) * np.cos(x)) - 0.6

    def schwarz(x: FloatArray, y: FloatArray, z: FloatArray) -> FloatArray:
        return np.cos(x) + np.cos(y) + np.cos(z) + 0.2

    add("gyroid", kind, lambda: level_set(ball_of(gyroid, 4), (1.8, 1.2, 1.2), 0.08))
    add(
        "gyroid, decimated",
        kind,
        lambda: fewer(level_set(ball_of(gyroid, 4), (1.8, 1.2, 1.2), 0.06), 4000),
        closed=None,
    )
    add("Schwarz", kind, lambda: level_set(ball_of(schwarz, 5), (1.8, 1.2, 1.2), 0.07), contact=True)
    add("chain of tori", kind, lambda: level_set(_tori(5), (3.2, 0.9, 0.4), 0.05))
    add("frame of a cube", kind, lambda: level_set(limbs(_frame(), 0.02), (1.2, 1.2, 1.2), 0.05))
    add("lattice of bars", kind, lambda: level_set(limbs(_bars(3), 0.015), (1.7, 1.2, 1.2), 0.07))
    add("sponge", kind, lambda: _sponge())
    add("figure eight", kind, lambda: level_set(_tori(2), (1.7, 0.9, 0.4), 0.05))


def _tori(n: int) -> Callable[..., FloatArray]:
    places = [1.1 * (k - (n - 1) / 2) for k in range(n)]
    return lambda x, y, z: np.min([np.hypot(np.hypot(x - p, y) - 0.6, z) - 0.17 for p in places], axis=0)


def _frame() -> list[tuple]:
    corners = np.array([[a, b, c] for a in (-1, 1) for b in (-1, 1) for c in (-1, 1)], dtype=float)
    return [(p, q, 0.09, 0.09) for i, p in enumerate(corners) for q in corners[i + 1 :] if (p != q).sum() == 1]


def _bars(n: int) -> list[tuple]:
    ticks = np.linspace(-1, 1, n)
    bars = [([-1.5, a, b], [1.5, a, b], 0.07, 0.07) for a in ticks for b in ticks]
    bars += [([1.5 * a, -1, b], [1.5 * a, 1, b], 0.07, 0.07) for a in ticks for b in ticks]
    return bars + [([1.5 * a, b, -1], [1.5 * a, b, 1], 0.07, 0.07) for a in ticks for b in ticks]


def _sponge() -> Surface:
    """A cube with three square tunnels, of unit cells."""
    cells = {(i, j, k) for i in range(9) for j in range(3) for k in range(3) if sum((i % 3 == 1, j == 1, k == 1)) < 2}
    quads = []
    for cell in sorted(cells):
        for axis in range(3):
            for side in (0, 1):
                beside = list(cell)
                beside[axis] += 2 * side - 1
                if tuple(beside) in cells:
                    continue
                u, v = (axis + 1) % 3, (axis + 2) % 3
                corners = np.array([cell] * 4, dtype=float)
                corners[:, axis] += side
                corners[[1, 2], u] += 1
                corners[[2, 3], v] += 1
                quads.append(corners if side else corners[::-1])
    vertices = np.concatenate(quads)
    halves = np.array([[0, 1, 2], [0, 2, 3]])
    return split(welded(vertices, (4 * np.arange(len(quads))[:, None, None] + halves).reshape(-1, 3)), 1)


# ------------------------------------------------------------------------------------------------------ sizes and units


def _sizes() -> None:
    kind = "few and many faces"
    add("ball of 80", kind, lambda: stretched(ball(1), 2, 1, 1))
    add("ball of 320", kind, lambda: stretched(ball(2), 2, 1, 1))
    add("octopus of 300", kind, lambda: fewer(BODIES["octopus"].make(), 300))
    add("blob of 900", kind, lambda: fewer(_blob(3), 900))
    add("blob of 1,010", kind, lambda: fewer(_blob(3), 1010))
    add("blob of 1,280", kind, lambda: _blob(3))
    add("torus of 1,600", kind, lambda: of(creation.torus(1, 0.3, 40, 20)))
    add("blob of 20,480", kind, lambda: _blob(5))
    add("torus of 60,000", kind, lambda: of(creation.torus(1, 0.3, 300, 100)))

    kind = "units"
    for name, factor in (("1e-3", 1e-3), ("1e4", 1e4), ("1e-9", 1e-9)):
        add(f"figure times {name}", kind, partial(_scaled, "figure", factor))
        add(f"blob times {name}", kind, partial(_scaled, "blob", factor))
    add("figure, far from the origin", kind, lambda: moved(BODIES["figure"].make(), 1e4, -2e4, 3e4))

    kind = "loose vertices"
    add("loose vertices before", kind, partial(_loose, "figure", 50, True))
    add("loose vertices after", kind, partial(_loose, "blob", 500, False))
    add("loose vertices far away", kind, partial(_loose, "capsule", 3, False, 100.0))


def _scaled(name: str, factor: float) -> Surface:
    return stretched(BODIES[name].make(), factor, factor, factor)


def _loose(name: str, n: int, before: bool, spread: float = 1.0) -> Surface:
    vertices, faces = BODIES[name].make()
    more = spread * np.random.default_rng(2).normal(size=(n, 3))
    return (np.concatenate([more, vertices]), faces + n) if before else (np.concatenate([vertices, more]), faces)


# -------------------------------------------------------------------------------------------------- triangles, machines


def _slivers() -> None:
    kind = "slivers"
    add("long triangles", kind, lambda: of(creation.cylinder(radius=0.3, height=4, sections=64)))
    add("squeezed grid", kind, lambda: _thick(lambda u, v: (3 * u**4, v, 0.2 * np.sin(3 * u)), 0.2, 40, 12))
    add("fan", kind, lambda: turned([(0, 0), (1, 0), (1, 0.5), (0, 0.5)], 200))
    add("nearly collapsed edges", kind, lambda: _nearly_collapsed(stretched(ball(3), 2, 1, 1)))
    add(
        "capsule, marching cubes",
        kind,
        lambda: level_set(limbs([([-1, 0, 0], [1, 0.2, 0.1], 0.4, 0.2)]), (1.6, 0.8, 0.6), 0.07),
    )
    add("squashed rings", kind, lambda: _tube(lambda u: np.stack([3 * u**3, 0 * u, 0 * u], 1), 0.3, 60, 20))

    kind = "machines"
    add("nut", kind, lambda: of_vtk(pyvista.read(f"{examples.dir_path}/nut.ply")))
    add("hexagonal beam", kind, lambda: of_vtk(pyvista.read(f"{examples.dir_path}/hexbeam.vtk")))
    add("gear", kind, lambda: _gear(16), contact=True)
    add(
        "shaft",
        kind,
        lambda: turned([(0, 0), (0.3, 0), (0.3, 1), (0.6, 1), (0.6, 1.4), (0.3, 1.4), (0.3, 3), (0, 3)], 32),
    )
    add("box of 12", kind, lambda: of(creation.box(extents=(3, 1, 1))))
    add("box of 192", kind, lambda: block((3, 1, 1), 2))
    add("bracket", kind, lambda: level_set(_bracket, (1.3, 1.3, 0.6), 0.09))
    add("letters", kind, lambda: of_vtk(pyvista.Text3D("wild", depth=0.3)), closed=False)
    add("icosahedron", kind, lambda: of(creation.icosahedron()))

    kind = "noisy"
    for part in (0.05, 0.2, 0.5):
        add(f"ellipsoid, noise {part}", kind, partial(_noisy_ball, part))
    add("octopus, noise 0.2", kind, lambda: noisy(BODIES["octopus"].make(), 0.2))
    add("plate, noise 0.1", kind, lambda: noisy(_plate(0.01), 0.1), contact=True)
    add("cup, noise 0.1", kind, lambda: noisy(BODIES["cup"].make(), 0.1), closed=False)


def _noisy_ball(part: float) -> Surface:
    return noisy(stretched(ball(3), 2, 1, 1), part)


def _nearly_collapsed(surface: Surface) -> Surface:
    """Every thirtieth vertex moved to a neighbour, but for a ten-thousandth of the edge."""
    vertices, faces = surface[0].copy(), surface[1]
    for a, b, _ in faces[::30]:
        vertices[a] = vertices[b] + 1e-4 * (vertices[a] - vertices[b])
    return vertices, faces


def _gear(n: int) -> Surface:
    """Teeth round a hub with a hole, of full height."""
    angles = np.linspace(0, 2 * np.pi, 4 * n, endpoint=False)
    outer = np.where(np.arange(4 * n) % 4 < 2, 1.0, 0.8)
    profile = [
        np.stack([r * np.cos(angles), r * np.sin(angles), np.full(4 * n, z)], 1)
        for r, z in ((0.4, 0.15), (outer, 0.15), (outer, -0.15), (0.4, -0.15))
    ]
    index = np.arange(16 * n).reshape(4, 4 * n)
    faces = []
    for k in range(4):
        a, d = index[k], index[(k + 1) % 4]
        b, c = np.roll(a, -1), np.roll(d, -1)
        faces += [np.stack([a, d, c], 1), np.stack([a, c, b], 1)]
    return split((np.concatenate(profile), np.concatenate(faces)), 1)


def _bracket(x: FloatArray, y: FloatArray, z: FloatArray) -> FloatArray:
    """An L of two plates with a hole in each."""

    def cuboid(centre: tuple[float, float, float], half: tuple[float, float, float]) -> FloatArray:
        return np.max([np.abs(c - m) - h for c, m, h in zip((x, y, z), centre, half, strict=True)], axis=0)

    corner = np.minimum(cuboid((0, -0.9, 0), (1.1, 0.2, 0.5)), cuboid((-0.9, 0, 0), (0.2, 1.1, 0.5)))
    return np.max([corner, 0.25 - np.hypot(x - 0.4, z), 0.25 - np.hypot(y - 0.4, z)], axis=0)


# ----------------------------------------------------------------------------------------------------------------- data


def _data() -> None:
    kind = "data"
    add("ant", kind, lambda: of_vtk(pyvista.read(f"{examples.dir_path}/ant.ply")), contact=True)
    for name in ("creature", "hand"):
        add(f"sample {name}", kind, partial(_sample, name), contact=True)
    if not DATA.is_dir():
        print(f"(without animals, hands and faces: the folder {DATA} is not there)")
        return
    for file in sorted((DATA / "animals").glob("*.npz")):
        add(file.stem, kind, partial(_animal, file.stem), closed=None, contact=file.stem == "fox")
    for folder, name in (
        ("mh-hand", "00-open"),
        ("mh-woman", "00-rest"),
        ("ict-face", "00-neutral"),
        ("hyper-cube", "cube-1"),
    ):
        add(folder, kind, partial(_file, folder, name), closed=None)


def _sample(name: str) -> Surface:
    sample = load_sample(name)
    return sample.keyframes[0].numpy().astype(np.float64), sample.faces.numpy()


def _animal(name: str) -> Surface:
    stored = np.load(DATA / "animals" / f"{name}.npz")
    return stored["frames"][0].astype(np.float64), stored["faces"].astype(np.int64)


def _file(folder: str, name: str) -> Surface:
    return read_mesh(DATA / folder / f"{name}.obj")


for _make in (_plain, _limbs, _pieces, _thin, _open, _non_manifold, _genus, _sizes, _slivers, _data):
    _make()
