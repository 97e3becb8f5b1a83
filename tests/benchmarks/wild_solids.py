"""Closed bodies of the wild set: plain ones, with thin limbs, of many pieces, of high genus."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np
from trimesh import creation
from wild_making import (
    FloatArray,
    Surface,
    add,
    ball,
    blob,
    block,
    circle,
    fewer,
    joined,
    level_set,
    limbs,
    moved,
    of,
    patch,
    split,
    stretched,
    super_ellipsoid,
    tube,
    turned,
)

# ---------------------------------------------------------------------------------------------------------------- plain


def _plain() -> None:
    body = partial(add, "plain")
    body("sphere", ball)
    body("ellipsoid", lambda: stretched(ball(), 3, 1, 0.6), contact=True)
    body("capsule", lambda: of(creation.capsule(height=4, radius=0.5, count=(20, 20))))
    body("cylinder", lambda: fewer(split(of(creation.cylinder(radius=0.4, height=4, sections=24)), 3), 2400))
    body("cone", lambda: turned([(0, 0), *[(0.8 * (1 - k / 20), 3 * k / 20) for k in range(20)], (0, 3)]))
    body("torus", lambda: of(creation.torus(1, 0.3, 40, 20)))
    body("box", lambda: block((4, 1, 1)))
    body("cube", lambda: block((1, 1, 1)))
    body(
        "pear",
        lambda: turned([(0, 0), *[(np.sin(a) * (1.3 + np.cos(a)), 2 * a) for a in np.linspace(0.1, 3, 30)], (0, 6.3)]),
    )
    body("superellipsoid", lambda: stretched(super_ellipsoid(0.3), 2.5, 1, 1))
    body("blob", lambda: blob(3))
    body(
        "bottle",
        lambda: turned([(0, 0), (0.5, 0), *[(0.5, k / 6) for k in range(1, 13)], (0.2, 2.4), (0.2, 3), (0, 3)], 32),
    )


# ---------------------------------------------------------------------------------------------------------------- limbs


def _limbs() -> None:
    body = partial(add, "thin limbs")
    tail = [(1.01 * np.sin(a), -np.cos(a)) for a in np.linspace(0.12, 3.05, 24)]
    for radius in (0.06, 0.02, 0.008):
        rope = [(radius, z) for z in np.linspace(1.05, 5, 60)]
        body(f"balloon, tail {radius}", partial(turned, [(0, -1), *tail, *rope, (0, 5)], 16), contact=radius == 0.06)
    arms = [([0, 0, 0], 0.9 * p, 0.1, 0.03) for p in circle(8, 1)]
    body(
        "octopus",
        lambda: fewer(level_set(limbs([([0, 0, 0], [0, 0, 0.3], 0.3, 0.35), *arms]), (1.2, 1.2, 0.8), 0.025), 4000),
        contact=True,
    )
    body(
        "starfish", lambda: level_set(limbs([([0, 0, 0], p, 0.15, 0.06) for p in circle(5, 1)]), (1.2, 1.2, 0.4), 0.04)
    )
    body("spider", lambda: fewer(level_set(limbs(_spider()), (1.2, 1.2, 0.7), 0.025), 3000), contact=True)
    body("tree", lambda: fewer(level_set(limbs(_tree(4, 0.8), 0.015), (1.4, 1.4, 1.4), 0.03), 5000))
    body("tree, a twig broken off", lambda: fewer(level_set(limbs(_tree(4, 0.65), 0.015), (1.4, 1.4, 1.4), 0.03), 5000))
    body("figure", lambda: fewer(level_set(limbs(_figure()), (1.1, 0.5, 1.2), 0.03), 3000))
    body("figure, 600 faces", lambda: fewer(level_set(limbs(_figure()), (1.1, 0.5, 1.2), 0.03), 600))
    body("snake", lambda: tube(lambda u: np.stack([3 * u, 0.4 * np.sin(9 * u), 0 * u], 1), 0.06, 160, 10))
    body(
        "coil",
        lambda: tube(lambda u: np.stack([2 * u, 0.5 * np.cos(30 * u), 0.5 * np.sin(30 * u)], 1), 0.05, 240, 8),
        contact=True,
    )
    body("hair", lambda: tube(lambda u: np.stack([4 * u, 0.1 * u**2, 0 * u], 1), 0.005, 200, 6))


def _spider() -> list[tuple]:
    legs = []
    for p in circle(8, 1, 0.2):
        knee = 0.6 * p + [0, 0, 0.35]
        legs += [(0.15 * p, knee, 0.035, 0.03), (knee, p - [0, 0, 0.3], 0.03, 0.025)]
    return [([0, 0, 0], [0.15, 0, 0], 0.2, 0.15), ([-0.35, 0, 0], [-0.4, 0, 0.05], 0.25, 0.2), *legs]


def _tree(depth: int, thinner: float) -> list[tuple]:
    random, found = np.random.default_rng(3), []

    def grow(start: FloatArray, way: FloatArray, radius: float, left: int) -> None:
        end = start + way
        found.append((start, end, radius, 0.75 * radius))
        for _ in range(2 * (left > 0)):
            turn = way + 0.75 * np.linalg.norm(way) * random.normal(size=3)
            grow(end, 0.7 * np.linalg.norm(way) * turn / np.linalg.norm(turn), thinner * radius, left - 1)

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
    return [([0, 0, 0.4], [0, 0, -0.15], 0.22, 0.2), ([0, 0, 0.75], [0, 0, 0.8], 0.17, 0.15), *arms, *legs]


# --------------------------------------------------------------------------------------------------------------- pieces


def _pieces() -> None:
    body = partial(add, "many pieces")
    body("two balls", lambda: joined(ball(2), moved(ball(2), 2.5, 0, 0)))
    body("two balls, overlapping", lambda: joined(ball(2), moved(ball(2), 1.2, 0, 0)))
    body("ball in a ball", lambda: joined(ball(3), ball(2, 0.5)))
    body("chain of 12", lambda: joined(*[moved(_link(k % 2), 1.3 * k, 0, 0) for k in range(12)]), contact=True)
    body("41 balls", lambda: _cloud(41, 2), contact=True)
    body("ball and a crumb", lambda: joined(ball(3), moved(ball(0, 0.01), 1.3, 0, 0)))
    body(
        "ball and ten crumbs",
        lambda: joined(stretched(ball(3), 2, 1, 1), *[moved(ball(0, 0.02), *(1.4 * p)) for p in circle(10, 1)]),
    )
    body("stack of plates", lambda: joined(*[moved(block((2, 1, 0.05), 2), 0, 0, 0.15 * k) for k in range(8)]))
    body("ball and sheets", lambda: joined(stretched(ball(3), 2, 1, 1), *[_sheet_at(k) for k in range(5)]))


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


def _sheet_at(k: int) -> Surface:
    return moved(patch(lambda u, v: (u, 0.5 * v, 0.1 * np.sin(3 * u)), 8, 5), -1 + 0.4 * k, 1.2, 0.2 * k)


# ----------------------------------------------------------------------------------------------------------- high genus


def _genus() -> None:
    body = partial(add, "high genus")

    def ball_of(pattern: Callable[..., FloatArray], scale: float) -> Callable[..., FloatArray]:
        return lambda x, y, z: np.maximum(
            pattern(scale * x, scale * y, scale * z), np.sqrt((x / 1.6) ** 2 + y**2 + z**2) - 1
        )

    def gyroid(x: FloatArray, y: FloatArray, z: FloatArray) -> FloatArray:
        return np.abs(np.sin(x) * np.cos(y) + np.sin(y) * np.cos(z) + np.sin(z) * np.cos(x)) - 0.6

    def schwarz(x: FloatArray, y: FloatArray, z: FloatArray) -> FloatArray:
        return np.cos(x) + np.cos(y) + np.cos(z) + 0.2

    body("gyroid", lambda: level_set(ball_of(gyroid, 4), (1.8, 1.2, 1.2), 0.08))
    body("gyroid, decimated", lambda: fewer(level_set(ball_of(gyroid, 4), (1.8, 1.2, 1.2), 0.06), 4000))
    body("Schwarz", lambda: level_set(ball_of(schwarz, 5), (1.8, 1.2, 1.2), 0.07), contact=True)
    body("chain of tori", lambda: level_set(_tori(5), (3.2, 0.9, 0.4), 0.05))
    body("frame of a cube", lambda: level_set(limbs(_frame(), 0.02), (1.2, 1.2, 1.2), 0.05))
    body("lattice of bars", lambda: level_set(limbs(_bars(3), 0.015), (1.7, 1.2, 1.2), 0.07))
    body("figure eight", lambda: level_set(_tori(2), (1.7, 0.9, 0.4), 0.05))


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


for _make in (_plain, _limbs, _pieces, _genus):
    _make()
