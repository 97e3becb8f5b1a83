"""In-betweens compared with the shapes that they start from, so that none is returned that is worse.

A minimisation on a coarse mesh, in a space of modes, can end in a shape that is wrong on the fine mesh: modes of loose
pieces, limbs that the coarse mesh does not see. The energy of Eq. 5 cannot judge that, because a few degenerate faces
dominate it. What is compared here is bounded for each element, and evaluated on a part of the elements
(:class:`torch_modal.backends.torch.distortion.Distortion`).
"""

from collections.abc import Sequence

import torch
from torch import Tensor

from torch_modal.autograd import traced, transformed

# A shape falls back if it has more distortion than its start by this factor. Below it, the volume error, which is not
# measured and which the starts have more of, and the choice of elements decide more than the shapes do.
SLACK = 1.2

# The same for shapes of a smooth path, where a change from one to the other would be seen as a jump in time.
SLACK_OF_PATHS = 3.0


def no_worse(
    x: Tensor,
    starts: Sequence[Tensor],
    distortion: Tensor,
    rounding: Tensor | float = 0.0,
    slack: float = SLACK,
) -> tuple[Tensor, Tensor]:
    """Shapes, and where one is worse than what it started from, the best of its starts.

    Args:
        x: *Shape:* ``(B, V, 3)``.
        starts: *Shape of each:* ``(B, V, 3)``.
        distortion: Of ``x`` and of the starts. *Shape:* ``(1 + S, B)``.
        rounding: Distortions that are no larger are equal. *Shape:* ``(B,)``.
        slack: How many times as much distortion as its start a shape may have.

    Returns:
        The shapes, *shape* ``(B, V, 3)``; where a start was taken, *shape* ``(B,)``, bool.
    """
    found, *others = distortion
    lowest, best = torch.stack(others).nan_to_num(torch.inf).min(0)
    worse = ~(found <= slack * lowest + rounding) & lowest.isfinite()
    # What need not be looked at need not be copied, either. A graph has no numbers to look at.
    if not (traced(worse) or transformed(worse)) and not bool(worse.any()):
        return x, worse
    for i, start in enumerate(starts):
        x = torch.where((worse & (best == i))[:, None, None], start, x)
    return x, worse
