"""Measured tables: printed while they grow, kept as JSON, and rendered into the pages of the documentation.

A page has a table between the lines ``<!-- results: NAME -->`` and ``<!-- end -->``; what stands there comes from
``docs/results/NAME.json`` (``refresh.py``), and that from the command that the file names, run with ``--keep``.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import re
import shlex
import subprocess
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path
from statistics import fmean
from typing import Any

ROOT = Path(__file__).parents[2]
RESULTS = ROOT / "docs" / "results"
PAGES = (ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md")))
MARKED = re.compile(r"(<!-- results: ([\w-]+) -->\n).*?(<!-- end -->)", re.S)


class Table:
    """A table that is printed row by row and, in the end, kept.

    Args:
        name: Of the file in docs/results.
        columns: Their heads.
        keep: The folder to keep it in; none, and it is only printed.
        timed: Heads of columns that hold times, which differ from run to run.
        check: Arguments of the command that measure the cheapest row alone, for a test.
        labels: The first so many cells tell the rows apart.
    """

    def __init__(
        self,
        name: str,
        columns: Sequence[str],
        keep: Path | None = None,
        timed: Iterable[str] = (),
        check: str = "",
        labels: int = 1,
    ) -> None:
        self.name, self.keep = name, keep
        self.content: dict[str, Any] = {
            "command": command(),
            "commit": commit() if keep else "",
            "check": check,
            "labels": labels,
            "timed": list(timed),
            "columns": list(columns),
            "rows": [],
        }

    def __enter__(self) -> Table:
        print(f"\n{head(*self.content['columns'])}", flush=True)
        return self

    def add(self, *cells: str) -> None:
        """One row."""
        if len(cells) != len(self.content["columns"]):
            raise ValueError(f"{len(cells)} cells for {len(self.content['columns'])} columns: {cells}")
        self.content["rows"].append(list(cells))
        print(line(cells), flush=True)

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if kind is None and self.keep is not None:
            self.keep.mkdir(parents=True, exist_ok=True)
            partial = self.keep / f".{self.name}.json"
            partial.write_text(json.dumps(self.content, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
            os.replace(partial, self.keep / f"{self.name}.json")


def add_keep(parser: argparse.ArgumentParser) -> None:
    """The option of every benchmark with a table."""
    parser.add_argument(
        "--keep", nargs="?", type=Path, const=RESULTS, metavar="FOLDER", help="keep the table as JSON (docs/results)"
    )


def wanted(name: str, only: Iterable[str]) -> bool:
    """Whether a row is asked for: its name holds one of the texts."""
    return any(text in name for text in only)


def command() -> str:
    """What runs now, without where to keep it and without local paths."""
    script = Path(sys.argv[0]).resolve()
    script = script.relative_to(ROOT) if script.is_relative_to(ROOT) else Path(script.name)
    given = re.sub(r"(--keep|--peer-python)( [^-]\S*)?", "", shlex.join(sys.argv[1:]))
    return " ".join(["python", str(script), *given.split()])


def commit() -> str:
    """Of the code that is measured; with a plus where it has changed since."""
    told = subprocess.run(
        ["git", "describe", "--always", "--dirty=+", "--exclude=*"], cwd=ROOT, capture_output=True, text=True
    )
    return told.stdout.strip()


def head(*columns: str) -> str:
    """The first two lines of a table in Markdown."""
    return f"{line(columns)}\n{'|---' * len(columns)}|"


def line(cells: Iterable[str]) -> str:
    """A row in Markdown."""
    return f"| {' | '.join(cells)} |"


def load(name: str) -> dict[str, Any]:
    """A kept table."""
    return json.loads((RESULTS / f"{name}.json").read_text(encoding="utf-8"))


def rendered(name: str) -> str:
    """A kept table as Markdown; a label that repeats the row above is left out."""
    found = load(name)
    lines, before = [head(*found["columns"])], [""] * found["labels"]
    for row in found["rows"]:
        labels = row[: found["labels"]]
        same = next((n for n, pair in enumerate(zip(labels, before, strict=True)) if pair[0] != pair[1]), 0)
        lines.append(line(["" if n < same else cell for n, cell in enumerate(row)]))
        before = labels
    return "\n".join(lines)


def refreshed(page: str) -> str:
    """A page with its tables as they are kept."""
    return MARKED.sub(lambda found: f"{found[1]}{rendered(found[2])}\n{found[3]}", page)


def names(page: str) -> list[str]:
    """The tables of a page."""
    return [found[1] for found in MARKED.findall(page)]


def geometric_mean(values: list[float]) -> float:
    """Of the values that are finite and positive."""
    logarithms = [math.log(value) for value in values if math.isfinite(value) and value > 0]
    return math.exp(fmean(logarithms)) if logarithms else math.nan


def percent(value: float) -> str:
    """A fraction as a percentage."""
    return number(100 * value, ".2f") + (" %" if math.isfinite(value) else "")


def number(value: float, form: str) -> str:
    """A number, or a dash where there is none."""
    return format(value, form) if math.isfinite(value) else "-"
