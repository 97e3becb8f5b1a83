r"""A bound on the accelerations of a trajectory of shapes with a displacement added, so that nothing pops.

With the accelerations :math:`a` of the trajectory, and the displacement :math:`d`,

.. math:: |a_{iv} + \ddot d_{iv}| \le \bar a

at each time and vertex. Both are second differences of consecutive shapes, in the unit of time between two of them.
"""

import torch
from torch import Tensor

from torch_modal.contact.detect import DEEPEST_CONTACT

ACCELERATION_ROOM = 1.27
"""Largest acceleration of a vertex, relative to the largest of the trajectory."""
LEAST_LIMIT = 8 * 100 * DEEPEST_CONTACT
"""Smallest bound, at a diagonal of 100 and a duration of 1: a parabola as high as the reach of contacts."""
MOST_PROJECTIONS = 400
"""Most iterations of :meth:`AccelerationLimit.nearest`."""
TOLERANCE = 0.01
"""Relative tolerance of the bound at which the iteration stops."""
RELAXATION = 1.7
PENALTY = 3.0
"""Penalty of accelerations. Less does not converge with weights; with more, the result is far off."""


class AccelerationLimit:
    """A bound on accelerations.

    Args:
        shapes: Even times of a trajectory, with both ends, which have no displacement, in the coordinates of the
            viewer. *Shape:* ``(T + 2, V, 3)``.
        rotations: Rotations from the coordinates of displacements to the viewer's. *Shape:* ``(T, 3, 3)``.
        goes_on: True if the motion continues beyond the first and the last shape. Each side has half of the room
            there: the motion must not bounce off a key-frame.
    """

    def __init__(self, shapes: Tensor, rotations: Tensor, goes_on: tuple[bool, bool] = (False, False)) -> None:
        x = shapes.double().nan_to_num()
        accelerations = x[2:] - 2 * x[1:-1] + x[:-2]
        #: The times of the displacements, from 0 to 1 at the ends. *Shape:* ``(T,)``.
        self.times = torch.arange(1, len(x) - 1).to(shapes) / (len(x) - 1)
        each = torch.eye(len(x), dtype=x.dtype, device=x.device)[:, 1:-1]
        second = each[2:] - 2 * each[1:-1] + each[:-2]
        ends = [i for i, beyond in zip((0, -1), goes_on, strict=True) if beyond]
        #: Accelerations of the trajectory. *Shape:* ``(N, V, 3)``.
        self.trajectory = torch.cat([accelerations, *(accelerations[i][None] for i in ends)])
        #: Accelerations of a displacement from its values at each time. *Shape:* ``(N, T)``.
        self.differences = torch.cat([second, *(2 * each[1:-1][i][None] for i in ends)])
        self.rotations = rotations.double()
        room = ACCELERATION_ROOM * float(accelerations.norm(dim=-1).max())
        #: The bound.
        self.most = max(room, LEAST_LIMIT / (len(x) - 1) ** 2)

    def nearest(self, wanted: Tensor, weights: Tensor | float = 1.0) -> tuple[Tensor, Tensor]:
        """Find the displacement nearest to a wanted one, in least squares, that keeps each vertex below the bound.

        A convex problem for each vertex, solved by the alternating direction method of multipliers (Boyd et al. 2011).
        Vertices below the bound stay; the others are returned, too. *Shape:* ``(T, V, 3), (T,) -> (T, V, 3), (m,)``.
        """
        rows, seen = self.differences, torch.einsum("tij,tvj->tvi", self.rotations, wanted.double())
        added = self.trajectory + torch.tensordot(rows, seen, 1)
        limited = torch.nonzero(added.norm(dim=-1).amax(0) > self.most).flatten()
        if not len(limited):
            return wanted, limited
        # Components before vertices: sums of three long rows are fast.
        goal, trajectory = (x[:, limited].movedim(-1, 1).flatten(1) for x in (seen, self.trajectory))
        metric = torch.eye(rows.shape[1]).to(rows) * weights
        inverse = torch.linalg.inv(metric + PENALTY * rows.T @ rows)
        # The displacement, and its accelerations, of the accelerations that it is pulled to.
        pull, freely = PENALTY * inverse @ rows.T, inverse @ metric @ goal
        reach, rest = rows @ pull, rows @ freely + trajectory
        split, dual = self._clip(rows @ goal + trajectory), torch.zeros_like(trajectory)
        for _ in range(MOST_PROJECTIONS):
            pulled = split - dual - trajectory
            reached = torch.addmm(rest, reach, pulled)
            if float(_lengths(reached).max()) <= (1 + TOLERANCE) * self.most:
                break
            relaxed = RELAXATION * reached + (1 - RELAXATION) * split + dual
            split = self._clip(relaxed)
            dual = relaxed - split
        nearest = torch.einsum("tij,tiv->tvj", self.rotations, torch.addmm(freely, pull, pulled).unflatten(1, (3, -1)))
        return wanted.index_copy(1, limited, nearest.to(wanted)), limited

    def _clip(self, rows: Tensor) -> Tensor:
        """Vectors shortened to the bound where they are longer. *Shape:* ``(N, 3 V)``."""
        factor = (self.most / _lengths(rows)).clamp_max(1)
        return (rows.unflatten(1, (3, -1)) * factor[:, None]).flatten(1)


def _lengths(rows: Tensor) -> Tensor:
    """*Shape:* ``(N, 3 V) -> (N, V)``."""
    return rows.unflatten(1, (3, -1)).square().sum(1).sqrt()
