"""Make the sample key-frames: a galloping animal (a cycle of six) and a grasping hand.

Everything is sculpted and posed by the tables below, so the samples are free of anyone else's rights, and the
frames between the key-frames are known: they come from the same smooth curves at other times.

    python -m examples.samples.make_samples [--out DIR]
"""

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
import trimesh
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

import torch_modal as tm

from .sculpt import (
    Array,
    Bone,
    Cone,
    IntArray,
    bind,
    corner_angles,
    place_bones,
    restore_volume,
    sculpt,
    skin,
)

# -------------------------------------------------------------------------------------------- creature, shape
# About 2 units long, Y up, facing +X; its right side is +Z. Left limbs are mirror images of the right ones.

SPINE = {
    "waist": Bone(None, (-0.16, 0.75, 0), (0.06, 0.74, 0)),
    "pelvis": Bone("waist", (-0.16, 0.75, 0), (-0.42, 0.76, 0)),
    "chest": Bone("waist", (0.06, 0.74, 0), (0.34, 0.75, 0)),
    "neck": Bone("chest", (0.36, 0.78, 0), (0.55, 0.98, 0)),
    "head": Bone("neck", (0.56, 0.99, 0), (0.86, 0.93, 0)),
    "tail1": Bone("pelvis", (-0.44, 0.80, 0), (-0.58, 0.76, 0)),
    "tail2": Bone("tail1", (-0.58, 0.76, 0), (-0.75, 0.69, 0)),
    "tail3": Bone("tail2", (-0.75, 0.69, 0), (-0.90, 0.64, 0)),
    "tail4": Bone("tail3", (-0.90, 0.64, 0), (-1.06, 0.63, 0)),
}
RIGHT_LIMBS = {
    "scapula": Bone("chest", (0.27, 0.79, 0.09), (0.37, 0.59, 0.115)),
    "upperarm": Bone("scapula", (0.37, 0.59, 0.115), (0.27, 0.43, 0.125)),
    "forearm": Bone("upperarm", (0.27, 0.43, 0.125), (0.285, 0.19, 0.125)),
    "pastern": Bone("forearm", (0.285, 0.19, 0.125), (0.305, 0.055, 0.125)),
    "forepaw": Bone("pastern", (0.305, 0.055, 0.125), (0.375, 0.035, 0.125)),
    "thigh": Bone("pelvis", (-0.36, 0.73, 0.10), (-0.27, 0.48, 0.14)),
    "shin": Bone("thigh", (-0.27, 0.48, 0.14), (-0.46, 0.26, 0.14)),
    "hock": Bone("shin", (-0.46, 0.26, 0.14), (-0.43, 0.055, 0.14)),
    "hindpaw": Bone("hock", (-0.43, 0.055, 0.14), (-0.35, 0.035, 0.14)),
    "ear": Bone("head", (0.56, 1.06, 0.07), (0.510, 1.245, 0.108)),
}
TRUNK_FLESH = [
    Cone("waist", (-0.16, 0.745, 0), (0.06, 0.72, 0), 0.112, 0.140, (1, 1, 0.85)),
    Cone("chest", (0.06, 0.72, 0), (0.26, 0.67, 0), 0.140, 0.182, (1, 1, 0.76), 0.12),
    Cone("chest", (0.26, 0.67, 0), (0.37, 0.68, 0), 0.182, 0.125, (1, 1, 0.80), 0.10),
    Cone("pelvis", (-0.16, 0.745, 0), (-0.37, 0.74, 0), 0.112, 0.122, (1, 1, 0.90), 0.10),
    Cone("neck", (0.36, 0.76, 0), (0.55, 0.99, 0), 0.130, 0.078, (1, 1, 0.85), 0.10),
    Cone("head", (0.57, 1.01, 0), (0.66, 0.99, 0), 0.105, 0.085, (1, 1, 0.98), 0.05),
    Cone("head", (0.68, 0.955, 0), (0.87, 0.925, 0), 0.060, 0.037, (1, 1, 0.92), 0.06),
    Cone("head", (0.885, 0.940, 0), (0.895, 0.940, 0), 0.026, 0.024, blend=0.02),
    Cone("tail1", (-0.44, 0.79, 0), (-0.58, 0.76, 0), 0.042, 0.046, blend=0.06),
    Cone("tail2", (-0.58, 0.76, 0), (-0.75, 0.69, 0), 0.046, 0.060, blend=0.015),
    Cone("tail3", (-0.75, 0.69, 0), (-0.90, 0.64, 0), 0.060, 0.055, blend=0.015),
    Cone("tail4", (-0.90, 0.64, 0), (-1.06, 0.63, 0), 0.055, 0.024, blend=0.015),
]
RIGHT_FLESH = [
    Cone("scapula", (0.29, 0.73, 0.085), (0.37, 0.59, 0.10), 0.085, 0.080, (1, 1, 0.8), 0.08),
    Cone("upperarm", (0.36, 0.60, 0.11), (0.27, 0.43, 0.125), 0.080, 0.061, blend=0.06),
    Cone("forearm", (0.27, 0.43, 0.125), (0.285, 0.19, 0.125), 0.060, 0.037, blend=0.03),
    Cone("pastern", (0.285, 0.19, 0.125), (0.305, 0.055, 0.125), 0.037, 0.038, blend=0.02),
    Cone("forepaw", (0.315, 0.042, 0.125), (0.37, 0.036, 0.125), 0.042, 0.038, (1, 1, 1.15), 0.03),
    Cone("thigh", (-0.36, 0.68, 0.085), (-0.29, 0.50, 0.13), 0.122, 0.076, (1, 1, 0.70), 0.08),
    Cone("shin", (-0.28, 0.49, 0.14), (-0.46, 0.26, 0.14), 0.070, 0.039, blend=0.05),
    Cone("hock", (-0.46, 0.26, 0.14), (-0.43, 0.055, 0.14), 0.040, 0.037, blend=0.03),
    Cone("hindpaw", (-0.42, 0.042, 0.14), (-0.355, 0.036, 0.14), 0.042, 0.038, (1, 1, 1.15), 0.03),
    Cone("ear", (0.555, 1.07, 0.064), (0.510, 1.245, 0.108), 0.080, 0.025, (0.78, 1, 0.72), 0.03),
]

# ------------------------------------------------------------------------------------------- creature, gallop
# Six key-frames of one stride: 0 stretched flight, 1 fore landing, 2 fore push, 3 gathered flight,
# 4 hind landing, 5 hind push. Degrees; a periodic cubic spline runs through each row.

# Pitch from the rest pose relative to the parent: positive lifts what points forward, lowers what points aft.
SPINE_PITCH = {
    "waist": (4, -3, -6, -2, 6, 9),
    "pelvis": (-16, -2, 20, 30, 14, -12),
    "chest": (8, 3, -6, -16, -8, 4),
    "neck": (-26, -14, -8, -4, -12, -24),
    "head": (14, 12, 14, 16, 12, 10),
    "ear": (30, 16, 8, 20, 34, 38),
    "tail1": (10, -22, -48, -50, -20, 8),
    "tail2": (-4, 6, -6, -20, -18, -8),
    "tail3": (-16, -2, 14, 4, -14, -20),
    "tail4": (-18, -10, 8, 18, 4, -12),
}
# Direction of each leg bone relative to the pelvis or the chest: 0 hangs straight down, 90 points forward.
LEG_DIRECTION = {
    "fore": {
        "scapula": (46, 32, 14, 8, 22, 42),
        "upperarm": (4, -22, -48, -60, -50, -14),
        "forearm": (62, 22, -26, -44, 10, 62),
        "pastern": (56, 14, -36, -92, -70, 14),
        "forepaw": (108, 82, 8, -104, -70, 48),
    },
    "hind": {
        "thigh": (-32, -14, 36, 66, 44, -4),
        "shin": (-76, -96, -52, 2, -26, -54),
        "hock": (-56, -66, -14, 48, 30, -22),
        "hindpaw": (-86, -84, 0, 102, 82, 22),
    },
}
# Legs swing a little outwards, so that hind paws pass outside fore paws when the animal is gathered.
LEG_OUTWARD = {"scapula": (0, 0, -2, -4, -2, 0), "thigh": (0, 2, 10, 17, 10, 2)}
# The second leg of each pair follows the first by a part of a frame.
LEG_DELAY = {"fore": {"right": 0.0, "left": 0.35}, "hind": {"right": 0.3, "left": 0.0}}
BODY = {
    "forward": (0.05, 0.02, -0.03, -0.05, -0.02, 0.03),
    "up": (0.0, 0.02, 0.07, 0.06, 0.01, 0.03),
    "roll": (2, 4, 2, -2, -4, -2),
    "yaw": (-2, 1, 3, 2, -1, -3),
}

# ------------------------------------------------------------------------------------------------ hand, shape
# A right hand about 1 unit long, fingers along +Y, palm facing +Z, thumb at +X.

FINGERS = {  # knuckle, splay at rest (degrees), lengths of the three bones, radii at their four ends
    "index": ((0.145, 0.490, 0.0), 14, (0.205, 0.125, 0.090), (0.045, 0.041, 0.038, 0.032)),
    "middle": ((0.047, 0.515, 0.0), 3, (0.225, 0.145, 0.095), (0.046, 0.042, 0.039, 0.033)),
    "ring": ((-0.050, 0.495, 0.0), -9, (0.205, 0.135, 0.092), (0.044, 0.040, 0.037, 0.032)),
    "little": ((-0.142, 0.445, 0.0), -23, (0.160, 0.095, 0.080), (0.039, 0.036, 0.033, 0.029)),
}
THUMB = {
    "thumb1": Bone("palm", (0.085, 0.085, 0.030), (0.205, 0.235, 0.060)),
    "thumb2": Bone("thumb1", (0.205, 0.235, 0.060), (0.290, 0.365, 0.070)),
    "thumb3": Bone("thumb2", (0.290, 0.365, 0.070), (0.345, 0.475, 0.072)),
}
PALM_FLESH = [
    Cone("palm", (0, -0.12, 0), (0, 0.06, 0), 0.094, 0.104, (1.2, 1, 0.68)),
    Cone("palm", (0.035, 0.10, 0), (0.140, 0.46, 0), 0.062, 0.056, (1, 1, 0.92), 0.10),
    Cone("palm", (0.010, 0.10, 0), (0.047, 0.48, 0), 0.064, 0.057, (1, 1, 0.92), 0.10),
    Cone("palm", (-0.020, 0.10, 0), (-0.048, 0.465, 0), 0.064, 0.055, (1, 1, 0.92), 0.10),
    Cone("palm", (-0.045, 0.10, 0), (-0.135, 0.415, 0), 0.060, 0.050, (1, 1, 0.92), 0.10),
    Cone("palm", (-0.075, 0.13, 0.035), (-0.110, 0.27, 0.03), 0.050, 0.045, blend=0.06),
    Cone("thumb1", (0.085, 0.095, 0.035), (0.195, 0.225, 0.060), 0.074, 0.054, blend=0.08),
    Cone("thumb2", (0.205, 0.235, 0.060), (0.290, 0.365, 0.070), 0.053, 0.045, blend=0.04),
    Cone("thumb3", (0.290, 0.365, 0.070), (0.345, 0.475, 0.072), 0.046, 0.031, blend=0.02),
]

# ------------------------------------------------------------------------------------------------ hand, grasp
# Degrees from the rest pose, (open, closed). Flexion bends towards the palm, spread turns within its plane.

FLEXION = {
    "index": ((4, 72), (10, 82), (8, 48)),
    "middle": ((2, 74), (9, 85), (7, 50)),
    "ring": ((4, 74), (11, 86), (8, 50)),
    "little": ((7, 75), (13, 84), (9, 48)),
}
SPREAD = {
    "index": (3, 13),
    "middle": (0, 2),
    "ring": (-2, -9),
    "little": (-6, -21),
}  # towards the middle line
LAG = {
    "index": -0.25,
    "middle": -0.10,
    "ring": 0.10,
    "little": 0.25,
    "thumb": 0.40,
    "palm": 0.0,
}  # above 0: starts late
THUMB_TURN = {  # rotation vectors in degrees, (open, closed)
    "thumb1": ((0, 0, 0), (13, -60, -15)),
    "thumb2": ((0, 0, 0), (6, -4, 11)),
    "thumb3": ((0, 0, 0), (14, -9, 24)),
}
WRIST_TURN = ((0, -8, 4), (-12, 14, -6))  # the whole hand
WRIST_SHIFT = ((0, 0, 0), (0.03, 0.06, -0.05))


# ----------------------------------------------------------------------------------------------------- models
def mirrored(point: tuple[float, float, float]) -> tuple[float, float, float]:
    """The point on the other side of the animal."""
    return point[0], point[1], -point[2]


def creature() -> tuple[dict[str, Bone], list[Cone]]:
    """Bones and flesh of the animal in its rest pose."""
    bones, flesh = dict(SPINE), list(TRUNK_FLESH)
    for side, place in (("right", tuple), ("left", mirrored)):
        for name, bone in RIGHT_LIMBS.items():
            parent = bone.parent if bone.parent in SPINE else f"{bone.parent}-{side}"
            bones[f"{name}-{side}"] = Bone(parent, place(bone.head), place(bone.tail))
        flesh += [Cone(f"{c.bone}-{side}", place(c.a), place(c.b), c.ra, c.rb, c.stretch, c.blend) for c in RIGHT_FLESH]
    return bones, flesh


def gallop(bones: dict[str, Bone], time: float) -> tuple[dict[str, Rotation], Array]:
    """Joint rotations and body shift at a time in frames; the stride takes six."""

    def curve(row: tuple[float, ...], delay: float = 0.0) -> float:
        return float(CubicSpline(np.arange(7), [*row, row[0]], bc_type="periodic")((time - delay) % 6))

    turns: dict[str, Rotation] = {}
    direction: dict[str | None, float] = {}  # of the leg bones placed so far, as a turn from the rest pose
    for name, bone in bones.items():
        base, _, side = name.partition("-")
        pair = next((p for p, rows in LEG_DIRECTION.items() if base in rows), None)
        if pair is None:
            turns[name] = Rotation.from_euler("z", curve(SPINE_PITCH[base]), degrees=True)
            continue
        delay, along = LEG_DELAY[pair][side], np.subtract(bone.tail, bone.head)
        direction[name] = curve(LEG_DIRECTION[pair][base], delay) - np.degrees(np.arctan2(along[0], -along[1]))
        swing = direction[name] - direction.get(bone.parent, 0.0)
        outward = curve(LEG_OUTWARD.get(base, (0,) * 6), delay) * (-1 if side == "right" else 1)
        turns[name] = Rotation.from_euler("xz", [outward, swing], degrees=True)
    body = Rotation.from_euler("xy", [curve(BODY["roll"]), curve(BODY["yaw"])], degrees=True)
    turns["waist"] = body * turns["waist"]
    return turns, np.array([curve(BODY["forward"]), curve(BODY["up"]), 0.0])


def hand() -> tuple[dict[str, Bone], list[Cone]]:
    """Bones and flesh of the hand in its rest pose."""
    bones, flesh = {"palm": Bone(None, (0, 0, 0), (0, 0.4, 0)), **THUMB}, list(PALM_FLESH)
    for finger, (knuckle, splay, lengths, radii) in FINGERS.items():
        along = np.array([np.sin(np.radians(splay)), np.cos(np.radians(splay)), 0])
        head, parent = np.array(knuckle), "palm"
        for n, length in enumerate(lengths):
            tail, name = head + length * along, f"{finger}{n + 1}"
            bones[name] = Bone(parent, tuple(head), tuple(tail))
            flesh.append(Cone(name, tuple(head), tuple(tail), radii[n], radii[n + 1], blend=0.03 if n == 0 else 0.01))
            head, parent = tail, name
    return bones, flesh


def grasp(bones: dict[str, Bone], time: float) -> tuple[dict[str, Rotation], Array]:
    """Joint rotations and shift of the hand at a time from 0, open, to 1, closed."""

    def between(pair: tuple, who: str) -> Array:
        share = time - LAG[who] * time * (1 - time)
        return (1 - share) * np.asarray(pair[0], float) + share * np.asarray(pair[1], float)

    turns = {n: Rotation.from_rotvec(between(pair, "thumb"), degrees=True) for n, pair in THUMB_TURN.items()}
    for finger, angles in FLEXION.items():
        along = np.subtract(bones[f"{finger}1"].tail, bones[f"{finger}1"].head)
        hinge = np.cross(along, [0, 0, 1]) / np.linalg.norm(along)
        for n, pair in enumerate(angles):
            turns[f"{finger}{n + 1}"] = Rotation.from_rotvec(between(pair, finger) * hinge, degrees=True)
        spread = Rotation.from_euler("z", between(SPREAD[finger], finger), degrees=True)
        turns[f"{finger}1"] = spread * turns[f"{finger}1"]
    turns["palm"] = Rotation.from_rotvec(between(WRIST_TURN, "palm"), degrees=True)
    return turns, between(WRIST_SHIFT, "palm")


def gesture(bones: dict[str, Bone], number: float) -> tuple[dict[str, Rotation], Array]:
    """The hand with each digit closed by a random amount of its own, the same for a number; 0 is open."""
    closed = np.random.default_rng(int(number)).uniform(size=5) * (number > 0)
    turns, shift = grasp(bones, 0.0)
    for digit, amount in zip(("thumb", "index", "middle", "ring", "little"), closed, strict=True):
        turns |= {name: turn for name, turn in grasp(bones, amount)[0].items() if name.startswith(digit)}
    return turns, shift


# ----------------------------------------------------------------------------------------------------- frames
SAMPLES = {  # model, motion, grid cell, softness of the joints in radii, times of the frames
    "creature": (creature, gallop, 0.0270, 1.15, {"key": np.arange(6.0), "true": np.arange(6) + 0.5}),
    "hand": (hand, grasp, 0.0200, 1.0, {"key": np.array([0.0, 1.0]), "true": np.array([0.25, 0.5, 0.75])}),
}


Motion = Callable[[dict[str, Bone], float], tuple[dict[str, Rotation], Array]]
"""From bones and a time to the rotations of the joints and the shift of the whole."""


class Body(NamedTuple):
    """A sculpted sample that can be posed."""

    rest: Array
    """*Shape:* ``(V, 3)``."""
    faces: IntArray
    """*Shape:* ``(F, 3)``."""
    frame: Callable[[float], Array]
    """The shape at a time of its motion. *Shape:* ``(V, 3)``."""


def sculpted(name: str, motion: Motion | None = None) -> Body:
    """Sculpt a sample; its motion, or another, is known at any time."""
    model, own, cell, softness, _ = SAMPLES[name]
    motion = motion or own
    bones, flesh = model()
    rest, faces = sculpt(flesh, cell)
    weights, radius = bind(flesh, bones, rest, faces, softness)
    volume = trimesh.Trimesh(rest, faces, process=False).volume

    def frame(time: float) -> Array:
        posed = skin(rest, weights, *place_bones(bones, *motion(bones, time)))
        return restore_volume(posed, faces, volume, radius)

    return Body(rest, faces, frame)


def parts_of(name: str, shape: Array) -> IntArray:
    """Part of each vertex of a sample's shape at time 0: the bone whose flesh, posed as it is there, is nearest."""
    model, motion, *_ = SAMPLES[name]
    bones, flesh = model()
    quaternions, translations = place_bones(bones, *motion(bones, 0.0))
    order, names = list(bones), sorted({cone.bone for cone in flesh})
    distances = []
    for cone in flesh:
        number = order.index(cone.bone)
        turn = Rotation.from_quat(quaternions[number])
        distances.append(cone.distance(turn.inv().apply(shape - translations[number]))[0])
    owner = np.array([names.index(cone.bone) for cone in flesh])
    return owner[np.argmin(distances, axis=0)]


def describe(name: str, rest: Array, faces: IntArray, frames: dict[str, Array]) -> None:
    """Check that the mesh is one closed, outward surface; print its quality, and its volume in each frame."""
    mesh = trimesh.Trimesh(rest, faces, process=False)
    if not (mesh.is_volume and mesh.body_count == 1 and len(mesh.edges_unique) * 2 == len(faces) * 3):
        raise RuntimeError(f"{name}: the surface is not one closed manifold; change the cell size or the cones.")
    smallest = corner_angles(rest, faces).min(1)
    print(f"{name}: {len(rest)} vertices, {len(faces)} faces")
    print(f"  smallest angle of a face: min {smallest.min():.1f}, median {np.median(smallest):.1f} degrees")
    for kind, shapes in frames.items():
        ratios = [trimesh.Trimesh(s, faces, process=False).volume / mesh.volume for s in shapes]
        print(f"  {kind:4s} volume / rest volume: " + " ".join(f"{r:.3f}" for r in ratios))


def main() -> None:
    """Write all samples."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path(__file__).parents[2] / "torch_modal" / "samples")
    out = parser.parse_args().out
    for name in SAMPLES:
        rest, faces, frame = sculpted(name)
        frames = {kind: np.stack([frame(t) for t in times]) for kind, times in SAMPLES[name][4].items()}
        describe(name, rest, faces, frames)
        for kind, shapes in frames.items():
            for n, shape in enumerate(shapes, start=0 if kind == "key" or name == "creature" else 1):
                tm.save_mesh(shape, faces, out / name / f"{kind}-{n}.ply")


if __name__ == "__main__":
    main()
