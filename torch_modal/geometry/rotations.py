r"""Finite rotations: exponential, logarithm, quaternions, and vectors turned by them.

Closed forms with all derivatives everywhere but at a whole turn: near none, where they divide zero by zero, series take
over. Quaternions have their real part first; components come first, as in :mod:`~torch_modal.geometry.vectors`.
"""

from math import factorial, pi

import torch
from torch import Tensor

from torch_modal.geometry.vectors import cross

# Squared half angle below which series are taken: so many terms are exact to rounding there, and beyond it closed forms
# lose six digits at most when they are differentiated twice.
SMALL = 1e-3
_COS = [(-1) ** k / factorial(2 * k) for k in range(4)]
_SINC = [(-1) ** k / factorial(2 * k + 1) for k in range(4)]
_ARC = [(-1) ** k / (2 * k + 1) for k in range(5)]

# At half a turn, the axis is taken that lies on this side. Hardly any axis that has a name lies between both sides.
HALF_TURN_SIDE = (1.0, 1 / pi, 1 / pi**2)

# A rotation is taken for half a turn within so many units of rounding of the real part of its quaternion.
HALF_TURN = 64


def exp(turn: Tensor) -> Tensor:
    """The rotation about an axis by its length in radians (Rodrigues). *Shape:* ``(..., 3) -> (..., 3, 3)``."""
    w = turn.movedim(-1, 0)
    cosine, sinc = _cos_and_sinc(0.25 * (w * w).sum(0))
    x, y, z = sinc * cosine * w
    real = 2 * cosine * cosine - 1
    skew = torch.stack([real, -z, y, z, real, -x, -y, x, real]).unflatten(0, (3, 3))
    return (skew + (0.5 * sinc * sinc * w)[:, None] * w).movedim((0, 1), (-2, -1))


def log(rotation: Tensor) -> Tensor:
    """Axis times angle of a rotation, of the shortest way: at most half a turn. *Shape:* ``(..., 3, 3) -> (..., 3)``.

    At half a turn both senses are equally short: the axis on the side of :data:`HALF_TURN_SIDE` is taken.
    """
    q = quaternion(rotation.movedim((-2, -1), (0, 1)))
    side = sum(factor * part for factor, part in zip(HALF_TURN_SIDE, q[1:], strict=True))
    half_turn = q[0].abs() <= HALF_TURN * torch.finfo(q.dtype).eps
    q = torch.where(torch.where(half_turn, side, q[0]) < 0, -q, q)
    return 2 * arc(q).movedim(0, -1)


def quaternion(rotation: Tensor) -> Tensor:
    """The quaternion of a rotation, one of two that differ in their sign. *Shape:* ``(3, 3, ...) -> (4, ...)``."""
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = rotation
    # Four times the quaternion's products with itself. The row of its largest entry is far from zero.
    w, x, y, z = 1 + xx + yy + zz, 1 + xx - yy - zz, 1 - xx + yy - zz, 1 - xx - yy + zz
    wx, wy, wz, xy2, xz2, yz2 = zy - yz, xz - zx, yx - xy, xy + yx, xz + zx, yz + zy
    products = torch.stack([w, wx, wy, wz, wx, x, xy2, xz2, wy, xy2, y, yz2, wz, xz2, yz2, z]).unflatten(0, (4, 4))
    # Elementwise, at a tenth of what argmax takes over few long rows.
    first, second = torch.where(x > w, 1, 0), torch.where(z > y, 3, 2)
    largest = torch.where(torch.maximum(y, z) > torch.maximum(w, x), second, first)
    row = products.gather(0, largest.expand(1, 4, *largest.shape)).squeeze(0)
    return 0.5 * row / row.gather(0, largest[None]).clamp_min(torch.finfo(row.dtype).eps).sqrt()


def power(q: Tensor, t: Tensor) -> Tensor:
    """Rotations about the same axes by the part ``t`` of the angle, which is below a whole turn.

    The sign of a quaternion tells the way round: with a real part below zero it is the long one.
    *Shape:* ``(4, ...), (...) -> (4, ...)``.
    """
    return about(t * arc(q))


def product(p: Tensor, q: Tensor) -> Tensor:
    """The quaternion of the rotation ``q`` followed by ``p``. *Shape:* ``(4, ...), (4, ...) -> (4, ...)``."""
    real = p[0] * q[0] - (p[1:] * q[1:]).sum(0)
    return torch.cat([real[None], p[0] * q[1:] + q[0] * p[1:] + cross(p[1:], q[1:])])


def conjugate(q: Tensor) -> Tensor:
    """The quaternion of the inverse rotation. *Shape:* ``(4, ...)``."""
    return torch.cat([q[:1], -q[1:]])


def rotate(q: Tensor, v: Tensor) -> Tensor:
    """Vectors turned by quaternions. *Shape:* ``(4, ...), (3, ...) -> (3, ...)``."""
    twice = 2 * cross(q[1:], v)
    return v + q[0] * twice + cross(q[1:], twice)


def turned(turn: Tensor, v: Tensor) -> Tensor:
    """Vectors turned about axes by their lengths. *Shape:* ``(3, ...), (3, ...) -> (3, ...)``."""
    return rotate(about(0.5 * turn), v)


def turn_of(q: Tensor) -> Tensor:
    """Axis times angle of a quaternion, the way round that its sign tells: below a whole turn.

    *Shape:* ``(4, ...) -> (3, ...)``.
    """
    return 2 * arc(q)


def arc(q: Tensor) -> Tensor:
    """Axis times half the angle: the logarithm of a quaternion of any size. *Shape:* ``(4, ...) -> (3, ...)``."""
    real, imaginary = q[0], q[1:]
    squared = (imaginary * imaginary).sum(0)
    small = (squared < SMALL * real * real) & (real > 0)
    sine = torch.where(small, 1, squared.clamp_min(torch.finfo(q.dtype).tiny)).sqrt()
    tangent = torch.where(small, imaginary, 0) / torch.where(small, real, 1)
    near = _series(_ARC, (tangent * tangent).sum(0)) * tangent
    return torch.where(small, near, torch.atan2(sine, real) / sine * imaginary)


def about(half: Tensor) -> Tensor:
    """The quaternion of axis times half the angle: the inverse of :func:`arc`. *Shape:* ``(3, ...) -> (4, ...)``."""
    cosine, sinc = _cos_and_sinc((half * half).sum(0))
    return torch.cat([cosine[None], sinc * half])


def _cos_and_sinc(squared: Tensor) -> tuple[Tensor, Tensor]:
    """``cos(a)`` and ``sin(a) / a``, of the square of the angle."""
    small = squared < SMALL
    near, angle = torch.where(small, squared, 0), torch.where(small, 1, squared).sqrt()
    cosine, sinc = angle.cos(), angle.sin() / angle
    return torch.where(small, _series(_COS, near), cosine), torch.where(small, _series(_SINC, near), sinc)


def _series(factors: list[float], x: Tensor) -> Tensor:
    """A polynomial, from its constant on."""
    out = factors[-2] + factors[-1] * x
    for factor in factors[-3::-1]:
        out = factor + x * out
    return out
