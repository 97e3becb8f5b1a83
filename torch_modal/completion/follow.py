"""As-rigid-as-possible steps of a shape towards clouds."""

import numpy as np
import torch
from scipy import sparse
from torch import Tensor

from torch_modal.completion.frames import Frame
from torch_modal.completion.pairs import OUTLIERS, SampledSurface, robust_weights
from torch_modal.geometry.connectivity import Connectivity
from torch_modal.registration.fit import ElasticSurface

STEPS, WEIGHTS, REACH = 20, (0.02, 0.5), (15.0, 1.5)
"""Steps; weights of points next to a vertex's, and the largest distance of a pair, in the first and in the last."""
ANCHOR = 1e-4
"""Weight of each vertex's place, as :data:`WEIGHTS`."""


def follow(
    frame: Frame, shape: Tensor, mesh: Connectivity, n_steps: int = STEPS, reach: tuple[float, float] = REACH
) -> Tensor:
    """The shape after steps towards the clouds of a frame, from far to near. *Shape:* ``(V, 3)``."""
    x, n = shape.numpy(), sum(len(one.points) for one in frame.seen if one.places is None)
    if not n:
        return shape
    elastic = ElasticSurface(SampledSurface(x, mesh))
    unit = elastic.stiffness * min(n, len(x) / 2)
    # Every part is anchored, also one that no point is near.
    anchor = sparse.identity(len(x), format="csr"), x, np.full(len(x), ANCHOR * elastic.stiffness)
    for weight, far in zip(np.geomspace(*WEIGHTS, n_steps), np.geomspace(*reach, n_steps), strict=True):
        current, pulls = SampledSurface(x, mesh), [anchor]
        for pairs in [one.pair(current) for one in frame.seen]:
            trust = robust_weights(pairs.distances(x), far / OUTLIERS)
            pulls.append((pairs.places, pairs.points, weight * unit * pairs.weights * trust))
        x = elastic.follow(x, pulls)
    return torch.from_numpy(x)
