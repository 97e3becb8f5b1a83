"""Cost and quality of each preset, or of numbers of modes and of coarse faces with and without local steps.

    python tests/benchmarks/presets.py [--only TEXT ...]
    python tests/benchmarks/presets.py --modes 10 30 80 --coarse-faces 300 1000 3000

Prints the table of docs/benchmarks.md: in-betweens at t = 1/2 with 30 modes of each key-frame, their mean relative
error of edge lengths where a truth is known, their energy over that of linear interpolation, the time of one, alone and
with its gradient to both key-frames, and what the layer's ``state_dict`` holds. Times are
processor time on one thread, best of several: what to read are the ratios, to the first line of the case.
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
from tables import geometric_mean, head, number, percent
from timing import limit_threads, timed
from torch import Tensor

import torch_modal as tm

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
        if any(text in case.name for text in only):
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


def compare(only: list[str], compared: dict[str, tuple[int, dict[str, Any]]]) -> None:
    """Print a line for each of them on each case, and their means."""
    found: dict[str, list[tuple[float, ...]]] = {name: [] for name in compared}
    columns = "", "preset", "edge error", "energy over linear", "ms", "over first", "with gradient", "over first", "MiB"
    print(head(*columns))
    for case in chosen(only):
        yardstick = Yardstick(case)
        straight = linear(case).frames[0]
        true = cases.HALF in case.truths
        of_lines = yardstick.edge_error(straight, cases.HALF) if true else math.nan
        print(f"| {case.name}, {len(case.x_a)} vertices | linear | {percent(of_lines)} | 1.000 | | | | | |")
        first: list[float] = []
        for name, (n_modes, options) in compared.items():
            layer = tm.InBetween(case.bases(n_modes), case.faces, **options)
            shape, seconds = timed(alone(layer, case))
            _, both = timed(with_gradient(layer, case))
            first = first or [seconds, both]
            error = yardstick.edge_error(shape, cases.HALF) if true else math.nan
            energy = yardstick.energy(shape) / yardstick.energy(straight)
            held = sum(value.numel() * value.element_size() for value in layer.state_dict().values()) / 2**20
            found[name].append((error / of_lines, energy, seconds / first[0], both / first[1]))
            print(
                f"| | {name} | {percent(error)} | {energy:.3f} | {1e3 * seconds:.0f} | {seconds / first[0]:.2f} | "
                f"{1e3 * both:.0f} | {both / first[1]:.2f} | {held:.1f} |",
                flush=True,
            )
    columns = "geometric means", "edge error over linear", "energy over linear", "time over first", "with gradient"
    print(f"\n{head(*columns)}")
    for name, rows in found.items():
        means = [geometric_mean(list(column)) for column in zip(*rows, strict=True)]
        print(f"| {name} | " + " | ".join(number(mean, ".3f") for mean in means) + " |")


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="+", default=[""], metavar="TEXT", help="only cases with one of these in them")
    parser.add_argument("--modes", nargs="+", type=int, default=[], help="of each key-frame")
    parser.add_argument("--coarse-faces", nargs="+", type=int, default=[])
    arguments = parser.parse_args()
    limit_threads()
    compare(arguments.only, settings(arguments.modes, arguments.coarse_faces))


if __name__ == "__main__":
    main()
