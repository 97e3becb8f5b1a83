"""How well one body is registered to another one's shape, by landmarks and without.

    python tests/benchmarks/across.py [--only TEXT ...]

Animals have eight landmarks, and thirteen places to judge by; hands have eight and three. The woman in another
connectivity is taken for another subject, and judged by all vertices. Errors are in per cent of the target's diagonal.
"""

import argparse
import itertools
from collections.abc import Callable
from typing import Any

import numpy as np
import registration as cases
from _animals import animal, galloping, held_out, tips
from morph_animals import TIMES
from results import Table, add_keep, wanted
from scipy.spatial import cKDTree
from timing import limit_threads

import torch_modal as tm
from torch_modal.arrays import FloatArray
from torch_modal.registration.surface import MeshSurface

COLUMNS = ["", "landmarks", "error, mean", "at most", "confidence"]
Pair = tuple[MeshSurface, MeshSurface, FloatArray, FloatArray]
"""The template, the target, and the same places on both: first those that are landmarks."""


def animals(times: dict[str, float] | None, there: str = "stout") -> Pair:
    """One of the animals on the other, standing or at times of their strides."""
    found = []
    for kind in ("slender", "stout"):
        rest, faces, cones = animal(kind)
        surface = MeshSurface(rest, faces)
        rows = surface.rows(surface.closest(np.concatenate([tips(cones), held_out(cones)])))
        x = rest if times is None else galloping(kind, times[kind])
        found.append((surface.moved(x), rows @ x))
    (here, places), (other, its_places) = found if there == "stout" else found[::-1]
    return here, other, places, its_places


def hands(pose: int) -> Pair:
    """The sample's hand on one of another maker, judged by the webs between the fingers."""
    first, faces, places = cases.own_hand()
    shapes, other_faces = cases.poses("mh-hand")
    here, there = MeshSurface(first, faces), MeshSurface(shapes[0], other_faces)
    marks = np.stack([cKDTree(first).query(places)[1], cases.HAND_LANDMARKS], axis=1)
    webs = [
        [cases.web(s, p) for s, p in zip((here, there), zip(*pair, strict=True), strict=True)]
        for pair in itertools.pairwise(marks[1:5].tolist())
    ]
    own, its = np.concatenate([marks, webs]).T
    return here, there.moved(shapes[pose]), first[own], shapes[pose][its]


def woman() -> Pair:
    """A woman on herself, with other vertices and faces."""
    case = cases.pair("mh-woman", 0, 0, "none", 5)
    surface = MeshSurface(case.rest, case.triangles)
    return surface, MeshSurface(case.there, case.there_faces), case.rest, case.truth


PAIRS: dict[str, Callable[[], Pair]] = {
    "slender on stout animal": lambda: animals(None),
    "the same in the strides of Figure 8": lambda: animals(TIMES),
    "stout on slender animal, the same strides": lambda: animals(TIMES, "slender"),
    "hand on a hand of another maker": lambda: hands(0),
    "hand on the same, half closed": lambda: hands(1),
    "woman on herself": woman,
}


def main() -> None:
    """Print and keep the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="+", default=[""], metavar="TEXT", help="pairs whose names hold one of these")
    add_keep(parser)
    given = parser.parse_args()
    limit_threads()
    with Table("registration-across", COLUMNS, given.keep, check="--only 'slender on stout'", labels=2) as table:
        for name, pair in PAIRS.items():
            if not wanted(name, given.only):
                continue
            here, there, own, its = pair()
            n = 8 if len(own) < len(here.vertices) else 0
            for marks in (np.stack([own[:n], its[:n]], axis=1), None) if n else (None,):
                meshes: tuple[Any, ...] = here.vertices, here.faces, there.vertices, there.faces
                found = tm.register(*meshes, landmarks=marks, same_subject=False, cache=False, progress=False)
                at = here.rows(here.closest(own[n:])) @ found.positions.numpy()
                errors = 100 / there.diagonal * np.linalg.norm(at - its[n:], axis=1)
                shown = f"{errors.mean():.2f} %", f"{errors.max():.2f} %", f"{found.confidence:.2f}"
                table.add(name, "none" if marks is None else str(n), *shown)


if __name__ == "__main__":
    main()
