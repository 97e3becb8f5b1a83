"""Amplitudes that bring a decoder's shapes closest to given frames: a small least-squares problem for each frame."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from torch_modal.geometry.rigid import best_fit
from torch_modal.geometry.rotations import log
from torch_modal.motion.decoder import Interval, ModalDecoder, moved

MAX_STEPS = 6
MIN_GAIN = 0.01
"""A frame is done when a step lowers the squared residual by less than this part."""
RIDGE = 1e-4
"""Over the mean diagonal of the normal equations: amplitudes that hardly move the vertices stay near zero."""
DIFFERENCE = 1e-3
"""Of amplitudes, in the finite differences of the Jacobian."""
MAX_ROTATION = 0.35
"""Radians that triangles on the path may rotate before the Jacobian is recomputed."""
QUANTILE = 0.95
"""Of the triangles' rotations, which is compared with that limit."""


class FittedFrames(NamedTuple):
    """Amplitudes, rigid motions and errors of frames."""

    amplitudes: Tensor
    """*Shape:* ``(T, k)``."""
    motions: Tensor
    """*Shape:* ``(T, 6)``."""
    errors: Tensor
    """Mean distance of the vertices, over the diagonal. *Shape:* ``(T,)``."""


def fit(
    decoder: ModalDecoder,
    frames: Tensor,
    times: Tensor,
    keys: Sequence[int],
    on_frame: Callable[[], None] = lambda: None,
    only: Sequence[int] | None = None,
) -> FittedFrames:
    """Fit amplitudes and rigid motions of frames; they are zero at the key-frames.

    Args:
        decoder: With key-frames near those frames.
        frames: *Shape:* ``(T, V, 3)``.
        times: Of the frames. *Shape:* ``(T,)``.
        keys: Which of them are key-frames.
        on_frame: Called after each frame.
        only: Frames to fit. Default: all. The others' numbers are zero.
    """
    n, k = len(frames), decoder.n_modes
    found = FittedFrames(torch.zeros(n, k).double(), torch.zeros(n, 6).double(), torch.zeros(n).double())
    wanted = list(range(n) if only is None else only)
    segment, u = torch.zeros(n).long(), torch.zeros(n).double()
    segment[wanted], u[wanted] = decoder.located(times[wanted])
    keyframe_of = {f: i for i, f in enumerate(keys)}
    with torch.no_grad():
        for i in range(decoder.n_intervals):
            own = [f for f in wanted if int(segment[f]) == i]
            inner = [f for f in own if f not in keyframe_of]
            if inner:
                _fit_interval(decoder, i, frames, u, inner, found, on_frame)
            for f in set(own) & keyframe_of.keys():
                found.errors[f] = _error(decoder.keyframes[keyframe_of[f]], frames[f], decoder)
                on_frame()
    return found


def _fit_interval(
    decoder: ModalDecoder,
    i: int,
    frames: Tensor,
    u: Tensor,
    rows: list[int],
    found: FittedFrames,
    on_frame: Callable[[], None],
) -> None:
    interval = decoder.interval(i)
    rotation = torch.quantile(interval.trajectory.step[:3].norm(dim=0).flatten()[::7], QUANTILE)
    n_parts = int(float(rotation) / MAX_ROTATION) + 1
    part_of = (u[rows] * n_parts).long().clamp(0, n_parts - 1)
    a = torch.zeros(decoder.n_modes).double()
    for part in part_of.unique():
        own = torch.tensor(rows)[part_of == part]
        jacobian = _Jacobian(decoder, i, interval, a, u[own].mean())
        for f in own.tolist():
            a = _fit_frame(decoder, i, interval, frames[f].double(), u[f], a, jacobian)
            x = decoder.alignment.restore(decoder.bent(i, interval, a[None], u[f : f + 1]), interval.pair, u[f : f + 1])
            motion = best_fit(x, frames[f : f + 1].double(), torch.ones(x.shape[1]).double())
            found.amplitudes[f] = a
            found.motions[f, :3] = log(motion.rotation)[0]
            found.motions[f, 3:] = (motion.target - motion.source)[0] / decoder.size
            found.errors[f] = _error(moved(x, found.motions[f : f + 1], decoder.size)[0], frames[f], decoder)
            on_frame()


class _Jacobian:
    """Derivatives of the vertices by the amplitudes, without rigid motions, and their normal equations."""

    def __init__(self, decoder: ModalDecoder, i: int, interval: Interval, a: Tensor, u: Tensor) -> None:
        k = decoder.n_modes
        x = decoder.bent(i, interval, a[None], u[None])[0]
        step = DIFFERENCE * torch.eye(k).double()
        chunk = max(1, 400_000 // decoder.keyframes.shape[1])
        parts = []
        for rows in torch.arange(k).split(chunk):
            parts.append((decoder.bent(i, interval, a + step[rows], u.expand(len(rows))) - x) / DIFFERENCE)
        axes = torch.eye(3).double()[:, None].expand(3, *x.shape)
        rigid = torch.cat([axes, torch.linalg.cross(axes, (x - x.mean(0)).expand(3, *x.shape))])
        rigid = torch.linalg.qr(rigid.flatten(1).mT).Q
        flat = torch.cat(parts).flatten(1)
        #: *Shape:* ``(k, 3V)``.
        self.rows = flat - (flat @ rigid) @ rigid.mT
        normal = self.rows @ self.rows.mT
        self.ridge = RIDGE * normal.diagonal().mean().clamp_min(torch.finfo(torch.float64).tiny)
        self.factor = torch.linalg.cholesky(normal + self.ridge * torch.eye(k).double())

    def step(self, residual: Tensor, a: Tensor) -> Tensor:
        right = self.rows @ residual.flatten() - self.ridge * a
        return torch.cholesky_solve(right[:, None], self.factor)[:, 0]


def _fit_frame(
    decoder: ModalDecoder, i: int, interval: Interval, frame: Tensor, u: Tensor, start: Tensor, jacobian: _Jacobian
) -> Tensor:
    """Amplitudes of one frame, from those of the frame before or from zero, whichever is nearer."""
    target = decoder.alignment.bring(frame[None], interval.pair, u[None])
    uniform = torch.ones(target.shape[1]).double()

    def tried(a: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        x = decoder.bent(i, interval, a[None], u[None])
        residual = best_fit(target, x, uniform).apply(target) - x
        return a, residual, residual.square().sum()

    best = min((tried(a) for a in (start, torch.zeros_like(start))), key=lambda one: float(one[2]))
    for _ in range(MAX_STEPS):
        a, residual, squared = best
        step = jacobian.step(residual, a)
        new = tried(a + step)
        if new[2] > squared:
            new = tried(a + 0.4 * step)
        if new[2] > squared:
            break
        best = new
        if 1 - float(new[2] / squared.clamp_min(torch.finfo(torch.float64).tiny)) < MIN_GAIN:
            break
    return best[0]


def _error(x: Tensor, frame: Tensor, decoder: ModalDecoder) -> Tensor:
    return (x - frame).norm(dim=-1).mean() / decoder.size
