"""Amplitudes that bring a decoder's shapes closest to given frames: a small least-squares problem for each frame."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from torch_modal.geometry.rigid import best_fit
from torch_modal.geometry.rotations import log
from torch_modal.nn.modal_decoder import Interval, ModalDecoder, moved

MAX_STEPS = 6
ENOUGH = 0.01
"""A frame is done when a step brings less than this part of what is left."""
RIDGE = 1e-4
"""Over the mean diagonal of the normal equations: what the vertices hardly tell stays near the path."""
DIFFERENCE = 1e-3
"""Of amplitudes, in the differences for derivatives."""
TURN = 0.35
"""Radians that a triangle in motion may turn before derivatives are taken anew."""
MOVING = 0.95
"""Of the triangles turn by less than the turn that counts for this."""


class Fit(NamedTuple):
    """What belongs to each frame."""

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
    told: Callable[[], None] = lambda: None,
    only: Sequence[int] | None = None,
) -> Fit:
    """Amplitudes and rigid motions of frames; zero at the key-frames.

    Args:
        decoder: With key-frames near those frames.
        frames: *Shape:* ``(T, V, 3)``.
        times: When they are. *Shape:* ``(T,)``.
        keys: Which of them are key-frames.
        told: Called after each frame.
        only: Frames to fit. Default: all; the others' numbers are zero.
    """
    n, k = len(frames), decoder.n_modes
    found = Fit(torch.zeros(n, k).double(), torch.zeros(n, 6).double(), torch.zeros(n).double())
    wanted = list(range(n) if only is None else only)
    segment, u = torch.zeros(n).long(), torch.zeros(n).double()
    segment[wanted], u[wanted] = decoder.located(times[wanted])
    keyed = set(keys)
    with torch.no_grad():
        for i in range(decoder.n_intervals):
            mine = [f for f in wanted if int(segment[f]) == i]
            inner = [f for f in mine if f not in keyed]
            if inner:
                _fit_interval(decoder, i, frames, u, inner, found, told)
            for f in set(mine) & keyed:
                found.errors[f] = _error(decoder.keyframes[list(keys).index(f)], frames[f], decoder)
                told()
    return found


def _fit_interval(
    decoder: ModalDecoder, i: int, frames: Tensor, u: Tensor, rows: list[int], found: Fit, told: Callable[[], None]
) -> None:
    interval = decoder.interval(i)
    turns = torch.quantile(interval.course.step[:3].norm(dim=0).flatten()[::7], MOVING)
    n_places = int(float(turns) / TURN) + 1
    places = ((u[rows] * n_places).long().clamp(0, n_places - 1)).tolist()
    a = torch.zeros(decoder.n_modes).double()
    tangent: _Tangent | None = None
    before = -1
    for f, place in zip(rows, places, strict=True):
        if place != before:
            here = [u[g] for g, other in zip(rows, places, strict=True) if other == place]
            tangent, before = _Tangent(decoder, i, interval, a, torch.stack(here).mean()), place
        assert tangent is not None
        a = _fit_frame(decoder, i, interval, frames[f].double(), u[f], a, tangent)
        x = decoder.alignment.restore(decoder.bent(i, interval, a[None], u[f : f + 1]), interval.pair, u[f : f + 1])
        motion = best_fit(x, frames[f : f + 1].double(), torch.ones(x.shape[1]).double())
        found.amplitudes[f] = a
        found.motions[f, :3] = log(motion.rotation)[0]
        found.motions[f, 3:] = (motion.target - motion.source)[0] / decoder.size
        found.errors[f] = _error(moved(x, found.motions[f : f + 1], decoder.size)[0], frames[f], decoder)
        told()


class _Tangent:
    """Derivatives of the vertices by the amplitudes, without rigid motions, and their normal equations."""

    def __init__(self, decoder: ModalDecoder, i: int, interval: Interval, a: Tensor, u: Tensor) -> None:
        k = decoder.n_modes
        x = decoder.bent(i, interval, a[None], u[None])[0]
        step = DIFFERENCE * torch.eye(k).double()
        chunk = max(1, 400_000 // decoder.keyframes.shape[1])
        parts = []
        for rows in torch.arange(k).split(chunk):
            u_rows = u.expand(len(rows))
            parts.append((decoder.bent(i, interval, a + step[rows], u_rows) - x) / DIFFERENCE)
        columns = torch.cat(parts)
        axes = torch.eye(3).double()[:, None].expand(3, *x.shape)
        rigid = torch.cat([axes, torch.linalg.cross(axes, (x - x.mean(0)).expand(3, *x.shape))])
        rigid = torch.linalg.qr(rigid.flatten(1).mT).Q
        flat = columns.flatten(1)
        #: *Shape:* ``(k, 3V)``.
        self.columns = flat - (flat @ rigid) @ rigid.mT
        normal = self.columns @ self.columns.mT
        ridge = RIDGE * normal.diagonal().mean().clamp_min(torch.finfo(torch.float64).tiny)
        self.ridge = ridge
        self.factor = torch.linalg.cholesky(normal + ridge * torch.eye(k).double())

    def step(self, residual: Tensor, a: Tensor) -> Tensor:
        right = self.columns @ residual.flatten() - self.ridge * a
        return torch.cholesky_solve(right[:, None], self.factor)[:, 0]


def _fit_frame(
    decoder: ModalDecoder, i: int, interval: Interval, frame: Tensor, u: Tensor, start: Tensor, tangent: _Tangent
) -> Tensor:
    """Amplitudes of one frame; from zero if that is nearer than where the frame before was."""
    target = decoder.alignment.bring(frame[None], interval.pair, u[None])
    even = torch.ones(target.shape[1]).double()

    def residual(a: Tensor) -> tuple[Tensor, Tensor]:
        x = decoder.bent(i, interval, a[None], u[None])
        apart = best_fit(target, x, even).apply(target) - x
        return apart, apart.square().sum()

    def tried(a: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        return (a, *residual(a))

    best = min((tried(a) for a in (start, torch.zeros_like(start))), key=lambda one: float(one[2]))
    for _ in range(MAX_STEPS):
        a, apart, left = best
        step = tangent.step(apart, a)
        new = tried(a + step)
        if new[2] > left:
            new = tried(a + 0.4 * step)
        if new[2] > left:
            break
        gain = 1 - float(new[2] / left.clamp_min(torch.finfo(torch.float64).tiny))
        best = new
        if gain < ENOUGH:
            break
    return best[0]


def _error(x: Tensor, frame: Tensor, decoder: ModalDecoder) -> Tensor:
    return (x - frame).norm(dim=-1).mean() / decoder.size
