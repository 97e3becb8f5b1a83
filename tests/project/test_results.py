"""Measured numbers in the pages are those that their commands have printed."""

import json
import re
import shlex
import sys
from pathlib import Path
from typing import Any

import pytest
import results
from test_examples import load_example
from timing import REPEATS

KEPT = sorted(path.stem for path in results.RESULTS.glob("*.json"))
CHECKED = [name for name in KEPT if results.load(name)["check"]]
MEASURED = re.compile(r"\d\.\d|\d %|\d m?s\b")
NUMBER = re.compile(r"-?\d[\d,]*(?:\.(\d+))?(?:e-?\d+)?")


def rows_by_labels(table: dict[str, Any]) -> dict[tuple[str, ...], dict[str, str]]:
    """The cells that hold no times, by the heads of their columns, by the labels of their rows."""
    found = {}
    for row in table["rows"]:
        cells = list(zip(table["columns"], row, strict=True))[table["labels"] :]
        found[tuple(row[: table["labels"]])] = {name: cell for name, cell in cells if name not in table["timed"]}
    return found


def close(cell: str, other: str) -> bool:
    """The same words, and numbers that differ by one in the last digit at most, or by 1 %."""
    if NUMBER.sub("#", cell) != NUMBER.sub("#", other):
        return False
    for mine, its in zip(NUMBER.finditer(cell), NUMBER.finditer(other), strict=True):
        a, b = (float(each[0].replace(",", "")) for each in (mine, its))
        if abs(a - b) > max(1.01 * 10.0 ** -len(mine[1] or ""), 0.01 * abs(b)):
            return False
    return True


@pytest.mark.parametrize("path", results.PAGES, ids=lambda path: path.stem)
def test_a_page_shows_what_was_measured(path: Path) -> None:
    page = path.read_text(encoding="utf-8")
    assert page == results.refreshed(page), "python tests/benchmarks/refresh.py"


@pytest.mark.parametrize("path", results.PAGES, ids=lambda path: path.stem)
def test_no_measured_table_is_written_by_hand(path: Path) -> None:
    page = results.MARKED.sub("", path.read_text(encoding="utf-8"))
    for table in re.findall(r"(?:^\|.*\n)+", page, re.M):
        cells = [cell for line in table.splitlines()[2:] for cell in line.strip("|").split("|")[1:]]
        measured = [cell for cell in cells if MEASURED.search(re.sub(r"`.*?`|\(.*?\)", "", cell))]
        assert 4 * len(measured) < len(cells), measured


def test_every_kept_table_stands_in_a_page() -> None:
    shown = [name for path in results.PAGES for name in results.names(path.read_text(encoding="utf-8"))]
    assert sorted(set(shown)) == KEPT


def test_cells_are_compared_by_their_last_digit() -> None:
    assert close("0.16; 4.0 %", "0.17; 4.0 %") and not close("0.16", "0.18") and not close("1,519", "1,600")
    assert not close("never", "2") and not close("3 %", "3 s")


@pytest.mark.slow
@pytest.mark.parametrize("name", CHECKED)
def test_a_row_is_measured_again(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A figure of the paper is also drawn."""
    table = results.load(name)
    script = table["command"].split()[1]
    pictures = [str(tmp_path)] * (name == "paper-figure5")
    arguments = [script, *pictures, *shlex.split(table["check"]), "--keep", str(tmp_path)]
    monkeypatch.setattr(sys, "argv", arguments)
    monkeypatch.setenv(REPEATS, "0")  # times are not compared
    load_example(f"../{script.removesuffix('.py')}").main()
    expected = rows_by_labels(table)
    again = rows_by_labels(json.loads((tmp_path / f"{name}.json").read_text(encoding="utf-8")))
    assert again
    assert not pictures or (tmp_path / f"{name}.png").stat().st_size > 30_000
    for labels, cells in again.items():
        for name, cell in cells.items():
            assert close(cell, expected[labels][name]), (labels, name, cell, expected[labels][name])
