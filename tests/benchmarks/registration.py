"""How well meshes are registered whose truth is known.

    python tests/benchmarks/registration.py [--parts poses pairs middle] [--n-pairs 12]
    python tests/benchmarks/registration.py --across [--only TEXT ...]
    python tests/benchmarks/registration.py --holes [--only TEXT ...]
    python tests/benchmarks/registration.py --picture docs/images/registration.png

The template is a pose decimated to 60 % of its vertices and shuffled; the target is another pose, turned, scaled and
moved, and often damaged. The truth of a template vertex is the point of the other pose with the same place in the same
face. Errors are in percent of the target's bounding-box diagonal: of a pair of poses the mean over the vertices, of an
in-between the mean distance to the one of the true connectivity, both ways. Mean and maximum are of trusted results.
Times are processor seconds of one thread. ``--across`` registers different subjects by eight landmarks and without, and
judges by other places; the woman in another connectivity is judged by all vertices. ``--holes`` cuts a part of the
surface out of the target, around four places of each body, once as it is, and once noisy and in millimetres: the error
of the vertices that the target has, over that of the same vertices without a hole, and the confidence of the others.
"""

import argparse
import contextlib
import itertools
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from functools import cache, partial
from pathlib import Path
from statistics import fmean
from typing import Any, NamedTuple

import numpy as np
from results import Table, add_keep, wanted
from scipy import sparse
from scipy.sparse import csgraph
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
from timing import limit_threads

import torch_modal as tm
from torch_modal.arrays import BoolArray, FloatArray, IntArray
from torch_modal.data.samples import sample_files
from torch_modal.geometry.connectivity import edge_graph
from torch_modal.geometry.decimation import decimate
from torch_modal.io.read import open_asset
from torch_modal.registration.report import Registration
from torch_modal.registration.surface import MeshSurface, drop_unreferenced

sys.path.insert(0, str(Path(__file__).parents[2] / "examples"))
from morph_animals import TIMES
from samples.animals import animal, galloping, held_out, tips
from samples.make_samples import hand
from samples.sculpt import sculpt

SHARED = Path(__file__).resolve().parents[2].parent / "shared" / "data"
BODIES = {
    "mh-hand": [SHARED / "mh-hand" / f"{n}.obj" for n in ("00-open", "01-half", "02-fist", "03-point", "04-spread")],
    "mh-woman": [SHARED / "mh-woman" / f"{n}.obj" for n in ("00-rest", "02-walk-a", "03-walk-b")],
    "creature": sample_files("creature"),
}
DAMAGES = ("none", "hole", "noise", "cut off", "slit", "non-manifold")
KEPT = 0.6
WRONG = 3.0  # percent
COLUMNS = ["", "pairs", "doubtful", "trusted, but off by 3 %", "error, mean", "at most", "time, mean"]
FINGERS = ("thumb", "index", "middle", "ring", "little")
HOLES = {
    "mh-hand": (0, 1, (1541, 850, 178, 358)),  # the wrist, two finger tips, the back
    "mh-woman": (0, 1, (881, 2122, 6161, 1528)),  # the head, a hand, a foot, the chest
    "creature": (0, 1, (1364, 3779, 0, 2332)),  # two feet, the head, the back
}
"""Template's and target's pose, and the vertices around which a part of the surface is missing."""
CUT_OUT = (0.0, 0.05, 0.1, 0.2)
FINE_NOISE = 0.001  # standard deviation of a coordinate, in diagonals
HAND_LANDMARKS = (850, 29, 221, 416, 605, 1500, 1291, 1267)
"""Of mh-hand, where `own_hand` has its places; all are among the suggestions."""


@cache
def poses(name: str) -> tuple[FloatArray, IntArray]:
    """All poses of a body. *Shape:* ``(K, V, 3), (F, 3)``."""
    meshes = [(asset.positions, asset.faces) for asset in map(open_asset, BODIES[name])]
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
    surface, _ = drop_unreferenced(vertices, faces)
    return surface.vertices, surface.faces


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


def without_part(vertices: FloatArray, faces: IntArray, at: int, share: float) -> BoolArray:
    """Faces that are left without a share of the area, the nearest to a vertex along the edges. *Shape:* ``(F,)``."""
    surface = MeshSurface(vertices, faces)
    distances = csgraph.dijkstra(edge_graph(vertices, surface.edges), indices=at)[faces].mean(1)
    order = np.argsort(distances)
    kept: BoolArray = np.empty(len(faces), dtype=bool)
    kept[order] = np.cumsum(surface.face_areas[order]) > share * surface.area
    return kept


class Hole(NamedTuple):
    """A registration to a target that misses a part."""

    errors: FloatArray
    """Of the template's vertices, in percent of the whole target's diagonal. *Shape:* ``(V,)``."""
    there: BoolArray
    """The vertices that the target has. *Shape:* ``(V,)``."""
    found: Registration


@cache
def with_hole(name: str, at: int, share: float, noisy: bool) -> Hole:
    """Register a body to another pose of it without a part, that may be noisy and in millimetres."""
    i, j, _ = HOLES[name]
    random = np.random.default_rng(17)
    shapes, faces = poses(name)
    rest, triangles = remeshed(shapes[i], faces, random)
    size = float(np.linalg.norm(np.ptp(shapes[j], axis=0)))
    turn = Rotation.random(rng=random).as_matrix()
    first, kept = MeshSurface(shapes[i], faces), without_part(shapes[j], faces, at, share)
    closest = first.closest(rest)
    truth, there = first.rows(closest) @ shapes[j] @ turn.T, shapes[j] @ turn.T
    if noisy:
        there, truth = 1000 * (there + FINE_NOISE * size * random.normal(size=there.shape)), 1000 * truth
        size *= 1000
    target, _ = drop_unreferenced(there, faces[kept])
    found, _ = registered(rest, triangles, target.vertices, target.faces)
    assert found is not None
    errors = 100 / size * np.linalg.norm(found.positions.numpy() - truth, axis=1)
    return Hole(errors, kept[closest.faces], found)


def holes(only: Iterable[str], table: Table) -> None:
    """Rows of bodies with 0 to 20 % of their surface cut out: a number for each place."""
    for name, noisy, share in itertools.product(HOLES, (False, True), CUT_OUT):
        label = f"{name}, noisy" if noisy else name
        if not wanted(f"{label}, {share:.0%}", only):
            continue
        places = HOLES[name][2] if share else HOLES[name][2][:1]
        results = [with_hole(name, at, share, noisy) for at in places]
        if share:
            whole = with_hole(name, places[0], 0.0, noisy).errors
            errors = [f"{one.errors[one.there].mean() / whole[one.there].mean():.2f}" for one in results]
        else:
            errors = [f"{results[0].errors.mean():.2f} %"]
        low = [(one.found.vertex_confidence.numpy() < 0.5, one.there) for one in results]
        missing = [f"{part[~there].mean():.0%}" if share else "-" for part, there in low]
        left = [f"{part[there].mean():.0%}" for part, there in low]
        lacking = [f"{one.found.unsupported_area:.0%}" for one in results]
        warned = sum(any("no counterpart" in line for line in one.found.warnings) for one in results)
        table.add(label, f"{share:.0%}", *map(" ".join, (errors, missing, left, lacking)), f"{warned} of {len(places)}")


class Result(NamedTuple):
    """A registration against its truth."""

    errors: list[float]
    """In percent."""
    trusted: bool
    seconds: float


def registered(*meshes: Any, **options: Any) -> tuple[Registration | None, float]:
    """A registration, unless it is refused, and its seconds."""
    started, found = time.process_time(), None
    with contextlib.suppress(tm.MeshError):
        found = tm.register(*meshes, cache=False, progress=False, **options)
    return found, time.process_time() - started


def one(name: str, i: int, j: int, how: str, seed: int) -> Result:
    """Two poses."""
    rest, triangles, there, there_faces, truth, size = pair(name, i, j, how, seed)
    found, seconds = registered(rest, triangles, there, there_faces)
    if found is None:
        return Result([], False, seconds)
    error = 100 / size * np.linalg.norm(found.positions.numpy() - truth, axis=1).mean()
    return Result([float(error)], found.confidence >= 0.5, seconds)


def pose_cases() -> Iterator[tuple[str, int, int, str, int]]:
    """Whole bodies."""
    for name, pairs in (
        ("mh-hand", [(0, 1), (0, 2), (2, 0), (0, 3), (3, 4), (1, 2)]),
        ("mh-woman", [(0, 1), (1, 2), (2, 0)]),
        ("creature", [(0, 1), (1, 2), (2, 5), (4, 2), (5, 1), (3, 0)]),
    ):
        for i, j in pairs:
            yield name, i, j, "none", 10 * i + j


def random_cases(n: int) -> Iterator[tuple[str, int, int, str, int]]:
    """Random pairs of poses, with each flaw in turn."""
    random = np.random.default_rng(7)
    for k in range(n):
        name = list(BODIES)[random.integers(len(BODIES))]
        i, j = random.permutation(len(BODIES[name]))[:2]
        yield name, int(i), int(j), DAMAGES[k % len(DAMAGES)], 1000 + k


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


Subjects = tuple[MeshSurface, MeshSurface, FloatArray, FloatArray]
"""The template, the target, and the same places on both: first those that are landmarks."""


def animals(times: dict[str, float] | None, there: str = "stout") -> Subjects:
    """One of the animals on the other, standing or at times of their strides."""
    found = []
    for kind in ("slender", "stout"):
        rest, faces, cones = animal(kind)
        surface = MeshSurface(rest, faces)
        rows = surface.rows(surface.closest(np.concatenate([tips(cones), held_out(cones)])))
        x = rest if times is None else galloping(kind, times[kind])
        found.append((surface.with_vertices(x), rows @ x))
    (here, places), (other, its_places) = found if there == "stout" else found[::-1]
    return here, other, places, its_places


def hands(pose: int) -> Subjects:
    """The sample's hand on one of another maker, judged by the webs between the fingers."""
    first, faces, places = own_hand()
    shapes, other_faces = poses("mh-hand")
    here, there = MeshSurface(first, faces), MeshSurface(shapes[0], other_faces)
    marks = np.stack([cKDTree(first).query(places)[1], HAND_LANDMARKS], axis=1)
    webs = [
        [web(s, p) for s, p in zip((here, there), zip(*pair, strict=True), strict=True)]
        for pair in itertools.pairwise(marks[1:5].tolist())
    ]
    own, its = np.concatenate([marks, webs]).T
    return here, there.with_vertices(shapes[pose]), first[own], shapes[pose][its]


def woman() -> Subjects:
    """A woman on herself, with other vertices and faces."""
    case = pair("mh-woman", 0, 0, "none", 5)
    surface = MeshSurface(case.rest, case.triangles)
    return surface, MeshSurface(case.there, case.there_faces), case.rest, case.truth


SUBJECTS: dict[str, Callable[[], Subjects]] = {
    "slender on stout animal": lambda: animals(None),
    "stout on slender animal, in the strides of Figure 8": lambda: animals(TIMES, "slender"),
    "hand on a hand of another maker": lambda: hands(0),
    "woman on herself": woman,
}


def across(only: Iterable[str], table: Table) -> None:
    """Bodies of two subjects, by landmarks and without: errors of places that are no landmarks."""
    for name, subjects in SUBJECTS.items():
        if not wanted(name, only):
            continue
        here, there, places, its_places = subjects()
        n = 8 if len(places) < len(here.vertices) else 0
        for marks in (np.stack([places[:n], its_places[:n]], axis=1), None) if n else (None,):
            meshes = here.vertices, here.faces, there.vertices, there.faces
            found, _ = registered(*meshes, landmarks=marks, same_subject=False)
            assert found is not None
            at = here.rows(here.closest(places[n:])) @ found.positions.numpy()
            errors = 100 / there.diagonal * np.linalg.norm(at - its_places[n:], axis=1)
            shown = f"{errors.mean():.2f} %", f"{errors.max():.2f} %", f"{found.confidence:.2f}"
            table.add(name, "none" if marks is None else str(n), *shown)


def middle(name: str, i: int, j: int) -> Result:
    """The in-between of a registered pair against that of the true connectivity."""
    shapes, faces = poses(name)
    rest, triangles = remeshed(shapes[i], faces, np.random.default_rng(0))
    found, seconds = registered(rest, triangles, shapes[j], faces)
    assert found is not None
    halves = [
        tm.interpolate(np.stack(pair), f, 1, progress=False)[1].numpy()
        for pair, f in (((rest, found.positions.numpy()), triangles), ((shapes[i], shapes[j]), faces))
    ]
    mine, true = MeshSurface(halves[0], triangles), MeshSurface(halves[1], faces)
    apart = [a.closest(b.vertices).distances.mean() for a, b in ((true, mine), (mine, true))]
    return Result([float(100 / true.diagonal * max(apart))], found.confidence >= 0.5, seconds)


def parts(n_pairs: int) -> dict[str, tuple[str, Iterable[Callable[[], Result]]]]:
    """Lines of the table, and what each is made of."""
    middles = (("mh-hand", 0, 1), ("mh-woman", 1, 2), ("creature", 1, 5))
    return {
        "poses": ("whole poses, no landmarks", (partial(one, *case) for case in pose_cases())),
        "pairs": ("random poses, no landmarks", (partial(one, *case) for case in random_cases(n_pairs))),
        "middle": ("in-between of a registered pair", (partial(middle, *case) for case in middles)),
    }


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
    )


def main() -> None:
    """Print and keep the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--parts", nargs="*", default=list(parts(0)), choices=list(parts(0)))
    parser.add_argument("--n-pairs", type=int, default=12)
    parser.add_argument("--across", action="store_true", help="different subjects instead")
    parser.add_argument("--holes", action="store_true", help="targets that miss a part instead")
    parser.add_argument(
        "--only", nargs="+", default=[""], metavar="TEXT", help="subjects whose names hold one of these"
    )
    parser.add_argument("--picture", type=Path, help="only draw three examples there")
    add_keep(parser)
    given = parser.parse_args()
    limit_threads()
    if given.picture:
        picture(given.picture)
        return
    if given.holes:
        columns = ["", "cut out", "error of what is there over the whole's", "missing, below 0.5", "there, below 0.5"]
        columns += ["without a counterpart", "warned"]
        check = "--holes --only 'mh-hand, 0%'"
        with Table("registration-holes", columns, given.keep, check=check, labels=2) as table:
            holes(given.only, table)
        return
    if given.across:
        columns = ["", "landmarks", "error, mean", "at most", "confidence"]
        check = "--across --only 'woman on herself'"
        with Table("registration-across", columns, given.keep, check=check, labels=2) as table:
            across(given.only, table)
        return
    with Table("registration", COLUMNS, given.keep, COLUMNS[-1:], "--parts middle") as table:
        for part in given.parts:
            name, tasks = parts(given.n_pairs)[part]
            results = [task() for task in tasks]
            errors = [result.errors for result in results if result.trusted]
            wrong = sum(max(own) > WRONG for own in errors)
            every = list(itertools.chain(*errors)) or [float("nan")]
            numbers = [len(results), len(results) - len(errors), wrong]
            seconds = fmean(result.seconds for result in results)
            table.add(name, *map(str, numbers), f"{fmean(every):.2f} %", f"{max(every):.2f} %", f"{seconds:.1f} s")


if __name__ == "__main__":
    main()
