"""The list of the wild set's bodies, and what they are made with."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import NamedTuple

import igl
import numpy as np
import pyvista
import trimesh
from numpy.typing import NDArray
from trimesh import creation

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
Surface = tuple[FloatArray, IntArray]


class WildBody(NamedTuple):
    """A surface."""

    name: str
    kind: str
    make: Callable[[], Surface]
    contact: bool
    """Whether it belongs to the smaller set that is tried with contact."""


BODIES: dict[str, WildBody] = {}


def add(kind: str, name: str, make: Callable[[], Surface], contact: bool = False) -> None:
    """Put a body into ``BODIES``."""
    BODIES[name] = WildBody(name, kind, make, contact)


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


def tube(curve: Callable[[FloatArray], FloatArray], radius: float, n: int, m: int) -> Surface:
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


def plate(thickness: float) -> Surface:
    return thick(lambda u, v: (2 * u, v, 0 * u), thickness, 30, 15)


def thick(function: Callable, thickness: float, n: int, m: int) -> Surface:
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


def super_ellipsoid(power: float) -> Surface:
    vertices, faces = ball(4)
    return np.sign(vertices) * np.abs(vertices) ** power, faces


def blob(level: int, seed: int = 1) -> Surface:
    vertices, faces = ball(level)
    random = np.random.default_rng(seed)
    waves = sum(
        a * np.sin(vertices @ k) for a, k in zip(random.normal(0, 0.12, 8), 3 * random.normal(size=(8, 3)), strict=True)
    )
    return vertices * (1 + np.asarray(waves))[:, None] * np.array([2, 1, 1]), faces
