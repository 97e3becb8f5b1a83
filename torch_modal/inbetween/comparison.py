"""In-betweens compared with the shapes that they start from: a worse shape is blended into its start.

A minimisation on a coarse mesh, in a space of modes, can end in a shape that is wrong on the fine mesh: modes of loose
pieces, limbs that the coarse mesh does not see. The energy of Eq. 5 cannot judge that, because a few degenerate faces
dominate it. What is compared here is bounded for each element, and evaluated on a part of the elements
(:class:`torch_modal.elastic.distortion.Distortion`).
"""

from collections.abc import Sequence

import torch
from torch import Tensor

from torch_modal.autograd import is_eager
from torch_modal.elastic.distortion import Distortion
from torch_modal.elastic.energy import RestShapes
from torch_modal.elastic.minimise import Solution, Status

# A shape has at most this many times the distortion of its starts. Below, the volume error, which is not measured and
# which the starts have more of, and the choice of elements decide more than the shapes do.
DISTORTION_SLACK = 1.2

# The same for shapes of a smooth path.
SLACK_OF_PATHS = 3.0

# From this part of the way between one and the slack on, a shape is blended into its start: none is replaced by a jump.
BLENDING_MARGIN = 0.5


def blend_towards_starts(
    x: Tensor, starts: Sequence[Tensor], solution: Solution, distortion: Distortion, rests: RestShapes, slack: float
) -> tuple[Tensor, Solution]:
    """Shapes, blended into their starts as far as they have more distortion.

    The result is a continuous function of the shapes, and differentiable.

    Args:
        x: *Shape:* ``(B, V, 3)``.
        starts: *Shape of each:* ``(B, V, 3)``.
        solution: Of the shapes.
        distortion: Measures the shapes.
        rests: What they are compared with.
        slack: How many times as much distortion as its start a shape may have.

    Returns:
        The shapes, and the solution with ratios of distortions and weights of the starts, in which shapes that a start
        has replaced are marked.
    """
    shapes = [x, *starts]
    with torch.no_grad():
        distortions = distortion(shapes, rests)
    numbers = is_eager(distortions)
    # Added to the distortions of the starts: invisible strains make no shape worse.
    visible = distortion.visibility_threshold(rests.stiffness, x)
    ratio = (distortions[0] / (distortions[1:] + visible)).amax(0)
    solution = solution._replace(distortion_ratio=ratio, start_weights=distortions.new_zeros(len(x), len(starts)))
    parts = _blend_weight(distortions[0], distortions[1:] + visible, slack)
    if numbers and not bool(parts.any()):
        return x, solution
    if torch.is_grad_enabled():
        # To first order, the shapes depend on the distortions where they are blended.
        if not numbers or bool(((parts > 0) & (parts < 1)).any()):
            distortions = distortion(shapes, rests)
    x, replaced, weights = blend_by_distortion(x, starts, distortions, visible, slack)
    status = torch.where(replaced & (solution.status != Status.INVALID), Status.FELL_BACK, solution.status)
    return x, solution._replace(status=status, start_weights=weights.detach())


def blend_by_distortion(
    x: Tensor, starts: Sequence[Tensor], distortion: Tensor, visible: Tensor, slack: float = DISTORTION_SLACK
) -> tuple[Tensor, Tensor, Tensor]:
    """Shapes, blended into their starts by the distortions of all, where a start has replaced one, and their weights.

    *Shape:* ``(B, V, 3), (1 + S, B), (B,) -> (B, V, 3), (B,), (B, S)``.
    """
    value, *others = distortion
    replaced, weights = (torch.zeros_like(value, dtype=torch.bool), value.new_zeros(len(value), 0))
    for start, other in zip(starts, others, strict=True):
        weight = _blend_weight(value, other + visible, slack)
        replaced = replaced | (weight == 1)
        weights = torch.cat([(1 - weight)[:, None] * weights, weight[:, None]], 1)
        whole = weight[:, None, None]
        x = torch.where(whole < 1, torch.lerp(x, start, whole), start)
        value = torch.where(weight < 1, torch.lerp(value, other, weight), other)
    return x, replaced, weights


def _blend_weight(value: Tensor, other: Tensor, slack: float) -> Tensor:
    """Part by which a shape gives way to one of its starts, 0 to 1. *Shape:* ``(B,), (..., B) -> (..., B)``."""
    least = 1 + BLENDING_MARGIN * (slack - 1)  # up to which a shape is not blended into its start
    weight = ((value / other - least) / (slack - least)).clamp(0, 1)
    weight = torch.where(value.isfinite(), weight * weight * (3 - 2 * weight), 1)
    return torch.where(other.isfinite(), weight, 0)
