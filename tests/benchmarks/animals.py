"""Two animals of other proportions and tessellation, sculpted by the generator of the samples, with landmarks."""

import sys
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[2] / "examples"))

from _sculpt import Array, Cone, IntArray, sculpt
from make_samples import creature

TIPS = ("tail4", "forepaw-right", "forepaw-left", "hindpaw-right", "hindpaw-left", "ear-right", "ear-left")
SIDES = ("thigh", "shin", "upperarm", "forearm", "scapula")


@cache
def animal(kind: str) -> tuple[Array, IntArray, tuple[Cone, ...]]:
    """``"slender"``, as the sample, or ``"stout"``: short legs and tail, thick trunk and neck, small ears."""
    _, cones = creature()
    if kind == "stout":
        cones = [_stout(cone) for cone in cones]
    vertices, faces = sculpt(list(cones), 0.030 if kind == "slender" else 0.034)
    return vertices, faces, tuple(cones)


def _stout(cone: Cone) -> Cone:
    def moved(point: tuple[float, float, float]) -> tuple[float, float, float]:
        x, y, z = point
        y = 0.18 + 0.75 * y if y < 0.72 else y  # legs
        x = -0.44 + 0.75 * (x + 0.44) if x < -0.44 else x  # tail
        y = 1.05 + 0.7 * (y - 1.05) if y > 1.05 else y  # ears
        return 1.1 * x, y, 1.2 * z

    wide = 1.25 if cone.bone in ("waist", "chest", "pelvis", "neck", "head") else 1.1
    return replace(cone, a=moved(cone.a), b=moved(cone.b), ra=wide * cone.ra, rb=wide * cone.rb)


def tips(cones: tuple[Cone, ...]) -> Array:
    """Eight places a person would pick: nose, tail, paws, ears. *Shape:* ``(8, 3)``."""
    nose = cones[7]
    found = [np.array([nose.b[0] + nose.rb, *nose.b[1:]])]
    for name in TIPS:
        cone = [cone for cone in cones if cone.bone == name][-1]
        along = np.subtract(cone.b, cone.a)
        found.append(np.array(cone.b) + cone.rb * along / np.linalg.norm(along))
    return np.array(found)


def held_out(cones: tuple[Cone, ...]) -> Array:
    """Places to judge by: back, belly, and the outer sides of the legs, each at the middle of a cone."""
    found = []
    for bone, direction in (("waist", [0, 1.0, 0]), ("waist", [0, -1.0, 0]), ("neck", [0, 0, 1.0])):
        found.append(_beside(cones, bone, direction))
    for bone in SIDES:
        for side, sign in (("right", 1.0), ("left", -1.0)):
            found.append(_beside(cones, f"{bone}-{side}", [0, 0, sign]))
    return np.array(found)


def _beside(cones: tuple[Cone, ...], bone: str, direction: list[float]) -> Array:
    cone = next(cone for cone in cones if cone.bone == bone)
    middle = 0.5 * (np.array(cone.a) + cone.b)
    return middle + 0.5 * (cone.ra + cone.rb) * np.array(direction) * cone.stretch
