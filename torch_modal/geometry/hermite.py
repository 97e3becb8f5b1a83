r"""Cubic motion through key-frames, relative to the straight step between two of them.

Of any quantity that steps by ``d`` from one key-frame to the next, in the time ``h``, the cubic with the velocities
``m_0`` and ``m_1`` at both is

.. math::
    q(u) = q_0 + u\, d + u (1 - u) \bigl((1 - u)\, e_0 - u\, e_1\bigr), \qquad e_i = h\, m_i - d,

with ``u`` from 0 to 1 (Hermite). Only the tangent offsets ``e`` depend on the neighbours in time. Quantities may be
vectors, or rotations, whose steps are axis times angle in coordinates that turn along.
"""

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from torch_modal.autograd import made_outside, traced

# Velocities are cut from this many times the slower one of the steps before and after on, and never reach three times:
# what stops, stops, and no quantity that grows overshoots (Fritsch and Carlson 1980).
LIMIT = 2.75


class TangentOffset(NamedTuple):
    """How far the velocities at both ends are from the straight step's."""

    first: Tensor
    last: Tensor


Tangents = Callable[[Tensor, Tensor, Tensor, Tensor, Callable[[Tensor], Tensor]], Tensor]
"""A path scheme: the velocity at a key-frame.

From the velocities of the steps before and after it, the durations of both, and a function for the squared size of a
quantity. Quantities are vectors or rotation vectors, with components in a dimension that this function knows.
"""


class Spacing(NamedTuple):
    """How long the intervals are: the one before, this one, and the one after. *Shape of each:* ``(B,)``."""

    before: Tensor
    own: Tensor
    after: Tensor
    tangents: Tangents | None = None
    """The path scheme; the limited parabola where None."""

    def mapped(self, function: Callable[[Tensor], Tensor]) -> "Spacing":
        """Durations of another shape or dtype."""
        return Spacing(function(self.before), function(self.own), function(self.after), self.tangents)


def tangent_offset(
    step: Tensor,
    before: Tensor | None,
    after: Tensor | None,
    spacing: Spacing,
    squared: Callable[[Tensor], Tensor] = torch.square,
) -> TangentOffset:
    r"""The tangent offsets that follow from the steps before and after.

    Velocities are those of the parabola through three key-frames, :math:`(h_+ v_- + h_- v_+) / (h_- + h_+)` of the
    velocities of both steps, limited (:data:`LIMIT`). Evenly spaced, that is Catmull and Rom's spline, and half-way
    the four-point scheme of Dyn, Levin and Gregory 1987. Another scheme is :attr:`Spacing.tangents`. An end has no
    acceleration (a natural end).

    Args:
        step: From one key-frame to the next. *Shape:* ``(...)``.
        before: The step before it; None at the first key-frame.
        after: The step after it; None at the last.
        spacing: Durations, that broadcast against the steps.
        squared: The square of a quantity's size, which broadcasts against it.
    """
    first: Tensor | None = None
    last: Tensor | None = None
    velocity = spacing.tangents or _velocity
    if before is not None:
        speed = velocity(before / spacing.before, step / spacing.own, spacing.before, spacing.own, squared)
        first = spacing.own * speed - step
    if after is not None:
        speed = velocity(step / spacing.own, after / spacing.after, spacing.own, spacing.after, squared)
        last = spacing.own * speed - step
    if first is None and last is None:
        return TangentOffset(torch.zeros_like(step), torch.zeros_like(step))
    # No second derivative at an end: -4 e_0 - 2 e_1 = 0 at the first.
    if first is None:
        assert last is not None
        return TangentOffset(-0.5 * last, last)
    return TangentOffset(first, -0.5 * first if last is None else last)


def _velocity(
    before: Tensor, after: Tensor, h_before: Tensor, h_after: Tensor, squared: Callable[[Tensor], Tensor]
) -> Tensor:
    wanted = (h_after * before + h_before * after) / (h_before + h_after)
    slow, fast, found = squared(before), squared(after), squared(wanted)
    both = slow + fast
    most = LIMIT**2 * slow * fast / torch.where(both > 0, both, 1)
    # Up to the limit nothing changes; beyond it, velocities fall so that no corner is left, there or at rest.
    cut = most < found
    part = torch.where(cut, most, 1) / torch.where(cut, found, 1)
    return wanted * (part * (2 - part))


def located(t: Tensor, times: Tensor, cyclic: bool, rounding: float = 0.0) -> tuple[Tensor, Tensor]:
    """The interval between key-frames that each time lies in, and how far along it is.

    Args:
        t: *Shape:* ``(B,)``.
        times: Of the key-frames, ascending; if cyclic, one more, when the first comes again. *Shape:* ``(K,)``.
        cyclic: Whether times are taken modulo the period.
        rounding: Relative. Times so near to a key-frame are taken for its own: 0.3 in float32 is beside 0.3 in float64,
            and would miss the key-frame, or lie after the last.

    Returns:
        *Shape of each:* ``(B,)``.

    Raises:
        ValueError: A time is before the first or after the last.
    """
    scale = torch.maximum(t.detach().abs(), times.abs().amax())
    if cyclic:
        t = wrapped(t, times)
    if rounding:
        differences = times - t.detach()[:, None]
        to_nearest = differences.gather(1, differences.abs().argmin(1, keepdim=True))[:, 0]
        t = t + torch.where(to_nearest.abs() <= 2 * rounding * scale, to_nearest, 0.0)
    if not traced(t):
        made_outside(_check_times, t, times)
    segment = (torch.searchsorted(times, t.detach().contiguous(), right=True) - 1).clamp(0, len(times) - 2)
    return segment, (t - times[segment]) / (times[segment + 1] - times[segment])


def _check_times(t: Tensor, times: Tensor) -> None:
    outside = ~((t >= times[0]) & (t <= times[-1]))
    if bool(outside.any()):
        raise ValueError(
            f"t lies between the times of the first and the last key-frame, {float(times[0]):g} and "
            f"{float(times[-1]):g}; got {float(t[outside][0]):g}"
        )


def wrapped(t: Tensor, times: Tensor) -> Tensor:
    """Times modulo the period of a cycle. *Shape:* ``(B,)``."""
    period = times[-1] - times[0]
    return t - period * torch.floor((t.detach() - times[0]) / period)


def around(i: int, times: Tensor, cyclic: bool) -> tuple[int | None, int | None, Spacing]:
    """The key-frames before and after an interval, None where there are none, and how long it and its neighbours are.

    Args:
        i: Number of the interval.
        times: As for :func:`located`.
        cyclic: Whether the last key-frame leads on to the first.
    """
    h = times.diff()
    n = len(h) + (not cyclic)
    before = (i - 1) % n if cyclic or i > 0 else None
    after = (i + 2) % n if cyclic or i < len(h) - 1 else None
    previous, own, following = (h[j % len(h)] for j in (i - 1, i, i + 1))
    return before, after, Spacing(previous, own, following)


def beyond(bend: TangentOffset, u: Tensor) -> Tensor:
    """The difference between the cubic and the straight step at ``u``, which broadcasts against the tangent offset."""
    return u * (1 - u) * ((1 - u) * bend.first - u * bend.last)


def squared_length(x: Tensor) -> Tensor:
    """Of vectors, components last. *Shape:* ``(..., 3) -> (..., 1)``."""
    return x.square().sum(-1, keepdim=True)
