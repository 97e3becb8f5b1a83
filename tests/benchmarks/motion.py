"""Motion through many key-frames, smooth in time, against each pair alone.

    python tests/benchmarks/motion.py [gallop hand-path grip unrelated] [--costs]

Distances are means over the vertices, in % of the diagonal, without any alignment; edge errors are means of
``|l - l_true| / l_true``, or, without a truth, of the strain against lengths that change evenly between key-frames.
"Corner" is the second difference in time at a key-frame over its median elsewhere, at 1/32 of an interval (of the pair,
elsewhere is at the quarters of the intervals). Overshoot is how far a vertex leaves a stop, or passes it. Times are of
the processor, of all threads, the best of several.
"""

from __future__ import annotations

import argparse
from statistics import fmean

from measures import NAN
from motion_measures import Measured
from motions import MOTIONS
from tables import head, number


def print_motion(measured: Measured) -> None:
    """A row of the table for each thing that is measured."""
    motion = measured.motion
    smooth, pair = (measured.measure(way) for way in (True, False))
    single, sequence = measured.costs()
    apart = [100 * abs(a / b - 1) for a, b in zip(smooth.volume, pair.volume, strict=True)]

    def row(what: str, own: float, other: float = NAN, truth: float = NAN) -> None:
        over = own / other if other else NAN
        cells = (number(x, ".3g") for x in (own, other, over, truth))
        print(f"| {motion.name} | {what} | {' | '.join(cells)} |", flush=True)

    parts = [round(motion.located(t)[1], 3) for t in motion.measured]
    for name, own, others in (
        ("distance, %", smooth.distance, pair.distance),
        ("edge error, %", smooth.edges, pair.edges),
        ("energy", smooth.energy, pair.energy),
    ):
        if own:
            row(name, fmean(own), fmean(others))
            for part in sorted(set(parts)):
                here = [i for i, u in enumerate(parts) if u == part]
                row(f"{name}, at {part:g}", fmean(own[i] for i in here), fmean(others[i] for i in here))
    row("volume apart, worst, %", max(apart))
    row("folds", smooth.folds, pair.folds, smooth.true_folds if smooth.distance else NAN)
    if smooth.distance:
        row("hinges unlike the truth", smooth.unlike, pair.unlike, 0)
        row("turned faces", smooth.turned, pair.turned, 0)
    row("collapsed faces", smooth.collapsed, pair.collapsed)
    truth = measured.of_truth()
    row("corner, mean", smooth.corner, pair.corner, truth.corner)
    row("corner, worst", smooth.worst_corner, pair.worst_corner, truth.worst_corner)
    if motion.stop is not None:
        row("overshoot, %", smooth.overshoot, pair.overshoot, truth.overshoot)
    row("time of one shape, over the pair's", single)
    row("time of a sequence, over the pair's", sequence)


def print_costs(measured: Measured) -> None:
    """A row of costs."""
    single, sequence = measured.costs()
    print(f"| {measured.motion.name} | {single:.2f} | {sequence:.2f} |", flush=True)


COSTS = ("motion", "one shape, over the pair's", "sequence")
TABLE = ("motion", "measure", "smooth", "pair", "smooth over pair", "truth")


def main() -> None:
    """Print what is asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("motions", nargs="*", help=f"of {', '.join(MOTIONS)}; default: all")
    parser.add_argument("--costs", action="store_true", help="costs alone")
    args = parser.parse_args()
    columns, row = (COSTS, print_costs) if args.costs else (TABLE, print_motion)
    print(head(*columns))
    for name in args.motions or MOTIONS:
        for motion in MOTIONS[name]():
            row(Measured(motion))


if __name__ == "__main__":
    main()
