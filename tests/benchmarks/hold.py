"""Shapes, gradients and statuses of real data, held in a file and compared with those of another version.

    python tests/benchmarks/hold.py write FILE      # of the version at hand: 12 pairs, 4 blends, 4 motions
    python tests/benchmarks/hold.py compare FILE    # how far this version is from the one that wrote the file

Distances are the largest of any vertex, in % of the diagonal; gradients differ relative to their norm. Where the true
shapes are known, errors of edges (pairs) and distances (motions) are given as ratios, this version's over the file's.
"""

from __future__ import annotations

import argparse
import math
import warnings
from collections.abc import Iterator
from itertools import chain, islice
from pathlib import Path
from typing import Any

import torch
from cases import Case, hand_path, samples, shared
from motions import gallop, grip
from motions import hand_path as hand_motion
from tables import number
from torch import Tensor

import torch_modal as tm

TIME = 0.3
GRADIENTS = 9  # pairs whose gradients are held


def pairs() -> Iterator[Case]:
    """Twelve pairs: of both samples, the rigged hand, the figure, the face, the cube."""
    every = list(chain(samples(), hand_path(), islice(shared(), 3, None)))
    for name in (
        *("sample creature 0/1", "sample creature 2/3", "sample hand 0/1", "sample hand 1/2"),
        *("mh-hand-path 00/08", "mh-hand-path 00/04", "mh-hand-path 04/08", "mh-woman 02/03"),
        *("mh-hand 00/03", "mh-hand 02/04", "ict-face 00/02", "hyper-cube 1/2"),
    ):
        yield from (case for case in every if case.name == name)


def of_pair(case: Case, with_gradient: bool) -> dict[str, Any]:
    """Shapes of both presets; of "accurate", gradients of a random sum in the first key-frame and the time."""
    out: dict[str, Any] = {"faces": case.faces, "ends": torch.stack([case.x_a, case.x_b])}
    for preset in ("accurate", "fast"):
        layer = tm.InBetween(case.bases(), case.faces, preset)
        for t in sorted({TIME, *case.truths}):
            solved = layer.solve(case.x_a, case.x_b, t)
            out[f"{preset} {t:g}"], out[f"{preset} {t:g} status"] = solved.shapes, solved.solution.status
        if preset == "accurate" and with_gradient:
            x, t = case.x_a.clone().requires_grad_(), torch.tensor(TIME, dtype=torch.float64, requires_grad=True)
            shape = layer(x, case.x_b, t)
            direction = torch.randn(shape.shape, generator=torch.Generator().manual_seed(0)).to(shape)
            out["gradients"] = torch.autograd.grad((shape * direction).sum(), (x, t))
    return out | {f"truth {t:g}": truth for t, truth in case.truths.items()}


def blends() -> Iterator[tuple[str, Tensor, Tensor]]:
    """Four sets of shapes."""
    wanted = ("sample creature 0/1", "mh-woman 02/03", "mh-hand 00/03", "ict-face 00/01")
    for case in chain(samples(), shared()):
        if case.name in wanted:
            yield case.name.rsplit(" ", 1)[0], case.shapes.keyframes[:3], case.faces


def of_blend(keyframes: Tensor, faces: Tensor) -> dict[str, Any]:
    """Weighted means of three shapes, one with a weight below zero."""
    weights = torch.tensor([[0.5, 0.3, 0.2], [0.7, 0.4, -0.1]], dtype=torch.float64)
    x = keyframes.clone().requires_grad_()
    found = tm.Blend(tm.extract_bases(keyframes, faces, 30), faces)(x, weights)
    direction = torch.randn(found.shape, generator=torch.Generator().manual_seed(0)).to(found)
    gradients = torch.autograd.grad((found * direction).sum(), x)
    return {"ends": keyframes, "faces": faces, "shapes": found.detach(), "gradients": gradients}


def everything() -> Iterator[tuple[str, dict[str, Any]]]:
    """Name and values of each case."""
    for i, case in enumerate(pairs()):
        yield case.name, of_pair(case, i < GRADIENTS)
    for name, keyframes, faces in blends():
        yield f"blend of {name}", of_blend(keyframes, faces)
    for motion in chain(gallop(), grip(), hand_motion()):
        shapes, times = motion.shapes, torch.tensor(motion.measured, dtype=torch.float64)
        path = tm.Path(shapes.bases(30), shapes.faces, motion.times, motion.cyclic)
        found = path(shapes.keyframes, times).detach()
        truth = {} if motion.truth is None else {"truth": torch.stack([motion.truth(t) for t in motion.measured])}
        yield f"motion {motion.name}", {"ends": shapes.keyframes, "faces": shapes.faces, "shapes": found, **truth}


def edge_error(x: Tensor, truth: Tensor, faces: Tensor) -> float:
    """Mean of ``|l - l_true| / l_true``."""
    lengths = [(y[faces] - y[faces.roll(1, 1)]).norm(dim=-1) for y in (x, truth)]
    return float(((lengths[0] - lengths[1]).abs() / lengths[1].clamp_min(1e-12)).mean())


def compared(name: str, now: dict[str, Any], then: dict[str, Any]) -> tuple[list[float], list[float]]:
    """A row of the table; ratios of edge errors, and of distances."""
    first = now["ends"][0]
    diagonal = float((first.amax(0) - first.amin(0)).norm())
    shapes = [
        key for key in then if key == "shapes" or (key.endswith(("0", "1", "2", "3", "5")) and "truth" not in key)
    ]
    apart = 100 * max(float((now[key] - then[key]).norm(dim=-1).max()) for key in shapes) / diagonal
    gradient = max(
        (
            float((a - b).norm() / b.norm())
            for a, b in zip(now.get("gradients", ()), then.get("gradients", ()), strict=True)
        ),
        default=math.nan,
    )
    changed = [
        f"{int(then[k])} -> {int(now[k])}" for k in then if k.endswith("status") and not torch.equal(now[k], then[k])
    ]
    edges, distances = [], []
    for key in shapes:
        truth = then.get("truth", then.get(f"truth {key.split()[-1]}"))
        if truth is not None and name.startswith("motion"):
            distances.append(float((now[key] - truth).norm(dim=-1).mean() / (then[key] - truth).norm(dim=-1).mean()))
        elif truth is not None:
            edges.append(edge_error(now[key], truth, now["faces"]) / edge_error(then[key], truth, now["faces"]))
    cells = [number(apart, ".2g"), number(gradient, ".1e"), ", ".join(changed)]
    cells += [" ".join(f"{x:.3f}" for x in values) for values in (edges, distances)]
    print(f"| {name} | {' | '.join(cells)} |", flush=True)
    return edges, distances


def main() -> None:
    """Write or compare."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("action", choices=("write", "compare"))
    parser.add_argument("file", type=Path)
    args = parser.parse_args()
    warnings.simplefilter("ignore")
    if args.action == "write":
        torch.save(dict(everything()), args.file)
        return
    then = torch.load(args.file)
    print("| case | apart, % | gradients | statuses | edges over | distance over |\n|---|---|---|---|---|---|")
    ratios: tuple[list[float], list[float]] = [], []
    for name, now in everything():
        for all_of_them, found in zip(ratios, compared(name, now, then[name]), strict=True):
            all_of_them.extend(found)
    for what, values in zip(("edge errors of pairs", "distances of motions"), ratios, strict=True):
        print(
            f"{what}: geometric mean {math.exp(sum(map(math.log, values)) / len(values)):.3f}, worst {max(values):.3f}"
        )


if __name__ == "__main__":
    main()
