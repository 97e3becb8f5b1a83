"""One motion on another body, against known motions.

    python tests/benchmarks/transfer.py [--only TEXT ...]

Bodies and poses are those of the generator ``anny`` (PyPI; Apache-2.0, its data CC0), which gives all people the same
vertices, so that the truth, the target in the same pose, is known. All meshes are decimated, each on its own. Six
random poses follow the rest. Distances are means over vertices and poses, after the best rigid motion of each, in per
cent of the target's diagonal: of displacements that are copied along the true map, plain and scaled; of `tm.transfer`
with the true map, and with the map of `tm.register` without landmarks. Edges: root mean square of the logarithmic
changes of their lengths since rest, over the source's. *Map* is the mean distance of the registration from the truth.

*Feet*: a man walks 48 frames in which his feet stand exactly. Slip is the largest distance that a vertex of the target
moves while the source's stands, over the stride; *free* is without anchors.

*Time*: processor seconds of one thread for 50 frames of 10,000 vertices on 10,000 vertices, the map given.
"""

import argparse
from collections.abc import Sequence
from functools import cache

import numpy as np
import torch
from people import PEOPLE, generator
from results import Table, add_keep, number, percent, wanted
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
from timing import limit_threads, timed
from torch import Tensor

import torch_modal as tm
from torch_modal.arrays import FloatArray, IntArray
from torch_modal.geometry.connectivity import Connectivity
from torch_modal.geometry.decimation import decimate
from torch_modal.registration.surface import MeshSurface

PAIRS = [("man", "woman"), ("man", "child"), ("thin", "heavy"), ("woman", "strong"), ("child", "small")]
SIZES = 4000, 3000
N_POSES, N_FRAMES, PERIOD, STANCE = 6, 48, 24, 0.6
STRIDE, CROUCH, LIFT = 0.8, 0.06, 0.08  # of a leg
LEG = 0.47  # of the height
WALKING = ("upperleg01.L", "lowerleg01.L", "foot.L", "upperleg01.R", "lowerleg01.R", "foot.R")
ARMS = ("upperarm01.L", "upperarm01.R")


# ------------------------------------------------------------------------------------------------------------- people
@cache
def corresponding() -> IntArray:
    """Vertices of the generator that the skin has."""
    _, skin, rest = generator()
    found: IntArray = cKDTree(rest).query(skin.vertices)[1].astype(np.int64)
    return found


def posed(kind: str, turns: Sequence[dict[str, FloatArray]]) -> FloatArray:
    """A person in poses, by rotation vectors of bones. *Shape:* ``(T, V, 3)``."""
    model, _, _ = generator()
    bones, poses = list(model.bone_labels), np.tile(np.eye(4), (len(turns), len(model.bone_labels), 1, 1))
    for pose, turn in zip(poses, turns, strict=True):
        for bone, vector in turn.items():
            pose[bones.index(bone), :3, :3] = Rotation.from_rotvec(vector).as_matrix()
    shape = {
        name: torch.full((len(turns),), float(PEOPLE[kind].get(name, 0.5)), dtype=torch.float32)
        for name in model.phenotype_labels
    }
    found = model(pose_parameters=torch.tensor(poses, dtype=torch.float32), phenotype_kwargs=shape)["vertices"]
    shapes: FloatArray = found.double().numpy()[:, corresponding()]
    return shapes


@cache
def poses(kind: str) -> FloatArray:
    """At rest, and in random poses, the same for all. *Shape:* ``(1 + N_POSES, V, 3)``."""
    turns: list[dict[str, FloatArray]] = [{}]
    for seed in range(N_POSES):
        random, turn = np.random.default_rng(seed), {}
        for side, sign in (("L", 1), ("R", -1)):
            for bone, low, high in (
                (f"upperarm01.{side}", (-30, -30 * sign, -60 * sign), (30, 50 * sign, 40 * sign)),
                (f"lowerarm01.{side}", (0, 0, -90 * sign), (0, 0, 0)),
                (f"upperleg01.{side}", (-60, -20, -15), (20, 10, 15)),
                (f"lowerleg01.{side}", (0, 0, 0), (70, 0, 0)),
            ):
                turn[bone] = np.deg2rad(random.uniform(np.minimum(low, high), np.maximum(low, high)))
        for bone in ("spine04", "spine03", "spine02"):
            turn[bone] = np.deg2rad(random.uniform((-4, -6, -6), (10, 6, 6)))
        turn["head"] = np.deg2rad(random.uniform((-20, -10, -25), (20, 10, 25)))
        turns.append(turn)
    return posed(kind, turns)


@cache
def walking(kind: str) -> tuple[FloatArray, float]:
    """A walk in which feet stand exactly, by inverse kinematics of the legs, and its stride. *Shape:* ``(T, V, 3)``."""
    rest = poses(kind)[0]
    height = float(np.ptp(rest[:, 2]))
    leg = LEG * height
    stride, angles, shapes, marks = STRIDE * leg, np.zeros(6), [rest], []
    for sign in (1, -1):
        sole = np.flatnonzero((sign * rest[:, 0] > 0) & (rest[:, 2] < rest[:, 2].min() + 0.02 * height))
        marks.append(sole[[rest[sole, 1].argmin(), rest[sole, 1].argmax()]])

    def bent(rows: FloatArray, phase: float) -> FloatArray:
        swing = 0.4 * np.sin(2 * np.pi * phase)
        axis = np.array([1.0, 0, 0])
        arms = {bone: sign * swing * axis for bone, sign in zip(ARMS, (1, -1), strict=True)}
        return posed(kind, [{**arms, **{b: a * axis for b, a in zip(WALKING, row, strict=True)}} for row in rows])

    for frame in range(1, N_FRAMES + 1):
        phase, goal = frame / PERIOD, []
        root = np.array([0, -stride * phase, -CROUCH * leg])
        for mark, offset in zip(marks, (0.0, 0.5), strict=True):
            step, part = divmod(phase + offset, 1)
            ahead, lift, swing = (step - offset + STANCE / 2) * stride, 0.0, max(0.0, (part - STANCE) / (1 - STANCE))
            ahead += stride * (swing - np.sin(2 * np.pi * swing) / (2 * np.pi))
            lift = LIFT * leg * (1 - np.cos(2 * np.pi * swing)) / 2
            goal.append(rest[mark] + [0, -ahead, lift])
        if frame == 1:
            angles = np.tile([-0.3, 0.5, -0.2], 2)
        for _ in range(8):
            found = bent(np.concatenate([angles[None], angles + 1e-3 * np.eye(6)]), phase)[:, np.concatenate(marks), 1:]
            off = (found[0] + root[1:] - np.concatenate(goal)[:, 1:]).ravel()
            slope = ((found[1:] - found[0]) / 1e-3).reshape(6, -1).T
            step_ = np.linalg.lstsq(slope, -off, rcond=1e-4)[0]
            angles = angles + np.clip(step_, -0.3, 0.3)
            if np.abs(step_).max() < 1e-6:
                break
        shapes.append(bent(angles[None], phase)[0] + root)
    return np.stack(shapes), stride


class Mesh:
    """A person in a triangulation of its own."""

    def __init__(self, shapes: FloatArray, size: int, seed: int) -> None:
        skin, random = generator()[1], np.random.default_rng(seed)
        surface = skin.with_vertices(shapes[0])
        noisy = shapes[0] + 4e-4 * surface.diagonal * random.normal(size=shapes[0].shape)
        points, faces, _ = decimate(noisy, skin.faces, int(size / len(noisy) * len(skin.faces)))
        self.rows = surface.rows(surface.closest(points))
        self.frames, self.faces = self.on(shapes), torch.from_numpy(faces)

    def on(self, shapes: FloatArray) -> Tensor:
        """Places of the vertices on another person, or in poses. *Shape:* ``(T, V, 3) -> (T, n, 3)``."""
        return torch.from_numpy(np.stack([self.rows @ shape for shape in shapes]))


# ----------------------------------------------------------------------------------------------------------- measures
def distance(found: Tensor, truth: Tensor) -> float:
    """Mean distance after the best rigid motion of each shape, over the diagonal at rest."""
    diagonal = (truth[0].amax(0) - truth[0].amin(0)).norm()
    return float((tm.align(found[1:], truth[1:]) - truth[1:]).norm(dim=-1).mean() / diagonal)


def edge_change(x: Tensor, faces: Tensor) -> float:
    """Root mean square of the logarithmic changes of edge lengths since rest."""
    i, j = torch.tensor(Connectivity(faces.numpy()).edges).T
    lengths = (x[:, i] - x[:, j]).norm(dim=-1)
    return float((lengths[1:] / lengths[:1]).log().square().mean().sqrt())


def slip(found: Tensor, source: Tensor, stride: float) -> float:
    """Largest distance that vertices move while their source stands."""
    stands = source.diff(dim=0).norm(dim=-1) < 1e-4 * stride
    worst, since = found.new_zeros(()), found[0]
    for t in range(len(stands)):
        since = torch.where(stands[t, :, None], since, found[t + 1])
        worst = torch.maximum(worst, ((found[t + 1] - since).norm(dim=-1) * stands[t]).max())
    return float(worst) / stride


def pair(first: str, second: str) -> list[str]:
    """One person's poses on another one: a row of the table."""
    source, target = Mesh(poses(first), SIZES[0], 1), Mesh(poses(second), SIZES[1], 2)
    places, (rest, truth) = target.on(poses(first)), (target.frames[0], target.frames)
    meshes = source.frames, source.faces, rest, target.faces
    scale = float(np.sqrt(MeshSurface(rest.numpy(), target.faces.numpy()).area))
    scale /= float(np.sqrt(MeshSurface(places[0].numpy(), target.faces.numpy()).area))
    copied = [distance(rest + factor * (places - places[0]), truth) for factor in (1.0, scale)]
    options = {"same_subject": first == second, "cache": False, "progress": False}
    found = tm.register(rest, target.faces, source.frames[0], source.faces, **options)
    off = float((found.positions - places[0]).norm(dim=1).mean() / (places[0].amax(0) - places[0].amin(0)).norm())
    maps = places[0], found
    moved = [tm.transfer(*meshes, registration=one, anchors=False, keep_doubtful=True) for one in maps]
    by_true, by_own = (distance(shapes, truth) for shapes in moved)
    edges = edge_change(moved[1], target.faces) / edge_change(source.frames, source.faces)
    return [
        *(percent(value) for value in (*copied, by_true, by_own)),
        *(
            number(value, ".2f")
            for value in (by_true / min(copied) if first != second else np.nan, by_own / by_true, edges)
        ),
        percent(off),
        f"{found.confidence:.2f}",
    ]


def main() -> None:
    """Print and keep the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="+", default=[""], metavar="TEXT", help="rows whose names hold one of these")
    add_keep(parser)
    given = parser.parse_args()
    limit_threads()
    columns = ["", "copied", "copied, scaled", "true map", "own map", "true over copied", "own over true", "edges"]
    with Table("transfer", [*columns, "map", "confidence"], given.keep) as table:
        for first, second in [("man", "man"), *PAIRS]:
            name = f"{first} on {second}" if first != second else "the same man, other triangles"
            if wanted(name, given.only):
                table.add(name, *pair(first, second))
    with Table("transfer-feet", ["", "slip", "free", "edges"], given.keep) as table:
        for second in ("child", "heavy"):
            name = f"feet of a {second}"
            if wanted(name, given.only):
                (shapes, stride), skin = walking("man"), generator()[1]
                x, faces = torch.from_numpy(shapes), torch.from_numpy(skin.faces)
                rest = torch.from_numpy(poses(second)[0])
                moved = [tm.transfer(x, faces, rest, faces, anchors=anchors) for anchors in (True, False)]
                edges = edge_change(moved[0], faces) / edge_change(x, faces)
                table.add(name, *(percent(slip(one, x, stride)) for one in moved), f"{edges:.2f}")
    with Table("transfer-time", ["", "50 frames"], given.keep, ["50 frames"]) as table:
        if wanted("time", given.only):
            source, target = Mesh(poses("man"), 10_000, 1), Mesh(poses("woman"), 10_000, 2)
            x, places = source.frames[torch.arange(50) % len(source.frames)], target.on(poses("man"))[0]
            meshes = x, source.faces, target.frames[0], target.faces
            seconds = timed(lambda: tm.transfer(*meshes, registration=places, progress=False))[1]
            table.add(f"time, {len(places):,} vertices", f"{seconds:.1f} s")


if __name__ == "__main__":
    main()
