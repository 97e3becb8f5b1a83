"""Tensors of a motion as its file holds them: 16 bits where the errors allow, and no mode that is not needed."""

import torch
from torch import Tensor

from torch_modal.motion.decoder import UNIT, scale_modes

SHARE = 0.05
"""Part of the largest error that rounding may add to the mean distance of a frame's vertices."""
LEAST = 1e-6
"""Rounding that is always allowed, over the diagonal."""
LEVELS = 2**16 - 1
BY_16_BITS = 2e-5
"""Largest distance by which 16 bits move a vertex, over the largest side of the bounding box."""


def reduce_modes(modes: Tensor, amplitudes: Tensor, size: float, allowed: float) -> tuple[Tensor, Tensor]:
    """Fewest combinations of the modes that move no frame by more than a part of the size, and their amplitudes.

    They are the right singular vectors of the amplitudes; at least one is left. *Shape:* ``(k, V, 3), (T, k) ->
    (r, V, 3), (T, r)``.
    """
    u, s, vh = torch.linalg.svd(amplitudes, full_matrices=False)
    scores = u * s
    left_out = scores.square().flip(1).cumsum(1).flip(1).sqrt().amax(0) * UNIT  # without the columns from each on
    r = max(1, int((left_out > allowed).sum()))
    combined = torch.einsum("rk,kvi->rvi", vh[:r], scale_modes(modes, size))
    largest = combined.flatten(1).abs().amax(1)[:, None, None].clamp_min(torch.finfo(combined.dtype).tiny)
    scaled = scale_modes(combined, size)
    # The decoder brings every mode to one size; the amplitudes take on the rest.
    factors = (combined * scaled).sum((1, 2)) / scaled.square().sum((1, 2)).clamp_min(torch.finfo(s.dtype).tiny)
    return combined / largest, scores[:, :r] * factors


def pack(name: str, x: Tensor, exact: bool = False) -> dict[str, Tensor]:
    """Shapes as 16-bit integers, or as float32, with what :func:`unpack` needs. *Shape:* ``(N, V, 3)``."""
    low = x.amin((0, 1))
    step = ((x.amax((0, 1)) - low).amax() / LEVELS).clamp_min(torch.finfo(x.dtype).tiny)
    rounded = (x - low).float() if exact else (((x - low) / step).round() - 2**15).to(torch.int16)
    return {name: rounded, f"{name}_low": low, f"{name}_step": step}


def unpack(name: str, tensors: dict[str, Tensor]) -> Tensor:
    """The shapes of :func:`pack`, float64. *Shape:* ``(N, V, 3)``."""
    x, low, step = (tensors[key] for key in (name, f"{name}_low", f"{name}_step"))
    return low + (x.double() if x.is_floating_point() else (x.double() + 2**15) * step)
