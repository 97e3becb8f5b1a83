"""Amplitudes for which a decoder's shapes are closest to given frames: a small least-squares problem for each frame."""

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from torch_modal.geometry.rigid import best_fit, infinitesimal_motions
from torch_modal.geometry.rotations import log
from torch_modal.motion.decoder import ModalDecoder

MAX_STEPS = 6
MIN_GAIN = 0.01  # a frame has converged when a step lowers the squared residual by less than this fraction
AMPLITUDE_RIDGE = 1e-4
"""Times the mean diagonal of the normal equations: amplitudes that hardly move the vertices stay near zero."""
MAX_TURN = 0.3
"""Change of edges, over their lengths, from which on the Jacobian is recomputed; about a rotation in radians."""
TURN_QUANTILE = 0.95  # quantile of the edges' changes that is compared with that limit


class FittedFrames(NamedTuple):
    """Amplitudes, rigid motions, and mean distances of the vertices over the diagonal, of T frames.

    *Shape:* ``(T, k), (T, 6), (T,)``.
    """

    amplitudes: Tensor
    motions: Tensor
    errors: Tensor


def fit(
    decoder: ModalDecoder, frames: Tensor, times: Tensor, on_frame: Callable[[], object] = lambda: None
) -> FittedFrames:
    """Fit amplitudes and rigid motions of frames at given times. *Shape:* ``(T, V, 3)``.

    Each frame starts from the amplitudes of the frame before, if both are in the same interval of key-frames.
    """
    n, k = len(frames), decoder.n_modes
    amplitudes, motions, errors = (torch.zeros(n, *size).double() for size in ((k,), (6,), ()))
    intervals = decoder.locate(times)[0]
    with torch.no_grad():
        for interval in intervals.unique():
            a, linear = torch.zeros(k).double(), None
            for f in torch.nonzero(intervals == interval)[:, 0].tolist():
                if linear is None or not linear.holds(decoder(a, times[f])):
                    linear = _Linearisation(decoder, a, times[f])
                a = _fit_frame(decoder, frames[f], times[f], a, linear)
                amplitudes[f] = a
                x = decoder(a, times[f])
                motion = best_fit(x, frames[f])
                motions[f] = torch.cat([log(motion.rotation), (motion.target - motion.source) / decoder.size])
                errors[f] = (motion.apply(x) - frames[f]).norm(dim=-1).mean() / decoder.size
                on_frame()
    return FittedFrames(amplitudes, motions, errors)


class _Linearisation:
    """Derivatives of the vertices with respect to the amplitudes, without rigid motions, and their normal equations.

    They are taken at one shape. Other shapes are aligned to it, so that they are valid however the body turns.
    """

    def __init__(self, decoder: ModalDecoder, a: Tensor, t: Tensor) -> None:
        self._ends = decoder.faces[:, :2].T
        self.x = decoder(a, t)
        flat = decoder.tangents(a, t).flatten(1)
        rigid = torch.linalg.qr(infinitesimal_motions(self.x - self.x.mean(0)).flatten(1).mT).Q
        #: *Shape:* ``(k, 3V)``.
        self.rows = flat - (flat @ rigid) @ rigid.mT
        normal = self.rows @ self.rows.mT
        self.ridge = AMPLITUDE_RIDGE * normal.diagonal().mean().clamp_min(torch.finfo(torch.float64).tiny)
        self.factor = torch.linalg.cholesky(normal + self.ridge * torch.eye(len(flat)).double())

    def holds(self, x: Tensor) -> bool:
        """True if a shape is so near that the derivatives are valid for it. *Shape:* ``(V, 3)``."""
        i, j = self._ends
        edges, other_edges = (shape[j] - shape[i] for shape in (self.x, best_fit(x, self.x).apply(x)))
        length = edges.norm(dim=1).clamp_min(torch.finfo(torch.float64).tiny)
        change = (other_edges - edges).norm(dim=1) / length
        return float(change.kthvalue(max(1, int(TURN_QUANTILE * len(change)))).values) < MAX_TURN

    def step(self, residual: Tensor, a: Tensor) -> Tensor:
        """Gauss-Newton step of the amplitudes. *Shape:* ``(V, 3), (k,) -> (k,)``."""
        right = self.rows @ residual.flatten() - self.ridge * a
        return torch.cholesky_solve(right[:, None], self.factor)[:, 0]


def _fit_frame(decoder: ModalDecoder, frame: Tensor, t: Tensor, start: Tensor, linear: _Linearisation) -> Tensor:
    """Amplitudes of one frame, starting from the given ones or from zero, whichever is nearer."""

    def evaluate(a: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        x = decoder(a, t)
        x = best_fit(x, linear.x).apply(x)
        residual = best_fit(frame, x).apply(frame) - x
        return a, residual, residual.square().sum()

    best = min((evaluate(a) for a in (start, torch.zeros_like(start))), key=lambda one: float(one[2]))
    for _ in range(MAX_STEPS):
        a, residual, squared = best
        new = evaluate(a + linear.step(residual, a))
        if new[2] > squared:
            break
        best = new
        if new[2] > (1 - MIN_GAIN) * squared:
            break
    return best[0]
