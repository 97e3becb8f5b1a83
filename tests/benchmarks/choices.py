"""What the number of modes and of coarse faces buys, with and without what is done on the fine mesh.

    python tests/benchmarks/choices.py [--modes 10 20 30 50 80] [--coarse-faces 300 1000 3000]

One line for each choice, over the spans of the hand, two pairs of the figure and the samples: the part of the energy
between linear interpolation and the best that was found that is gone (mean and least), the geometric mean of the
edge-length error over that of linear interpolation where a truth is known, and the processor time over that of *joint*
with 30 modes and 1,000 faces: the modes alone, added to the blend by local rotations. *subdivide*, which is the preset
"accurate", has local steps on top. The best that was found stands in for the optimum over all vertices: four times ten
long steps on the fine mesh after 80 modes and 3,000 faces.
"""

import argparse
import math
from itertools import product
from statistics import fmean, geometric_mean

import cases
from cases import Case
from measures import Yardstick
from methods import InBetweens, linear
from threads import limit_threads
from timing import timed

import torch_modal as tm

WAYS = {"joint": tm.Solver(local_steps=0), "subdivide": tm.Solver()}
DEFAULT = (30, 1000, "joint")


def chosen() -> list[Case]:
    """Real and sampled key-frames; of the long sample two spans."""
    women = list(cases.women())[:2]
    samples = [case for case in cases.samples() if case.first != case.last]
    return [*cases.hand_path(), *women, *samples[:2], *samples[-1:]]


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--modes", nargs="+", type=int, default=[10, 20, 30, 50, 80], help="of each key-frame")
    parser.add_argument("--coarse-faces", nargs="+", type=int, default=[300, 1000, 3000])
    parser.add_argument("--ways", nargs="+", choices=list(WAYS), default=list(WAYS), metavar="NAME")
    parser.add_argument("--only", nargs="+", default=[""], metavar="TEXT", help="only cases with one of these in them")
    arguments = parser.parse_args()
    limit_threads()
    choices = list(product(arguments.modes, arguments.coarse_faces, arguments.ways))
    choices += [DEFAULT] * (DEFAULT not in choices)
    found: dict[tuple[int, int, str], list[tuple[float, float, float]]] = {choice: [] for choice in choices}
    for case in chosen():
        if not any(text in case.name for text in arguments.only):
            continue
        print(f"{case.name} ...", flush=True)
        yardstick = Yardstick(case)
        halfway = case.at([cases.HALF])
        straight = linear(halfway).frames[0]
        most_of_all = {"objective": tm.Objective(coarse_faces=3000), "solver": tm.Solver(polish=40)}
        best = InBetweens(halfway, 80, most_of_all)().shapes[0]
        most, least = yardstick.energy(straight), yardstick.energy(best)
        for n_modes, coarse_faces, way in choices:
            objective = tm.Objective(coarse_faces=coarse_faces)
            layer = InBetweens(halfway, n_modes, {"objective": objective, "solver": WAYS[way]})
            result, seconds = timed(layer)
            shape = result.shapes[0]
            error = float("nan")
            if cases.HALF in case.truths:
                error = yardstick.edge_error(shape, cases.HALF) / yardstick.edge_error(straight, cases.HALF)
            gap = (most - yardstick.energy(shape)) / (most - least)
            found[n_modes, coarse_faces, way].append((gap, error, seconds))
    print("\n| modes | coarse faces | | gap closed: mean | least | edge error over linear | time |")
    print("|---|---|---|---|---|---|---|")
    for (n_modes, coarse_faces, way), rows in found.items():
        gaps, errors, seconds = zip(*rows, strict=True)
        known = [error for error in errors if not math.isnan(error)]
        times = [s / reference[2] for s, reference in zip(seconds, found[DEFAULT], strict=True)]
        print(
            f"| {n_modes} | {coarse_faces} | {way} | {fmean(gaps):.3f} | {min(gaps):.3f} | "
            f"{geometric_mean(known):.3f} | {geometric_mean(times):.2f} |"
        )


if __name__ == "__main__":
    main()
