r"""Finite rotations: exponential, logarithm, quaternions, weighted means.

Closed forms with all derivatives everywhere but at a whole turn; near zero, where they divide zero by zero, series
replace them. Quaternions have their real part first; their sign distinguishes the two ways round. Components come
first, as in :mod:`~torch_modal.geometry.vectors`: kornia's conversions, which take them last, would copy the fields of
all triangles twice. Its logarithm also leaves the axis at half a turn open, and its quaternions their sign.
"""

from math import factorial, pi

import torch
from kornia.geometry.conversions import axis_angle_to_rotation_matrix
from torch import Tensor

from torch_modal.geometry.vectors import cross

# Squared half angle below which series are evaluated: they are exact to rounding there, and beyond it closed forms lose
# at most six digits when differentiated twice.
SMALL = 1e-3
_COS = [(-1) ** k / factorial(2 * k) for k in range(4)]
_SINC = [(-1) ** k / factorial(2 * k + 1) for k in range(4)]
_ARC = [(-1) ** k / (2 * k + 1) for k in range(5)]
_ONCE = [(-1) ** k / factorial(2 * k + 2) for k in range(4)]
_TWICE = [(-1) ** k / factorial(2 * k + 3) for k in range(4)]

# At half a turn the axis on this side is chosen. Hardly any axis that has a name lies between both sides.
HALF_TURN_SIDE = (1.0, 1 / pi, 1 / pi**2)

# Roundings of the real part of a quaternion within which a rotation counts as half a turn.
HALF_TURN = 64

# Newton steps from the mean of quaternions, before the one with derivatives. The mean of rotations within 90 degrees of
# a point is then exact to rounding, and its derivatives to six digits or more.
MEAN_STEPS = 1

# Smallest eigenvalue of the Hessian for a Newton step; below it, where rotations spread by about a turn and the mean is
# not unique, the step is the mean of logarithms.
SMALLEST_CURVATURE = 0.1


def exp(vector: Tensor) -> Tensor:
    """Rotation matrix of axis times angle in radians (Rodrigues). *Shape:* ``(..., 3) -> (..., 3, 3)``."""
    return axis_angle_to_rotation_matrix(vector.reshape(-1, 3)).reshape(*vector.shape, 3)


def log(rotation: Tensor) -> Tensor:
    """Axis times angle of a rotation, at most half a turn. *Shape:* ``(..., 3, 3) -> (..., 3)``.

    At half a turn both directions are equally short: the axis on the side of :data:`HALF_TURN_SIDE` is chosen.
    """
    q = quaternion(rotation.movedim((-2, -1), (0, 1)))
    side = sum(factor * entry for factor, entry in zip(HALF_TURN_SIDE, q[1:], strict=True))
    half_turn = q[0].abs() <= HALF_TURN * torch.finfo(q.dtype).eps
    q = torch.where(torch.where(half_turn, side, q[0]) < 0, -q, q)
    return 2 * arc(q).movedim(0, -1)


def quaternion(rotation: Tensor) -> Tensor:
    """Quaternion of a rotation, of either sign. *Shape:* ``(3, 3, ...) -> (4, ...)``."""
    # Four times the quaternion's products with itself. The row of its largest entry is far from zero.
    (a, b, c), (d, e, f), (g, h, i) = rotation
    wx, wy, wz, xy, xz, yz = h - f, c - g, d - b, b + d, c + g, f + h
    rows = (
        [1 + a + e + i, wx, wy, wz],
        [wx, 1 + a - e - i, xy, xz],
        [wy, xy, 1 - a + e - i, yz],
        [wz, xz, yz, 1 - a - e + i],
    )
    products = torch.stack([torch.stack(row) for row in rows])
    w, x, y, z = products.diagonal().unbind(-1)
    # Elementwise, at a tenth of what argmax takes over few long rows.
    first, second = torch.where(x > w, 1, 0), torch.where(z > y, 3, 2)
    largest = torch.where(torch.maximum(y, z) > torch.maximum(w, x), second, first)
    row = products.gather(0, largest.expand(1, 4, *largest.shape)).squeeze(0)
    return 0.5 * row / row.gather(0, largest[None]).clamp_min(torch.finfo(row.dtype).eps).sqrt()


def matrix(q: Tensor) -> Tensor:
    """Rotation matrix of a quaternion of norm one. *Shape:* ``(4, ...) -> (3, 3, ...)``."""
    return rotate(q[:, None], torch.eye(3).to(q).view(3, 3, *[1] * (q.dim() - 1)))


def product(p: Tensor, q: Tensor) -> Tensor:
    """Quaternion of the rotation ``q`` followed by ``p``. *Shape:* ``(4, ...), (4, ...) -> (4, ...)``."""
    real = p[0] * q[0] - (p[1:] * q[1:]).sum(0)
    return torch.cat([real[None], p[0] * q[1:] + q[0] * p[1:] + cross(p[1:], q[1:])])


def conjugate(q: Tensor) -> Tensor:
    """Quaternion of the inverse rotation. *Shape:* ``(4, ...)``."""
    return torch.cat([q[:1], -q[1:]])


def rotate(q: Tensor, v: Tensor) -> Tensor:
    """Vectors rotated by quaternions. *Shape:* ``(4, ...), (3, ...) -> (3, ...)``."""
    twice = 2 * cross(q[1:], v)
    return v + q[0] * twice + cross(q[1:], twice)


def rotate_by(vector: Tensor, v: Tensor) -> Tensor:
    """Vectors rotated by rotation vectors. *Shape:* ``(3, ...), (3, ...) -> (3, ...)``."""
    return rotate(about(0.5 * vector), v)


def turn_of_change(vector: Tensor, change: Tensor) -> Tensor:
    """Turn that a small change of a rotation vector adds: the left Jacobian of the exponential, times the change.

    *Shape:* ``(3, ...), (3, ...) -> (3, ...)``.
    """
    squared = (vector * vector).sum(0)
    small = squared < SMALL
    near, far = torch.where(small, squared, 0), torch.where(small, 1, squared)
    angle = far.sqrt()
    once = torch.where(small, _series(_ONCE, near), (1 - angle.cos()) / far)
    twice = torch.where(small, _series(_TWICE, near), (1 - angle.sin() / angle) / far)
    across = cross(vector, change)
    return change + once * across + twice * cross(vector, across)


def arc(q: Tensor) -> Tensor:
    """Axis times half the angle: the logarithm of a quaternion of any norm. *Shape:* ``(4, ...) -> (3, ...)``.

    Of a point of a sphere of any dimension, whose first coordinate is its cosine, it is the way there from the pole.
    """
    real, imaginary = q[0], q[1:]
    squared = (imaginary * imaginary).sum(0)
    small = (squared < SMALL * real * real) & (real > 0)
    sine = torch.where(small, 1, squared.clamp_min(torch.finfo(q.dtype).tiny)).sqrt()
    tangent = torch.where(small, imaginary, 0) / torch.where(small, real, 1)
    near = _series(_ARC, (tangent * tangent).sum(0)) * tangent
    return torch.where(small, near, torch.atan2(sine, real) / sine * imaginary)


def about(half: Tensor) -> Tensor:
    """Quaternion of axis times half the angle, the inverse of :func:`arc`. *Shape:* ``(3, ...) -> (4, ...)``."""
    squared = (half * half).sum(0)
    small = squared < SMALL
    near, angle = torch.where(small, squared, 0), torch.where(small, 1, squared).sqrt()
    cosine = torch.where(small, _series(_COS, near), angle.cos())
    return torch.cat([cosine[None], torch.where(small, _series(_SINC, near), angle.sin() / angle) * half])


def mean(rotations: Tensor, weights: Tensor) -> Tensor:
    """Weighted mean of K rotations, where the weighted sum of their relative logarithms vanishes.

    Of two rotations it is the point on the geodesic between them. Quaternions have the signs of
    :func:`signs_of_mean`; weights add up to one. There are first and second derivatives.

    *Shape:* ``(4, ..., K, F), (..., K, 1) -> (4, ..., F)``.
    """
    if rotations.shape[-2] == 2:
        first, second = rotations.unbind(-2)
        cosine = (first * second).sum(0, keepdim=True)
        # Quaternions are points of a sphere, where the arc from the first to the second is half as long as the angle.
        arc_to_mean = about(weights[..., 1, :] * arc(torch.cat([cosine, second - cosine * first])))
        return arc_to_mean[:1] * first + arc_to_mean[1:]
    with torch.no_grad():
        estimate = (weights * rotations).sum(-2)
        estimate = estimate / estimate.square().sum(0).sqrt().clamp_min(torch.finfo(estimate.dtype).tiny)
        for _ in range(MEAN_STEPS):
            estimate = _mean_step(estimate, rotations, weights)
    estimate = estimate.detach()  # forward mode goes through no_grad
    for _ in range(2):  # at the mean, each step has one more derivative
        estimate = _mean_step(estimate, rotations, weights)
    return estimate


@torch.no_grad()
def signs_of_mean(products: Tensor, weights: Tensor) -> Tensor:
    r"""Signs with which K quaternions, or fields of them, are near their chordal mean (Markley et al. 2007).

    The mean is the dominant eigenvector of :math:`\sum_k w_k q_k q_k^T`: it is continuous in the weights and does not
    depend on the order. The signs change only where a rotation is half a turn away from it. They follow from the inner
    products of all pairs, and the weights. *Shape:* ``(..., K, K), (..., K) -> (..., K)``.
    """
    if weights.shape[-1] == 2:
        return torch.where(products[..., 0] < 0, -1.0, 1.0).to(products)
    roots = weights.clamp_min(0).sqrt()
    dominant = torch.linalg.eigh(roots[..., None] * products * roots[..., None, :]).eigenvectors[..., -1]
    return torch.where((products @ (roots * dominant)[..., None]).squeeze(-1) < 0, -1.0, 1.0).to(products)


def _mean_step(estimate: Tensor, rotations: Tensor, weights: Tensor) -> Tensor:
    """Newton step for half the weighted sum of squared angles; at the mean, it has the derivatives of the mean."""
    relative = product(conjugate(estimate)[..., None, :], rotations)
    arcs = arc(relative)
    downhill = (weights * arcs).sum(-2)
    with torch.no_grad():
        # The Hessian of one rotation is 1 along its axis and a cot(a) of half its angle across it.
        squared = (arcs * arcs).sum(0)
        small = squared < SMALL
        safe = torch.where(small, 1, squared)
        sine = relative[1:].square().sum(0).sqrt().clamp_min(torch.finfo(arcs.dtype).tiny)
        # a cot(a) = 1 - a²/3 - a⁴/45 - 2 a⁶/945 - ...
        series = 1 / 3 + squared / 45 + 2 * squared * squared / 945
        less = torch.where(small, series, (1 - safe.sqrt() * relative[0] / sine) / safe)
        across = (weights * (1 - less * squared)).sum(-2)  # a lower bound of the eigenvalues
        along = ((weights * less * arcs)[:, None] * arcs).sum(-2)
        eye = torch.eye(3).to(across).reshape(3, 3, *[1] * across.dim())
        hessian = torch.where(across < SMALLEST_CURVATURE, eye, along + eye * across)
    a, b, c = hessian.detach()
    cofactors = cross(b, c), cross(c, a), cross(a, b)
    step = sum(x * cofactor for x, cofactor in zip(downhill, cofactors, strict=True)) / (a * cofactors[0]).sum(0)
    return product(estimate, about(step))


def _series(factors: list[float], x: Tensor) -> Tensor:
    """Polynomial, coefficients in ascending order."""
    out = factors[-2] + factors[-1] * x
    for factor in factors[-3::-1]:
        out = factor + x * out
    return out
