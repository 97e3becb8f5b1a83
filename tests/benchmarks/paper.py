"""The preset "paper" half-way between pairs whose middle is known.

    python tests/benchmarks/paper.py [--modes 30] [--mu X] [--regions N] [--only TEXT ...]

Errors are the mean relative error of edge lengths: of linear interpolation, of Eq. 4 alone, and of the whole method, on
the whole mesh and in the regions of local interpolation. *Floor* is that of the mean of both key-frames' lengths, which
no shape need have. The Gauss-Newton steps are those until one lowers the energy by less than 1e-10 of it.
"""

import argparse
from itertools import chain
from typing import Any

import cases
import torch
from cases import Case
from methods import linear
from results import Table, add_keep, wanted
from shapes import edge_lengths
from tables import number, percent
from timing import limit_threads
from torch import Tensor

import torch_modal as tm
from torch_modal.elastic.energy import RestShapes

DECREASE = 1e-10
COLUMNS = ["pair", "floor", "linear", "Eq. 4", "the paper", "over linear", "in the regions, over Eq. 4", "steps"]


def error(lengths: Tensor, truth: Tensor) -> float:
    """Mean relative error of some edges."""
    return float(((lengths - truth).abs() / truth).mean())


def steps(layer: tm.MidShape, case: Case) -> int:
    """Gauss-Newton steps until one gains less than a part of the energy."""
    core, half = layer.in_between.core, torch.full((1, 2), 0.5, dtype=torch.float64)
    shapes, _, _ = core.alignment(torch.stack([case.x_a, case.x_b])[None], half)
    stiffness, mu = (each(half, half.shape[:1]) for each in (layer.in_between.stiffness_of, layer.in_between.mu_of))
    placed = core.space.place(shapes[:, 0], RestShapes(shapes, half, stiffness), mu)
    step, a = tm.GaussNewtonStep(core.space), half.new_zeros(1, core.space.n_amplitudes)
    value = core.space.value(a, placed)
    for n in range(1, 100):
        taken = step(a, placed)
        if float((value - taken.energy) / taken.energy) < DECREASE:
            return n
        a, value = taken.amplitudes, taken.energy
    return n


def cells(case: Case, n_modes: int, options: dict[str, Any]) -> list[str]:
    """One row of the table."""
    ends, faces = (case.x_a, case.x_b), case.faces
    layer = tm.MidShape(case.bases(n_modes), faces, preset="paper", **options)
    plain = tm.MidShape(case.bases(n_modes), faces, preset="paper", **{**options, "regions": 0})
    with torch.no_grad():
        shapes = [linear(case).frames[0], plain.solve(*ends).shapes, layer.solve(*ends).shapes]
    core, errors = layer.in_between.core, []
    region = core.local.region
    for some in (faces, faces[region[faces].all(1)]):
        truth = edge_lengths(case.truths[cases.HALF], some)
        middle = sum(edge_lengths(x, some) for x in ends) / 2
        errors.append([error(middle, truth), *(error(edge_lengths(x, some), truth) for x in shapes)])
    (floor, straight, eq_4, paper), (_, _, eq_4_in, paper_in) = errors
    found = [case.name, *map(percent, (floor, straight, eq_4, paper)), number(paper / straight, ".3f")]
    return [*found, number(paper_in / eq_4_in, ".3f"), str(steps(layer, case))]


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--modes", type=int, default=30, help="of each key-frame (default: %(default)s)")
    parser.add_argument("--mu", type=float, help="weight of the similarity (default: the preset's)")
    parser.add_argument("--regions", type=int, help="segments that are interpolated locally (default: the preset's)")
    parser.add_argument("--only", nargs="+", default=[""], metavar="TEXT", help="pairs whose names hold one of these")
    add_keep(parser)
    given = parser.parse_args()
    limit_threads()
    options = {name: value for name, value in (("mu", given.mu), ("regions", given.regions)) if value is not None}
    with Table("paper-pairs", COLUMNS, given.keep, check="--only 'hand 0/1'") as table:
        for case in chain(cases.samples(), cases.hand_path()):
            if cases.HALF in case.truths and wanted(case.name, given.only):
                table.add(*cells(case, given.modes, options))


if __name__ == "__main__":
    main()
