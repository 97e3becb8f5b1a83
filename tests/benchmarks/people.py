"""How well people of many shapes are registered without landmarks, and what a confidence is worth.

    python tests/benchmarks/people.py [--only TEXT ...] [--every 1]

Bodies and poses are those of the generator ``anny`` (PyPI; Apache-2.0, its data CC0), which gives all the same
vertices, so that the truth is known. Both meshes of a pair are remeshed, each on its own, to 2,000 vertices, and
turned. The shape of each person is random around a kind of people. *Plain* bodies are smoothed until fingers, toes and
faces are gone; *extreme* ones are babies, apes with long arms and short legs in a crouch, and people with short or long
legs. The symmetric bodies are those of the tests.

An error is the mean distance along the surface between a vertex and its true place, in per cent of the root of the
area; a result is right with less than 10 %. Times are processor seconds of one thread.
"""

import argparse
import itertools
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import potpourri3d
from results import Table, add_keep, wanted
from scipy import sparse
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
from timing import limit_threads

import torch_modal as tm
from torch_modal.arrays import FloatArray
from torch_modal.geometry.decimation import decimate
from torch_modal.registration.report import TRUSTED, Registration
from torch_modal.registration.surface import MeshSurface, largest_pieces

sys.path.insert(0, str(Path(__file__).parents[1] / "registration"))

N_VERTICES = 2000
VARIATION = 0.15  # of the parameters of a person's shape, from 0 to 1
RIGHT = 10.0  # percent of the root of the area
N_MEASURED = 120  # vertices at which an error is measured
COLUMNS = ["", "pairs", "right", "error, median", "trusted", "trusted, but wrong", "time, median"]
CONFIDENCES = (0.0, 0.25, 0.5, 0.75, 1.01)

PEOPLE: Mapping[str, Mapping[str, float]] = {
    "man": {"gender": 0.0, "age": 0.6},
    "woman": {"gender": 1.0, "age": 0.6},
    "child": {"age": 0.33, "height": 0.5},
    "heavy": {"gender": 0.2, "age": 0.7, "weight": 1.0, "muscle": 0.3},
    "thin": {"gender": 0.8, "age": 0.65, "weight": 0.0, "muscle": 0.3, "height": 0.9},
    "strong": {"gender": 0.0, "age": 0.6, "muscle": 1.0, "weight": 0.6, "height": 0.8},
    "small": {"gender": 1.0, "age": 0.9, "height": 0.1, "weight": 0.7},
    "baby": {"age": 0.0},
    "ape": {"gender": 0.0, "age": 0.6, "muscle": 1.0, "weight": 0.9},
    "dwarf": {"weight": 1.0, "height": 0.0, "age": 0.6},
    "long": {"gender": 0.7, "age": 0.65, "weight": 0.0, "height": 1.0},
}
GROWTH: Mapping[str, Mapping[str, float]] = {
    "ape": {"upperarm01": 1.45, "upperleg01": 0.7},
    "dwarf": {"upperarm01": 1.25, "upperleg01": 0.6},
    "long": {"upperarm01": 0.65, "upperleg01": 1.35},
}
"""Factors of limbs, beyond the generator's own proportions."""
ALIKE, EXTREME = list(PEOPLE)[:7], list(PEOPLE)[7:]


class Pair(NamedTuple):
    """Two meshes, and the true places of the first one's vertices."""

    template: MeshSurface
    target: MeshSurface
    truth: FloatArray
    same_subject: bool
    landmarks: FloatArray | None = None


# ------------------------------------------------------------------------------------------------------------- bodies
@cache
def generator() -> Any:
    """The model of bodies, and the faces of their skin, without eyes and teeth."""
    import anny

    model = anny.Anny()
    faces = np.asarray(model.faces.tolist(), dtype=np.int64)
    rest = model()["vertices"][0].double().numpy()
    return model, largest_pieces(MeshSurface(rest, faces)), rest


def body(kind: str, seed: int, pose_seed: int) -> MeshSurface:
    """A person of a kind in a random pose."""
    import torch

    model, skin, rest = generator()
    random, crouch = np.random.default_rng(pose_seed), kind == "ape"
    bones, pose = list(model.bone_labels), np.tile(np.eye(4), (len(model.bone_labels), 1, 1))

    def turn(bone: str, low: tuple[float, ...], high: tuple[float, ...]) -> None:
        vector = np.deg2rad(random.uniform(np.minimum(low, high), np.maximum(low, high)))
        pose[bones.index(bone), :3, :3] = Rotation.from_rotvec(vector).as_matrix()

    for side, sign in (("L", 1), ("R", -1)):
        arm = ((-20, 20, -50), (20, 45, -10)) if crouch else ((-30, -30, -60), (30, 50, 40))
        turn(f"upperarm01.{side}", *(np.array(ends) * [1, sign, sign] for ends in arm))
        turn(f"lowerarm01.{side}", (0, 0, -90 * sign), (0, 0, 0))
        turn(f"upperleg01.{side}", (-80 if crouch else -60, -20, -15), (-40 if crouch else 20, 10, 15))
        turn(f"lowerleg01.{side}", (40 if crouch else 0, 0, 0), (90 if crouch else 70, 0, 0))
        for limb, factor in GROWTH.get(kind, {}).items():
            pose[bones.index(f"{limb}.{side}"), :3, :3] *= factor
    for bone in ("spine04", "spine03", "spine02"):
        turn(bone, (5 if crouch else -4, -6, -6), (18 if crouch else 10, 6, 6))
    turn("head", (-20, -10, -25), (20, 10, 25))
    vary = np.random.default_rng(seed)
    shape = {
        name: torch.tensor([float(np.clip(PEOPLE[kind].get(name, 0.5) + vary.uniform(-VARIATION, VARIATION), 0, 1))])
        for name in model.phenotype_labels
    }
    posed = model(pose_parameters=torch.tensor(pose, dtype=torch.float32)[None], phenotype_kwargs=shape)
    return skin.with_vertices(posed["vertices"][0].double().numpy()[cKDTree(rest).query(skin.vertices)[1]])


def plain(surface: MeshSurface) -> MeshSurface:
    """Smoothed."""
    (i, j), n = surface.edges.T, len(surface.vertices)
    around = sparse.csr_matrix((np.ones(2 * len(i)), (np.r_[i, j], np.r_[j, i])), shape=(n, n))
    mean, x = sparse.diags(1 / np.asarray(around.sum(1)).ravel()) @ around, surface.vertices
    for _ in range(25):
        x = 0.5 * (x + mean @ x)
    return surface.with_vertices(x)


def remeshed(surface: MeshSurface, random: np.random.Generator) -> MeshSurface:
    """With vertices of its own, in random order: noise decides which edges collapse."""
    noisy = surface.vertices + 4e-4 * surface.diagonal * random.normal(size=surface.vertices.shape)
    points, faces, _ = decimate(noisy, surface.faces, int(N_VERTICES / len(noisy) * len(surface.faces)))
    order = random.permutation(len(points))
    return MeshSurface(surface.closest(points).points[order], np.argsort(order)[faces])


def pair(first: MeshSurface, second: MeshSurface, seed: int, *, same_subject: bool, marked: bool = False) -> Pair:
    """Two bodies in a pair of meshes."""
    random = np.random.default_rng(seed)
    template, target = remeshed(first, random), remeshed(second, random)
    turn = Rotation.random(rng=random).as_matrix()
    truth = first.rows(first.closest(template.vertices)) @ second.vertices @ turn.T
    at = landmark_vertices() if marked else []
    marks = np.stack([first.vertices[at], second.vertices[at] @ turn.T], axis=1) if marked else None
    return Pair(template, target.with_vertices(target.vertices @ turn.T), truth, same_subject, marks)


@cache
def landmark_vertices() -> list[int]:
    """Vertices of the skin on top of the head, at the tips of hands and feet, and on the back."""
    x, y, z = generator()[1].vertices.T
    hands = [int((sign * x).argmax()) for sign in (1, -1)]
    feet = [int(np.where(sign * x > 0, y + z, np.inf).argmin()) for sign in (1, -1)]
    back = np.where((np.abs(x) < 0.02) & (np.abs(z - 0.25) < 0.05), y, -np.inf)
    return [int(z.argmax()), *hands, *feet, int(back.argmax())]


# ------------------------------------------------------------------------------------------------------------ measures
def lengths(target: MeshSurface, places: FloatArray, truths: FloatArray) -> FloatArray:
    """Distances along a surface from places to true places, in per cent of the root of its area.

    *Shape:* ``(n, 3), (k, n, 3) -> (k, n)``.
    """
    solver, tree = potpourri3d.MeshHeatMethodDistanceSolver(target.vertices, target.faces), cKDTree(target.vertices)
    found: FloatArray = np.linalg.norm(places - truths, axis=-1)
    near, true = tree.query(places)[1], tree.query(truths)[1]
    far = found > 0.05 * np.sqrt(target.area)  # nearer, vertices are too coarse
    for i in np.flatnonzero(far.any(0)):
        along = solver.compute_distance(int(near[i]))[true[:, i]]
        found[:, i] = np.where(far[:, i], np.maximum(along, found[:, i]), found[:, i])
    return 100 / np.sqrt(target.area) * found


def error(found: Registration, pair: Pair) -> float:
    """Mean distance along the target from the true places, in per cent of the root of its area."""
    sample = np.random.default_rng(0).permutation(len(pair.truth))[:N_MEASURED]
    places = pair.target.closest(found.positions.numpy()[sample]).points
    return float(lengths(pair.target, places, pair.truth[None, sample]).mean())


class Result(NamedTuple):
    """A registration against its truth."""

    error: float
    confidence: float
    seconds: float


def register(pair: Pair) -> Result:
    """Register one pair."""
    meshes = pair.template.vertices, pair.template.faces, pair.target.vertices, pair.target.faces
    started = time.process_time()
    options: dict[str, Any] = {"same_subject": pair.same_subject, "landmarks": pair.landmarks}
    found = tm.register(*meshes, **options, cache=False, progress=False)
    seconds = time.process_time() - started
    return Result(error(found, pair), found.confidence, seconds)


# --------------------------------------------------------------------------------------------------------------- rows
def people(kind: str, n: int) -> Iterator[Callable[[], Pair]]:
    """Pairs of people, the same in every run."""
    random = np.random.default_rng(sum(map(ord, kind)))
    for seed in range(n):
        first, second = random.choice(ALIKE, 2, replace=False)
        seeds, poses = random.choice(1000, 2, replace=False), random.choice(1000, 2, replace=False)
        if kind == "one person":
            second, seeds[1] = first, seeds[0]
        elif kind.startswith("extreme"):
            first, second = random.permutation([EXTREME[seed % len(EXTREME)], random.choice(ALIKE[:6])])
        who = list(zip((first, second), seeds, poses, strict=True))

        def make(who: list[tuple[str, int, int]] = who, seed: int = seed) -> Pair:
            bodies = [body(*one) for one in who]
            if kind.endswith("plain"):
                bodies = [plain(each) for each in bodies]
            return pair(*bodies, seed, same_subject=kind == "one person", marked="landmarks" in kind)

        yield make


def symmetric_pairs() -> Iterator[Callable[[], Pair]]:
    """Bodies whose shape does not determine the map, as one subject and as two."""
    from test_confidence import SYMMETRIC, symmetric, tilted

    for name in SYMMETRIC:
        for same in (True, False):

            def make(name: str = name, same: bool = same) -> Pair:
                points, faces = symmetric(name)
                target, target_faces, truth = tilted(points, faces)
                return Pair(MeshSurface(points, faces), MeshSurface(target, target_faces), truth, same)

            yield make


ROWS: Mapping[str, Callable[[], Iterator[Callable[[], Pair]]]] = {
    "one person": lambda: people("one person", 20),
    "two people": lambda: people("two people", 30),
    "two people, plain": lambda: people("two people, plain", 10),
    "extreme proportions": lambda: people("extreme", 20),
    "extreme, six landmarks": lambda: people("extreme, landmarks", 10),
    "symmetric bodies": symmetric_pairs,
}


def main() -> None:
    """Print and keep the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="+", default=[""], metavar="TEXT", help="rows whose names hold one of these")
    parser.add_argument("--every", type=int, default=1, help="every so many pairs")
    add_keep(parser)
    given = parser.parse_args()
    limit_threads()
    everything: list[Result] = []
    with Table("registration-people", COLUMNS, given.keep, COLUMNS[-1:]) as table:
        for name, makers in ROWS.items():
            if not wanted(name, given.only):
                continue
            results = [register(make()) for make in list(makers())[:: given.every]]
            trusted = [result for result in results if result.confidence >= TRUSTED]
            right, wrong = (sum(one.error < RIGHT for one in results), sum(one.error >= RIGHT for one in trusted))
            median, seconds = (np.median([one[k] for one in results]) for k in (0, 2))
            counts = (len(results), right, f"{median:.1f}", len(trusted), wrong, f"{seconds:.1f} s")
            table.add(name, *map(str, counts))
            everything += results
    with Table("registration-confidence", ["confidence", "maps", "right"], given.keep) as table:
        for low, high in itertools.pairwise(CONFIDENCES):
            errors = [one.error for one in everything if low <= one.confidence < high]
            share = f"{100 * np.mean([e < RIGHT for e in errors]):.0f} %" if errors else "-"
            table.add(f"{low:.2f} to {min(high, 1):.2f}", str(len(errors)), share)


if __name__ == "__main__":
    main()
