r"""What a displacement in time may add to the accelerations of vertices, so that nothing pops.

Of a displacement :math:`d_v(t) = \sum_j B_j(t)\, c_{jv}` that is added to a course of shapes,

.. math:: \kappa \sum_v A_v \frac{1}{N} \sum_i \max(|a_{iv} + \ddot d_v(t_i)| - \bar a, 0)^2

is what vertices have beyond the acceleration :math:`\bar a` that is allowed, with those :math:`a` of the course. Both
are differences of shapes that follow each other: what one sees.
"""

from typing import NamedTuple

import torch
from torch import Tensor

STIFFNESS = 1e7
"""``kappa``, with the area of the surface as the unit: a contact gives way to it."""
ROUNDS = 200
"""Of :meth:`AccelerationLimit.nearest`, at most."""
TOLERANCE = 0.01
"""How far over the limit it may leave a vertex, as a part of it."""
RELAXATION = 1.7
PENALTY = 0.5


class Excess(NamedTuple):
    """What is too much at one displacement."""

    value: Tensor
    gradient: Tensor
    """*Shape:* ``(3, J, V)``."""
    vertices: Tensor
    """Those that are accelerated too much at some time. *Shape:* ``(m,)``."""
    hessian: Tensor
    """Of each of their accelerations; positive. *Shape:* ``(3, 3, N, m)``."""


class AccelerationLimit:
    """Accelerations that are held below a limit.

    Args:
        course: Accelerations without the displacement. *Shape:* ``(3, N, V)``.
        differences: Accelerations of a displacement from what it is at each time. *Shape:* ``(N, T)``.
        functions: Of time, in which a displacement is given. *Shape:* ``(T, J)``.
        area: Around each vertex. *Shape:* ``(V,)``.
        most: The largest that is allowed, of a vertex.
    """

    def __init__(self, course: Tensor, differences: Tensor, functions: Tensor, area: Tensor, most: float) -> None:
        self.course, self.differences, self.functions, self.area, self.most = course, differences, functions, area, most
        #: Accelerations of the functions. *Shape:* ``(N, J)``.
        self.second = differences @ functions
        self.weights = STIFFNESS / len(differences) * area

    def of(self, vertices: Tensor) -> "AccelerationLimit":
        """The same for some of the vertices. *Shape:* ``(R,)``."""
        given = self.course[..., vertices], self.differences, self.functions, self.area[vertices]
        return AccelerationLimit(*given, self.most)

    def _excess(self, at: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Accelerations, how large they are, and what is too much of it."""
        there = self.course + self.second @ at
        length = (there * there).sum(0).sqrt()
        return there, length, (length - self.most).clamp_min(0)

    def value(self, at: Tensor) -> Tensor:
        """*Shape:* ``(3, J, V) -> ()``."""
        return (self.weights * self._excess(at)[2] ** 2).sum()

    def linearised(self, at: Tensor) -> Excess:
        """At a displacement, *shape* ``(3, J, V)``."""
        there, length, over = self._excess(at)
        vertices = torch.nonzero(over.any(0)).flatten()
        there, length, over, weights = (
            there[..., vertices],
            length[:, vertices],
            over[:, vertices],
            self.weights[vertices],
        )
        way, length = there / length.clamp_min(1e-30), length.clamp_min(1e-30)
        gradient = torch.zeros_like(at).index_copy(2, vertices, self.second.T @ (2 * weights * over * way))
        outer = way[:, None] * way
        eye = torch.eye(3).to(at)[..., None, None]
        hessian = 2 * weights * ((over > 0) * outer + over / length * (eye - outer))
        return Excess((weights * over**2).sum(), gradient, vertices, hessian)

    def add_product(self, at: Excess, field: Tensor, to: Tensor) -> Tensor:
        """The Hessian times a displacement, added to another in place. *Shape:* ``(3, J, V)`` each."""
        if not len(at.vertices):
            return to
        found = self.second.T @ (at.hessian * (self.second @ field[..., at.vertices])).sum(1)
        return to.index_add_(2, at.vertices, found)

    def add_diagonal(self, at: Excess, to: Tensor) -> Tensor:
        """The blocks of each function at each vertex, added to others. *Shape:* ``(3, 3, J, V)`` each."""
        return to.index_add(3, at.vertices, (self.second**2).T @ at.hessian)

    def in_columns(self, at: Excess, columns: Tensor) -> Tensor:
        """The Hessian in amplitudes of columns that each function has. *Shape:* ``(n, V, 3) -> (J, n, J, n)``."""
        n, j = len(columns), self.second.shape[1]
        found, columns = columns.new_zeros(j, n, j, n), columns[:, at.vertices]
        for i, second in enumerate(self.second):
            own = torch.nonzero(at.hessian[:, :, i].diagonal().sum(-1)).flatten()
            if len(own):
                turned = torch.einsum("xyv,avy->avx", at.hessian[:, :, i, own], columns[:, own])
                one = turned.flatten(1) @ columns[:, own].flatten(1).T
                found += (second[:, None] * second)[:, None, :, None] * one[:, None, :]
        return found

    def nearest(self, wanted: Tensor, weights: Tensor) -> Tensor:
        """The displacement nearest to a wanted one, in least squares, that keeps each vertex below the limit.

        Vertices do not know of each other here, and what is below the limit is left as it is. The rest is a convex
        problem for each vertex, and solved by the alternating direction method of multipliers (Boyd et al. 2011).

        Args:
            wanted: At each time. *Shape:* ``(3, T, V)``.
            weights: Of the times. *Shape:* ``(T,)``.
        """
        own = torch.nonzero((self.course + self.differences @ wanted).norm(dim=0).amax(0) > self.most).flatten()
        if not len(own):
            return wanted
        # In frames: the unit of time drops out.
        unit = float(self.differences.abs().max()) / 2
        rows, weight = self.differences.double() / unit, weights.double()
        goal, course = (x[..., own].double().movedim(0, 1).flatten(1) for x in (wanted, self.course))
        course, most = course / unit, self.most / unit
        penalty = PENALTY * float(weight.max()) ** 0.75
        inverse = torch.linalg.inv(torch.diag(weight) + penalty * rows.T @ rows)
        # What is found, and the accelerations there, of what accelerations are pulled to.
        pull, freely = penalty * inverse @ rows.T, inverse @ (weight[:, None] * goal)
        reach, rest = rows @ pull, rows @ freely + course
        split, dual = _clipped(rows @ goal + course, most), torch.zeros_like(course)
        for _ in range(ROUNDS):
            pulled = split - dual - course
            reached = torch.addmm(rest, reach, pulled)
            if float(_lengths(reached).max()) <= (1 + TOLERANCE) * most:
                break
            relaxed = RELAXATION * reached + (1 - RELAXATION) * split + dual
            split = _clipped(relaxed, most)
            dual = relaxed - split
        found = torch.addmm(freely, pull, pulled)
        return wanted.index_copy(2, own, found.unflatten(1, (3, -1)).movedim(1, 0).to(wanted))


def _lengths(rows: Tensor) -> Tensor:
    """*Shape:* ``(N, 3 V) -> (N, V)``."""
    x, y, z = rows.unflatten(1, (3, -1)).unbind(1)
    return (x * x + y * y + z * z).sqrt()


def _clipped(rows: Tensor, most: float) -> Tensor:
    """Vectors shortened to a length where they are longer. *Shape:* ``(N, 3 V)``."""
    part = (most / _lengths(rows).clamp_min(torch.finfo(rows.dtype).tiny)).clamp_max(1)
    return (rows.unflatten(1, (3, -1)) * part[:, None]).flatten(1)
