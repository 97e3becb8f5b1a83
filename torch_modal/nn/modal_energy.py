"""Eq. 5 for a shape that moves in an affine space: value, gradient and both Hessians in the amplitudes.

First derivatives are local (3 numbers of an edge, 9 of a hinge) and are gathered through the columns of the space,
which are the same for a whole batch. The second-order term is in :mod:`torch_modal.energy.curvature`.
"""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor, nn

from torch_modal.energy.curvature import Curvature
from torch_modal.energy.linearised import Reference, energy_of, gather, gradient, linearise, slopes_of
from torch_modal.energy.shell import Measures, Rest, ShellEnergy


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
        at = linearise(shell, x.movedim(-1, 0).contiguous(), placement.references)
        slope, curvature = at.slope, at.curvature

        to_volume = at.to_volume.movedim(0, -1).flatten(1)
        volume_row = to_volume @ self.columns.flatten(0, 1)
        edge_extra = hinge_extra = None
        if placement.extra is not None:
            extra_rows = placement.extra.movedim(-1, 0)
            edge_extra = shell.edge_vectors(extra_rows)
            hinge_extra = shell.hinge_spokes(extra_rows).flatten(0, 1)
            volume_row = torch.cat([volume_row, (to_volume * placement.extra.flatten(1)).sum(-1, True)], -1)
        to_amplitudes = slope.volume[:, None] * volume_row
        gauss_newton = curvature.volume[:, None, None] * volume_row[:, :, None] * volume_row[:, None, :]
        for local, slopes, curvatures, columns, extra in (
            (at.to_edges, slope.length, curvature.length, self.edge_columns, edge_extra),
            (at.to_hinges.flatten(0, 1), slope.angle, curvature.angle, self.hinge_columns, hinge_extra),
        ):
            to_gradient, to_gauss_newton = _normal_equations(local, slopes, curvatures, columns, extra)
            to_amplitudes, gauss_newton = to_amplitudes + to_gradient, gauss_newton + to_gauss_newton
        stiffness = curvature.length.sum(-1) + curvature.angle.sum(-1) + curvature.volume
        stiffest = gauss_newton.diagonal(dim1=-2, dim2=-1).amax(-1)
        rounding = torch.finfo(x.dtype).eps * x.abs().amax((-1, -2))
        resolution = rounding * (stiffest * stiffness).sqrt()
        curved = self.second_order(a, placement) if second_order else None
        return Derivatives(to_amplitudes, gauss_newton, curved, resolution)

    def second_order(self, a: Tensor, placement: Placement) -> Tensor:
        """What the full Hessian has more than Gauss-Newton's. *Shape:* ``(B, n, n)``."""
        x = self.shape(a, placement)
        slope, _ = slopes_of(self.shell.measure(x), placement.references)
        return self.curvature(self.shell, self.columns, x.movedim(-1, 0).contiguous(), slope, placement.extra)

    def pull_back(self, a: Tensor, direction: Tensor, placement: Placement) -> Placement:
        """Gradient of ``direction . dE/da`` in all that the placement holds, at amplitudes that stay.

        Written out, as ``torch.func`` takes twice as long through the derivatives of the angles.

        Args:
            a: Amplitudes. *Shape:* ``(B, n)``.
            direction: In the amplitudes, of each sample. *Shape:* ``(B, n)``.
            placement: The space of each sample and its references.

        Returns:
            One gradient in the place of each tensor.
        """
        shell, n = self.shell, self.columns.shape[-1]
        rows = self.shape(a, placement).movedim(-1, 0).contiguous()
        moved = (self.shape(direction, placement) - placement.base).movedim(-1, 0).contiguous()
        at = linearise(shell, rows, placement.references)
        rate = Measures(
            (at.to_edges * shell.edge_vectors(moved)).sum(0),
            (at.to_hinges * shell.hinge_spokes(moved)).sum((0, 1)),
            (at.to_volume * moved).sum((0, -1)),
        )
        bent = [c * r for c, r in zip(at.curvature, rate, strict=True)]
        pushed = gather(shell, bent[0] * at.to_edges, bent[1] * at.to_hinges, bent[2], at.to_volume)
        pushed = pushed + self.curvature.push(shell, self.curvature.blocks(shell, rows, at.slope), moved)
        to_base, to_extra = pushed.movedim(0, -1), None
        if placement.extra is not None:
            own = gradient(shell, at).movedim(0, -1)
            to_extra = a[:, n, None, None] * to_base + direction[:, n, None, None] * own
        return Placement(
            to_base, to_extra, [self._to_reference(at.measures, rate, one) for one in placement.references]
        )

    @staticmethod
    def _to_reference(measures: Measures, rate: Measures, reference: Reference) -> Reference:
        """Gradient of ``sum_q 2 p w_q (q - q_rest) rate_q`` in the rest measures, the weights and the pull."""
        rest, pull = reference
        differences = ShellEnergy.differences(measures, rest)
        to_weights, to_rest, to_pull = [], [], torch.zeros_like(pull)
        for p, r, w, d in zip((pull[:, None], pull[:, None], pull), rate, rest.weights, differences, strict=True):
            to_weights.append(2 * p * r * d)
            to_rest.append(-2 * p * r * w)
            to_pull = to_pull + (2 * r * w * d).reshape(len(pull), -1).sum(-1)
        return Reference(Rest(Measures(*to_rest), Measures(*to_weights)), to_pull)


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
