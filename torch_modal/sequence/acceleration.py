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
        second: Those of the functions of time. *Shape:* ``(N, J)``.
        area: Around each vertex. *Shape:* ``(V,)``.
        most: The largest that is allowed, of a vertex.
    """

    def __init__(self, course: Tensor, second: Tensor, area: Tensor, most: float) -> None:
        self.course, self.second, self.area, self.most = course, second, area, most
        self.weights = STIFFNESS / len(second) * area

    def of(self, vertices: Tensor) -> "AccelerationLimit":
        """The same for some of the vertices. *Shape:* ``(R,)``."""
        return AccelerationLimit(self.course[..., vertices], self.second, self.area[vertices], self.most)

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
        """The Hessian times a displacement, added to another. *Shape:* ``(3, J, V)`` each."""
        if not len(at.vertices):
            return to
        found = self.second.T @ (at.hessian * (self.second @ field[..., at.vertices])).sum(1)
        return to.index_add(2, at.vertices, found)

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
