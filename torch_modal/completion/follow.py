"""As-rigid-as-possible steps of a shape towards clouds."""

import numpy as np
import torch
from scipy import sparse
from scipy.spatial import cKDTree
from torch import Tensor

from torch_modal.arrays import FloatArray
from torch_modal.completion.frames import Frame
from torch_modal.completion.pairs import OUTLIERS, SampledSurface, robust_weights, seen_at
from torch_modal.elastic.volume import encloses
from torch_modal.geometry.connectivity import Connectivity
from torch_modal.geometry.inspect import volume_of
from torch_modal.geometry.surface import Surface
from torch_modal.registration.fit import ElasticSurface

STEPS, WEIGHTS, REACH = 20, (0.02, 0.5), (15.0, 1.5)
"""Steps; weights of points next to a vertex's, and the largest distance of a pair, in the first and in the last."""
ANCHOR = 1e-4
"""Weight of each vertex's place, as :data:`WEIGHTS`."""
LEAST_HIDDEN, MOST_MOVED = 0.05, 0.5
"""Part of the area that is taken as hidden at least where the volume is kept; the largest move in a step."""


def follow(
    frame: Frame,
    shape: Tensor,
    mesh: Connectivity,
    n_steps: int = STEPS,
    reach: tuple[float, float] = REACH,
    volume: float | None = None,
) -> Tensor:
    """The shape after steps towards the clouds of a frame, from far to near. *Shape:* ``(V, 3)``.

    Steps towards the points of one side make a body thicker or thinner. With a volume, what no point is near moves
    along its normals until the shape has that.
    """
    x, n = shape.numpy(), sum(len(one.points) for one in frame.seen if one.places is None)
    if not n:
        return shape
    elastic = ElasticSurface(SampledSurface(x, mesh))
    unit = elastic.stiffness * min(n, len(x) / 2)
    # Every part is anchored, also one that no point is near.
    anchor = sparse.identity(len(x), format="csr"), x, np.full(len(x), ANCHOR * elastic.stiffness)
    points = cKDTree(np.concatenate([one.points for one in frame.seen]))
    for weight, far in zip(np.geomspace(*WEIGHTS, n_steps), np.geomspace(*reach, n_steps), strict=True):
        current, pulls = SampledSurface(x, mesh), [anchor]
        for pairs in [one.pair(current) for one in frame.seen]:
            trust = robust_weights(pairs.distances(x), far / OUTLIERS)
            pulls.append((pairs.places, pairs.points, weight * unit * pairs.weights * trust))
        x = elastic.follow(x, pulls)
        if volume is not None:
            surface, hidden = Surface(x, mesh), 1 - seen_at(points.query(x)[0])
            area = max(float(hidden @ surface.vertex_areas), LEAST_HIDDEN * surface.area)
            move = (volume - volume_of(x, mesh.faces, mesh.used)) / area
            x = x + np.clip(move, -MOST_MOVED, MOST_MOVED) * hidden[:, None] * surface.vertex_normals
    return torch.from_numpy(x)


def volumes_at(when: list[float], times: FloatArray, shapes: Tensor, mesh: Connectivity) -> list[float] | list[None]:
    """Volumes between whole shapes, or of a template of no time; None if one is open. *Shape:* ``(K,), (K, V, 3)``."""
    if not all(encloses(x, mesh) for x in shapes):
        return [None] * len(when)
    volumes = [volume_of(x.numpy(), mesh.faces, mesh.used) for x in shapes]
    found: list[float] = np.interp(when, times, volumes).tolist() if len(times) else volumes * len(when)
    return found
