"""Curves in time that vanish at both key-frames: through given values, and as a basis."""

from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

KNOTS = 12
"""Intervals of the splines."""


def through(times: Tensor, t: Tensor) -> Tensor:
    """Weights of a cubic spline through values at given times, and zero at 0 and 1. *Shape:* ``(T,), (B,) -> (B, T)``.

    Their first derivative in ``t`` comes as a gradient.
    """
    from scipy.interpolate import CubicSpline  # 0.1 s, where nothing needs it

    knots = np.concatenate([[0.0], times.detach().double().cpu().numpy(), [1.0]])
    return _with_slopes(CubicSpline(knots, np.eye(len(knots)), bc_type="natural"), t)


def _with_slopes(spline: Any, t: Tensor) -> Tensor:
    """All but the first and the last of some functions, at given times. *Shape:* ``(B,) -> (B, J)``."""
    at = t.detach().double().cpu().numpy()
    values, slopes = (torch.from_numpy(f(at)[:, 1:-1]).to(t) for f in (spline, spline.derivative()))
    return values + slopes * (t - t.detach())[:, None] if t.requires_grad else values


class Splines(NamedTuple):
    """Cubic B-splines that vanish at 0 and 1."""

    values: Tensor
    """*Shape:* ``(T, J)``."""
    bend: Tensor
    """Integrals of products of their second derivatives. *Shape:* ``(J, J)``."""


def splines(t: Tensor, n: int | None = None) -> Splines:
    """The splines at given times, with their first derivative as a gradient.

    Args:
        t: Times in [0, 1]. *Shape:* ``(T,)``.
        n: Number of their intervals, J - 1. Default: :data:`KNOTS`.
    """
    from scipy.interpolate import BSpline  # 0.1 s, where nothing needs it

    n = KNOTS if n is None else n
    knots = np.concatenate([np.zeros(3), np.linspace(0, 1, n + 1), np.ones(3)])
    every = BSpline(knots, np.eye(n + 3), 3)
    # Second derivatives are linear in each interval: Gauss' rule with two points is exact for their products.
    middle, half = (np.arange(n) + 0.5) / n, 0.5 / n / np.sqrt(3)
    second = every.derivative(2)(np.concatenate([middle - half, middle + half]))[:, 1:-1]
    return Splines(_with_slopes(every, t), torch.from_numpy(second.T @ second / (2 * n)).to(t.detach()))
