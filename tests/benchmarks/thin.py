"""Thin things: sheets without a thickness.

    python tests/benchmarks/thin.py --sheets [--peer-python FILE] [--only TEXT ...]

``--sheets``: flat and open surfaces whose in-betweens are known (tests/sheets.py), by modes of the surface. Edge errors
at t = 1/4, 1/2 and 3/4, and ratios of their means to those of linear interpolation and of a peer.
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Iterator, Sequence
from pathlib import Path

import torch
from cases import HALF, Case, KeyframeSet
from measures import Yardstick
from methods import METHODS, UnavailableError
from sheets import SHEETS, sheet
from tables import number
from threads import limit_threads
from timing import untimed

import torch_modal as tm

N_MODES = 30
TIMES = (0.25, HALF, 0.75)
OURS = {"subdivide": "accurate", "fast": "fast"}
"""Methods of the comparison, and the presets that they are."""
OTHERS = ("linear", "morphomatics")
TARGETS = {"linear": 0.1, "morphomatics": 1.0}


# -------------------------------------------------------------------------------------------------------------- sheets


def sheet_cases(only: Sequence[str]) -> Iterator[Case]:
    """The sheets of our own making, with modes of the surface."""
    for name in SHEETS:
        if not any(text in name for text in only):
            continue
        body = sheet(name)
        faces = torch.tensor(body.faces)
        keyframes = torch.stack([torch.from_numpy(body.pose(t)) for t in (0.0, 1.0)])
        bases = tm.extract_bases(keyframes, faces, N_MODES, method="shell")
        truths = {t: torch.from_numpy(body.pose(t)) for t in TIMES}
        yield Case(name, KeyframeSet(keyframes, faces, {N_MODES: bases}), 0, 1, truths, TIMES)


def sheet_rows(only: Sequence[str]) -> Iterator[list[str]]:
    """A line for each sheet and preset."""
    for case in sheet_cases(only):
        yardstick = Yardstick(case)
        errors, notes = {}, {}
        for name in (*OURS, *OTHERS):
            try:
                outcome = METHODS[name].function(case)
            except UnavailableError as error:
                notes[name] = f"{name}: {error}"
                continue
            errors[name] = [yardstick.edge_error(x, t) for x, t in zip(outcome.frames, TIMES, strict=True)]
            if name in OURS:
                notes[name] = outcome.note
        for name, preset in OURS.items():
            mine = errors[name]
            ratios = [sum(mine) / sum(errors[other]) if other in errors else float("nan") for other in OTHERS]
            missed = [f"MISSED over {o}" for o, ratio in zip(OTHERS, ratios, strict=True) if ratio > TARGETS[o]]
            yield [
                case.name,
                preset,
                *(f"{100 * error:.3f} %" for error in mine),
                *(number(ratio, ".3f") for ratio in ratios),
                "; ".join([*missed, *(notes[n] for n in (name, *OTHERS) if n in notes)]),
            ]


SHEET_COLUMNS = ["sheet", "preset", *(f"t = {t:g}" for t in TIMES), *(f"over {name}" for name in OTHERS), "notes"]


# -------------------------------------------------------------------------------------------------------------- tables


def print_table(title: str, columns: Sequence[str], rows: Iterator[list[str]]) -> None:
    """Print a table in Markdown, each line as soon as it is known."""
    print(f"\n**{title}**\n\n| " + " | ".join(columns) + " |\n" + "|---" * len(columns) + "|", flush=True)
    for row in rows:
        print("| " + " | ".join(row) + " |", flush=True)


def main(words: Sequence[str] | None = None) -> None:
    """Run the parts that were asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sheets", action="store_true", help="sheets of our own making, against linear and a peer")
    parser.add_argument("--only", nargs="+", default=[""], metavar="TEXT", help="only what has this in its name")
    parser.add_argument("--peer-python", type=Path, metavar="FILE", help="a Python that has morphomatics")
    arguments = parser.parse_args(words)
    if not arguments.sheets:
        parser.error("name a part: --sheets")
    if arguments.peer_python:
        os.environ["TORCH_MODAL_PEER_PYTHON"] = str(arguments.peer_python)
    print_table("Sheets: edge errors", SHEET_COLUMNS, sheet_rows(arguments.only))


if __name__ == "__main__":
    limit_threads()
    with untimed():
        main()
