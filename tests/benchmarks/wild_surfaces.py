"""Thin, open and non-manifold surfaces of the wild set."""

from __future__ import annotations

from functools import partial

import numpy as np
import pyvista
import trimesh
from pyvista import examples
from trimesh import creation
from wild_making import (
    Surface,
    add,
    ball,
    block,
    joined,
    moved,
    of,
    of_vtk,
    patch,
    plate,
    split,
    stretched,
    thick,
    turned,
    welded,
)

# -------------------------------------------------------------------------------------------------------- thin and open


def _thin() -> None:
    body = partial(add, "thin shells")
    for thickness in (0.05, 0.01, 0.001):
        body(f"plate {thickness}", partial(plate, thickness), contact=thickness == 0.01)
    body("wavy plate", lambda: thick(lambda u, v: (3 * u, v, 0.15 * np.sin(9 * u)), 0.01, 40, 12))
    body(
        "cup with walls",
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
    body("tube with walls", lambda: of(creation.annulus(0.45, 0.5, 3, sections=24)))
    body("fine tube with walls", lambda: split(of(creation.annulus(0.47, 0.5, 3, sections=24)), 2))
    body("hollow ball", lambda: hollow(ball(3), 0.97))
    body(
        "ribbon",
        lambda: thick(
            lambda u, v: (2 * u, 0.3 * (v - 0.5) * np.cos(3 * u), 0.3 * (v - 0.5) * np.sin(3 * u)), 0.005, 60, 6
        ),
    )
    body("needle", lambda: stretched(ball(3), 1, 0.01, 0.01))


def hollow(surface: Surface, part: float) -> Surface:
    return joined(surface, (part * surface[0], surface[1][:, ::-1]))


def _open() -> None:
    body = partial(add, "open")
    body("hemisphere", lambda: _hemisphere(3))
    body(
        "cup", lambda: turned([(0, 0), (0.5, 0), *[(0.5 + 0.02 * k, 0.1 * k) for k in range(1, 15)]], 32), contact=True
    )
    body(
        "open cylinder",
        lambda: welded(*patch(lambda u, v: (np.cos(2 * np.pi * v), np.sin(2 * np.pi * v), 4 * u), 30, 24)),
    )
    body("curved sheet", lambda: patch(lambda u, v: (3 * u, v, 0.5 * np.sin(2 * u)), 40, 14))
    body("flat sheet", lambda: patch(lambda u, v: (3 * u, v, 0 * u), 40, 14))
    body("saddle", lambda: patch(lambda u, v: (2 * u, v, (u - 0.5) ** 2 - (v - 0.5) ** 2), 30, 20))
    body("hills", lambda: of_vtk(pyvista.ParametricRandomHills(u_res=40, v_res=30, w_res=30)))
    body("Enneper", lambda: of_vtk(pyvista.ParametricEnneper(u_res=40, v_res=40, w_res=10)))
    body("Moebius strip", lambda: of_vtk(pyvista.ParametricMobius(u_res=40, v_res=12, w_res=10)))
    body("helicoid", lambda: patch(lambda u, v: (4 * u, (v - 0.5) * np.cos(6 * u), (v - 0.5) * np.sin(6 * u)), 50, 10))
    body("sieve", lambda: _sieve(0.3))
    body("airplane", lambda: of_vtk(pyvista.read(f"{examples.dir_path}/airplane.ply")), contact=True)


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
    body = partial(add, "non-manifold")
    body("boxes at an edge", lambda: welded(*joined(block((1, 1, 3), 2), moved(block((1, 1, 3), 2), 1, 1, 0))))
    body("boxes at a corner", lambda: welded(*joined(block((1, 1, 1), 2), moved(block((1, 1, 1), 2), 1, 1, 1))))
    body("box with inner wall", lambda: welded(*joined(block((2, 1, 1), 2), _wall())))
    body("T of sheets", lambda: welded(*joined(_page(0), _page(1), _page(2))))
    body("book of five pages", lambda: welded(*joined(*[_page(k, 5) for k in range(5)])), contact=True)
    body("repeated faces", lambda: (ball(2)[0] * [2, 1, 1], np.concatenate([ball(2)[1], ball(2)[1][:30]])))
    body("mixed winding", lambda: _mixed_winding())
    body("triangle soup", lambda: _soup(stretched(ball(2), 2, 1, 1)))
    body("Klein bottle", lambda: of_vtk(pyvista.ParametricKlein(u_res=40, v_res=30, w_res=30)))
    body("Roman surface", lambda: of_vtk(pyvista.ParametricRoman(u_res=30, v_res=30, w_res=30)))
    body("ball with a fin", lambda: _fin())


def _wall() -> Surface:
    return patch(lambda u, v: (0 * u, u - 0.5, v - 0.5), 5, 5)


def _page(k: int, n: int = 3) -> Surface:
    angle = 2 * np.pi * k / n
    return patch(lambda u, v: (3 * u, v * np.cos(angle), v * np.sin(angle)), 24, 8)


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


for _make in (_thin, _open, _non_manifold):
    _make()
