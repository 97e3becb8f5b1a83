"""In-betweens half-way by this package, by linear interpolation and by other methods.

    python tests/benchmarks/quality.py [FOLDER ...] [--only TEXT ...] [--methods NAME ...] [--peer-python FILE]
    python tests/benchmarks/quality.py --bodies
    python tests/benchmarks/quality.py --presets

A folder holds the frames of a motion: the first and the last are the key-frames, the others the truth at their places.
Without one, pairs of the samples and of the data beside the repository are compared. *Edge error* is the mean of
``|l - l_true| / l_true`` over the edges where the middle is known, *energy* that of Eq. 5 against both key-frames, on
the fine mesh. Means are geometric, over the pairs that both methods have. Times are processor seconds of one call on
one thread. Morphomatics joins where it is installed (``pip install morphomatics``), or with ``--peer-python``.

``--bodies`` compares bodies in closed form (tests/helpers/bodies.py) with their true shapes. *Folds* are hinges bent by
more than a right angle beyond both key-frames. ``--presets`` compares the presets, on pairs of frames of animated
animals and on bodies that modes know better: *vertices* is the mean distance from the truth.
"""

import argparse
import sys
from collections.abc import Iterator
from itertools import chain
from pathlib import Path

import cases
import torch
from cases import HALF, Case
from error_pictures import draw_sheet
from measures import Yardstick
from methods import METHODS, Outcome, UnavailableError, add_peer
from results import Table, add_keep, geometric_mean, number, percent, wanted
from timing import limit_threads

FEW = ["hand-path", "hand 00/04", "woman 00/02", "face 00/01", "cube 1/2", "creature 1", "creature 2", "sample hand"]
BODIES = ["limb bent 120", "bar bent 360", "bar twisted 270", "bar twisted 360", "vessel bent 60", "gutter rolled 270"]
OURS = "accurate"
PRESETS = ["fast", "accurate", "modal"]


def half_way(case: Case, names: list[str]) -> dict[str, Outcome]:
    """What the methods that know this case give at t = 1/2."""
    found = {}
    for name in names:
        print(f"{case.name}, {name}", file=sys.stderr, flush=True)
        try:
            with torch.no_grad():
                found[name] = METHODS[name](case.at([HALF]))
        except (UnavailableError, ValueError, RuntimeError) as error:
            print(f"{case.name}, {name}: {error}", file=sys.stderr)
    return found


def chosen(folders: list[Path], only: list[str]) -> Iterator[Case]:
    """The cases that are compared."""
    given = chain.from_iterable(map(cases.folder, folders)) if folders else chain(cases.shared(), cases.samples())
    return (case for case in given if folders or wanted(case.name, only))


def compare(found: dict[Case, dict[str, Outcome]], table: Table) -> None:
    """Add a row for each pair and measure, and the means over the pairs."""
    methods = table.content["columns"][2:]
    edges, energies, times = {}, {}, {}
    for case, outcomes in found.items():
        yardstick = Yardstick(case)
        if HALF in case.truths:
            edges[case.name] = {name: yardstick.edge_error(x.frames[0], HALF) for name, x in outcomes.items()}
        energies[case.name] = {name: yardstick.energy(x.frames[0]) for name, x in outcomes.items()}
        times[case.name] = {name: x.seconds for name, x in outcomes.items()}
    for name, row in edges.items():
        table.add("edge error", name, *(percent(row[method]) if method in row else "-" for method in methods))
    for title, rows in (("edge error", edges), ("energy", energies), ("time", times)):
        if len(rows) > 1 and OURS in methods:
            table.add(f"{title} over {OURS}", f"mean of {len(rows)} pairs", *(mean(rows, method) for method in methods))


def mean(rows: dict[str, dict[str, float]], method: str) -> str:
    """Of the ratios to our own method."""
    return number(geometric_mean([row[method] / row[OURS] for row in rows.values() if method in row]), ".3g")


def compare_bodies(names: list[str], table: Table) -> None:
    """Add a row for each body."""
    for case in cases.bodies(names):
        yardstick, truth = Yardstick(case), case.truths[HALF]
        straight, own = (outcome.frames[0] for outcome in half_way(case, ["linear", OURS]).values())
        table.add(
            case.name,
            *(percent(yardstick.edge_error(x, HALF)) for x in (straight, own)),
            number(yardstick.energy(own) / yardstick.energy(truth), ".3f"),
            number(yardstick.volume(own) / yardstick.volume(truth), ".3f"),
            str(int(yardstick.folded(own).sum())),
        )


def compare_presets(table: Table) -> None:
    """Add a row for each measure, the mean over pairs of clips, and one for each body."""
    found = {measure: [] for measure in ("vertices", "edges", "energy of Eq. 5", "time")}
    for case in cases.clips():
        outcomes, yardstick, truth = half_way(case, PRESETS), Yardstick(case), case.truths[HALF]
        shapes = {name: outcome.frames[0] for name, outcome in outcomes.items()}
        rows = {
            "vertices": {
                name: float((yardstick.laid(x, truth) - truth).norm(dim=1).mean()) for name, x in shapes.items()
            },
            "edges": {name: yardstick.edge_error(x, HALF) for name, x in shapes.items()},
            "energy of Eq. 5": {name: yardstick.energy(x) for name, x in shapes.items()},
            "time": {name: outcome.seconds for name, outcome in outcomes.items()},
        }
        for measure, row in rows.items():
            found[measure].append([row[name] / row["modal"] for name in PRESETS])
    for measure, ratios in found.items():
        means = (number(geometric_mean(each), ".3f") for each in zip(*ratios, strict=True))
        table.add(f"{measure}, over `modal`", f"mean of {len(ratios)} pairs of clips", *means)
    for case in cases.bodies(BODIES):
        outcomes, yardstick = half_way(case, PRESETS), Yardstick(case)
        errors = (percent(yardstick.edge_error(x.frames[0], HALF)) for x in outcomes.values())
        table.add("edge error", case.name, *errors)


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folders", nargs="*", type=Path, metavar="FOLDER", help="frames of a motion, or two key-frames")
    parser.add_argument("--only", nargs="+", metavar="TEXT", help="cases with one of these in their names")
    parser.add_argument("--methods", nargs="+", choices=METHODS, default=list(METHODS), metavar="NAME")
    parser.add_argument("--bodies", action="store_true", help="bodies in closed form; --only names others")
    parser.add_argument("--presets", action="store_true", help="the presets on animated animals and on bodies")
    parser.add_argument("--sheet", type=Path, metavar="FILE.png", help="draw the shapes, coloured by their edge errors")
    add_peer(parser)
    add_keep(parser)
    given = parser.parse_args()
    limit_threads()
    if given.bodies:
        ratios = [f"{what} over the truth's" for what in ("energy", "volume")]
        columns = ["body", "edge error, linear", "edge error", *ratios, "folds"]
        with Table("bodies", columns, given.keep, check="--bodies --only 'limb bent 120'") as table:
            compare_bodies(given.only or BODIES, table)
        return
    if given.presets:
        heads = [f"`{name}`" for name in PRESETS]
        with Table("presets", ["", "of", *heads], given.keep, labels=2) as table:
            compare_presets(table)
        return
    found = {case: half_way(case, given.methods) for case in chosen(given.folders, given.only or FEW)}
    methods = [name for name in given.methods if any(name in outcomes for outcomes in found.values())]
    check = f"--only 'sample hand' --methods linear {OURS}"
    with Table("quality", ["", "pair", *methods], given.keep, check=check, labels=2) as table:
        compare(found, table)
    if given.sheet:
        draw_sheet(found, given.sheet)


if __name__ == "__main__":
    main()
