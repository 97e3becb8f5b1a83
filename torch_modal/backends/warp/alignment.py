""":class:`torch_modal.inbetween.frame.Alignment` by Warp kernels, without gradients."""

import math

import torch
from torch import Tensor

from torch_modal.autograd import traced, transformed
from torch_modal.backends.torch.alignment import Alignment, Pair, PlacedPairs
from torch_modal.backends.warp.launch import kernels, launch, zeros
from torch_modal.geometry.rigid import RigidMotion

# Of Jacobi's rotations of a 4 x 4 matrix: the last ones change nothing.
N_SWEEPS = 8


def serves(*given: Tensor) -> bool:
    """Whether tensors are plain numbers in float64, and nothing is recorded."""
    plain = all(x.dtype == torch.float64 and not traced(x) and not transformed(x) for x in given)
    return plain and not (torch.is_grad_enabled() and any(x.requires_grad for x in given))


def place(frame: Alignment, x_a: Tensor, x_b: Tensor) -> PlacedPairs | None:
    """Bring key-frames into a frame.

    Args:
        frame: The frame.
        x_a: Key-frames at 0. *Shape:* ``(B, V, 3)``.
        x_b: Key-frames at 1. *Shape:* ``(B, V, 3)``.

    Returns:
        None where something is not finite.
    """
    module, (b, n) = kernels("alignment"), x_a.shape[:2]
    x_a, x_b, weights, reference = x_a.contiguous(), x_b.contiguous(), frame.weights, frame.reference
    sums, total, covariances = zeros(x_a, (b, 3, 3), (b,), (b, 2, 3, 3))
    launch(module.moments, (b, n), [x_a, x_b, reference, weights, n, sums, total])
    launch(module.covariances, (b, n), [x_a, x_b, reference, weights, sums, total, n, covariances])
    # What is not finite anywhere is not finite here.
    if not math.isfinite(covariances.sum()):
        return None
    turn, between = x_a.new_empty(2, b, 3, 3).unbind()
    rotations, vectors = x_a.new_empty(2, b, 3, 3).unbind(), x_a.new_empty(9, b, 3)
    centres, targets, highest, lowest = vectors.split([2, 3, 2, 2])
    given = [covariances, sums, total, frame.scale.reshape(1), b, N_SWEEPS, turn, between, rotations[0]]
    launch(module.aligned, (b,), [*given, centres, targets, highest, lowest])
    first, second = torch.empty(2, *x_a.shape, dtype=x_a.dtype, device=x_a.device).unbind()
    source, end, own_end = targets.unbind()
    both = (x_a, first), (x_b, second)
    each = zip(both, centres.unbind(), rotations, highest.unbind(), lowest.unbind(), strict=True)
    for (x, moved), centre, rotation, *reach in each:
        launch(module.carried, (b, n), [x, centre, rotation, source, n, moved, *reach])
    motions = RigidMotion(turn, centres[0], own_end), RigidMotion(between, source, end)
    finite = torch.ones(b, dtype=torch.bool, device=x_a.device)
    return PlacedPairs(Pair(first, second, *motions), finite, (highest - lowest).norm(dim=-1).amin(0))


def restore(frame: Alignment, x: Tensor, pair: Pair, t: Tensor) -> Tensor:
    """As :meth:`torch_modal.inbetween.frame.Alignment.restore`. *Shape:* ``(B, V, 3)``."""
    module, (b, n) = kernels("alignment"), x.shape[:2]
    out, placed = torch.empty_like(x, memory_format=torch.contiguous_format), pair.placed
    if pair.around is None:
        turn, moved, centre = x.new_empty(b, 3, 3), x.new_empty(b, 3), pair.between.source.contiguous()
        motions = [part.contiguous() for motion in (pair.between, placed) for part in motion]
        launch(module.trajectory, (b,), [t.contiguous(), *motions, frame.scale.reshape(1), turn, moved])
    else:
        motion, back = frame.motion(pair, t), placed.rotation.mT
        turn, centre = ((back @ motion.rotation) / frame.scale).contiguous(), motion.source.contiguous()
        reached = motion.target / frame.scale - placed.target
        moved = (back @ reached[..., None]).squeeze(-1) + placed.source
    launch(module.carried, (b, n), [x.contiguous(), centre, turn, moved, n, out, None, None])
    return out
