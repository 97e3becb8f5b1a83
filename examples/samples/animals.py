"""Two animals of other proportions and tessellation, sculpted by the generator of the samples, with landmarks."""

from dataclasses import replace
from functools import cache

import numpy as np
from scipy.spatial.transform import Rotation

from .make_samples import creature, gallop
from .sculpt import Array, Bone, Cone, IntArray, Point, bind, place_bones, sculpt, skin

TIPS = ("tail4", "forepaw-right", "forepaw-left", "hindpaw-right", "hindpaw-left", "ear-right", "ear-left")
SIDES = ("thigh", "shin", "upperarm", "forearm", "scapula")


@cache
def animal(kind: str, cell: float | None = None) -> tuple[Array, IntArray, tuple[Cone, ...]]:
    """``"slender"``, as the sample, or ``"stout"``: short legs and tail, thick trunk and neck, small ears.

    Vertices ``(V, 3)``, faces ``(F, 3)`` of a tessellation of its own, and the cones that it is made of; ``cell`` is
    the length of its edges.
    """
    _, cones = _skeleton(kind)
    vertices, faces = sculpt(list(cones), cell or (0.030 if kind == "slender" else 0.034))
    return vertices, faces, tuple(cones)


@cache
def _weights(kind: str, cell: float | None) -> Array:
    """Weights of the bones on its vertices. *Shape:* ``(V, B)``."""
    rest, faces, cones = animal(kind, cell)
    return bind(list(cones), _skeleton(kind)[0], rest, faces, 1.15)[0]


def galloping(
    kind: str, time: float, cell: float | None = None, reach: tuple[float, float, float] = (1.0, 1.0, 1.0)
) -> Array:
    """The same animal at a time of its gallop, in frames, of which a stride takes six. *Shape:* ``(V, 3)``.

    Rotations of the joints of fore legs, hind legs and spine are multiplied by ``reach``.
    """
    bones, _ = _skeleton(kind)
    turns, shift = gallop(bones, time)
    scaled = {name: Rotation.from_rotvec(reach[_limb(name, bones)] * turn.as_rotvec()) for name, turn in turns.items()}
    return skin(animal(kind, cell)[0], _weights(kind, cell), *place_bones(bones, scaled, shift))


def strides(n: int, n_frames: int, cell: float, low: float, high: float, seed: int) -> tuple[Array, IntArray]:
    """One stride each of slender animals that gallop with a random reach between two numbers, and their faces.

    Lengths are in bounding-box diagonals. *Shape:* ``(N, T, V, 3), (F, 3)``.
    """
    reaches = np.random.default_rng(seed).uniform(low, high, (n, 3))
    times = 6 * np.arange(n_frames) / n_frames
    x = np.array([[galloping("slender", time, cell, tuple(reach)) for time in times] for reach in reaches])
    return x / np.linalg.norm(np.ptp(x[0, 0], axis=0)), animal("slender", cell)[1]


def _limb(name: str, bones: dict[str, Bone]) -> int:
    """0 for the bones of a fore leg, 1 of a hind leg, 2 of the spine."""
    bone: str | None = name
    while bone is not None:
        if bone.startswith(("scapula", "thigh")):
            return int(bone.startswith("thigh"))
        bone = bones[bone].parent
    return 2


def _skeleton(kind: str) -> tuple[dict[str, Bone], list[Cone]]:
    """Bones and flesh."""
    bones, cones = creature()
    if kind == "slender":
        return bones, cones
    stout = {name: Bone(bone.parent, _stouter(bone.head), _stouter(bone.tail)) for name, bone in bones.items()}
    return stout, [_fatter(cone) for cone in cones]


def _stouter(point: Point) -> Point:
    """Where a point of the slender animal is in the stout one."""
    x, y, z = point
    y = 0.18 + 0.75 * y if y < 0.72 else y  # legs
    x = -0.44 + 0.75 * (x + 0.44) if x < -0.44 else x  # tail
    y = 1.05 + 0.7 * (y - 1.05) if y > 1.05 else y  # ears
    return 1.1 * x, y, 1.2 * z


def _fatter(cone: Cone) -> Cone:
    wide = 1.25 if cone.bone in ("waist", "chest", "pelvis", "neck", "head") else 1.1
    return replace(cone, a=_stouter(cone.a), b=_stouter(cone.b), ra=wide * cone.ra, rb=wide * cone.rb)


def tips(cones: tuple[Cone, ...]) -> Array:
    """Eight places a person would pick: nose, tail, paws, ears. *Shape:* ``(8, 3)``."""
    nose = cones[7]
    places = [np.array([nose.b[0] + nose.rb, *nose.b[1:]])]
    for name in TIPS:
        cone = [cone for cone in cones if cone.bone == name][-1]
        along = np.subtract(cone.b, cone.a)
        places.append(np.array(cone.b) + cone.rb * along / np.linalg.norm(along))
    return np.array(places)


def held_out(cones: tuple[Cone, ...]) -> Array:
    """Places to judge by: back, belly, and the outer sides of the legs, each at the middle of a cone."""
    places = []
    for bone, direction in (("waist", [0, 1.0, 0]), ("waist", [0, -1.0, 0]), ("neck", [0, 0, 1.0])):
        places.append(_beside(cones, bone, direction))
    for bone in SIDES:
        for side, sign in (("right", 1.0), ("left", -1.0)):
            places.append(_beside(cones, f"{bone}-{side}", [0, 0, sign]))
    return np.array(places)


def _beside(cones: tuple[Cone, ...], bone: str, direction: list[float]) -> Array:
    cone = next(cone for cone in cones if cone.bone == bone)
    middle = 0.5 * (np.array(cone.a) + cone.b)
    return middle + 0.5 * (cone.ra + cone.rb) * np.array(direction) * cone.stretch
