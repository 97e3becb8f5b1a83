r"""Cubic splines in time through key-frames, relative to the straight steps between them.

A quantity steps by ``d`` from one key-frame to the next in the time ``h``. Its cubic with the velocities ``m_0`` and
``m_1`` at both is

.. math::
    q(u) = q_0 + u\, d + u (1 - u) \bigl((1 - u)\, e_0 - u\, e_1\bigr), \qquad e_i = h\, m_i - d,

with ``u`` from 0 to 1 (Hermite). Quantities may be vectors, or rotations, whose steps are axis times angle in
coordinates that turn along.
"""

from collections.abc import Callable
from typing import NamedTuple, TypeVar

import torch
from torch import Tensor

from torch_modal import trees
from torch_modal.autograd import is_traced, is_vmapped, run_outside_transforms

# Velocities are cut from this many times the slower one of the steps before and after on, and never reach three times:
# what stops, stops, and no quantity that grows overshoots (Fritsch and Carlson 1980).
LIMIT = 2.75

Part = TypeVar("Part")

Squared = Callable[[Tensor], Tensor]
"""Squared size of a quantity, which broadcasts against it."""

Scheme = Callable[[Tensor, Tensor, bool, Squared], Tensor]
"""A path scheme: velocities at all key-frames, from the mean velocities between them.

Arguments: mean velocities, *shape* ``(N, ...)``; the durations, *shape* ``(N,)``; True for a cycle; the squared size of
a quantity, whose components are in a dimension that this function knows. Result: *shape* ``(N + 1, ...)``.
"""


class Cubics(NamedTuple):
    """A quantity between key-frames: its steps, and how far the velocities at both ends are from them.

    *Shape of each:* ``(N, ...)``.
    """

    step: Tensor
    first: Tensor
    last: Tensor

    def along(self, i: int, which: Tensor, u: Tensor) -> Tensor:
        """The way from the start of an interval to times in it, 0 to 1. *Shape:* ``(B,), (B,) -> (B, ...)``."""
        step, first, last = (values[i][which] for values in self)
        wide = u.view(-1, *[1] * (step.dim() - 1))
        return wide * step + offset(first, last, wide)


def cubics(
    steps: Tensor, durations: Tensor, cyclic: bool, squared: Squared = torch.square, scheme: Scheme | None = None
) -> Cubics:
    """Cubics of given steps and durations, by :func:`limited_spline` unless there is another scheme.

    *Shape:* ``(N, ...), (N,)``. A cycle's last step leads back to its first key-frame.
    """
    h = durations.to(steps).view(-1, *[1] * (steps.dim() - 1))
    velocities = (scheme or limited_spline)(steps / h, durations, cyclic, squared)
    return Cubics(steps, h * velocities[:-1] - steps, h * velocities[1:] - steps)


def limited_spline(speeds: Tensor, durations: Tensor, cyclic: bool, squared: Squared) -> Tensor:
    r"""Velocities of the cubic spline with continuous acceleration, limited at each key-frame (:data:`LIMIT`).

    .. math:: h_i\, m_{i-1} + 2 (h_{i-1} + h_i)\, m_i + h_{i-1}\, m_{i+1} = 3 (h_i\, s_{i-1} + h_{i-1}\, s_i)

    with the mean velocities ``s`` between the key-frames. Ends have no acceleration. Arguments as for :data:`Scheme`.
    """
    n = len(speeds)
    if n == 1 and not cyclic:
        return torch.cat([speeds, speeds])
    # Not SciPy's spline: transforms of torch.func wrap even constants.
    h, inner = durations.double(), torch.arange(0 if cyclic else 1, n, device=durations.device)
    before, here = h[inner - 1][:, None], h[inner][:, None]
    of_speed, of_velocity = torch.eye(n).to(h), torch.eye(n + (not cyclic)).to(h)
    matrix = here * of_velocity[inner - 1] + 2 * (before + here) * of_velocity[inner]
    matrix = matrix + before * of_velocity[(inner + 1) % len(of_velocity)]
    right = 3 * (here * of_speed[inner - 1] + before * of_speed[inner])
    if not cyclic:
        ends = of_velocity[:1] * 2 + of_velocity[1:2], of_velocity[-2:-1] + 2 * of_velocity[-1:]
        matrix = torch.cat([ends[0], matrix, ends[1]])
        right = torch.cat([3 * of_speed[:1], right, 3 * of_speed[-1:]])
    velocities = torch.tensordot(torch.linalg.solve(matrix, right).to(speeds), speeds, 1)
    slow, fast, length = squared(speeds[inner - 1]), squared(speeds[inner]), squared(velocities[inner])
    both = slow + fast
    most = LIMIT**2 * slow * fast / torch.where(both > 0, both, 1)
    # Up to the limit nothing changes; beyond it, velocities fall so that no corner is left, there or at rest.
    cut = most < length
    ratio = torch.where(cut, most, 1) / torch.where(cut, length, 1)
    limited = velocities[inner] * (ratio * (2 - ratio))
    if cyclic:
        return torch.cat([limited, limited[:1]])
    return torch.cat([1.5 * speeds[:1] - 0.5 * limited[:1], limited, 1.5 * speeds[-1:] - 0.5 * limited[-1:]])


def offset(first: Tensor, last: Tensor, u: Tensor) -> Tensor:
    """Difference between a cubic and the straight step at ``u``, which broadcasts against the others."""
    return u * (1 - u) * ((1 - u) * first - u * last)


def evaluate_by_interval(segment: Tensor, n: int, shapes: Callable[[int, Tensor | slice], Part]) -> Part:
    """Evaluate shapes interval by interval, and join the results in the order of the batch.

    Where ``vmap`` maps the intervals, or tracing does not know them, all rows are computed in each interval.

    Args:
        segment: The interval of each shape. *Shape:* ``(B,)``.
        n: Number of intervals.
        shapes: Computes some rows of the batch, which are in one interval: a tensor, or a tree of tensors.
    """
    traced = is_traced(segment)
    used = range(n) if traced else run_outside_transforms(lambda x: x.unique().tolist(), segment)
    intervals = list(used) or [0]  # of nothing, nothing
    if traced or is_vmapped(segment):
        place, size = sum((segment == i) * place for place, i in enumerate(intervals)), segment.shape[0]
        order = place * size + torch.arange(size, device=segment.device)
        parts = [shapes(i, slice(None)) for i in intervals]
    else:
        rows = [torch.nonzero(segment == i).flatten() for i in intervals]
        order = torch.argsort(torch.cat(rows))
        parts = [shapes(*each) for each in zip(intervals, rows, strict=True)]
    joined = (torch.cat(tensors)[order] for tensors in zip(*map(trees.leaves, parts), strict=True))
    return trees.fill(parts[0], joined)  # type: ignore[no-any-return]
