"""Bodies of all kinds, each bent and twisted by 60 degrees with a known middle: what comes back, and what it says.

    python tests/benchmarks/wild.py [--kinds KIND ...] [--only TEXT ...] [--presets NAME ...] [--contact none|few|all]
                                    [--method auto|solid|shell] [--bodies N] [--jobs N] [--patience FACTOR]
                                    [--out FILE.json]
    python tests/benchmarks/wild.py --list

More than a hundred bodies (tests/benchmarks/wild_bodies.py): with thin limbs, of many pieces, thin, open, not
manifold, of high genus, of 12 to 60,000 faces, in tiny and huge units, with loose vertices, slivers and noise, machines
and animals. The key-frames are the body at rest, and bent and twisted; the true in-between is the same motion half-way.
Each body is tried with each preset, and those that ``--list`` marks with contact, too, which "paper" does not have.
Kinds take turns, so that a run that is ended early has seen all of them.

An outcome is one of

- good;
- fell back, or not converged: the status says so;
- refused: by an error that the package raised;
- silent: edges more than 1.1 times as wrong as linear interpolation's, or not finite, and a good status;
- foreign: an error that did not start in the package;
- hang, past a limit of time;
- died: the process ended.

The last four are mistakes; with one, the exit code is 1. A child process tries each body.

Edge errors are means of ``|l - l_true| / max(l_true, l_mean / 100)``: edges of next to no length do not count for more
than all others. Times are seconds on the clock for the bases of both key-frames, and processor time for one in-between.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import signal
import subprocess
import sys
import tempfile
import time
import traceback
import warnings
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from itertools import zip_longest
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
import torch
from helpers.shapes import rigid_blend
from results import geometric_mean, number, wanted
from timing import limit_threads
from tqdm import tqdm
from wild_bodies import bent_and_twisted
from wild_making import BODIES, WildBody

import torch_modal as tm
from torch_modal.elastic.minimise import Status
from torch_modal.geometry.connectivity import Connectivity
from torch_modal.modes.extract import METHODS, Method

N_MODES = 30
PRESETS = ("accurate", "fast", "paper")
WORSE = 1.1  # times linear interpolation's edge error
SHORT = 0.01  # of the mean edge; shorter ones are measured by this
LIMITS = {"modes": 400.0, "in-between": 200.0, "contact": 400.0}  # seconds on the clock
STEPS = {False: "in-between", True: "contact"}
START = 60.0  # seconds until a child process has imported all
REPEATED = 5.0  # seconds; what takes less is called again for its time

OUTCOMES = ("good", "fell back", "not converged", "refused", "silent", "foreign", "hang", "died")
MISTAKES = ("silent", "foreign", "hang", "died")
FELL_BACK = getattr(Status, "FELL_BACK", None)


@dataclass
class Row:
    """One body with one preset."""

    body: str
    kind: str
    preset: str
    contact: bool
    outcome: str = "died"
    reason: str = ""
    """The message of an error, where it came from, or the status."""
    vertices: int = 0
    faces: int = 0
    linear: float = math.nan
    """Edge error of linear interpolation."""
    means: float = math.nan
    """That of the mean of both key-frames' edge lengths, over linear's: fat bodies are stretched, and not evenly."""
    ratio: float = math.nan
    """Edge error over that."""
    modes: float = math.nan
    """Seconds on the clock for both bases."""
    seconds: float = math.nan
    """Processor seconds of one in-between."""
    warned: str = ""
    """Of what the package warned."""

    @property
    def way(self) -> str:
        """Preset and contact."""
        return self.preset + " + contact" * self.contact


# ------------------------------------------------------------------------------------------------- in the child process


def attempt(body: WildBody, ways: Sequence[tuple[str, bool]], method: Method) -> None:
    """Try a body, and print a row after each way."""
    rows = [Row(body.name, body.kind, preset, contact) for preset, contact in ways]
    vertices, faces = body.make()
    poses = [torch.from_numpy(bent_and_twisted(vertices, faces, time)) for time in (0.0, 0.5, 1.0)]
    surface = torch.from_numpy(np.array(faces))
    linear = edge_error(straight(poses[0], poses[2], faces), poses[1], faces)
    ends = [edge_lengths(pose, faces) for pose in poses]
    means = error_of((ends[0] + ends[2]) / 2, ends[1]) / linear
    with warnings.catch_warnings(record=True) as warned:
        warnings.simplefilter("always")
        start = time.perf_counter()
        bases, failed = guarded(
            lambda: tm.extract_bases(torch.stack(poses[::2]), surface, N_MODES, method=method, progress=False)
        )
        spent = time.perf_counter() - start
    for row in rows:
        row.vertices, row.faces, row.modes = len(vertices), len(faces), spent
        row.linear, row.means = linear, means
        with warnings.catch_warnings(record=True) as more:
            warnings.simplefilter("always")
            if failed:
                row.outcome, row.reason = failed
            else:
                in_between(row, bases, surface, poses)
        row.warned = "; ".join(
            dict.fromkeys(f"{w.category.__name__}: {str(w.message)[:150]}" for w in [*warned, *more])
        )
        print(json.dumps(asdict(row)), flush=True)


def in_between(row: Row, bases: list[tm.ModalBasis], faces: torch.Tensor, poses: list[torch.Tensor]) -> None:
    """Make the shape half-way, and write what came out into a row."""

    def solve() -> Any:
        with torch.no_grad():
            return layer.solve(poses[0], poses[2], 0.5)

    def first() -> Any:
        nonlocal layer
        layer = tm.InBetween(bases, faces, row.preset, contact=row.contact or None)
        return solve()

    layer: Any = None
    start = time.process_time()
    result, failed = guarded(first)
    row.seconds = time.process_time() - start
    if failed:
        row.outcome, row.reason = failed
        return
    if row.seconds < REPEATED:
        start = time.process_time()
        solve()
        row.seconds = time.process_time() - start
    row.ratio = edge_error(result.shapes, poses[1], faces.numpy()) / row.linear
    status = Status(int(result.solution.status))
    row.reason = status.name
    if FELL_BACK is not None and status == FELL_BACK:
        row.outcome = "fell back"
    elif not bool(result.solution.usable):
        row.outcome = "not converged"
    else:
        row.outcome = "good" if row.ratio <= WORSE else "silent"  # NaN is silent


def guarded(function: Callable[[], Any]) -> tuple[Any, tuple[str, str] | None]:
    """What a function returns, or how it failed: refused if a statement of the package raised it, foreign otherwise."""
    try:
        return function(), None
    except Exception as error:
        frames = traceback.extract_tb(error.__traceback__)
        package = str(Path(tm.__file__).parent)
        own = frames[-1].filename.startswith(package) and (frames[-1].line or "").startswith("raise ")
        own &= isinstance(error, (ValueError, ImportError, RuntimeError))  # not an AssertionError, for instance
        where = [
            f" ({Path(frame.filename).name} {frame.lineno})" for frame in frames if frame.filename.startswith(package)
        ]
        said = f"{type(error).__name__}: {' '.join(str(error).split())[:200]}"
        return None, ("refused" if own else "foreign", said + "".join(where[-1:]))


def straight(x_a: torch.Tensor, x_b: torch.Tensor, faces: np.ndarray, time: float = 0.5) -> torch.Tensor:
    """Linear interpolation, the second shape laid upon the first. *Shape:* ``(V, 3)``."""
    weights = torch.zeros(len(x_a), dtype=x_a.dtype)
    weights[np.unique(faces)] = 1
    return rigid_blend(x_a, x_b, torch.tensor([time], dtype=x_a.dtype), weights)[0]


def edge_error(found: torch.Tensor, truth: torch.Tensor, faces: np.ndarray) -> float:
    """Mean relative error of edge lengths; short edges relative to a part of the mean edge."""
    return error_of(edge_lengths(found, faces), edge_lengths(truth, faces))


def edge_lengths(x: torch.Tensor, faces: np.ndarray) -> torch.Tensor:
    """*Shape:* ``(V, 3) -> (E,)``."""
    i, j = torch.tensor(Connectivity(faces).edges).T
    return torch.linalg.norm(x[i].double() - x[j].double(), dim=1)


def error_of(length: torch.Tensor, wanted: torch.Tensor) -> float:
    """The same of lengths."""
    return float(((length - wanted).abs() / wanted.clamp(min=SHORT * float(wanted.mean()))).mean())


# ------------------------------------------------------------------------------------------------ in the parent process


def rows_of(body: WildBody, ways: list[tuple[str, bool]], arguments: argparse.Namespace) -> list[Row]:
    """Rows of all ways. One that ends its child process, or hangs, has a row too; another child tries the rest."""
    rows: list[Row] = []
    while len(rows) < len(ways):
        left = ways[len(rows) :]
        limit = arguments.patience * (START + LIMITS["modes"] + sum(LIMITS[STEPS[contact]] for _, contact in left))
        command = [sys.executable, __file__, "--child", body.name, json.dumps(left), arguments.method]
        child = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, start_new_session=True)
        try:
            said, outcome = child.communicate(timeout=limit)[0], "died"
        except subprocess.TimeoutExpired:
            os.killpg(child.pid, signal.SIGKILL)  # with its own children
            said, outcome = child.communicate()[0], "hang"
        rows += [Row(**json.loads(line)) for line in said.splitlines() if line.startswith("{")]
        if len(rows) < len(ways):
            preset, contact = ways[len(rows)]
            reason = f"no answer in {limit:.0f} s" if outcome == "hang" else f"exit code {child.returncode}"
            rows.append(Row(body.name, body.kind, preset, contact, outcome, reason))
    return rows


def run(chosen: list[WildBody], arguments: argparse.Namespace) -> Iterator[list[Row]]:
    """All bodies, the rows of each as it is done."""
    with ThreadPoolExecutor(arguments.jobs) as pool:
        yield from pool.map(lambda body: rows_of(body, ways_of(body, arguments), arguments), chosen)


def ways_of(body: WildBody, arguments: argparse.Namespace) -> list[tuple[str, bool]]:
    """Presets, and then those with contact."""
    touched = arguments.contact == "all" or (arguments.contact == "few" and body.contact)
    with_contact = [(name, True) for name in arguments.presets if touched and name != "paper"]
    return [(name, False) for name in arguments.presets] + with_contact


# --------------------------------------------------------------------------------------------------------------- tables

COLUMNS = ("tries", *OUTCOMES, " mean", "  worst", "modes s", "shape ms")


def line(rows: list[Row]) -> list[str]:
    """Counts of outcomes, geometric mean and worst of the ratios to linear, medians of times."""
    ratios = [row.ratio for row in rows if math.isfinite(row.ratio)]
    times = [
        [value for value in values if math.isfinite(value)]
        for values in zip(*((r.modes, r.seconds) for r in rows), strict=True)
    ]
    modes, seconds = (median(values) if values else math.nan for values in times)
    counts = [str(sum(row.outcome == outcome for row in rows) or "-") for outcome in OUTCOMES]
    worst = max(ratios, default=math.nan)
    return [
        str(len(rows)),
        *counts,
        number(geometric_mean(ratios), ".3f"),
        number(worst, ".3g"),
        number(modes, ".1f"),
        number(1e3 * seconds, ".0f"),
    ]


def table(rows: list[Row]) -> str:
    """By kind and way, and by way alone; then what was not good."""
    ways = list(dict.fromkeys(row.way for row in sorted(rows, key=lambda row: row.contact)))
    lines = [f"{'':<22}{'':<20}" + "".join(f"{column:>{len(column) + 2}}" for column in COLUMNS)]
    for kind in [*dict.fromkeys(body.kind for body in BODIES.values()), "all"]:
        for way in ways:
            mine = [row for row in rows if row.way == way and kind in (row.kind, "all")]
            if mine:
                cells = "".join(f"{cell:>{len(column) + 2}}" for column, cell in zip(COLUMNS, line(mine), strict=True))
                lines.append(f"{kind:<22}{way:<20}" + cells)
    for outcome in OUTCOMES[::-1]:
        mine = sorted((row for row in rows if row.outcome == outcome), key=lambda row: -row.ratio)
        if outcome == "good":
            mine = [row for row in mine if row.ratio > 1]
        if mine:
            lines += ["", f"{outcome}{', worse than linear' * (outcome == 'good')}:"]
            alike: dict[tuple[str, str], list[Row]] = {}
            for row in mine:
                alike.setdefault((row.body, row.reason), []).append(row)
            for (name, reason), found in alike.items():
                ratios = ", ".join(f"{row.way} {number(row.ratio, '.2f')}" for row in found)
                about = (
                    f"{found[0].kind}: {name}, {found[0].faces} faces, mean of lengths {number(found[0].means, '.2f')}"
                )
                lines.append(f"  {about}; {ratios}: {reason}")
    return "\n".join(lines)


def chosen_bodies(arguments: argparse.Namespace) -> list[WildBody]:
    """Those asked for, of each kind in turn."""
    found = [
        body
        for body in BODIES.values()
        if (not arguments.kinds or body.kind in arguments.kinds) and wanted(body.name, arguments.only)
    ]
    kinds: dict[str, list[WildBody]] = {}
    for body in found:
        kinds.setdefault(body.kind, []).append(body)
    return [body for turn in zip_longest(*kinds.values()) for body in turn if body][: arguments.bodies]


def parse(words: Sequence[str] | None) -> argparse.Namespace:
    """The command line, or words in its place."""
    kinds = list(dict.fromkeys(body.kind for body in BODIES.values()))
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kinds", nargs="+", choices=kinds, default=[], metavar="KIND", help=", ".join(kinds))
    parser.add_argument("--only", nargs="+", default=[""], metavar="TEXT", help="only bodies with one of these in them")
    parser.add_argument("--presets", nargs="+", choices=PRESETS, default=list(PRESETS))
    parser.add_argument(
        "--contact", choices=("none", "few", "all"), default="few", help="bodies to try with contact, too"
    )
    parser.add_argument("--method", choices=METHODS, default="auto", help="of the modes (default: %(default)s)")
    parser.add_argument("--bodies", type=int, metavar="N", help="so many at most, of each kind about as many")
    parser.add_argument("--jobs", type=int, default=1, metavar="N", help="child processes")
    parser.add_argument("--patience", type=float, default=1.0, metavar="FACTOR", help=f"of the limits, {LIMITS} s")
    parser.add_argument("--out", type=Path, metavar="FILE.json", help="keep all rows")
    parser.add_argument("--child", nargs=3, help=argparse.SUPPRESS)
    parser.add_argument("--list", action="store_true", help="name all bodies, and end")
    return parser.parse_args(words)


def main(words: Sequence[str] | None = None) -> int:
    """Try all, print a table, and say whether there was a mistake."""
    arguments = parse(words)
    chosen = chosen_bodies(arguments)
    if arguments.list:
        print("\n".join(f"{body.kind}: {body.name}{', also with contact' * body.contact}" for body in chosen))
        return 0
    if arguments.child:
        name, ways, method = arguments.child
        limit_threads()
        attempt(BODIES[name], json.loads(ways), method)
        return 0
    rows: list[Row] = []
    start = time.perf_counter()
    with tempfile.TemporaryDirectory() as cache:
        os.environ["TORCH_MODAL_CACHE"] = cache
        for found in tqdm(run(chosen, arguments), total=len(chosen), disable=None):
            rows += found
            for row in found:
                print(f"{row.body}, {row.way}: {row.outcome}, {number(row.ratio, '.3f')} {row.reason}", flush=True)
            if arguments.out:
                arguments.out.write_text(json.dumps([asdict(row) for row in rows], indent=0))
    print(f"\n{table(rows)}\n\n{len(chosen)} bodies in {(time.perf_counter() - start) / 60:.0f} minutes")
    return 1 if any(row.outcome in MISTAKES for row in rows) else 0


if __name__ == "__main__":
    sys.exit(main())
