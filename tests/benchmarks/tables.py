"""Numbers of tables as text."""

import math
from statistics import fmean

from measures import NAN


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
