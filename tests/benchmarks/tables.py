"""Numbers of tables as text."""

import math
from collections.abc import Iterable
from statistics import fmean

from measures import NAN
from results import head


def print_table(title: str, columns: Iterable[str], rows: Iterable[Iterable[str]]) -> None:
    """Print a table in Markdown, each line as soon as it is known."""
    print(f"\n**{title}**\n\n{head(*columns)}", flush=True)
    for row in rows:
        print(f"| {' | '.join(row)} |", flush=True)


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
