"""A wading bird with slender legs and a person, sculpted by the generator of the samples, each in two poses.

Their joints turn evenly with time, so that the shapes between the poses are known. Y is up, they face +X, and their
right side is +Z.
"""

from collections.abc import Mapping
from functools import cache
from typing import NamedTuple

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

from .sculpt import Array, Bone, Cone, IntArray, Point, bind, place_bones, restore_volume, sculpt, skin

Turn = tuple[float, float, float]
"""Of a bone against its parent, as a rotation vector in degrees: about X to the side, Y round, Z back and up."""

WADER_TRUNK = {
    "body": Bone(None, (-0.20, 0.95, 0), (0.18, 0.97, 0)),
    "tail": Bone("body", (-0.24, 0.93, 0), (-0.42, 0.86, 0)),
    "neck1": Bone("body", (0.17, 1.00, 0), (0.29, 1.10, 0)),
    "neck2": Bone("neck1", (0.29, 1.10, 0), (0.30, 1.24, 0)),
    "neck3": Bone("neck2", (0.30, 1.24, 0), (0.25, 1.37, 0)),
    "neck4": Bone("neck3", (0.25, 1.37, 0), (0.26, 1.49, 0)),
    "head": Bone("neck4", (0.26, 1.49, 0), (0.35, 1.54, 0)),
    "bill": Bone("head", (0.37, 1.53, 0), (0.47, 1.43, 0)),
}
WADER_LEG = {
    "thigh": Bone("body", (-0.02, 0.88, 0.075), (0.03, 0.73, 0.075)),
    "tibia": Bone("thigh", (0.03, 0.73, 0.075), (-0.02, 0.41, 0.075)),
    "tarsus": Bone("tibia", (-0.02, 0.41, 0.075), (0.01, 0.03, 0.075)),
    "foot": Bone("tarsus", (0.01, 0.03, 0.075), (0.13, 0.015, 0.075)),
}
WADER_FLESH = [
    Cone("body", (-0.16, 0.95, 0), (0.10, 0.98, 0), 0.120, 0.135, (1, 1, 0.85)),
    Cone("body", (0.10, 0.98, 0), (0.19, 1.01, 0), 0.130, 0.070, (1, 1, 0.85), 0.08),
    Cone("tail", (-0.22, 0.94, 0), (-0.41, 0.87, 0), 0.085, 0.024, (1, 0.8, 1), 0.08),
    Cone("neck1", (0.18, 1.01, 0), (0.29, 1.10, 0), 0.062, 0.038, blend=0.05),
    Cone("neck2", (0.29, 1.10, 0), (0.30, 1.24, 0), 0.037, 0.029, blend=0.015),
    Cone("neck3", (0.30, 1.24, 0), (0.25, 1.37, 0), 0.029, 0.026, blend=0.015),
    Cone("neck4", (0.25, 1.37, 0), (0.26, 1.49, 0), 0.026, 0.027, blend=0.015),
    Cone("head", (0.27, 1.51, 0), (0.34, 1.535, 0), 0.042, 0.036, blend=0.03),
    Cone("bill", (0.36, 1.53, 0), (0.42, 1.50, 0), 0.028, 0.025, blend=0.02),
    Cone("bill", (0.42, 1.50, 0), (0.46, 1.43, 0), 0.025, 0.016, blend=0.015),
]
WADER_LEG_FLESH = [
    Cone("thigh", (-0.02, 0.88, 0.070), (0.03, 0.72, 0.075), 0.075, 0.034, blend=0.05),
    Cone("tibia", (0.03, 0.73, 0.075), (-0.02, 0.41, 0.075), 0.030, 0.018, blend=0.02),
    Cone("tarsus", (-0.02, 0.412, 0.075), (-0.019, 0.40, 0.075), 0.023, 0.022, blend=0.015),
    Cone("tarsus", (-0.02, 0.41, 0.075), (0.01, 0.035, 0.075), 0.017, 0.017, blend=0.015),
    Cone("foot", (0.00, 0.022, 0.075), (0.13, 0.018, 0.075), 0.021, 0.017, (1, 0.8, 1.5), 0.02),
]
WADER_POSES: tuple[Mapping[str, Turn], Mapping[str, Turn]] = (
    {"thigh-left": (0, 0, -8), "tibia-left": (0, 0, 4), "tarsus-left": (0, 0, 4), "neck1": (0, 0, 6)},
    {
        "thigh-left": (0, 0, 64),
        "tibia-left": (0, 0, -30),
        "tarsus-left": (0, 0, -166),
        "foot-left": (0, 0, -80),
        "thigh-right": (0, 0, -8),
        "tibia-right": (0, 0, 5),
        "foot-right": (0, 0, 3),
        "neck1": (0, 0, -30),
        "neck2": (0, 12, -44),
        "neck3": (0, 14, -34),
        "neck4": (0, 14, 26),
        "head": (0, 10, 30),
        "tail": (0, 0, 16),
    },
)

PERSON_TRUNK = {
    "pelvis": Bone(None, (0, 0.98, 0), (0, 0.88, 0)),
    "waist": Bone("pelvis", (0, 1.02, 0), (0, 1.17, 0)),
    "chest": Bone("waist", (0, 1.17, 0), (0, 1.40, 0)),
    "neck": Bone("chest", (-0.01, 1.43, 0), (0.01, 1.53, 0)),
    "head": Bone("neck", (0.01, 1.54, 0), (0.03, 1.68, 0)),
}
PERSON_LIMBS = {
    "upperarm": Bone("chest", (0, 1.385, 0.165), (-0.01, 1.15, 0.275)),
    "forearm": Bone("upperarm", (-0.01, 1.15, 0.275), (0.03, 0.94, 0.355)),
    "hand": Bone("forearm", (0.03, 0.94, 0.355), (0.05, 0.79, 0.400)),
    "thigh": Bone("pelvis", (0, 0.91, 0.095), (0.01, 0.50, 0.110)),
    "shin": Bone("thigh", (0.01, 0.50, 0.110), (-0.02, 0.09, 0.115)),
    "foot": Bone("shin", (-0.02, 0.08, 0.115), (0.13, 0.03, 0.135)),
}
PERSON_FLESH = [
    Cone("pelvis", (-0.005, 0.93, -0.055), (-0.005, 0.93, 0.055), 0.112, 0.112, (0.95, 1, 1)),
    Cone("waist", (0, 1.01, 0), (0, 1.16, 0), 0.112, 0.094, (0.85, 1, 1.15), 0.08),
    Cone("chest", (0, 1.18, 0), (-0.01, 1.32, 0), 0.094, 0.108, (0.92, 1, 1.25), 0.08),
    Cone("chest", (-0.01, 1.375, -0.115), (-0.01, 1.375, 0.115), 0.064, 0.064, blend=0.08),
    Cone("chest", (0.055, 1.285, 0.062), (0.075, 1.275, 0.064), 0.055, 0.045, blend=0.04),
    Cone("chest", (0.055, 1.285, -0.062), (0.075, 1.275, -0.064), 0.055, 0.045, blend=0.04),
    Cone("neck", (-0.01, 1.42, 0), (0.005, 1.53, 0), 0.056, 0.046, blend=0.06),
    Cone("head", (0.015, 1.575, 0), (0.010, 1.635, 0), 0.078, 0.088, (1.1, 1.1, 0.9), 0.03),
    Cone("head", (0.060, 1.555, 0), (0.070, 1.60, 0), 0.042, 0.036, blend=0.04),
]
PERSON_LIMB_FLESH = [
    Cone("upperarm", (0, 1.375, 0.155), (-0.01, 1.15, 0.275), 0.056, 0.041, blend=0.06),
    Cone("forearm", (-0.01, 1.15, 0.275), (0.005, 1.07, 0.305), 0.041, 0.042, blend=0.02),
    Cone("forearm", (0.005, 1.07, 0.305), (0.03, 0.94, 0.355), 0.042, 0.029, blend=0.02),
    Cone("hand", (0.032, 0.925, 0.36), (0.045, 0.84, 0.388), 0.033, 0.036, (0.8, 1, 1), 0.02),
    Cone("hand", (0.045, 0.84, 0.388), (0.05, 0.785, 0.402), 0.034, 0.024, (0.8, 1, 1), 0.02),
    Cone("thigh", (0, 0.88, 0.085), (0.01, 0.52, 0.110), 0.096, 0.058, blend=0.05),
    Cone("shin", (0.01, 0.51, 0.110), (-0.01, 0.36, 0.112), 0.057, 0.054, blend=0.03),
    Cone("shin", (-0.01, 0.36, 0.112), (-0.02, 0.10, 0.115), 0.055, 0.036, blend=0.03),
    Cone("foot", (-0.03, 0.05, 0.115), (0.11, 0.035, 0.133), 0.045, 0.034, (1, 0.9, 1), 0.03),
]
PERSON_POSES: tuple[Mapping[str, Turn], Mapping[str, Turn]] = (
    {
        "upperarm-right": (-14, 0, 6),
        "upperarm-left": (14, 0, -6),
        "forearm-right": (0, 0, 12),
        "forearm-left": (0, 0, 16),
        "thigh-left": (0, 0, 4),
        "thigh-right": (0, 0, -4),
    },
    {
        "pelvis": (4, 0, 0),
        "waist": (6, -8, 2),
        "chest": (6, -10, 0),
        "neck": (-8, -8, 2),
        "head": (-8, -10, 4),
        "upperarm-right": (-104, 0, 10),
        "forearm-right": (-46, 0, 20),
        "hand-right": (-14, 0, 8),
        "upperarm-left": (58, 10, 16),
        "forearm-left": (34, 0, 30),
        "hand-left": (12, 0, 10),
        "thigh-left": (62, 0, 22),
        "shin-left": (-118, 0, -14),
        "foot-left": (-14, 0, -44),
        "thigh-right": (-5, 0, 0),
    },
)


class Kind(NamedTuple):
    """What a body is made of, and how it stands."""

    trunk: dict[str, Bone]
    limbs: dict[str, Bone]
    """Of the right side."""
    flesh: list[Cone]
    limb_flesh: list[Cone]
    poses: tuple[Mapping[str, Turn], Mapping[str, Turn]]
    cell: float
    """Length of its edges."""
    softness: float
    """Of the joints, in radii."""


KINDS = {
    "wader": Kind(WADER_TRUNK, WADER_LEG, WADER_FLESH, WADER_LEG_FLESH, WADER_POSES, 0.0125, 0.9),
    "person": Kind(PERSON_TRUNK, PERSON_LIMBS, PERSON_FLESH, PERSON_LIMB_FLESH, PERSON_POSES, 0.0200, 0.6),
}


class Biped(NamedTuple):
    """A body that moves from one pose to the other."""

    rest: Array
    """*Shape:* ``(V, 3)``."""
    faces: IntArray
    """*Shape:* ``(F, 3)``."""
    bones: dict[str, Bone]
    bone: IntArray
    """The bone in the list of ``bones`` that each vertex follows most. *Shape:* ``(V,)``."""
    weights: Array
    radius: Array
    poses: tuple[Mapping[str, Turn], Mapping[str, Turn]]

    def pose(self, time: float) -> Array:
        """The shape at a time in [0, 1]. *Shape:* ``(V, 3)``."""
        names = self.poses[0].keys() | self.poses[1].keys()
        ends = [{name: np.array(pose.get(name, (0, 0, 0))) for name in names} for pose in self.poses]
        turns = {n: Rotation.from_rotvec((1 - time) * ends[0][n] + time * ends[1][n], degrees=True) for n in names}
        posed = skin(self.rest, self.weights, *place_bones(self.bones, turns, np.zeros(3)))
        volume = trimesh.Trimesh(self.rest, self.faces, process=False).volume
        return restore_volume(posed, self.faces, volume, self.radius)


@cache
def biped(name: str, cell: float | None) -> Biped:
    """Sculpt ``"wader"`` or ``"person"``; ``cell`` is the length of its edges, None for its own."""
    kind = KINDS[name]
    bones, flesh = dict(kind.trunk), list(kind.flesh)
    for side, sign in (("right", 1), ("left", -1)):
        for bone, (parent, head, tail) in ((n, (b.parent, b.head, b.tail)) for n, b in kind.limbs.items()):
            parent = parent if parent in kind.trunk else f"{parent}-{side}"
            bones[f"{bone}-{side}"] = Bone(parent, _mirrored(head, sign), _mirrored(tail, sign))
        flesh += [
            Cone(f"{c.bone}-{side}", _mirrored(c.a, sign), _mirrored(c.b, sign), c.ra, c.rb, c.stretch, c.blend)
            for c in kind.limb_flesh
        ]
    rest, faces = sculpt(flesh, cell or kind.cell, rounds=30)
    weights, radius = bind(flesh, bones, rest, faces, kind.softness)
    return Biped(rest, faces, bones, weights.argmax(1), weights, radius, kind.poses)


def _mirrored(point: Point, sign: int) -> Point:
    return point[0], point[1], sign * point[2]
