r"""A bound on the accelerations that a displacement adds to a trajectory, so that nothing pops.

With the accelerations :math:`a` of a trajectory of shapes, and a displacement :math:`d` that is added to it,

.. math:: |a_{iv} + \ddot d_{iv}| \le \bar a

at each time and vertex. Both are differences of shapes that follow each other: what one sees.
"""

import torch
from torch import Tensor

ROUNDS = 200
"""Of :meth:`AccelerationLimit.nearest`, at most."""
TOLERANCE = 0.01
"""How far over the limit it may leave a vertex, as a part of it."""
RELAXATION = 1.7
PENALTY = 0.5


class AccelerationLimit:
    """A bound on accelerations.

    Args:
        trajectory: Accelerations without the displacement. *Shape:* ``(3, N, V)``.
        differences: Accelerations of a displacement from what it is at each time. *Shape:* ``(N, T)``.
        turns: From the coordinates in which displacements are given, to those of the accelerations. *Shape:*
            ``(T, 3, 3)``.
        most: The largest that is allowed, of a vertex.
    """

    def __init__(self, trajectory: Tensor, differences: Tensor, turns: Tensor, most: float) -> None:
        self.trajectory, self.differences, self.turns, self.most = trajectory, differences, turns, most

    def nearest(self, wanted: Tensor) -> tuple[Tensor, Tensor]:
        """The displacement nearest to a wanted one, in least squares, that keeps each vertex below the limit.

        Vertices do not know of each other here, and what is below the limit is left as it is. The rest is a convex
        problem for each vertex, and solved by the alternating direction method of multipliers (Boyd et al. 2011).

        Args:
            wanted: At each time. *Shape:* ``(3, T, V)``.

        Returns:
            It, and the vertices that were kept back. *Shape:* ``(3, T, V), (m,)``.
        """
        seen = torch.einsum("tij,jtv->itv", self.turns, wanted)
        own = torch.nonzero((self.trajectory + self.differences @ seen).norm(dim=0).amax(0) > self.most).flatten()
        if not len(own):
            return wanted, own
        goal, trajectory = (x[..., own].double().movedim(0, 1).flatten(1) for x in (seen, self.trajectory))
        # In frames: the unit of time drops out.
        unit = float(self.differences.abs().max()) / 2
        rows, trajectory, most = self.differences.double() / unit, trajectory / unit, self.most / unit
        inverse = torch.linalg.inv(torch.eye(rows.shape[1]).to(rows) + PENALTY * rows.T @ rows)
        # What is found, and the accelerations there, of what accelerations are pulled to.
        pull, freely = PENALTY * inverse @ rows.T, inverse @ goal
        reach, rest = rows @ pull, rows @ freely + trajectory
        split, dual = _clipped(rows @ goal + trajectory, most), torch.zeros_like(trajectory)
        for _ in range(ROUNDS):
            pulled = split - dual - trajectory
            reached = torch.addmm(rest, reach, pulled)
            if float(_lengths(reached).max()) <= (1 + TOLERANCE) * most:
                break
            relaxed = RELAXATION * reached + (1 - RELAXATION) * split + dual
            split = _clipped(relaxed, most)
            dual = relaxed - split
        found = torch.addmm(freely, pull, pulled).unflatten(1, (3, -1)).to(wanted)
        return wanted.index_copy(2, own, torch.einsum("tij,tiv->jtv", self.turns, found)), own


def _lengths(rows: Tensor) -> Tensor:
    """*Shape:* ``(N, 3 V) -> (N, V)``."""
    x, y, z = rows.unflatten(1, (3, -1)).unbind(1)
    return (x * x + y * y + z * z).sqrt()


def _clipped(rows: Tensor, most: float) -> Tensor:
    """Vectors shortened to a length where they are longer. *Shape:* ``(N, 3 V)``."""
    part = (most / _lengths(rows).clamp_min(torch.finfo(rows.dtype).tiny)).clamp_max(1)
    return (rows.unflatten(1, (3, -1)) * part[:, None]).flatten(1)
