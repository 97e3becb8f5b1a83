"""An energy by kernels, in float64: each term in one pass over its elements, where torch takes dozens.

The torch code is the reference of the tests, runs where Warp is not installed, and computes second derivatives.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from torch_modal.elastic.bend import NEEDLE, NEEDLE_OF_STEPS
from torch_modal.elastic.energy import Energy, RestShapes
from torch_modal.elastic.kernel_terms import KernelTerm, KernelTotal, Pass, passes_of
from torch_modal.elastic.kernels.function import Operation

Factors = Sequence[Sequence[Tensor | None]]
"""Factors of the term, and of the fused one, of each pass. *Shape of each:* ``(B, M, f)``."""
Seen = tuple[Tensor, Tensor | None]
"""Shapes of the elements that are merged, and the sum of their measures where it counts."""


class Target(NamedTuple):
    """K rest shapes of each sample as one, in the layout of kernels: :class:`Reference` without its constant."""

    anchors: Tensor
    """Fixed points of the terms. *Shape:* ``(B, P, 3)``."""
    records: Sequence[Tensor]
    """Of each term. *Shape of each:* ``(B, M, R)``."""


class KernelPoint(NamedTuple):
    """The energy at given shapes, with factors of products with the convex Hessian; or gradients in these."""

    value: Tensor
    """But for the constant. *Shape:* ``(B,)``."""
    gradient: Tensor
    """*Shape:* ``(B, V, 3)``."""
    diagonal: Tensor
    """Blocks of the convex Hessian's diagonal, packed, if wanted. *Shape:* ``(B, V, 6)``."""
    factors: Factors
    sums: Tensor
    """Totals, the first components of the second of two vertices. *Shape:* ``(T, B, 2, 3)``."""
    forces: Tensor
    """First derivatives of the energy in these. *Shape:* ``(T, B, 2, 3)``."""
    normals: Tensor
    """Gradients of the totals. *Shape:* ``(T, B, V, 3)``."""
    stiffness: Tensor
    """Second derivatives of the energy in the totals. *Shape:* ``(T, B)``."""
    extra: Callable[[Tensor], Tensor] | None = None
    """Products with the Hessian of further energies, whose values and derivatives are included above."""

    def slope(self, direction: Tensor) -> Tensor:
        """Derivative of the energy along a direction. *Shape:* ``(B, V, 3) -> (B,)``."""
        return (self.gradient * direction).sum((1, 2))


class KernelEnergy(nn.Module):
    """Terms towards K rest shapes, by kernels: an energy in torch, and its terms."""

    def __init__(self, energy: Energy, parts: Sequence[KernelTerm]) -> None:
        super().__init__()
        self.energy = energy
        self.parts: Any = nn.ModuleList(parts)
        #: Numbers of the terms whose rest shapes are merged by kernels, and by torch.
        self.weighed = [i for i, term in enumerate(parts) if term.formulas.weight is not None]
        self.unweighed = [i for i in range(len(parts)) if i not in self.weighed]
        #: The terms in passes over elements, each alone or fused with another.
        self.passes: Sequence[Pass] = nn.ModuleList(passes_of(parts, energy.n_extended))  # type: ignore[assignment]
        #: Passes over the one element of each total.
        totals = [Pass((i, term)) for i, term in enumerate(parts) if isinstance(term, KernelTotal)]
        self.totals: Sequence[Pass] = nn.ModuleList(totals)  # type: ignore[assignment]
        #: True if the elements of passes have vertices beyond those of the mesh; and if any term's have.
        self.extends = any(one.term.extends for one in self.passes)
        self.any_extends = any(term.extends for term in parts)
        #: True if all terms have adjoints by kernels.
        self.exact = all(part.term.kernel_formulas(part.n).exact for part in parts)  # type: ignore[union-attr]

    def extend(self, x: Tensor, anchors: Tensor | None = None) -> Tensor:
        """:meth:`Energy.extend` in the layout of kernels. *Shape:* ``(B, V, 3)``."""
        centre = x[:, self.energy.used].mean(1, keepdim=True)
        return torch.cat([x, centre, self.no_anchors(x) if anchors is None else anchors], 1)

    def no_anchors(self, x: Tensor) -> Tensor:
        """Displacements of the anchors, or their places where they are unknown. *Shape:* ``(B, P, 3)``."""
        return x.new_zeros(len(x), sum(self.energy.n_anchors), 3)

    def fold(self, extended: Tensor, out: Tensor, to_anchors: Tensor | None = None) -> Tensor:
        """Adjoint of :meth:`extend`: adds to values of vertices and anchors. *Shape:* ``(B, E, 3) -> (B, V, 3)``."""
        n, used = out.shape[1], self.energy.used
        if to_anchors is not None:
            to_anchors.add_(extended[:, n + 1 :])
        out.add_(extended[:, :n])
        return out.index_add_(1, used, (extended[:, n : n + 1] / len(used)).expand(-1, len(used), -1))

    def target(self, rests: RestShapes, start: Tensor | None = None, relative: bool = False) -> Target:
        """Merge rest shapes into one (Eq. 8); arguments as :meth:`RestShapes.reference`."""
        records: dict[int, Tensor] = {}
        for numbers, by_kernels in ((self.weighed, True), (self.unweighed, False)):
            if numbers:
                tensors = [rests.shapes, rests.weights, *(rests.stiffness[i] for i in numbers)]
                tensors += [] if start is None else [start]
                merge = _MergeRests(self, [self.parts[i] for i in numbers], relative)
                merged = merge(*tensors) if by_kernels else merge.by_torch(*(x.double() for x in tensors))
                records.update(zip(numbers, merged, strict=True))
        anchors = self.no_anchors(rests.shapes[:, 0]) if rests.anchors is None else rests.anchors
        return Target(anchors, [records[i] for i in range(len(self.parts))])

    def at(self, x: Tensor, target: Target, order: int = 2) -> KernelPoint:
        """Value, gradient from the order of 1 on, and convex Hessian from 2 on. *Shape:* ``(B, V, 3)``."""
        (b, n), factors = x.shape[:2], []
        energy, extended = x.new_zeros(b), self.extend(x, target.anchors) if self.any_extends else x
        shapes = extended if self.extends else x
        gradient, diagonal = (
            x.new_zeros(*shapes.shape[:2], size) if order > least else None for size, least in ((3, 0), (6, 1))
        )
        for one in self.passes:
            pass_factors = [x.new_empty(b, *size) if order > 1 and size else None for size in one.sizes]
            results = energy, gradient, diagonal, *pass_factors
            one.launch("linearise", b, shapes.shape[1], shapes, *one.of_terms(target.records), *results)
            factors.append(pass_factors)
        if self.extends and gradient is not None:
            gradient = self.fold(gradient, torch.zeros_like(x))
            diagonal = None if diagonal is None else diagonal[:, :n].contiguous()
        sums, forces, normals = (x.new_zeros(len(self.totals), b, size, 3) for size in (2, 2, n if order > 0 else 0))
        blocks, own_factors = x.new_empty(b, 2, 6) if order > 1 else None, x.new_empty(len(self.totals), b, 1, 5)
        for i, one in enumerate(self.totals):
            total: KernelTotal = one.term  # type: ignore[assignment]
            shapes, folds = (extended, True) if total.extends else (x, False)
            normal = (torch.zeros_like(shapes) if folds else normals[i]) if order > 0 else None
            total.sum(b, shapes.shape[1], shapes, sums[i], normal)
            if folds and normal is not None:
                self.fold(normal, normals[i])
            derivatives = (forces[i] if order > 0 else None), blocks, (own_factors[i] if order > 1 else None)
            one.launch("linearise", b, 2, sums[i], *one.of_terms(target.records), energy, *derivatives, None)
            if gradient is not None:
                gradient.addcmul_(forces[i, :, 1:, :1], normals[i])
        stiffness = own_factors[:, :, 0, 3].contiguous()  # along the gradient
        return KernelPoint(energy, gradient, diagonal, factors, sums, forces, normals, stiffness)  # type: ignore[arg-type]

    def back(
        self, x: Tensor, target: Target, at: KernelPoint, to_x: Tensor, to_target: Target, to_at: KernelPoint
    ) -> None:
        """Adjoint of :meth:`at`: adds the gradients in the shapes ``(B, V, 3)`` and their target.

        ``to_at`` has the gradients in the energy there; those in its sums and forces are overwritten.
        """
        (b, n), extends = x.shape[:2], self.extends
        shapes, to_shapes, to_forces, to_diagonal = x, to_x, to_at.gradient, to_at.diagonal
        extended = self.extend(x, target.anchors) if self.any_extends else x
        if extends:
            shapes, to_forces, to_shapes = extended, self.extend(to_at.gradient), torch.zeros_like(extended)
            if to_diagonal is not None:
                to_diagonal = nn.functional.pad(to_diagonal, (0, 0, 0, shapes.shape[1] - n))
        for one, factors, received in zip(self.passes, at.factors, to_at.factors, strict=True):
            records, to_records = one.of_terms(target.records), one.of_terms(to_target.records)
            # Of results, adjoints read no values, only which are wanted.
            values = shapes.shape[1], shapes, *records, at.value, to_forces, to_diagonal, *factors
            adjoints = None, to_shapes, *to_records, to_at.value, to_forces, to_diagonal, *received
            one.launch("linearise", b, *values, adjoints=adjoints)
        if extends:
            self.fold(to_shapes, to_x, to_target.anchors)
        for i, one in enumerate(self.totals):
            total: KernelTotal = one.term  # type: ignore[assignment]
            to_record = to_target.records[one.number]
            to_at.forces[i, :, 1, 0] = (to_at.gradient * at.normals[i]).sum((1, 2))
            known = 2, at.sums[i], *one.of_terms(target.records), at.value, at.forces[i], None, None, None
            received = None, to_at.sums[i], to_record, None, to_at.value, to_at.forces[i], None, None, None
            one.launch("linearise", b, *known, adjoints=received)
            to_record[:, 0, 0].add_(to_at.stiffness[i], alpha=2)  # twice the weight, the first row of a record
            to_normal = at.forces[i, :, 1:, :1] * to_at.gradient + to_at.normals[i]
            if total.extends:
                to_shapes = torch.zeros_like(extended)
                total.back(extended, to_at.sums[i], self.extend(to_normal), to_shapes)
                self.fold(to_shapes, to_x, to_target.anchors)
            else:
                total.back(x, to_at.sums[i], to_normal, to_x)

    def add_products(self, field: Tensor, factors: Factors, out: Tensor, scalars: Tensor | None = None) -> None:
        """Products with the convex Hessian but for the totals' parts, and their scalars. *Shape:* ``(B, V, 3)``."""
        fields = self.extend(field) if self.extends else field
        products = torch.zeros_like(fields) if self.extends else out
        for one, own in zip(self.passes, factors, strict=True):
            one.launch("product", len(field), fields.shape[1], fields, *own, products, scalars)
        if self.extends:
            self.fold(products, out)

    def add_products_back(
        self, field: Tensor, factors: Factors, to_field: Tensor, to_factors: Factors, to_out: Tensor, to_scalars: Tensor
    ) -> None:
        """Adjoint of :meth:`add_products`: adds the gradients in the field and the factors."""
        fields, received = (self.extend(each) if self.extends else each for each in (field, to_out))
        to_fields = torch.zeros_like(fields) if self.extends else to_field
        for one, own, to_own in zip(self.passes, factors, to_factors, strict=True):
            values = fields.shape[1], fields, *own, received, to_scalars
            adjoints = None, to_fields, *to_own, received, to_scalars
            one.launch("product", len(field), *values, adjoints=adjoints)
        if self.extends:
            self.fold(to_fields, to_field)


@dataclass(frozen=True, eq=False)
class _MergeRests(Operation[Seen]):
    """Rest shapes, weights, the stiffnesses of some terms, and perhaps a start as the records of the terms."""

    energy: KernelEnergy
    parts: Sequence[KernelTerm]
    relative: bool

    def _arguments(self, i: int, seen: Seen, tensors: Sequence[Tensor]) -> list[Tensor | float | None]:
        """Arguments of the kernel before its results, or their gradients."""
        (x, total), (shapes, weights, *stiffness) = seen, tensors
        start = stiffness[-1] if len(stiffness) > len(self.parts) else None
        soft = None if self.parts[i].formulas.fullness is None else start
        relative = self.relative and soft is not None
        needle = NEEDLE_OF_STEPS if relative else NEEDLE
        sizes = needle, int(relative), shapes.shape[1], stiffness[i].shape[1]
        return [x.shape[1], x, weights, total, stiffness[i], soft, *sizes]

    def run(self, kept: list[Seen] | None, *tensors: Tensor) -> tuple[Tensor, ...]:
        shapes, records = tensors[0], []
        for i, term in enumerate(self.parts):
            x = shapes.flatten(0, 1)
            seen = term.shapes_to_merge(self.energy.extend(x) if term.extends else x)
            n_rows = 6 if term.formulas.periodic else 2  # formulas.periodic_record, square_record
            records.append(shapes.new_empty(len(shapes), term.n_elements, n_rows))
            term.launch("merge", len(shapes), *self._arguments(i, seen, tensors), records[i])
            if kept is not None:
                kept.append(seen)
        return tuple(records)

    def back(self, kept: list[Seen], grads: Sequence[Tensor], *tensors: Tensor) -> tuple[Tensor | None, ...]:
        if not kept:
            self.run(kept, *tensors)
        gradients = tuple(torch.zeros_like(each) for each in tensors)
        x, to_x = tensors[0].flatten(0, 1), gradients[0].flatten(0, 1)
        for i, term in enumerate(self.parts):
            shapes = self.energy.extend(x) if term.extends else x
            to_shapes = torch.zeros_like(shapes) if term.extends else to_x
            to_seen = torch.zeros_like(kept[i][0]) if isinstance(term, KernelTotal) else to_shapes
            values = *self._arguments(i, kept[i], tensors), torch.empty_like(grads[i])
            _, _, to_weights, _, to_stiffness, to_start, *sizes = self._arguments(i, (to_seen, None), gradients)
            adjoints = None, to_seen, to_weights, None, to_stiffness, to_start, *[None] * len(sizes), grads[i]
            term.launch("merge", len(tensors[0]), *values, adjoints=adjoints)
            if isinstance(term, KernelTotal):
                term.back(shapes, to_seen, None, to_shapes)
            if term.extends:
                self.energy.fold(to_shapes, to_x)
        return gradients

    def by_torch(self, *tensors: Tensor) -> tuple[Tensor, ...]:
        shapes, weights, *stiffness = tensors
        start = stiffness.pop() if len(stiffness) > len(self.parts) else None
        extend = self.energy.energy.extend
        rows, begin = extend(shapes.movedim(-1, 0)), None if start is None else extend(start.movedim(-1, 0))
        pairs = zip(self.parts, stiffness, strict=True)
        return tuple(
            term.part.merge_rests(rows, weights, factor, begin, self.relative)[0].mT.contiguous()
            for term, factor in pairs
        )
