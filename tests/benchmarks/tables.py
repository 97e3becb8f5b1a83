"""Tables of results, as text and as Markdown."""

import json
import math
from collections.abc import Callable, Iterable
from dataclasses import asdict
from pathlib import Path
from statistics import fmean

from measures import NAN, Row

BASELINE, REFERENCE, FULL = "linear", "joint", "full"
ROUNDING = 1e-9  # relative; what is worse than linear interpolation by less is not worse

COLUMNS = (
    "edge error",
    "all times",
    "edge drift",
    "vertex error",
    "volume",
    "energy",
    "gap closed",
    "turned",
    "folds",
    "crossings",
    "ms",
    "time",
)


def load_rows(path: Path | None) -> list[Row]:
    """Results of earlier runs."""
    return [Row(**row) for row in json.loads(path.read_text())] if path and path.exists() else []


def save_rows(path: Path | None, rows: Iterable[Row]) -> None:
    """Keep results."""
    if path:
        path.write_text(json.dumps([asdict(row) for row in rows], indent=0))


def gap_closed(row: Row, linear: Row | None, full: Row | None) -> float:
    """The part of the energy between linear interpolation and the optimum over all vertices that is gone."""
    if linear is None or full is None or not linear.energy > full.energy:
        return NAN
    return (linear.energy - row.energy) / (linear.energy - full.energy)


def worse_than(row: Row, linear: Row | None) -> list[str]:
    """In what a row is worse than linear interpolation."""
    if linear is None:
        return []
    pairs = {"energy": (row.energy, linear.energy), "edge error": (row.edge_error, linear.edge_error)}
    return [name for name, (mine, other) in pairs.items() if mine > other * (1 + ROUNDING)]


def cells(row: Row, by_name: dict[str, Row]) -> list[str]:
    """What stands in the columns."""
    linear, joint, full = (by_name.get(name) for name in (BASELINE, REFERENCE, FULL))
    return [
        percent(row.edge_error),
        percent(row.edge_error_all),
        percent(row.edge_drift),
        percent(row.vertex_error),
        number(row.volume, ".3f"),
        number(row.energy / linear.energy if linear and linear.energy else NAN, ".3f"),
        number(gap_closed(row, linear, full), ".3f"),
        number(row.turned, ".0f"),
        number(row.folds, ".0f"),
        number(row.crossings, ".0f"),
        number(1e3 * row.seconds, ".1f"),
        number(row.seconds / joint.seconds if joint else NAN, ".2f"),
    ]


def case_table(name: str, rows: list[Row]) -> str:
    """One case as text, and whether anything is worse than linear interpolation."""
    by_name = {row.method: row for row in rows}
    lines = [f"{name}", f"  {'':<26}" + "".join(f"{column:>13}" for column in COLUMNS)]
    for row in rows:
        numbers = "".join(f"{cell:>13}" for cell in cells(row, by_name))
        lines.append(f"  {row.method:<26}" + numbers + remark(row, by_name))
    return "\n".join(lines)


def remark(row: Row, by_name: dict[str, Row]) -> str:
    """What to say beside a row."""
    worse = worse_than(row, by_name.get(BASELINE))
    said = [f"WORSE THAN LINEAR in {' and '.join(worse)}"] * bool(worse) + [row.note] * bool(row.note)
    return f"  {'; '.join(said)}" if said else ""


def head(*columns: str) -> str:
    """The first two lines of a table in Markdown."""
    return f"| {' | '.join(columns)} |\n{'|---' * len(columns)}|"


def print_table(title: str, columns: Iterable[str], rows: Iterable[Iterable[str]]) -> None:
    """Print a table in Markdown, each line as soon as it is known."""
    print(f"\n**{title}**\n\n{head(*columns)}", flush=True)
    for row in rows:
        print(f"| {' | '.join(row)} |", flush=True)


def markdown(rows: list[Row]) -> str:
    """What comes out of all cases, and what matters most of each: a line for each case, a column for each method."""
    names = list(dict.fromkeys(row.case for row in rows))
    methods = list(dict.fromkeys(row.method for row in rows))
    found = {name: {row.method: row for row in rows if row.case == name} for name in names}
    lines = ["", *summary(found, methods)]
    for title, cell in PIVOTS.items():
        table = [[cell(found[name].get(method), found[name]) for method in methods] for name in names]
        if all(value == "-" for line in table for value in line):
            continue
        lines += ["", f"**{title}**", "", head("", *methods)]
        lines += [f"| {name} | {' | '.join(line)} |" for name, line in zip(names, table, strict=True)]
    return "\n".join([*lines, ""])


def _edge_error(row: Row | None, by_name: dict[str, Row]) -> str:
    if row is None or math.isfinite(row.edge_error):
        return percent(row.edge_error if row else NAN)
    return percent(row.edge_drift) + (" *" if math.isfinite(row.edge_drift) else "")


def _gap(row: Row | None, by_name: dict[str, Row]) -> str:
    return number(gap_closed(row, by_name.get(BASELINE), by_name.get(FULL)) if row else NAN, ".3f")


def _energy(row: Row | None, by_name: dict[str, Row]) -> str:
    linear = by_name.get(BASELINE)
    return number(row.energy / linear.energy if row and linear and linear.energy else NAN, ".4f")


def _turned(row: Row | None, by_name: dict[str, Row]) -> str:
    return f"{number(row.turned, '.0f')} / {number(row.folds, '.0f')}" if row and math.isfinite(row.folds) else "-"


PIVOTS: dict[str, Callable[[Row | None, dict[str, Row]], str]] = {
    "Edge error (*: no truth, drift)": _edge_error,
    "Energy over that of linear interpolation": _energy,
    "Gap closed": _gap,
    "Volume": lambda row, _: number(row.volume if row else NAN, ".3f"),
    "Faces turned / hinges folded": _turned,
    "New crossings": lambda row, _: number(row.crossings if row else NAN, ".0f"),
    "Milliseconds": lambda row, _: number(1e3 * row.seconds if row else NAN, ".1f"),
}


def summary(found: dict[str, dict[str, Row]], methods: list[str]) -> list[str]:
    """Over all cases: geometric means of errors and times, the gap closed, and how often a method lost."""
    columns = "method", "edge error", "over linear", "edge drift over linear", "gap closed: mean", "least"
    lines = [head(*columns, "time over joint", "cases", "worse than linear")]
    for name in methods:
        mine = [(found[case][name], found[case]) for case in found if name in found[case]]
        mine = [(row, others) for row, others in mine if math.isfinite(row.energy)]
        ratios: dict[str, list[float]] = {"error": [], "over": [], "drift": [], "gap": [], "time": []}
        lost = []
        for row, others in mine:
            linear, joint, full = (others.get(other) for other in (BASELINE, REFERENCE, FULL))
            ratios["error"].append(row.edge_error)
            ratios["over"].append(row.edge_error / linear.edge_error if linear else NAN)
            ratios["drift"].append(row.edge_drift / linear.edge_drift if linear else NAN)
            ratios["gap"].append(gap_closed(row, linear, full))
            ratios["time"].append(row.seconds / joint.seconds if joint else NAN)
            lost += [f"{row.case} ({', '.join(worse)})" for worse in [worse_than(row, linear)] if worse]
        gaps = [gap for gap in ratios["gap"] if math.isfinite(gap)]
        columns = [
            percent(geometric_mean(ratios["error"])),
            number(geometric_mean(ratios["over"]), ".3f"),
            number(geometric_mean(ratios["drift"]), ".3f"),
            number(fmean(gaps) if gaps else NAN, ".3f"),
            number(min(gaps) if gaps else NAN, ".3f"),
            number(geometric_mean(ratios["time"]), ".2f"),
            str(len(mine)),
            "; ".join(lost) or "never",
        ]
        lines.append(f"| {name} | " + " | ".join(columns) + " |")
    return lines


def geometric_mean(values: list[float]) -> float:
    """Over those that are finite and positive."""
    logarithms = [math.log(value) for value in values if math.isfinite(value) and value > 0]
    return math.exp(fmean(logarithms)) if logarithms else NAN


def percent(value: float) -> str:
    """A fraction as a percentage."""
    return number(100 * value, ".2f") + (" %" if math.isfinite(value) else "")


def number(value: float, form: str) -> str:
    """A number, or a dash where there is none."""
    return format(value, form) if math.isfinite(value) else "-"
