"""Bodies of many kinds, made by code or taken from packages and samples, and a motion whose middle is known.

Each body is a function that gives vertices and faces; ``BODIES`` has all by their names. Nothing is downloaded. Where
data that is kept beside the project is absent, its bodies are left out, with a word.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import pyvista
import wild_solids  # noqa: F401 - its bodies enter the list
import wild_surfaces  # noqa: F401
from cases import DATA, animal, keyframes_of
from pyvista import examples
from trimesh import creation
from wild_making import (
    BODIES,
    FloatArray,
    IntArray,
    Surface,
    add,
    ball,
    blob,
    block,
    fewer,
    level_set,
    limbs,
    moved,
    noisy,
    of,
    of_vtk,
    plate,
    split,
    stretched,
    thick,
    tube,
    turned,
)

ANGLE = np.radians(60.0)


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


# ------------------------------------------------------------------------------------------------------ sizes and units


def _sizes() -> None:
    body = partial(add, "few and many faces")
    body("ball of 80", lambda: stretched(ball(1), 2, 1, 1))
    body("ball of 320", lambda: stretched(ball(2), 2, 1, 1))
    body("octopus of 300", lambda: fewer(BODIES["octopus"].make(), 300))
    body("blob of 900", lambda: fewer(blob(3), 900))
    body("blob of 1,010", lambda: fewer(blob(3), 1010))
    body("blob of 1,280", lambda: blob(3))
    body("torus of 1,600", lambda: of(creation.torus(1, 0.3, 40, 20)))
    body("blob of 20,480", lambda: blob(5))
    body("torus of 60,000", lambda: of(creation.torus(1, 0.3, 300, 100)))

    body = partial(add, "units")
    for name, factor in (("1e-3", 1e-3), ("1e4", 1e4), ("1e-9", 1e-9)):
        body(f"figure times {name}", partial(_scaled, "figure", factor))
        body(f"blob times {name}", partial(_scaled, "blob", factor))
    body("figure, far from the origin", lambda: moved(BODIES["figure"].make(), 1e4, -2e4, 3e4))

    body = partial(add, "loose vertices")
    body("loose vertices before", partial(_loose, "figure", 50, True))
    body("loose vertices after", partial(_loose, "blob", 500, False))
    body("loose vertices far away", partial(_loose, "capsule", 3, False, 100.0))


def _scaled(name: str, factor: float) -> Surface:
    return stretched(BODIES[name].make(), factor, factor, factor)


def _loose(name: str, n: int, before: bool, spread: float = 1.0) -> Surface:
    vertices, faces = BODIES[name].make()
    more = spread * np.random.default_rng(2).normal(size=(n, 3))
    return (np.concatenate([more, vertices]), faces + n) if before else (np.concatenate([vertices, more]), faces)


# -------------------------------------------------------------------------------------------------- triangles, machines


def _slivers() -> None:
    body = partial(add, "slivers")
    body("long triangles", lambda: of(creation.cylinder(radius=0.3, height=4, sections=64)))
    body("squeezed grid", lambda: thick(lambda u, v: (3 * u**4, v, 0.2 * np.sin(3 * u)), 0.2, 40, 12))
    body("fan", lambda: turned([(0, 0), (1, 0), (1, 0.5), (0, 0.5)], 200))
    body("nearly collapsed edges", lambda: _nearly_collapsed(stretched(ball(3), 2, 1, 1)))
    body(
        "capsule, marching cubes",
        lambda: level_set(limbs([([-1, 0, 0], [1, 0.2, 0.1], 0.4, 0.2)]), (1.6, 0.8, 0.6), 0.07),
    )
    body("squashed rings", lambda: tube(lambda u: np.stack([3 * u**3, 0 * u, 0 * u], 1), 0.3, 60, 20))

    body = partial(add, "machines")
    body("nut", lambda: of_vtk(pyvista.read(f"{examples.dir_path}/nut.ply")))
    body("hexagonal beam", lambda: of_vtk(pyvista.read(f"{examples.dir_path}/hexbeam.vtk")))
    body("gear", lambda: _gear(16), contact=True)
    body("shaft", lambda: turned([(0, 0), (0.3, 0), (0.3, 1), (0.6, 1), (0.6, 1.4), (0.3, 1.4), (0.3, 3), (0, 3)], 32))
    body("box of 12", lambda: of(creation.box(extents=(3, 1, 1))))
    body("box of 192", lambda: block((3, 1, 1), 2))
    body("letters", lambda: of_vtk(pyvista.Text3D("wild", depth=0.3)))
    body("icosahedron", lambda: of(creation.icosahedron()))

    body = partial(add, "noisy")
    for part in (0.05, 0.2, 0.5):
        body(f"ellipsoid, noise {part}", partial(_noisy_ball, part))
    body("octopus, noise 0.2", lambda: noisy(BODIES["octopus"].make(), 0.2))
    body("plate, noise 0.1", lambda: noisy(plate(0.01), 0.1), contact=True)
    body("cup, noise 0.1", lambda: noisy(BODIES["cup"].make(), 0.1))


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


# ----------------------------------------------------------------------------------------------------------------- data


def _data() -> None:
    body = partial(add, "data")
    body("ant", lambda: of_vtk(pyvista.read(f"{examples.dir_path}/ant.ply")), contact=True)
    for name in ("creature", "hand"):
        body(f"sample {name}", partial(_first, keyframes_of, name), contact=True)
    if not DATA.is_dir():
        print(f"(without animals, hands and faces: the folder {DATA} is not there)")
        return
    for file in sorted((DATA / "animals").glob("*.npz")):
        body(file.stem, partial(_first, animal, file.stem), contact=file.stem == "fox")
    for folder in ("mh-hand", "mh-woman", "ict-face", "hyper-cube"):
        body(folder, partial(_first, keyframes_of, folder))


def _first(load: Callable[[str], Any], name: str) -> Surface:
    """The first shape of a sample, of a folder beside the project, or of an animal."""
    keyframes, faces = load(name)[:2]
    return keyframes[0].double().numpy(), faces.numpy()


for _make in (_sizes, _slivers, _data):
    _make()
