"""Damped Gauss-Newton steps for fits: one problem, a dense matrix."""

from collections.abc import Callable

import torch
from torch import Tensor

# Larger dampings that are tried for one step.
MOST_TRIALS = 8


def levenberg_marquardt(
    x: Tensor,
    cost: Callable[[Tensor], Tensor],
    linearise: Callable[[Tensor], tuple[Tensor, Tensor]],
    n_steps: int,
    tolerance: float,
) -> Tensor:
    """Minimise a sum of squares by Gauss-Newton steps, damped where the cost does not fall.

    Args:
        x: Start. *Shape:* ``(n,)``.
        cost: The sum of squares. *Shape:* ``(n,) -> ()``.
        linearise: Gauss-Newton matrix and half the negative gradient. *Shape:* ``(n,) -> (n, n), (n,)``.
        n_steps: Maximum number of steps.
        tolerance: Relative decrease of the cost below which the iteration ends.

    Returns:
        *Shape:* ``(n,)``; its cost is at most the cost of the start.
    """
    value, damping = cost(x), 0.0
    eye = torch.eye(len(x)).to(x)
    for _ in range(n_steps):
        matrix, downhill = linearise(x)
        for _ in range(MOST_TRIALS):
            tried = x + torch.linalg.solve_ex(matrix + damping * eye, downhill).result
            lower = cost(tried)
            if lower < value:
                break
            damping = max(10 * damping, 1.0)
        else:
            return x
        damping = damping / 10 if damping > 1 else 0.0
        has_converged = value - lower < tolerance * value
        x, value = tried, lower
        if has_converged:
            return x
    return x
