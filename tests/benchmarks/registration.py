"""How well meshes are registered whose truth is known: the table of docs/registration.md.

    python tests/benchmarks/registration.py [--parts poses pairs across middle time] [--n-pairs 50]
    python tests/benchmarks/registration.py --picture docs/images/registration.png

The template is a pose decimated to 60 % of its vertices and shuffled; the target is another pose, turned, scaled and
moved, and often damaged. The truth of a template vertex is the point of the other pose with the same place in the same
face. Lengths are in percent of the target's bounding-box diagonal. Times are processor seconds of one thread.
"""

import argparse
import itertools
import json
import sys
import time
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy import sparse
from scipy.sparse import csgraph
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

import torch_modal as tm
from torch_modal.arrays import FloatArray, IntArray
from torch_modal.data.samples import sample_files
from torch_modal.geometry.decimation import decimate
from torch_modal.io.read import read_mesh
from torch_modal.registration.maps import SpectralShape
from torch_modal.registration.surface import MeshSurface, referenced

sys.path.insert(0, str(Path(__file__).parents[2] / "examples"))
from _animals import animal, held_out, tips
from _sculpt import sculpt
from make_samples import hand

SHARED = Path(__file__).parents[2].parent / "shared" / "data"
BODIES = {
    "mh-hand": [SHARED / "mh-hand" / f"{n}.obj" for n in ("00-open", "01-half", "02-fist", "03-point", "04-spread")],
    "mh-woman": [SHARED / "mh-woman" / f"{n}.obj" for n in ("00-rest", "02-walk-a", "03-walk-b")],
    "creature": sample_files("creature"),
}
DAMAGES = ("none", "hole", "noise", "cut off", "slit", "non-manifold")
KEPT = 0.6
WRONG = 3.0  # percent
FINGERS = ("thumb", "index", "middle", "ring", "little")
HAND_LANDMARKS = (850, 29, 221, 416, 605, 1500, 1291, 1267)
"""Of mh-hand, where `own_hand` has its places; all are among the suggestions."""


@cache
def poses(name: str) -> tuple[FloatArray, IntArray]:
    """All poses of a body. *Shape:* ``(K, V, 3), (F, 3)``."""
    meshes = [read_mesh(path) for path in BODIES[name]]
    return np.stack([vertices for vertices, _ in meshes]), meshes[0][1]


def remeshed(
    vertices: FloatArray, faces: IntArray, random: np.random.Generator, kept: float = KEPT
) -> tuple[FloatArray, IntArray]:
    """Decimated, with vertices and faces in random order."""
    points, triangles, _ = decimate(vertices, faces, int(kept * len(faces)))
    order = random.permutation(len(points))
    number = np.argsort(order)
    return points[order], number[triangles][random.permutation(len(triangles))]


def transported(points: FloatArray, source: FloatArray, target: FloatArray, faces: IntArray) -> FloatArray:
    """The points of another pose at the same places."""
    surface = MeshSurface(source, faces)
    return surface.rows(surface.closest(points)) @ target


def damaged(
    vertices: FloatArray, faces: IntArray, how: str, random: np.random.Generator
) -> tuple[FloatArray, IntArray]:
    """A target with a flaw."""
    size = np.linalg.norm(np.ptp(vertices, axis=0))
    centres = vertices[faces].mean(1)
    if how == "noise":
        return vertices + 0.003 * size * random.normal(size=vertices.shape), faces
    if how == "hole":
        at = centres[random.integers(len(faces))]
        faces = faces[np.linalg.norm(centres - at, axis=1) > 0.06 * size]
    elif how == "cut off":
        along = centres @ (lambda d: d / np.linalg.norm(d))(random.normal(size=3))
        faces = faces[along > np.quantile(along, 0.12)]
    elif how == "slit":
        at, axis = centres[random.integers(len(faces))], random.normal(size=3)
        near = np.linalg.norm(centres - at, axis=1) < 0.15 * size
        faces = faces[~(near & (np.abs((centres - at) @ axis / np.linalg.norm(axis)) < 0.01 * size))]
    elif how == "non-manifold":
        fins = faces[random.permutation(len(faces))[:20]]
        tops = vertices[fins].mean(1) + 0.02 * size * random.normal(size=(20, 3))
        new = np.column_stack([fins[:, :2], len(vertices) + np.arange(20)])
        vertices, faces = np.concatenate([vertices, tops]), np.concatenate([faces, new])
    surface, _ = referenced(vertices, faces)
    return surface.vertices, surface.faces


def five_marks(rest: FloatArray, faces: IntArray, truth: FloatArray) -> FloatArray:
    """Five points spread over the template, and where they belong: what a person would pick. *Shape:* ``(5, 2, 3)``."""
    surface = MeshSurface(rest, faces)
    shape = SpectralShape(surface)
    chosen = surface.nearest_alike(shape.placed.vertices, shape.coarse.vertex_normals)[shape.farthest_points(5)[0]]
    return np.stack([rest[chosen], truth[chosen]], axis=1)


class Case(NamedTuple):
    """Two meshes to be registered, and the truth."""

    rest: FloatArray
    triangles: IntArray
    there: FloatArray
    there_faces: IntArray
    truth: FloatArray
    """Of the template's vertices. *Shape:* ``(V, 3)``."""
    size: float
    """Diagonal of the whole target."""


def pair(name: str, i: int, j: int, how: str, seed: int) -> Case:
    """Two poses of a body, the second with a flaw."""
    random = np.random.default_rng(seed)
    shapes, faces = poses(name)
    rest, triangles = remeshed(shapes[i], faces, random)
    truth = transported(rest, shapes[i], shapes[j], faces)
    there, there_faces = damaged(shapes[j], faces, how, random)
    rotation, scale = Rotation.random(rng=random).as_matrix(), random.uniform(0.3, 3)
    shift = scale * random.normal(size=3)
    there, truth = (scale * p @ rotation.T + shift for p in (there, truth))
    return Case(rest, triangles, there, there_faces, truth, float(scale * np.linalg.norm(np.ptp(shapes[j], axis=0))))


def one(name: str, i: int, j: int, how: str, seed: int, marked: bool) -> dict[str, Any]:
    """One registration against its truth."""
    rest, triangles, there, there_faces, truth, size = pair(name, i, j, how, seed)
    marks = five_marks(rest, triangles, truth) if marked else None
    row: dict[str, Any] = {"case": f"{name} {i}-{j}", "how": how, "marked": marked, "vertices": len(rest)}
    started = time.process_time()
    try:
        found = tm.register(rest, triangles, there, there_faces, landmarks=marks, cache=False, progress=False)
    except tm.MeshError as error:
        return row | {"error": str(error)}
    seconds = time.process_time() - started
    errors = 100 / size * np.linalg.norm(found.positions.numpy() - truth, axis=1)
    return row | {
        "mean": errors.mean(),
        "p95": np.percentile(errors, 95),
        "confidence": found.confidence,
        "score": found.map_score,
        "distortion": found.distortion,
        "stretch": found.stretch,
        "to": found.to_target.mean,
        "from": found.from_target.mean,
        "flipped": found.flipped_area,
        "seconds": seconds,
    }


def pose_cases() -> Iterator[tuple[str, int, int, str, int, bool]]:
    """Whole bodies, without landmarks."""
    for name, pairs in (
        ("mh-hand", [(0, 1), (0, 2), (2, 0), (0, 3), (3, 4), (1, 2)]),
        ("mh-woman", [(0, 1), (1, 2), (2, 0)]),
        ("creature", [(0, 1), (1, 2), (2, 5), (4, 2), (5, 1), (3, 0)]),
    ):
        for i, j in pairs:
            yield name, i, j, "none", 10 * i + j, False


def random_cases(n: int) -> Iterator[tuple[str, int, int, str, int, bool]]:
    """Random pairs of poses, with each flaw in turn."""
    random = np.random.default_rng(7)
    for k in range(n):
        name = list(BODIES)[random.integers(len(BODIES))]
        i, j = random.permutation(len(BODIES[name]))[:2]
        yield name, int(i), int(j), DAMAGES[k % len(DAMAGES)], 1000 + k, False


def own_hand() -> tuple[FloatArray, IntArray, FloatArray]:
    """The hand of the samples, sculpted without its wrist, which the other hand has not; and eight places on it.

    The tips from thumb to little finger, the palm, the side below the little finger, and the back below the middle one.
    """
    _, cones = hand()
    vertices, faces = sculpt(cones[1:], 0.024)
    ends = [[cone for cone in cones if cone.bone == f"{name}3"][-1] for name in FINGERS]
    tips = [np.array(c.b) + c.rb * np.subtract(c.b, c.a) / np.linalg.norm(np.subtract(c.b, c.a)) for c in ends]
    places = np.array([*tips, (0.02, 0.335, 0.08), (-0.20, 0.40, 0.01), (-0.03, 0.475, -0.07)])
    return vertices, faces, places


def web(surface: MeshSurface, tips: tuple[int, int]) -> int:
    """Where the shortest way along edges from one finger tip to another is farthest from both: between the fingers."""
    i, j = surface.edges.T
    lengths = np.linalg.norm(surface.vertices[i] - surface.vertices[j], axis=1)
    graph = sparse.csr_matrix((lengths, (i, j)), shape=(len(surface.vertices),) * 2)
    _, before = csgraph.dijkstra(graph, directed=False, indices=tips[0], return_predecessors=True)
    way = [tips[1]]
    while way[-1] != tips[0]:
        way.append(int(before[way[-1]]))
    away = np.linalg.norm(surface.vertices[way][:, None] - surface.vertices[list(tips)], axis=2).min(1)
    return way[int(away.argmax())]


def across() -> dict[str, Any]:
    """An animal on one of other proportions and tessellation, by eight landmarks; other places are held out."""
    (first, first_faces, cones), (second, second_faces, second_cones) = animal("slender"), animal("stout")
    here, there = MeshSurface(first, first_faces), MeshSurface(second, second_faces)
    marks = np.stack([here.closest(tips(cones)).points, there.closest(tips(second_cones)).points], axis=1)
    others, places = here.closest(held_out(cones)), there.closest(held_out(second_cones)).points
    return laid("slender animal on stout animal", here, there, marks, lambda x: here.rows(others) @ x - places)


def across_hands() -> dict[str, Any]:
    """A hand on a hand of another maker, eight landmarks; the webs between the four fingers are held out."""
    first, first_faces, places = own_hand()
    second, second_faces = (part[0] if part.ndim == 3 else part for part in poses("mh-hand"))
    here, there = MeshSurface(first, first_faces), MeshSurface(second, second_faces)
    marks = np.stack([cKDTree(first).query(places)[1], HAND_LANDMARKS], axis=1)
    pairs = [(web(here, (a[0], b[0])), web(there, (a[1], b[1]))) for a, b in itertools.pairwise(marks[1:5])]
    own, others = (list(column) for column in zip(*pairs, strict=True))
    return laid("sample hand on mh-hand", here, there, marks, lambda x: x[own] - second[others])


def laid(
    case: str, here: MeshSurface, there: MeshSurface, marks: Any, off: Callable[[FloatArray], FloatArray]
) -> dict[str, Any]:
    """A registration across subjects, with the distances of what is held out."""
    started = time.process_time()
    meshes = here.vertices, here.faces, there.vertices, there.faces
    found = tm.register(*meshes, landmarks=marks, same_subject=False, cache=False, progress=False)
    seconds = time.process_time() - started
    return {
        "case": case,
        "vertices": len(here.vertices),
        "to": found.to_target,
        "from": found.from_target,
        "flipped": found.flipped_area,
        "folds": found.folds,
        "held out": (100 / there.diagonal * np.linalg.norm(off(found.positions.numpy()), axis=1)).tolist(),
        "landmarks": found.landmark_errors.tolist(),
        "confidence": found.confidence,
        "seconds": seconds,
    }


def middle(name: str, i: int, j: int) -> dict[str, Any]:
    """The in-between of a registered pair against that of the true connectivity."""
    shapes, faces = poses(name)
    rest, triangles = remeshed(shapes[i], faces, np.random.default_rng(0))
    found = tm.register(rest, triangles, shapes[j], faces, cache=False, progress=False)
    halves = [
        tm.subdivide(np.stack(pair), f, 1, progress=False)[1].numpy()
        for pair, f in (((rest, found.positions.numpy()), triangles), ((shapes[i], shapes[j]), faces))
    ]
    mine, true = MeshSurface(halves[0], triangles), MeshSurface(halves[1], faces)
    size = 100 / true.diagonal
    apart = [size * a.closest(b.vertices).distances for a, b in ((true, mine), (mine, true))]
    return {"case": f"{name} {i}-{j}", "mean": [a.mean() for a in apart], "max": [a.max() for a in apart],
            "confidence": found.confidence}  # fmt: skip


def timed(n_rounds: int, kept: float = KEPT) -> dict[str, Any]:
    """The woman, in faces cut into four as often as told and then decimated."""
    import trimesh

    shapes, faces = poses("mh-woman")
    both, triangles = np.concatenate([shapes[0], shapes[1]], axis=1), faces
    for _ in range(n_rounds):
        cut, triangles, new = trimesh.remesh.subdivide(both[:, :3], triangles, vertex_attributes={"o": both[:, 3:]})
        both = np.hstack([cut, new["o"]])
    rest, template = remeshed(both[:, :3], triangles, np.random.default_rng(0), kept)
    started = time.process_time()
    tm.register(rest, template, both[:, 3:], triangles, cache=False, progress=False)
    return {"case": f"{len(rest)} on {len(both)} vertices", "seconds": time.process_time() - started}


def tasks(part: str, n_pairs: int) -> list[Callable[[], dict[str, Any]]]:
    """What a part of the table is made of."""
    if part in ("poses", "pairs"):
        cases = pose_cases() if part == "poses" else random_cases(n_pairs)
        return [lambda case=case: one(*case) for case in cases]  # type: ignore[misc]
    if part == "across":
        return [across, across_hands]
    if part == "middle":
        pairs = (("mh-hand", 0, 1), ("mh-woman", 1, 2), ("creature", 1, 5))
        return [lambda pair=pair: middle(*pair) for pair in pairs]  # type: ignore[misc]
    return [lambda: timed(0), lambda: timed(1), lambda: timed(1, 0.785)]


def picture(out: Path) -> None:
    """The template, then laid onto another pose, and onto a gathered one in a mesh with a slit; above it the truth."""
    shapes, faces = poses("creature")
    case = pair("creature", 0, 3, "slit", 1004)
    truths = [transported(case.rest, shapes[0], shape, faces) for shape in shapes[[0, 1, 3]]]
    laid = [case.rest]
    for target, target_faces in ((shapes[1], faces), (case.there, case.there_faces)):
        found = tm.register(case.rest, case.triangles, target, target_faces, cache=False, progress=False)
        print(found.summary())
        laid.append(found.positions.numpy())
    # The last target is turned, scaled and moved: back again.
    turned, upright = (x - x.mean(0) for x in (case.truth, truths[2]))
    back = Rotation.align_vectors(upright, turned)[0]
    laid[2] = back.apply(laid[2] - case.truth.mean(0)) * np.linalg.norm(upright) / np.linalg.norm(turned)
    laid[2] += truths[2].mean(0)
    size = [100 / np.linalg.norm(np.ptp(shape, axis=0)) for shape in shapes[[0, 1, 3]]]
    errors = [k * np.linalg.norm(x - y, axis=1) for k, x, y in zip(size, laid, truths, strict=True)]
    print("mean errors:", " ".join(f"{error.mean():.2f}" for error in errors))
    tm.render_sequence(
        {"true": np.stack(truths), "registered": np.stack(laid)},
        case.triangles,
        out,
        keyframe_indices=[0],
        colors={"registered": np.stack(errors)},
        color_label="error, % of the diagonal",
        overwrite=True,
    )


def main() -> None:
    """Run parts and print their rows, and a summary of all."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--parts", nargs="*", default=["poses", "pairs", "across", "middle", "time"])
    parser.add_argument("--n-pairs", type=int, default=50)
    parser.add_argument("--picture", type=Path, help="only draw three examples there")
    args = parser.parse_args()
    if args.picture:
        picture(args.picture)
        return
    rows = []
    for part in args.parts:
        for task in tasks(part, args.n_pairs):
            rows.append({"part": part, **task()})
            print(json.dumps(rows[-1], default=float), flush=True)
    print("\n".join(table(rows)))


def table(rows: list[dict[str, Any]]) -> list[str]:
    """The lines of the summary."""
    lines = []
    for part in ("poses", "pairs"):
        own = [row for row in rows if row["part"] == part]
        if not own:
            continue
        results = [row for row in own if "error" not in row]
        trusted = [row for row in results if row["confidence"] >= 0.5]
        whole = [row for row in trusted if row["how"] != "cut off"]
        lines.append(
            f"{part}: {len(own)} pairs, {len(own) - len(results)} errors, {len(results) - len(trusted)} doubtful, "
            f"{sum(row['mean'] > WRONG for row in results)} beyond {WRONG:g} %, of these trusted "
            f"{sum(row['mean'] > WRONG for row in trusted)}"
        )
        if trusted:
            means, tails = ([row[key] for row in whole] for key in ("mean", "p95"))
            lines.append(
                f"  trusted whole ones: mean {np.mean(means):.2f} %, worst {max(means):.2f} %; 95th percentile "
                f"{np.mean(tails):.2f} %, worst {max(tails):.2f} %; {sum(m > 1.3 for m in means)} of {len(whole)} "
                "above 1.3 %"
            )
    return lines


if __name__ == "__main__":
    main()
