"""Rotations and stretches of triangles, and the sides that they ask for.

Batches stand last here, ``(V, 3, B)``: vertices are gathered and summed as whole rows, and all else is elementwise.
"""

from typing import NamedTuple

import torch
from torch import Tensor


class Sides(NamedTuple):
    """Two sides of each triangle, from its first corner to the others; the third is their difference."""

    first: Tensor
    """*Shape:* ``(F, 3, B)``."""
    second: Tensor
    """*Shape:* ``(F, 3, B)``."""


class Frames(NamedTuple):
    """A frame on each triangle, and its sides in it: ``first = length e1``, ``second = along e1 + height e2``."""

    e1: Tensor
    """Unit vector along the first side. *Shape:* ``(F, 3, B)``."""
    e2: Tensor
    """Unit vector in the plane, across it. *Shape:* ``(F, 3, B)``."""
    normal: Tensor
    """Unit normal. *Shape:* ``(F, 3, B)``."""
    length: Tensor
    """*Shape:* ``(F, B)``."""
    along: Tensor
    """*Shape:* ``(F, B)``."""
    height: Tensor
    """*Shape:* ``(F, B)``, above 0."""

    def world(self, x: Tensor, y: Tensor) -> Tensor:
        """The vector of given coordinates in the plane. *Shape:* ``(F, B), (F, B) -> (F, 3, B)``."""
        return x[:, None] * self.e1 + y[:, None] * self.e2


class Bend(NamedTuple):
    """What a displacement does to each triangle, to first order."""

    turn: Tensor
    """Axis times angle, in the coordinates of the shape. *Shape:* ``(F, 3, B)``."""
    strain: tuple[Tensor, Tensor, Tensor]
    """Entries ``xx, xy, yy`` of the symmetric gradient in the triangle's frame. *Shape of each:* ``(F, B)``."""


def sides(x: Tensor, faces: Tensor) -> Sides:
    """Sides of all triangles. *Shape:* ``(V, 3, B), (F, 3)``."""
    origin = x[faces[:, 0]]
    return Sides(x[faces[:, 1]] - origin, x[faces[:, 2]] - origin)


def frames(given: Sides) -> Frames:
    """The frame of each triangle; of one without area it is finite, and means nothing."""
    first, second = given
    tiny = torch.finfo(first.dtype).tiny ** 0.5
    length = _norm(first).clamp_min(tiny)
    e1 = first / length[:, None]
    along = _dot(second, e1)
    across = second - along[:, None] * e1
    # Below this part of the sides a height is rounding, and dividing by it would make noise into a gradient.
    floor = 1e-6 * (length + along.abs()) + tiny
    height = torch.maximum(_norm(across), floor)
    e2 = across / height[:, None]
    return Frames(e1, e2, torch.linalg.cross(e1, e2, dim=1), length, along, height)


def bend(displaced: Sides, reference: Frames) -> Bend:
    """Infinitesimal rotation and strain of a displacement, its normal staying normal (Kirchhoff and Love).

    Args:
        displaced: Sides of the displacement field.
        reference: Frames of the shape that is displaced; of a batch of one they serve for all.
    """
    axes = (reference.e1, reference.e2, reference.normal)
    d_x, d_y = ([_dot(side, axis) for axis in axes] for side in displaced)
    x_x, y_x, n_x = (d / reference.length for d in d_x)
    x_y, y_y, n_y = (
        (d - along * reference.along) / reference.height for d, along in zip(d_y, (x_x, y_x, n_x), strict=True)
    )
    spin = 0.5 * (y_x - x_y)
    turn = n_y[:, None] * axes[0] - n_x[:, None] * axes[1] + spin[:, None] * axes[2]
    return Bend(turn, (x_x, 0.5 * (x_y + y_x), y_y))


def bent_sides(bending: Bend, own: Frames) -> Sides:
    """Sides after a bend: stretched in their plane, then turned by the finite rotation of the same axis and angle.

    The stretch is the exponential of the strain, so that a shear keeps the area, and no triangle turns over.

    Args:
        bending: Rotations in the coordinates of ``own``.
        own: Frames of the shape whose sides are wanted.
    """
    xx, xy, yy = _exponential(*bending.strain)
    first = own.world(xx * own.length, xy * own.length)
    second = own.world(xx * own.along + xy * own.height, xy * own.along + yy * own.height)
    return Sides(_rotate(bending.turn, first), _rotate(bending.turn, second))


def mirrored_sides(centre: Frames, other: Frames) -> Sides:
    r"""Sides of the shape that lies as far beyond ``centre`` as ``other`` lies before it.

    From ``centre`` to ``other`` a triangle turns by ``R`` and stretches by ``U``. The mirror image turns by ``R^T``
    and stretches by :math:`4 (1 + U)^{-2}`, which agrees with :math:`U^{-1}` to first order and stays between 0 and 4.
    """
    m_xx = other.length / centre.length
    m_xy = (other.along - m_xx * centre.along) / centre.height
    m_yy = other.height / centre.height
    trace = torch.hypot(m_xx + m_yy, m_xy)  # of U; never 0, as both heights are above 0
    cos, sin = (m_xx + m_yy) / trace, -m_xy / trace
    u_xx, u_xy = cos * m_xx, cos * m_xy + sin * m_yy
    u_yy = cos * m_yy - sin * m_xy
    determinant = (1 + u_xx) * (1 + u_yy) - u_xy**2
    i_xx, i_xy, i_yy = (2 * v / determinant for v in (1 + u_yy, -u_xy, 1 + u_xx))
    g_xx, g_xy, g_yy = i_xx**2 + i_xy**2, i_xy * (i_xx + i_yy), i_xy**2 + i_yy**2

    def turned(x: Tensor, y: Tensor) -> Tensor:
        v = centre.world(x, y)
        p, q, r = (_dot(v, axis) for axis in (other.e1, other.e2, other.normal))
        return centre.world(cos * p + sin * q, cos * q - sin * p) + r[:, None] * centre.normal

    first = turned(g_xx * centre.length, g_xy * centre.length)
    second = turned(
        g_xx * centre.along + g_xy * centre.height,
        g_xy * centre.along + g_yy * centre.height,
    )
    return Sides(first, second)


def _dot(a: Tensor, b: Tensor) -> Tensor:
    """*Shape:* ``(F, 3, B), (F, 3, B) -> (F, B)``."""
    return (a * b).sum(1)


def _exponential(xx: Tensor, xy: Tensor, yy: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Of symmetric 2 x 2 matrices, entry by entry."""
    mean, half = 0.5 * (xx + yy), 0.5 * (xx - yy)
    radius = (half**2 + xy**2).clamp_min(torch.finfo(xx.dtype).tiny).sqrt()
    scale = mean.exp()
    even, odd = scale * radius.cosh(), scale * radius.sinh() / radius
    return even + odd * half, odd * xy, even - odd * half


def _norm(a: Tensor) -> Tensor:
    """With gradient zero where it is zero; much faster than the norm along an inner dimension. *Shape:* ``(F, B)``."""
    return _dot(a, a).clamp_min(torch.finfo(a.dtype).tiny).sqrt()


def _rotate(turn: Tensor, v: Tensor) -> Tensor:
    """Rodrigues' formula, smooth at no turn. *Shape:* ``(F, 3, B), (F, 3, B) -> (F, 3, B)``."""
    angle = _norm(turn)[:, None]
    across = torch.linalg.cross(turn.expand_as(v), v, dim=1)
    twice = torch.linalg.cross(turn.expand_as(v), across, dim=1)
    return v + torch.sinc(angle / torch.pi) * across + 0.5 * torch.sinc(angle / (2 * torch.pi)) ** 2 * twice
