"""Times of key-frames and frames: one check, times between them, and the interval of a time."""

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from torch_modal.arrays import FloatArray
from torch_modal.autograd import is_traced, run_outside_transforms

Times = Tensor | Sequence[float] | FloatArray | None
"""Times of key-frames or frames, ascending; None: 0, 1, 2 and so on."""


def check_times(times: Times, n: int, cyclic: bool | None = False, of: str = "key-frame") -> Tensor:
    """Ascending times of key-frames or frames; of a cycle, also the time when the first comes again.

    Args:
        times: By default 0, 1, 2 and so on. *Shape:* ``(n,)``, or ``(n + 1,)`` of a cycle.
        n: Number of key-frames.
        cyclic: True for a cycle; None if the number of times says so.
        of: What has the times, for the message.

    Returns:
        Float64, on the CPU.

    Raises:
        ValueError: The number of times is wrong, or they do not ascend.
    """
    if times is None:
        return torch.arange(n + bool(cyclic), dtype=torch.float64)
    when = torch.as_tensor(times, dtype=torch.float64).detach().cpu()
    sizes = (n, n + 1) if cyclic is None else (n + cyclic,)
    got = f"shape {tuple(when.shape)}"
    if when.dim() == 1 and len(when) in sizes:
        ascends = when.isfinite() & (when.diff(prepend=when.new_tensor([-torch.inf])) > 0)
        if bool(ascends.all()):
            return when
        i = int(ascends.long().argmin())
        got = f"{when[i]:g} at place {i}" + (f", after {when[i - 1]:g}" if i else "")
    end = ", and one when the first comes again" if cyclic else ""
    raise ValueError(
        f"times must be {' or '.join(map(str, sizes))} ascending numbers, one for each {of}{end}; got {got}"
    )


def fill_linear(values: Tensor, places: Sequence[int]) -> Tensor:
    """Values of all frames up to the last place, linear between the places, which have the given values.

    One place more than values closes a cycle, whose last frame is left out. *Shape:* ``(N, ...) -> (T, ...)``.
    """
    cyclic, n = len(places) > len(values), len(values)
    at = np.interp(np.arange(places[-1] + (not cyclic)), places, np.arange(len(places)))
    left, u = torch.from_numpy(at).long(), torch.from_numpy(at).frac().to(values)
    return torch.lerp(values[left % n], values[(left + 1) % n], u.reshape(-1, *[1] * (values.dim() - 1)))


def wrap_times(t: Tensor, times: Tensor) -> Tensor:
    """Times modulo the period of a cycle. *Shape:* ``(B,), (K + 1,) -> (B,)``."""
    period = times[-1] - times[0]
    return t - period * torch.floor((t.detach() - times[0]) / period)


def locate_times(
    t: Tensor, times: Tensor, cyclic: bool, rounding: float = 0.0, of: str = "key-frame"
) -> tuple[Tensor, Tensor]:
    """Interval that each time lies in, and its fraction of the interval. *Shape of each:* ``(B,)``.

    Args:
        t: *Shape:* ``(B,)``.
        times: Of :func:`check_times`. *Shape:* ``(K,)``, or ``(K + 1,)`` of a cycle.
        cyclic: True if times are taken modulo the period.
        rounding: Relative distance from a key-frame below which a time is the key-frame's: 0.3 in float32 differs from
            0.3 in float64, and would miss the key-frame, or lie after the last.
        of: What has the times, for the message.

    Raises:
        ValueError: A time is before the first or after the last.
    """
    scale = torch.maximum(t.detach().abs(), times.abs().amax())
    if cyclic:
        t = wrap_times(t, times)
    if rounding:
        differences = times - t.detach()[:, None]
        to_nearest = differences.gather(1, differences.abs().argmin(1, keepdim=True))[:, 0]
        t = t + torch.where(to_nearest.abs() <= 2 * rounding * scale, to_nearest, 0.0)

    def require_within(t: Tensor, times: Tensor) -> None:
        outside = t[~((t >= times[0]) & (t <= times[-1]))].tolist()
        if outside:
            ends = f"{float(times[0]):g} and {float(times[-1]):g}"
            raise ValueError(f"t lies between the times of the first and the last {of}, {ends}; got {outside[0]:g}")

    if not is_traced(t):
        run_outside_transforms(require_within, t, times)
    interval = (torch.searchsorted(times, t.detach().contiguous(), right=True) - 1).clamp(0, len(times) - 2)
    return interval, (t - times[interval]) / (times[interval + 1] - times[interval])
