"""Eq. 5 for a shape that moves in an affine space: value, gradient and both Hessians in the amplitudes.

First derivatives are local (3 numbers of an edge, 9 of a hinge) and are gathered through the columns of the space,
which are the same for a whole batch. The second-order term is in :mod:`torch_modal.nn.curvature`.
"""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor, nn

from torch_modal.nn.curvature import Curvature
from torch_modal.nn.shell import (
    Measures,
    Rest,
    ShellEnergy,
    dihedral_angle,
    dihedral_gradient,
    edge_length,
    length_gradient,
)


class Derivatives(NamedTuple):
    """Derivatives of an energy in the amplitudes ``a``."""

    gradient: Tensor
    """*Shape:* ``(B, n)``."""
    gauss_newton: Tensor
    """``2 J^T J``, always positive semi-definite. *Shape:* ``(B, n, n)``."""
    second_order: Tensor | None
    """What the full Hessian has more than Gauss-Newton's. *Shape:* ``(B, n, n)``."""
    resolution: Tensor
    """Gradient norm that the rounding of the positions alone explains. *Shape:* ``(B,)``."""


class Reference(NamedTuple):
    """A rest shape that pulls, and how strongly."""

    rest: Rest
    pull: Tensor
    """Factor of its energy. *Shape:* ``(B,)``."""


def slopes_of(measures: Measures, references: Sequence[Reference]) -> tuple[Measures, Measures]:
    """First and second derivative of the energy in each measure, summed over the references."""
    slopes, curvatures = [], []
    for rest, pull in references:
        differences = ShellEnergy.differences(measures, rest)
        pulls = (pull[:, None], pull[:, None], pull)
        doubled = [2 * p * w for p, w in zip(pulls, rest.weights, strict=True)]
        slopes.append([w * d for w, d in zip(doubled, differences, strict=True)])
        curvatures.append(doubled)
    return (
        Measures(*(sum(parts) for parts in zip(*slopes, strict=True))),
        Measures(*(sum(parts) for parts in zip(*curvatures, strict=True))),
    )


def energy_of(shell: ShellEnergy, measures: Measures, references: Sequence[Reference]) -> Tensor:
    """Energy of shapes that were measured, summed over the references. *Shape:* ``(..., B)``."""
    return sum(pull * shell.energy(measures, rest) for rest, pull in references)  # type: ignore[return-value]


class Placement(NamedTuple):
    """The affine space of each sample: ``x(a) = base + columns a[:n] (+ extra a[n])``."""

    base: Tensor
    """*Shape:* ``(B, V, 3)``."""
    extra: Tensor | None
    """A column of the sample's own. *Shape:* ``(B, V, 3)``."""
    references: Sequence[Reference]


class ModalShell(nn.Module):
    """Sum of Eq. 5 against several references, for shapes ``x(a)`` of an affine space.

    All references see the same lengths, angles and volume of ``x(a)``, so that one Jacobian serves all of them.

    Args:
        shell: The energy on the mesh that ``columns`` live on.
        columns: Directions of the space. *Shape:* ``(n, V, 3)``.
    """

    columns: Tensor
    edge_columns: Tensor
    hinge_columns: Tensor

    def __init__(self, shell: ShellEnergy, columns: Tensor) -> None:
        super().__init__()
        self.shell = shell
        self.curvature = Curvature(shell, columns)
        self.register_buffer("columns", columns.permute(1, 2, 0).contiguous())
        spokes = shell.hinge_spokes(columns.movedim(-1, 0))
        self.register_buffer("edge_columns", shell.edge_vectors(columns.movedim(-1, 0)).permute(2, 0, 1).contiguous())
        self.register_buffer("hinge_columns", spokes.permute(3, 0, 1, 2).flatten(1, 2).contiguous())

    def shape(self, a: Tensor, placement: Placement) -> Tensor:
        """The shape ``x(a)``. *Shape:* ``(..., B, n) -> (..., B, V, 3)``."""
        n = self.columns.shape[-1]
        x = placement.base + (a[..., :n] @ self.columns.flatten(0, 1).mT).unflatten(-1, (-1, 3))
        return x if placement.extra is None else x + a[..., n, None, None] * placement.extra

    def value(self, a: Tensor, placement: Placement) -> Tensor:
        """Energy at ``a``. *Shape:* ``(..., B, n) -> (..., B)``."""
        return energy_of(self.shell, self.shell.measure(self.shape(a, placement)), placement.references)

    def derivatives(self, a: Tensor, placement: Placement, second_order: bool = True) -> Derivatives:
        """Gradient and Hessians at ``a``.

        Args:
            a: Amplitudes. *Shape:* ``(B, n)``.
            placement: The space of each sample and its references.
            second_order: Whether the term beyond Gauss-Newton is wanted.
        """
        shell = self.shell
        x = self.shape(a, placement)
        rows = x.movedim(-1, 0).contiguous()
        edges, spokes = shell.edge_vectors(rows), shell.hinge_spokes(rows)
        measures = Measures(edge_length(edges), dihedral_angle(spokes), shell.volume(rows))
        slope, curvature = slopes_of(measures, placement.references)

        to_volume = self.shell.volume_gradient(rows).movedim(0, -1).flatten(1)
        volume_row = to_volume @ self.columns.flatten(0, 1)
        edge_extra = hinge_extra = None
        if placement.extra is not None:
            extra_rows = placement.extra.movedim(-1, 0)
            edge_extra = shell.edge_vectors(extra_rows)
            hinge_extra = shell.hinge_spokes(extra_rows).flatten(0, 1)
            volume_row = torch.cat([volume_row, (to_volume * placement.extra.flatten(1)).sum(-1, True)], -1)
        gradient = slope.volume[:, None] * volume_row
        gauss_newton = curvature.volume[:, None, None] * volume_row[:, :, None] * volume_row[:, None, :]
        for local, slopes, curvatures, columns, extra in (
            (length_gradient(edges), slope.length, curvature.length, self.edge_columns, edge_extra),
            (dihedral_gradient(spokes).flatten(0, 1), slope.angle, curvature.angle, self.hinge_columns, hinge_extra),
        ):
            to_gradient, to_gauss_newton = _normal_equations(local, slopes, curvatures, columns, extra)
            gradient, gauss_newton = gradient + to_gradient, gauss_newton + to_gauss_newton
        stiffness = curvature.length.sum(-1) + curvature.angle.sum(-1) + curvature.volume
        stiffest = gauss_newton.diagonal(dim1=-2, dim2=-1).amax(-1)
        rounding = torch.finfo(x.dtype).eps * x.abs().amax((-1, -2))
        resolution = rounding * (stiffest * stiffness).sqrt()
        curved = self.second_order(a, placement) if second_order else None
        return Derivatives(gradient, gauss_newton, curved, resolution)

    def second_order(self, a: Tensor, placement: Placement) -> Tensor:
        """What the full Hessian has more than Gauss-Newton's. *Shape:* ``(B, n, n)``."""
        x = self.shape(a, placement)
        slope, _ = slopes_of(self.shell.measure(x), placement.references)
        return self.curvature(self.shell, self.columns, x.movedim(-1, 0).contiguous(), slope, placement.extra)

    def slope(self, a: Tensor, direction: Tensor, placement: Placement) -> Tensor:
        """Derivative of the energy along a direction of amplitudes: what the adjoint is differentiated through.

        *Shape:* ``(B, n), (B, n) -> (B,)``.
        """
        shell = self.shell
        x = self.shape(a, placement)
        moved = self.shape(direction, placement) - placement.base
        rows, along = (y.movedim(-1, 0).contiguous() for y in (x, moved))
        edges, spokes = shell.edge_vectors(rows), shell.hinge_spokes(rows)
        measures = Measures(edge_length(edges), dihedral_angle(spokes), shell.volume(rows))
        slope, _ = slopes_of(measures, placement.references)
        length = (length_gradient(edges) * shell.edge_vectors(along)).sum(0)
        angle = (dihedral_gradient(spokes) * shell.hinge_spokes(along)).sum((0, 1))
        volume = (self.shell.volume_gradient(rows) * along).sum((0, -1))
        return (slope.length * length).sum(-1) + (slope.angle * angle).sum(-1) + slope.volume * volume


def _normal_equations(
    local: Tensor, slopes: Tensor, curvatures: Tensor, columns: Tensor, extra: Tensor | None
) -> tuple[Tensor, Tensor]:
    """What measures of one kind add to the gradient and to Gauss-Newton's Hessian.

    Args:
        local: Gradient of each measure in the vectors that it depends on. *Shape:* ``(c, B, M)``.
        slopes: First derivative of the energy in each measure. *Shape:* ``(B, M)``.
        curvatures: Second derivative. *Shape:* ``(B, M)``.
        columns: These vectors in each direction of the space. *Shape:* ``(M, c, n)``.
        extra: These vectors in each sample's own direction. *Shape:* ``(c, B, M)``.

    Returns:
        *Shape:* ``(B, n)``, ``(B, n, n)``; with an own direction, one more of each.
    """
    # Rows of the Jacobian are scaled before they pass through the columns, where they are few numbers.
    root = curvatures.clamp_min(torch.finfo(curvatures.dtype).tiny).sqrt()
    local = root * local
    # Products of tiny matrices are fast in one dense block only: any other layout is copied matrix by matrix.
    jacobian = (local.permute(2, 1, 0).contiguous() @ columns).transpose(0, 1)
    residual = slopes / root
    inner = jacobian.mT @ jacobian
    if extra is None:
        return (jacobian.mT @ residual[..., None]).squeeze(-1), inner
    # The own direction is one row and column more; put beside the others, it would copy them all.
    own = (local * extra).sum(0)
    gradient, border = (jacobian.mT @ torch.stack([residual, own], -1)).unbind(-1)
    last = torch.stack([(own * residual).sum(-1), (own * own).sum(-1)], -1)
    upper = torch.cat([inner, border[..., None]], -1)
    lower = torch.cat([border, last[:, 1:]], -1)
    return torch.cat([gradient, last[:, :1]], -1), torch.cat([upper, lower[:, None]], 1)
