"""Cost and quality of each preset, or of numbers of modes and of coarse faces with and without local steps.

    python tests/benchmarks/presets.py [--only TEXT ...]
    python tests/benchmarks/presets.py --modes 10 30 80 --coarse-faces 300 1000 3000

In-betweens at t = 1/2 with 30 modes of each key-frame, their mean relative error of edge lengths where a truth is
known, their energy over that of linear interpolation, and the time of one, alone and with its gradient to both
key-frames: of the processor, on one thread, best of several, over that of the first line of the case.
"""

import argparse
import math
from collections.abc import Callable, Iterator
from itertools import chain, product
from typing import Any

import cases
import torch
from cases import Case
from measures import Yardstick
from methods import linear
from results import Table, add_keep, percent, wanted
from timing import limit_threads, timed
from torch import Tensor

import torch_modal as tm

FEW = ["creature 1/2", "sample hand", "00/08"]
WAYS = {"local steps": tm.Solver(), "modal solve alone": tm.Solver(local_steps=0)}


def settings(modes: list[int], coarse_faces: list[int]) -> dict[str, tuple[int, dict[str, Any]]]:
    """Numbers of modes and options of a layer by their names: the presets where neither is given."""
    if not modes and not coarse_faces:
        return {preset: (30, {"preset": preset}) for preset in tm.PRESETS}
    found = {}
    for n, n_faces, (way, solver) in product(modes or [30], coarse_faces or [1000], WAYS.items()):
        options = {"objective": tm.Objective(coarse_faces=n_faces), "solver": solver}
        found[f"{n} modes, {n_faces} faces, {way}"] = n, options
    return found


def chosen(only: list[str]) -> Iterator[Case]:
    """The samples, and larger key-frames where they are there."""
    for case in chain(cases.samples(), cases.hand_path(), cases.women()):
        if wanted(case.name, only):
            yield case.at([cases.HALF])


def alone(layer: tm.InBetween, case: Case) -> Callable[[], Tensor]:
    """One in-between."""

    def run() -> Tensor:
        with torch.no_grad():
            return layer(case.x_a, case.x_b, cases.HALF)

    return run


def with_gradient(layer: tm.InBetween, case: Case) -> Callable[[], tuple[Tensor, ...]]:
    """One in-between, and the gradient of a weighted sum of its coordinates to both key-frames."""
    weights = torch.linspace(-1, 1, case.x_a.numel(), dtype=case.x_a.dtype).view_as(case.x_a)

    def run() -> tuple[Tensor, ...]:
        ends = [x.clone().requires_grad_() for x in (case.x_a, case.x_b)]
        return torch.autograd.grad((layer(*ends, cases.HALF) * weights).sum(), ends)

    return run


def compare(only: list[str], compared: dict[str, tuple[int, dict[str, Any]]], table: Table) -> None:
    """Add a line for each of them on each case."""
    for case in chosen(only):
        yardstick = Yardstick(case)
        straight = linear(case).frames[0]
        name, true = f"{case.name}, {len(case.x_a):,} vertices", cases.HALF in case.truths
        table.add(
            name, "linear", percent(yardstick.edge_error(straight, cases.HALF) if true else math.nan), "1", "", ""
        )
        first: list[float] = []
        for preset, (n_modes, options) in compared.items():
            layer = tm.InBetween(case.bases(n_modes), case.faces, **options)
            shape, seconds = timed(alone(layer, case))
            _, both = timed(with_gradient(layer, case))
            first = first or [seconds, both]
            error = yardstick.edge_error(shape, cases.HALF) if true else math.nan
            energy = yardstick.energy(shape) / yardstick.energy(straight)
            ratios = [f"{spent / of:.2f}" for spent, of in zip((seconds, both), first, strict=True)]
            table.add(name, preset, percent(error), f"{energy:.3f}", *ratios)


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="+", default=FEW, metavar="TEXT", help="cases with one of these in their names")
    parser.add_argument("--modes", nargs="+", type=int, default=[], help="of each key-frame")
    parser.add_argument("--coarse-faces", nargs="+", type=int, default=[])
    add_keep(parser)
    given = parser.parse_args()
    limit_threads()
    timed_columns = ["time", "with gradient"]
    columns = ["", "preset", "edge error", "energy over linear", *timed_columns]
    with Table("presets", columns, given.keep, timed_columns, "--only 'creature 1/2'", labels=2) as table:
        compare(given.only, settings(given.modes, given.coarse_faces), table)


if __name__ == "__main__":
    main()
