"""What :class:`torch_modal.nn.frame.Alignment` does, by kernels of NVIDIA Warp, where no gradient is recorded."""

import torch
from torch import Tensor

from torch_modal.geometry.functions import traced, transformed
from torch_modal.geometry.rigid import RigidMotion, best_rotation, centroid
from torch_modal.nn.frame import Alignment, Pair
from torch_modal.nn.launch import kernels, launch


def serves(*given: Tensor) -> bool:
    """Whether tensors are plain numbers in float64, and nothing is recorded."""
    plain = all(x.dtype == torch.float64 and not traced(x) and not transformed(x) for x in given)
    return plain and not (torch.is_grad_enabled() and any(x.requires_grad for x in given))


def place(frame: Alignment, x_a: Tensor, x_b: Tensor) -> tuple[Pair, Tensor] | None:
    """Bring key-frames into a frame.

    Args:
        frame: The frame.
        x_a: Key-frames at 0. *Shape:* ``(B, V, 3)``.
        x_b: Key-frames at 1. *Shape:* ``(B, V, 3)``.

    Returns:
        The pair, and the sizes of the smaller of both ends, *shape* ``(B,)``; None where something is not finite.
    """
    module, (b, n) = kernels("alignment"), x_a.shape[:2]
    x_a, x_b, weights, scale = x_a.contiguous(), x_b.contiguous(), frame.weights, frame.scale
    centres = x_a.new_zeros(2, b, 3)
    launch(module.moments, (b, n), [x_a, x_b, weights, n, *centres])
    first_centre, second_centre = centres = centres / weights.sum()
    covariances = x_a.new_zeros(b, 2, 3, 3)
    given = [x_a, x_b, frame.reference, weights, first_centre, second_centre, n, covariances]
    launch(module.covariances, (b, n), given)
    # What is not finite anywhere is not finite here.
    if not bool(covariances.sum().isfinite()):
        return None
    turn, back = best_rotation(covariances).unbind(1)
    target = centroid(frame.reference, weights).expand(b, 3).contiguous()
    out = torch.empty(2, *x_a.shape, dtype=x_a.dtype, device=x_a.device)
    reach = x_a.new_full((2, 2, b, 3), torch.inf)
    reach[0] *= -1
    unturned = turn @ back
    both = (x_a, first_centre, turn), (x_b, second_centre, unturned)
    for k, (x, centre, rotation) in enumerate(both):
        given = [x, centre, (scale * rotation).contiguous(), target, n, out[k], reach[0, k], reach[1, k]]
        launch(module.carried, (b, n), given)
    apart = scale * (turn @ (second_centre - first_centre)[..., None]).squeeze(-1)
    between = RigidMotion(turn @ (unturned).mT, target, target + apart)
    placed = RigidMotion(turn, first_centre, target / scale)
    return Pair(out[0], out[1], placed, between), (reach[0] - reach[1]).norm(dim=-1).amin(0)


def restore(frame: Alignment, x: Tensor, pair: Pair, t: Tensor) -> Tensor:
    """As :meth:`torch_modal.nn.frame.Alignment.restore`. *Shape:* ``(B, V, 3)``."""
    module, (b, n) = kernels("alignment"), x.shape[:2]
    out, placed = torch.empty_like(x, memory_format=torch.contiguous_format), pair.placed
    if pair.around is None:
        turn, moved, centre = x.new_empty(b, 3, 3), x.new_empty(b, 3), pair.between.source.contiguous()
        motions = [part.contiguous() for motion in (pair.between, placed) for part in motion]
        launch(module.course, (b,), [t.contiguous(), *motions, frame.scale.reshape(1), turn, moved])
    else:
        motion, back = frame.motion(pair, t), placed.rotation.mT
        turn, centre = ((back @ motion.rotation) / frame.scale).contiguous(), motion.source.contiguous()
        reached = motion.target / frame.scale - placed.target
        moved = (back @ reached[..., None]).squeeze(-1) + placed.source
    launch(module.carried, (b, n), [x.contiguous(), centre, turn, moved, n, out, None, None])
    return out
