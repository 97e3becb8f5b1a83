r"""Weighted means of rotations: where the weighted sum of the logarithms of all, seen from the mean, vanishes.

Quaternions have their real part first; components come first. Their signs tell the way round.
"""

import torch
from torch import Tensor

from torch_modal.geometry.rotations import SMALL, about, arc, conjugate, power, product
from torch_modal.geometry.vectors import cross

# Newton steps from the mean of quaternions, before the one that has derivatives. Rotations within 90 degrees of a point
# have then a mean that is exact to rounding, and derivatives to six digits or more.
STEPS = 1

# Smallest eigenvalue of the Hessian for which a step is one of Newton: below it, where rotations spread by about a
# turn, there is no one mean, and steps go by the mean of logarithms.
LEAST = 0.1


def mean(rotations: Tensor, weights: Tensor) -> Tensor:
    """The weighted mean of K rotations; of two, the point on the geodesic from one to the other.

    Of more than two it has first derivatives only.

    Args:
        rotations: Quaternions whose signs are those of :func:`agreeing`. *Shape:* ``(4, ..., K, F)``.
        weights: They add up to one. *Shape:* ``(..., K, 1)``.

    Returns:
        *Shape:* ``(4, ..., F)``.
    """
    if rotations.shape[-2] == 2:
        first, second = rotations.unbind(-2)
        return product(first, power(product(conjugate(first), second), weights[..., 1, :]))
    with torch.no_grad():
        found = (weights * rotations).sum(-2)
        found = found / found.square().sum(0).sqrt().clamp_min(torch.finfo(found.dtype).tiny)
        for _ in range(STEPS):
            found = _stepped(found, rotations, weights)
    return _stepped(found.detach(), rotations, weights)  # forward mode goes through no_grad


@torch.no_grad()
def agreeing(products: Tensor, weights: Tensor) -> Tensor:
    r"""Signs with which K quaternions, or fields of them, are near their chordal mean (Markley et al. 2007).

    The mean is the dominant eigenvector of :math:`\sum_k w_k q_k q_k^T`: it is continuous in the weights and depends on
    no order. The signs change only where a rotation is half a turn away from it.

    Args:
        products: Inner products of all pairs. *Shape:* ``(..., K, K)``.
        weights: *Shape:* ``(..., K)``.

    Returns:
        *Shape:* ``(..., K)``.
    """
    roots = weights.clamp_min(0).sqrt()
    dominant = torch.linalg.eigh(roots[..., None] * products * roots[..., None, :]).eigenvectors[..., -1]
    return torch.where((products @ (roots * dominant)[..., None]).squeeze(-1) < 0, -1.0, 1.0).to(products)


def _stepped(found: Tensor, rotations: Tensor, weights: Tensor) -> Tensor:
    """A Newton step; at the mean, its derivatives are those of the mean."""
    relative = product(conjugate(found)[..., None, :], rotations)
    arcs = arc(relative)
    downhill = (weights * arcs).sum(-2)
    with torch.no_grad():
        hessian, least = _hessian(relative, arcs, weights)
        hessian = torch.where(least < LEAST, _identity(least), hessian)
    return product(found, about(_solved(hessian.detach(), downhill)))


def _hessian(relative: Tensor, arcs: Tensor, weights: Tensor) -> tuple[Tensor, Tensor]:
    """Of half the sum of squared angles, and a lower bound of its eigenvalues. *Shape:* ``(3, 3, ..., F), (..., F)``.

    Along its axis a rotation has 1, across it ``a cot(a)`` of half its angle.
    """
    squared = (arcs * arcs).sum(0)
    small = squared < SMALL
    safe = torch.where(small, 1, squared)
    sine = relative[1:].square().sum(0).sqrt().clamp_min(torch.finfo(arcs.dtype).tiny)
    # a cot(a) = 1 - a²/3 - a⁴/45 - 2 a⁶/945 - ...
    series = 1 / 3 + squared / 45 + 2 * squared * squared / 945
    less = torch.where(small, series, (1 - safe.sqrt() * relative[0] / sine) / safe)
    across = (weights * (1 - less * squared)).sum(-2)
    along = ((weights * less * arcs)[:, None] * arcs).sum(-2)
    return along + _identity(across) * across, across


def _identity(like: Tensor) -> Tensor:
    """The matrix, with as many dimensions behind. *Shape:* ``(3, 3, 1, ...)``."""
    return torch.eye(3).to(like).reshape(3, 3, *[1] * like.dim())


def _solved(matrix: Tensor, right: Tensor) -> Tensor:
    """Of symmetric matrices, by cofactors. *Shape:* ``(3, 3, ...), (3, ...) -> (3, ...)``."""
    a, b, c = matrix
    cofactors = cross(b, c), cross(c, a), cross(a, b)
    return sum(x * part for x, part in zip(right, cofactors, strict=True)) / (a * cofactors[0]).sum(0)
