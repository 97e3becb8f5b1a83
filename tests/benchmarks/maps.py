"""Meshes registered in pairs, scored as papers on maps between surfaces score them.

    python tests/benchmarks/maps.py FOLDER [--same-subject] [--only TEXT ...] [--every 1]

The folder is a benchmark of remeshed bodies: the meshes are ``vtx_5k/NAME.off``. A row of ``corres/NAME.vts``, in the
folder or in ``vtx_5k``, is a vertex of the mesh, counted from 1, and is the same place of all bodies; in
``corres/NAME.sym.vts`` it is the place on the other side of the body. A row of ``test_pairs.txt`` names a template and
a target. ``register`` gets no landmarks, and with ``--same-subject`` takes all pairs for poses of one body.

An error is the mean distance along the target from the true places, in percent of the root of the target's area, over
1,000 of the places (all, where there are fewer):

- direct: from the places on the same side of the body;
- best side: from those of the same or of the other side, whichever is nearer in the mean of the map;
- best side of vertices: whichever is nearer at each place.

A map is wrong if its best side is off by 10 % or more; it is mirrored if the best side is right and the direct one is
off by so much. Both are counted among the trusted ones. The published numbers, of the pairs across species, are
from the papers of other methods, in ascending order, and were not measured here. A refused pair is printed, and is in
no mean. Seconds are of one processor.
"""

import argparse
import sys
import time
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from people import RIGHT, lengths
from results import Table, add_keep, wanted
from timing import limit_threads

import torch_modal as tm
from torch_modal.arrays import FloatArray, IntArray
from torch_modal.registration.report import TRUSTED
from torch_modal.registration.surface import MeshSurface

N_PLACES = 1000
COLUMNS = ["", "pairs", "direct, %", "best side, %", "best side of vertices, %"]
COLUMNS += ["trusted", "wrong, of these", "mirrored, of these", "s"]
PUBLISHED = "13.4, 26.2, 27.7"
"""Errors of other methods, across species."""


class Body(NamedTuple):
    """A mesh, and the vertices at the common places on the same and on the other side. *Shape:* ``(n,)`` each."""

    surface: MeshSurface
    direct: IntArray
    other: IntArray


class Score(NamedTuple):
    """Errors of a map in percent, and its confidence."""

    direct: float
    best: float
    best_of_vertices: float
    confidence: float
    seconds: float


def read_pairs(folder: Path) -> list[tuple[str, str]]:
    """Names of templates and targets."""
    listed = folder / "test_pairs.txt"
    if not listed.is_file():
        raise SystemExit(f"{listed}: no such file; it names a template and a target in each row")
    rows = [line.replace(",", " ").split() for line in listed.read_text().splitlines() if line.strip()]
    if not rows or any(len(row) != 2 for row in rows):
        raise SystemExit(f"{listed}: each row must have two names")
    return [(first.removesuffix(".off"), second.removesuffix(".off")) for first, second in rows]


def read_places(folder: Path, name: str, n_vertices: int) -> IntArray:
    """Vertices at the common places, counted from 0. *Shape:* ``(n,)``."""
    files = [path for path in (folder / "corres" / name, folder / "vtx_5k" / "corres" / name) if path.is_file()]
    if not files:
        raise SystemExit(f"{folder} has neither corres/{name} nor vtx_5k/corres/{name}")
    try:
        places = np.loadtxt(files[0], dtype=np.int64, ndmin=1) - 1
    except ValueError as error:
        raise SystemExit(f"{files[0]}: {error}") from None
    if places.ndim != 1 or not len(places) or places.min() < 0 or places.max() >= n_vertices:
        raise SystemExit(f"{files[0]}: each row must be a vertex from 1 to {n_vertices}")
    return places


def read_body(folder: Path, name: str) -> Body:
    """One body of the benchmark."""
    try:
        mesh = tm.open_asset(folder / "vtx_5k" / f"{name}.off")
    except (OSError, tm.MeshError) as error:
        raise SystemExit(str(error)) from None
    n = len(mesh.positions)
    direct, other = (read_places(folder, name + suffix, n) for suffix in (".vts", ".sym.vts"))
    if len(direct) != len(other):
        raise SystemExit(f"{name}: {len(direct)} places, but {len(other)} on the other side")
    return Body(MeshSurface(mesh.positions, mesh.faces), direct, other)


def errors(x: FloatArray, template: Body, target: Body) -> tuple[float, float, float]:
    """Errors of a template at positions on the target: direct, best side, best side of vertices.

    *Shape:* ``(V, 3)``.
    """
    if len(template.direct) != len(target.direct):
        raise SystemExit(f"the bodies of a pair have {len(template.direct)} and {len(target.direct)} places")
    at = np.random.default_rng(0).permutation(len(target.direct))[:N_PLACES]
    places = target.surface.closest(x[template.direct[at]]).points
    truths = target.surface.vertices[np.stack([target.direct[at], target.other[at]])]
    off = lengths(target.surface, places, truths)
    direct, other = off.mean(1)
    return float(direct), float(min(direct, other)), float(off.min(0).mean())


def score(folder: Path, names: tuple[str, str], same_subject: bool) -> Score:
    """Register one pair."""
    template, target = (read_body(folder, name) for name in names)
    (x, faces), goal = ((body.surface.vertices, body.surface.faces) for body in (template, target))
    start = time.process_time()
    found = tm.register(x, faces, *goal, same_subject=same_subject, cache=False, progress=False)
    seconds = time.process_time() - start
    return Score(*errors(found.positions.numpy(), template, target), found.confidence, seconds)


def cells(scores: Sequence[Score]) -> list[str]:
    """Means and counts over some maps."""
    trusted = [one for one in scores if one.confidence >= TRUSTED]
    wrong = sum(one.best >= RIGHT for one in trusted)
    mirrored = sum(one.direct >= RIGHT > one.best for one in trusted)
    means = np.mean([(*one[:3], one.seconds) for one in scores], 0) if scores else np.full(4, np.nan)
    *off, seconds = (f"{mean:.1f}" if scores else "-" for mean in means)
    return [str(len(scores)), *off, *map(str, (len(trusted), wrong, mirrored)), seconds]


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--same-subject", action="store_true", help="all pairs are poses of one body")
    parser.add_argument("--only", nargs="+", default=[""], metavar="TEXT", help="pairs whose names hold one of these")
    parser.add_argument("--every", type=int, default=1, help="every so many pairs")
    add_keep(parser)
    options = parser.parse_args()
    limit_threads()
    warnings.simplefilter("ignore")
    pairs = [pair for pair in read_pairs(options.folder) if wanted(" on ".join(pair), options.only)]
    if not pairs:
        raise SystemExit(f"no pair of test_pairs.txt holds one of {options.only}")
    scores: list[Score] = []
    with Table("maps", COLUMNS, options.keep, COLUMNS[-1:]) as table:
        for pair in pairs[:: options.every]:
            try:
                scores.append(score(options.folder, pair, options.same_subject))
            except tm.MeshError as error:
                print(f"{' on '.join(pair)} is refused: {error}", file=sys.stderr)
                continue
            table.add(" on ".join(pair), *cells(scores[-1:]))
        table.add("all", *cells(scores))
        table.add("trusted", *cells([one for one in scores if one.confidence >= TRUSTED]))
        table.add("published, across species", "-", "-", PUBLISHED, *["-"] * 5)


if __name__ == "__main__":
    main()
