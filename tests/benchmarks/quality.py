"""How good in-betweens are: the methods of this package, linear interpolation, and peers, side by side.

    python tests/benchmarks/quality.py [FOLDER ...] [--shared] [--samples] [--bodies]

A folder holds the frames of a motion, in the order of their names: the first and the last are the key-frames, those
between are the truth at their places. Two frames alone have no truth, and then only energies, drift and volumes are
compared. Peers join when they are installed (pip install morphomatics), or with ``--peer-python``.

Everything is measured at t = 1/2, and the edge error also over all times with a truth (docs/quality.md says what the
columns mean). Times are processor seconds on one thread, best of several: compare them within one run.
"""

import argparse
import os
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

import cases
import torch
from cases import HALF, Case
from measures import Row, Yardstick
from methods import METHODS, Method, UnavailableError
from sheet import draw_sheet
from tables import case_table, load_rows, markdown, save_rows
from timing import limit_threads, untimed

REFERENCE = "full"
"""The method whose optimum tells which way faces look where there is no truth; it comes first."""

RETRIED = ("not available", "failed")
"""Notes of rows that are tried again."""


def run(case: Case, names: list[str], shapes: dict[str, torch.Tensor]) -> Iterator[Row]:
    """All methods on one case; their shapes half-way are put into ``shapes``."""
    yardstick = Yardstick(case)
    upright = None
    for name in sorted(names, key=lambda name: name != REFERENCE):
        row = Row(case.name, name)
        try:
            found = attempt(case, METHODS[name], row, yardstick)
        except UnavailableError as error:
            row.note = f"not available: {error}"
            print(f"    {name}: {error}", file=sys.stderr)
        except (ValueError, RuntimeError) as error:
            row.note = f"failed: {str(error)[:100]}"
        else:
            shapes[name] = found
            upright = found if name == REFERENCE else upright
            yardstick.measure(row, found, upright)
        yield row


def attempt(case: Case, method: Method, row: Row, yardstick: Yardstick) -> torch.Tensor:
    """Call a method: at t = 1/2, which is timed, and at all times with a truth."""
    half = method.function(case.at([HALF]))
    row.seconds, row.note = half.seconds, half.note
    others = [time for time in case.truths if time != HALF]
    if not method.half_only and case.truths:
        errors = [yardstick.edge_error(half.frames[0], HALF)] if HALF in case.truths else []
        if others:
            with untimed():
                frames = method.function(case.at(others)).frames
            errors += [yardstick.edge_error(x, time) for x, time in zip(frames, others, strict=True)]
        row.edge_error_all = sum(errors) / len(errors)
    return half.frames[0]


def chosen_cases(arguments: argparse.Namespace) -> Iterator[Case]:
    """The cases that were asked for."""
    for folder in arguments.folders:
        yield from cases.folder(folder)
    if arguments.shared:
        yield from cases.shared()
    if arguments.samples:
        yield from cases.samples()
    if arguments.bodies:
        yield from cases.bodies()
    yield from cases.bodies(arguments.body)


def parse(words: Sequence[str] | None) -> argparse.Namespace:
    """The command line, or words in its place."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folders", nargs="*", type=Path, metavar="FOLDER", help="frames of a motion, or two key-frames")
    parser.add_argument("--shared", action="store_true", help="all data sets that are kept beside the project")
    parser.add_argument("--samples", action="store_true", help="the samples that come with the package")
    parser.add_argument("--bodies", action="store_true", help="bars, hollow and slender bodies, a sheet")
    parser.add_argument("--body", nargs="+", default=[], metavar="NAME", help="others, such as 'bar bent 270'")
    parser.add_argument("--methods", nargs="+", choices=list(METHODS), default=list(METHODS), metavar="NAME")
    parser.add_argument("--only", nargs="+", default=[""], metavar="TEXT", help="only cases with one of these in them")
    parser.add_argument("--peer-python", type=Path, metavar="FILE", help="a Python that has morphomatics")
    parser.add_argument("--results", type=Path, metavar="FILE.json", help="keep results, and go on from those there")
    parser.add_argument("--markdown", type=Path, metavar="FILE.md", help="write all tables")
    parser.add_argument("--sheet", type=Path, metavar="FILE.png", help="draw the shapes, coloured by their edge errors")
    arguments = parser.parse_args(words)
    named = ("folders", "shared", "samples", "bodies", "body")
    if not any(getattr(arguments, name) for name in named):
        parser.error("name a folder of frames, or --shared, --samples, --bodies or --body")
    return arguments


def main(words: Sequence[str] | None = None) -> None:
    """Run what is missing, print and write tables."""
    arguments = parse(words)
    if arguments.peer_python:
        os.environ["TORCH_MODAL_PEER_PYTHON"] = str(arguments.peer_python)
    rows = load_rows(arguments.results)
    drawn: list[tuple[Case, dict[str, torch.Tensor]]] = []
    shown: list[Row] = []
    for case in chosen_cases(arguments):
        if not any(text in case.name for text in arguments.only):
            continue
        known = {row.method: row for row in rows if row.case == case.name and not row.note.startswith(RETRIED)}
        missing = [name for name in arguments.methods if name not in known or arguments.sheet]
        shapes: dict[str, torch.Tensor] = {}
        if missing:
            with torch.no_grad():
                known |= {row.method: row for row in run(case, missing, shapes)}
            rows = [row for row in rows if row.case != case.name] + list(known.values())
            save_rows(arguments.results, rows)
        mine = [known[name] for name in METHODS if name in known and name in arguments.methods]
        print(case_table(case.name, mine), flush=True)
        shown += mine
        drawn.append((case, shapes))
    text = markdown(shown)
    print(text)
    if arguments.markdown:
        arguments.markdown.write_text(text)
    if arguments.sheet:
        draw_sheet(drawn, arguments.sheet)


if __name__ == "__main__":
    limit_threads()
    main()
