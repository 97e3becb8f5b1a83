"""An energy of a shape that moves in an affine space: value, gradient and both Hessians in the amplitudes.

Jacobians are local and come from ``torch.func``: 3 numbers of an edge, 9 of a hinge. They are gathered through the
columns of the space, which are the same for a whole batch.
"""

from functools import reduce
from typing import Generic, NamedTuple, TypeVar

import torch
from torch import Tensor, nn
from torch.func import vjp

from torch_modal.elastic.energy import ENERGY_ROUNDING, Energy, Linearised, Reference
from torch_modal.elastic.shell import ShellEnergy
from torch_modal.elastic.term import Term

Placed = TypeVar("Placed", contravariant=True)

# The second-order term of a batch passes through an array of this many bytes at a time.
MOST_BYTES = 2**26


class Derivatives(NamedTuple):
    """An energy and its derivatives in the amplitudes ``a``."""

    value: Tensor
    """*Shape:* ``(B,)``."""
    gradient: Tensor
    """*Shape:* ``(B, n)``."""
    gauss_newton: Tensor
    """``2 J^T J``, positive semi-definite up to rounding. *Shape:* ``(B, n, n)``."""
    second_order: Tensor | None
    """The second-order term of the full Hessian, if wanted. *Shape:* ``(B, n, n)``."""
    resolution: Tensor
    """Gradient norm that the rounding of the positions alone explains. *Shape:* ``(B,)``."""

    @property
    def floor(self) -> Tensor:
        """Gradient norm below which there is only rounding, which adds up along sums of elements. *Shape:* ``(B,)``."""
        return 4 * self.resolution

    @property
    def hessian(self) -> Tensor:
        """The full Hessian, or Gauss-Newton's without the second-order term. *Shape:* ``(B, n, n)``."""
        return self.gauss_newton if self.second_order is None else self.gauss_newton + self.second_order

    @property
    def rounding(self) -> Tensor:
        """Change of the energy, a sum of squares, that rounding of sums and positions explains. *Shape:* ``(B,)``."""
        stiffest = self.gauss_newton.diagonal(dim1=-2, dim2=-1).amax(-1).clamp_min(torch.finfo(self.value.dtype).tiny)
        of_positions = self.resolution * (self.value.clamp_min(0) / stiffest).sqrt()
        return ENERGY_ROUNDING * torch.finfo(self.value.dtype).eps * self.value.abs() + of_positions


class AmplitudeEnergy(nn.Module, Generic[Placed]):
    """An energy in amplitudes that depends on a placement of each sample: nested tuples of tensors."""

    def value(self, a: Tensor, placement: Placed) -> Tensor:
        """Energy at ``a``. *Shape:* ``(..., B, n) -> (..., B)``."""
        raise NotImplementedError

    def value_and_gradient(self, a: Tensor, placement: Placed) -> tuple[Tensor, Tensor]:
        """Energy and gradient at ``a``. *Shape:* ``(B, n) -> (B,), (B, n)``."""
        value, back = vjp(lambda a: self.value(a, placement), a)[:2]
        return value, back(torch.ones_like(value))[0]

    def derivatives(self, a: Tensor, placement: Placed, second_order: bool = True) -> Derivatives:
        """Energy, gradient and Hessians at ``a``, with the term beyond Gauss-Newton if wanted. *Shape:* ``(B, n)``."""
        raise NotImplementedError


class Placement(NamedTuple):
    """The affine space of each sample, ``x(a) = base + columns a``, and its reference."""

    base: Tensor
    """Components before vertices, extended. *Shape:* ``(B, 3, V)``."""
    reference: Reference


class ModalEnergy(AmplitudeEnergy[Placement]):
    """An energy in the amplitudes of an affine space.

    This is what :class:`torch_modal.GaussNewtonStep` steps on; see there for an example.

    Args:
        energy: The energy on the mesh that the columns live on.
        columns: Directions of the space, for example vibration modes. *Shape:* ``(n, V, 3)``.
    """

    columns: Tensor

    def __init__(self, energy: Energy | ShellEnergy, columns: Tensor) -> None:
        super().__init__()
        self.energy = energy.energy if isinstance(energy, ShellEnergy) else energy
        rows = self.energy.extend(columns.movedim(-1, 0))
        self.register_buffer("columns", rows.transpose(0, 1).contiguous(), persistent=False)
        for i, summand in enumerate(self.energy.parts):
            vectors = summand.edge_vectors(rows).permute(3, 0, 1, 2).flatten(1, 2).contiguous()
            #: Edge vectors of the elements of a term along each column. *Shape:* ``(M, 3 (c-1), n)``.
            self.register_buffer(f"edge_vectors_{i}", vectors, persistent=False)

    def place(self, base: Tensor, reference: Reference, anchors: Tensor | None = None) -> Placement:
        """The space of each sample.

        Args:
            base: The shape at amplitudes of zero. *Shape:* ``(B, V, 3)``.
            reference: What is compared with, for example of :meth:`torch_modal.ShellEnergy.reference_of`.
            anchors: Anchors of the energy's terms; by default in the coordinates in which the terms have them.
                *Shape:* ``(B, P, 3)``.
        """
        if anchors is None and self.energy.anchors is not None:
            anchors = self.energy.anchors.to(base)[None]
        fixed = None if anchors is None else anchors.movedim(-1, 0)
        return Placement(self.energy.extend(base.movedim(-1, 0), fixed).movedim(0, -2), reference)

    def rows(self, a: Tensor, placement: Placement) -> Tensor:
        """The shape ``x(a)``, components first. *Shape:* ``(..., B, n) -> (3, ..., B, V)``."""
        x = placement.base + (a @ self.columns.to(a).flatten(1)).unflatten(-1, (3, -1))
        return x.movedim(-2, 0).contiguous()

    def value(self, a: Tensor, placement: Placement) -> Tensor:
        """Energy at ``a``. *Shape:* ``(..., B, n) -> (..., B)``."""
        return self.energy.value(self.rows(a, placement), placement.reference)

    def derivatives(self, a: Tensor, placement: Placement, second_order: bool = True) -> Derivatives:
        """Energy, gradient and Hessians at ``a``, as for the base class. *Shape:* ``(B, n)``."""
        x = self.rows(a, placement)
        terms, curved = [], []
        for i, (summand, record) in enumerate(zip(self.energy.parts, placement.reference.records, strict=True)):
            one, columns = summand.linearise(x, record, by_torch=True), getattr(self, f"edge_vectors_{i}").to(a)
            if summand.term.total:
                row = one.gradients.transpose(0, 1).flatten(1) @ self.columns.to(a).flatten(1).mT
                normal = one.slope * row, one.curvature[..., None] * row[:, :, None] * row[:, None, :]
                if second_order and one.beyond is not None:
                    curved.append(one.beyond[..., None] * row[:, :, None] * row[:, None, :])
                one = one._replace(beyond=None)
            else:
                normal = _normal_equations(one, columns)
            terms.append((one.energy, *normal, one.curvature.sum(-1)))
            if second_order:
                curved.append(_second_order(summand.term, one, columns))
        value, gradient, inner, stiffness = (reduce(torch.add, each) for each in zip(*terms, strict=True))
        stiffest = inner.diagonal(dim1=-2, dim2=-1).amax(-1)
        resolution = torch.finfo(x.dtype).eps * x.abs().amax((0, -1)) * (stiffest * stiffness).sqrt()
        beyond = reduce(torch.add, curved) if second_order else None
        return Derivatives(placement.reference.constant + value, gradient, inner, beyond, resolution)


def _normal_equations(one: Linearised, columns: Tensor) -> tuple[Tensor, Tensor]:
    """Contribution of one term to the gradient and to Gauss-Newton's Hessian, by edge vectors along the columns.

    *Shape:* ``(M, c, n) -> (B, n), (B, n, n)``, with ``c`` three times the number of edge vectors.
    """
    # Rows of the Jacobian are scaled before they pass through the columns, where they are few numbers.
    root = one.curvature.clamp_min(torch.finfo(one.curvature.dtype).tiny).sqrt()
    local = root * one.gradients.flatten(0, 1)
    # Products of tiny matrices are fast in one dense block only: any other layout is copied matrix by matrix.
    jacobian = (local.permute(2, 1, 0).contiguous() @ columns).transpose(0, 1)
    return (jacobian.mT @ (one.slope / root)[..., None]).squeeze(-1), jacobian.mT @ jacobian


def _second_order(term: Term, one: Linearised, columns: Tensor) -> Tensor:
    """Contribution of one term to the second-order term of the Hessian. Arguments as above. *Shape:* ``(B, n, n)``."""
    curved = one.slope * term.hessians(one.edge_vectors).flatten(2, 3).flatten(0, 1)
    if one.beyond is not None:
        gradients = one.gradients.flatten(0, 1)
        curved = curved + (one.beyond * gradients)[:, None] * gradients
    n, flat = columns.shape[-1], columns.flatten(0, 1)
    most, sums = max(1, MOST_BYTES // max(1, columns.numel() * columns.element_size())), []
    for some in curved.permute(3, 0, 2, 1).split(most, 2):  # (M, c, b, c) of some samples: two dense products
        pushed = some.flatten(1, 2) @ columns
        sums.append((flat.mT @ pushed.view(len(flat), some.shape[2] * n)).view(n, -1, n))
    return torch.cat(sums, 1).transpose(0, 1)
