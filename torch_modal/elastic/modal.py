"""An energy of a shape that moves in an affine space: value, gradient and both Hessians in the amplitudes.

First derivatives are local (3 numbers of an edge, 9 of a hinge) and are gathered through the columns of the space,
which are the same for a whole batch.
"""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from functools import reduce
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from torch_modal import trees
from torch_modal.autograd import is_eager
from torch_modal.elastic.energy import Energy, EnergyAt, Linearised, Reference, RestShapes
from torch_modal.elastic.kernel_energy import KernelEnergy
from torch_modal.elastic.kernels.function import Operation
from torch_modal.elastic.kernels.launch import launch, of_elements
from torch_modal.elastic.shell import ShellEnergy
from torch_modal.elastic.term import Term

# The second-order term of a batch passes through an array of this many bytes at a time.
MOST_BYTES = 2**26

# Columns that a kernel takes at a time.
_BLOCK = 8

MOST_NUMBERS = 2**27
"""Largest array for all samples of a batch (1 GiB): kernels index with 32 bits, and memory is finite."""


class Derivatives(NamedTuple):
    """An energy and its derivatives in the amplitudes ``a``."""

    value: Tensor
    """*Shape:* ``(B,)``."""
    gradient: Tensor
    """*Shape:* ``(B, n)``."""
    gauss_newton: Tensor
    """``2 J^T J``, positive semi-definite but for rounding; of single precision without the second-order term.
    *Shape:* ``(B, n, n)``."""
    second_order: Tensor | None
    """The second-order term of the full Hessian. *Shape:* ``(B, n, n)``."""
    resolution: Tensor
    """Gradient norm that the rounding of the positions alone explains. *Shape:* ``(B,)``."""

    @property
    def floor(self) -> Tensor:
        """Gradient norm below which there is only rounding, which adds up along sums of elements. *Shape:* ``(B,)``."""
        return 4 * self.resolution

    @property
    def hessian(self) -> Tensor:
        """The full Hessian. *Shape:* ``(B, n, n)``."""
        assert self.second_order is not None
        return self.gauss_newton + self.second_order


class Placement(NamedTuple):
    """The affine space of each sample, ``x(a) = base + columns a``, and its reference."""

    base: Tensor
    """Components before vertices, extended. *Shape:* ``(B, 3, V)``."""
    reference: Reference


class ModalEnergy(nn.Module):
    """An energy in the amplitudes of an affine space.

    This is what :class:`torch_modal.GaussNewtonStep` steps on; see there for an example.

    Args:
        energy: The energy on the mesh that the columns live on.
        columns: Directions of the space, for example vibration modes. *Shape:* ``(n, V, 3)``.
    """

    columns: Tensor
    tabulated = True
    """True if the edge vectors of elements along all columns are kept; otherwise they are computed at each use."""

    def __init__(self, energy: Energy | ShellEnergy, columns: Tensor) -> None:
        super().__init__()
        self.energy = energy.energy if isinstance(energy, ShellEnergy) else energy
        rows = self.energy.extend(columns.movedim(-1, 0))
        self.register_buffer("columns", rows.transpose(0, 1).contiguous(), persistent=False)
        for i in range(len(self.energy.parts)):
            table = self._edge_vectors(i) if self.tabulated else None
            self.register_buffer(f"edge_vectors_{i}", table, persistent=False)

    def _edge_vectors(self, i: int) -> Tensor:
        """Edge vectors of the elements of a term along each column. *Shape:* ``(M, 3 (c-1), n)``."""
        corners = self.energy.parts[i].corners
        values = self.columns.permute(2, 1, 0).contiguous()  # rows that lie together in memory
        first, *others = (values.index_select(0, corner) for corner in corners)
        return torch.cat([other - first for other in others], 1)

    def reference(self, rests: RestShapes, base: Tensor | None = None) -> Any:
        """Merge rest shapes into the reference of a :class:`Placement`; arguments as :meth:`RestShapes.reference`."""
        return rests.reference(self.energy, base)

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
        x = placement.base + (a @ self.columns.flatten(1)).unflatten(-1, (3, -1))
        return x.movedim(-2, 0).contiguous()

    def value(self, a: Tensor, placement: Placement) -> Tensor:
        """Energy at ``a``. *Shape:* ``(..., B, n) -> (..., B)``."""
        return self.energy.value(self.rows(a, placement), placement.reference)

    def derivatives(self, a: Tensor, placement: Placement, second_order: bool = True) -> Derivatives:
        """Energy, gradient and Hessians at ``a``.

        Args:
            a: Amplitudes. *Shape:* ``(B, n)``.
            placement: The space of each sample and its reference.
            second_order: True to compute the term beyond Gauss-Newton.
        """
        x = self.rows(a, placement)
        at = EnergyAt(self.energy, x, placement.reference)
        gradients, inner, curved = [], [], []
        for i, (summand, one) in enumerate(zip(self.energy.parts, at.terms, strict=True)):
            columns = getattr(self, f"edge_vectors_{i}") if self.tabulated else self._edge_vectors(i)
            if summand.term.total:
                row = self._along_columns(one.gradients)
                gradient, normal_matrix = one.slope * row, one.curvature[..., None] * row[:, :, None] * row[:, None, :]
            else:
                gradient, normal_matrix = _normal_equations(one, columns, second_order)
            gradients.append(gradient)
            inner.append(normal_matrix)
            if second_order:
                curved.append(_second_order(summand.term, one, columns))
        gauss_newton = reduce(torch.add, inner)
        resolution = _resolution(x.movedim(0, 1), gauss_newton, sum(one.curvature.sum(-1) for one in at.terms))
        beyond = reduce(torch.add, curved) if second_order else None
        return Derivatives(at.value, reduce(torch.add, gradients), gauss_newton, beyond, resolution)

    def value_and_gradient(self, a: Tensor, placement: Placement) -> tuple[Tensor, Tensor]:
        """Energy and gradient at ``a``. *Shape:* ``(B, n) -> (B,), (B, n)``."""
        at = EnergyAt(self.energy, self.rows(a, placement), placement.reference)
        return at.value, self._along_columns(at.gradient())

    def _along_columns(self, extended: Tensor) -> Tensor:
        """From gradients in the vertices to gradients in the amplitudes. *Shape:* ``(3, B, V) -> (B, n)``."""
        return extended.transpose(0, 1).flatten(1) @ self.columns.flatten(1).mT


def gram(rows: Tensor, exact: bool) -> Tensor:
    """``J^T J``, or the same of single precision in half of the time. *Shape:* ``(B, m, n) -> (B, n, n)``."""
    rows, like = rows if exact else rows.float(), rows
    return (rows.mT @ rows).to(like)


def _resolution(x: Tensor, gauss_newton: Tensor, stiffness: Any) -> Tensor:
    """Gradient norm due to the rounding of shapes, from the sum of all stiffnesses, ``(B,)``. *Shape:* ``(B, ...)``."""
    stiffest = gauss_newton.diagonal(dim1=-2, dim2=-1).amax(-1)
    return torch.finfo(x.dtype).eps * x.abs().flatten(1).amax(1) * (stiffest * stiffness).sqrt()


def _normal_equations(one: Linearised, columns: Tensor, exact: bool) -> tuple[Tensor, Tensor]:
    """Contribution of one term to the gradient and to Gauss-Newton's Hessian, by edge vectors along the columns.

    *Shape:* ``(M, c, n) -> (B, n), (B, n, n)``, with ``c`` three times the number of edge vectors.
    """
    # Rows of the Jacobian are scaled before they pass through the columns, where they are few numbers.
    root = one.curvature.clamp_min(torch.finfo(one.curvature.dtype).tiny).sqrt()
    local = root * one.gradients.flatten(0, 1)
    # Products of tiny matrices are fast in one dense block only: any other layout is copied matrix by matrix.
    jacobian = (local.permute(2, 1, 0).contiguous() @ columns).transpose(0, 1)
    return (jacobian.mT @ (one.slope / root)[..., None]).squeeze(-1), gram(jacobian, exact)


def _second_order(term: Term, one: Linearised, columns: Tensor) -> Tensor:
    """Contribution of one term to the second-order term of the Hessian. Arguments as above. *Shape:* ``(B, n, n)``."""
    curved = one.slope * term.hessians(one.edge_vectors).flatten(2, 3).flatten(0, 1)
    if one.beyond is not None:
        gradients = one.gradients.flatten(0, 1)
        curved = curved + (one.beyond * gradients)[:, None] * gradients
    most = max(1, MOST_BYTES // max(1, columns.numel() * columns.element_size()))
    # (b, M, c, c) by (M, c, n), of some samples at a time.
    parts = (some.contiguous() @ columns for some in curved.permute(2, 3, 0, 1).split(most))
    return torch.cat([columns.flatten(0, 1).mT @ pushed.flatten(1, 2) for pushed in parts])


class KernelModalEnergy(ModalEnergy):
    """:class:`ModalEnergy` whose values and derivatives come from kernels, in float64.

    Torch computes second derivatives and tensors without data. Shapes are not extended, and records of references have
    the layout of kernels.

    Args:
        kernels: The terms.
        columns: Directions of the space. *Shape:* ``(n, V, 3)``.
    """

    flat: Tensor
    blocks: Tensor
    tabulated = False  # kernels have their own tables

    def __init__(self, kernels: KernelEnergy, columns: Tensor) -> None:
        super().__init__(kernels.energy, columns)
        self.kernels = kernels
        self.register_buffer("flat", columns.flatten(1).contiguous(), persistent=False)
        rows = self.columns.permute(2, 1, 0).flatten(0, 1)
        blocks = nn.functional.pad(rows, (0, -(len(columns) + 2) % _BLOCK + 2)).contiguous()
        #: Columns of each component of each vertex and of the centre, with room for two more, and zeros.
        self.register_buffer("blocks", blocks, persistent=False)

    def reference(self, rests: RestShapes, base: Tensor | None = None) -> Reference:
        """Overrides the base class."""
        return self.kernels.reference(rests, base)

    def place(self, base: Tensor, reference: Reference, anchors: Tensor | None = None) -> Placement:
        """Overrides the base class."""
        return Placement(base.double(), reference)

    def by_torch(self, placement: Placement) -> Placement:
        """A placement for torch."""
        base, reference = trees.map_leaves(placement, lambda value: value.to(self.columns.dtype))
        return super().place(base, reference.transpose())

    def shapes(self, a: Tensor, base: Tensor) -> Tensor:
        """Shapes of amplitudes, in float64. *Shape:* ``(B, n), (B, V, 3) -> (B, V, 3)``."""
        return torch.addmm(base.flatten(1), a.double(), self.flat.double()).view_as(base)

    def value(self, a: Tensor, placement: Placement) -> Tensor:
        """Overrides the base class; by torch: only Newton's method compares values alone."""
        for_torch = self.by_torch(placement)
        return super().value(a.to(for_torch.base), for_torch).to(placement.base)

    def derivatives(self, a: Tensor, placement: Placement, second_order: bool = True) -> Derivatives:
        """Overrides the base class."""
        if torch.is_grad_enabled() or not is_eager(placement.base, *placement.reference.records):
            for_torch = self.by_torch(placement)
            result = super().derivatives(a.to(for_torch.base), for_torch, second_order)
            return trees.map_leaves(result, lambda value: value.to(placement.base))
        terms = [self.kernels.parts[i] for i in self.kernels.terms]
        rows = max(sum(len(term.elements) for term in terms) + 1, len(self.blocks))
        local = [len(term.elements) * (3 * term.functions.n) ** 2 for term in terms]
        most = max(1, MOST_NUMBERS // max(self.blocks.shape[1] * rows, *local))
        parts = [
            self._derivatives(a[i : i + most], trees.rows(placement, slice(i, i + most)), second_order)
            for i in range(0, max(len(a), 1), most)
        ]
        return parts[0] if len(parts) == 1 else trees.join(parts)  # type: ignore[no-any-return]

    def _derivatives(self, a: Tensor, placement: Placement, second_order: bool) -> Derivatives:
        (base, to), kernels, blocks = placement, self.kernels, self.blocks.double()
        x, n, n_blocks = self.shapes(a, base), len(self.columns), blocks.shape[1] // _BLOCK
        b, n_vertices = x.shape[:2]
        terms = [(kernels.parts[i], to.records[i]) for i in kernels.terms]
        starts = [0, *itertools.accumulate(len(term.elements) for term, _ in terms)]
        n_rows, totals = starts[-1] + len(kernels.volumes), x.new_zeros(b, 2)
        # One row for each measure, the last for the volume; the residuals are a column like the others.
        jacobian = x.new_empty(b, n_rows, blocks.shape[1])
        for (term, record), first in zip(terms, starts, strict=False):
            arguments = n_vertices, x, record, blocks, n, n_blocks, first, n_rows, jacobian, jacobian, totals
            term.launch("jacobian", b, *arguments)
        stiffness, value = totals.unbind(1)
        for i in kernels.volumes:
            sizes, normal = kernels.parts[i].at(x, gradient=True)
            weight, off = to.records[i][:, 0, 0], sizes[:, 1, 0] - to.records[i][:, 0, 1]
            last = jacobian[:, -1]
            last[:, :n], last[:, n] = normal.flatten(1) @ self.flat.double().mT, off
            last *= (2 * weight).sqrt()[:, None]
            last[:, n + 1 :] = 0
            stiffness, value, moment = stiffness + 2 * weight, value + weight * off**2, 2 * weight * off
        gradient = (jacobian.mT @ jacobian[..., n : n + 1])[:, :n, 0]
        inner = gram(jacobian, second_order)[:, :n, :n]
        resolution, curved = _resolution(x, inner, stiffness), None
        if second_order:
            pushed = x.new_zeros(b, *blocks.shape)
            for term, record in terms:
                hessians = x.new_empty(b, len(term.elements), (3 * term.functions.n) ** 2)
                term.launch("hessians", b, n_vertices, x, record, hessians, back=True)
                curve, local = of_elements("curving", term.functions.n).curved, (term.elements, hessians)
                launch(curve, (b, len(term.elements)), [*local, n_vertices + 1, blocks, n_blocks, pushed])
            for i in kernels.volumes:
                extended = kernels.parts[i].extend(x)
                kernels.parts[i].of_faces("curved", extended, moment, blocks, n_vertices + 1, n_blocks, pushed)
            curved = (blocks.mT @ pushed)[:, :n, :n]
        return Derivatives(value + to.constant, gradient, inner, curved, resolution)

    def value_and_gradient(self, a: Tensor, placement: Placement) -> tuple[Tensor, Tensor]:
        """Overrides the base class; the value has no gradient."""
        base, (records, constant) = placement
        gradient, value = _GradientAndValue(self)(a, base, *records)
        return value + constant, gradient


@dataclass(frozen=True, eq=False)
class _GradientAndValue(Operation):
    """Gradient in the amplitudes and energy but for the constant, from amplitudes, base, and records of a reference."""

    modal: KernelModalEnergy
    n_results, n_differentiable = 2, 1

    def run(self, kept: list[Any] | None, a: Tensor, base: Tensor, *records: Tensor) -> tuple[Tensor, ...]:
        modal = self.modal
        at = modal.kernels.at(modal.shapes(a, base), Reference.of_records(records), 1)
        return at.gradient.flatten(1) @ modal.flat.double().mT, at.value

    def back(
        self, kept: list[Any], grads: Sequence[Tensor], a: Tensor, base: Tensor, *records: Tensor
    ) -> tuple[Tensor | None, ...]:
        modal, to = self.modal, Reference.of_records(records)
        x, moved = modal.shapes(a, base), modal.shapes(grads[0], torch.zeros_like(base))
        to_base, to_records = torch.zeros_like(x), [torch.zeros_like(record) for record in records]
        modal.kernels.back(x, modal.kernels.at(x, to, 1), to, moved, to_base, to_records)
        return to_base.flatten(1) @ modal.flat.double().mT, to_base, *to_records

    def by_torch(self, a: Tensor, base: Tensor, *records: Tensor) -> tuple[Tensor, ...]:
        placement = self.modal.by_torch(Placement(base, Reference.of_records(records)))
        value, gradient = ModalEnergy.value_and_gradient(self.modal, a.to(placement.base), placement)
        return gradient.to(a), value.to(a)
