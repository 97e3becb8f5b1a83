"""An energy by kernels, in float64: each term in one pass over its elements, where torch takes dozens.

The torch code is the reference of the tests, runs where Warp is not installed, and computes second derivatives.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from torch_modal.elastic.bend import NEEDLE, NEEDLE_OF_STEPS
from torch_modal.elastic.energy import Energy, Reference, RestShapes
from torch_modal.elastic.kernel_terms import KernelTerm, KernelVolume, Pass, passes_of
from torch_modal.elastic.kernels.function import Operation
from torch_modal.geometry.vectors import inverse

Factors = Sequence[Sequence[Tensor | None]]
"""Factors of the term, and of the term that rides on it, of each pass. *Shape of each:* ``(B, M, f)``."""
Seen = tuple[Tensor, Tensor | None]
"""Shapes of the elements that are merged, and the sum of their measures where it counts."""


class KernelPoint(NamedTuple):
    """The energy at given shapes, with factors of products with the convex Hessian."""

    value: Tensor
    """But for the constant. *Shape:* ``(B,)``."""
    gradient: Tensor
    """*Shape:* ``(B, V, 3)``."""
    diagonal: Tensor
    """Blocks of the convex Hessian's diagonal, packed, if wanted. *Shape:* ``(B, V, 6)``."""
    factors: Factors
    """Factors of the term and of the term that rides on it, for each pass. *Shape of each:* ``(B, M, f)``."""
    normal: Tensor
    """Gradient of the volume. *Shape:* ``(B, V, 3)``."""
    moment: Tensor
    """First derivative of the energy in the volume. *Shape:* ``(B,)``."""
    stiffness: Tensor
    """Second derivative. *Shape:* ``(B,)``."""
    extra: Callable[[Tensor], Tensor] | None = None
    """Products with the Hessian of further energies, whose values and derivatives are included above."""

    def slope(self, direction: Tensor) -> Tensor:
        """Derivative of the energy along a direction. *Shape:* ``(B, V, 3) -> (B,)``."""
        return (self.gradient * direction).sum((1, 2))


class KernelEnergy(nn.Module):
    """Terms towards K rest shapes, by kernels.

    Args:
        energy: The same in torch.
        parts: Its terms.
    """

    def __init__(self, energy: Energy, parts: Sequence[KernelTerm]) -> None:
        super().__init__()
        self.energy = energy
        self.parts: Any = nn.ModuleList(parts)
        #: The number of the volume, if there is one.
        self.volumes = [i for i, term in enumerate(parts) if isinstance(term, KernelVolume)]
        #: Numbers of the terms whose rest shapes are merged by kernels, and by torch.
        self.weighed = [i for i, term in enumerate(parts) if term.formulas.weight is not None]
        self.unweighed = [i for i in range(len(parts)) if i not in self.weighed]
        #: The terms in passes over elements, each alone or with another that rides on it.
        self.passes: Sequence[Pass] = nn.ModuleList(passes_of(parts, energy.n_vertices))  # type: ignore[assignment]
        #: True if kernels know the adjoints of all terms.
        self.exact = all(part.formulas.exact for part in parts if not isinstance(part, KernelVolume))

    def reference(self, rests: RestShapes, start: Tensor | None = None, relative: bool = False) -> Reference:
        """Merge rest shapes into one reference (Eq. 8); arguments as :meth:`RestShapes.reference`."""
        records: dict[int, Tensor] = {}
        constant = rests.weights.new_zeros(len(rests.weights), dtype=torch.float64)
        for numbers, by_kernels in ((self.weighed, True), (self.unweighed, False)):
            if numbers:
                tensors = [rests.shapes, rests.weights, *(rests.stiffness[i] for i in numbers)]
                tensors += [] if start is None else [start]
                parts = [self.parts[i] for i in numbers]
                merge = _MergeRests(self, parts, relative)
                *merged, left = merge(*tensors) if by_kernels else merge.by_torch(*(x.double() for x in tensors))
                records.update(zip(numbers, merged, strict=True))
                constant = constant + left
        return Reference(tuple(records[i] for i in range(len(self.parts))), constant)

    def at(self, x: Tensor, to: Reference, order: int = 2) -> KernelPoint:
        """Value, gradient from the order of 1 on, and convex Hessian from 2 on. *Shape:* ``(B, V, 3)``."""
        energy, factors = x.new_zeros(len(x)), []
        gradient = torch.zeros_like(x) if order > 0 else None
        diagonal = x.new_zeros(*x.shape[:2], 6) if order > 1 else None
        for one in self.passes:
            pass_factors = [x.new_empty(len(x), *size) if order > 1 and size else None for size in one.sizes]
            records = to.records[one.number], None if one.other is None else to.records[one.other]
            one.launch("linearise", len(x), x.shape[1], x, *records, energy, gradient, diagonal, *pass_factors)
            factors.append(pass_factors)
        if self.volumes:
            number = self.volumes[0]
            sizes, normal = self.parts[number].at(x, order > 0)
            weight, value = to.records[number][:, 0].unbind(1)
            stiffness = 2 * weight
            off = sizes[:, 1, 0] - value
            moment = stiffness * off
            energy = torch.addcmul(energy, moment, off, value=0.5)
            if gradient is not None:
                gradient.addcmul_(moment[:, None, None], normal)
        else:
            normal = torch.zeros_like(x)
            moment = stiffness = torch.zeros_like(energy)
        return KernelPoint(energy, gradient, diagonal, factors, normal, moment, stiffness)  # type: ignore[arg-type]

    def back(
        self,
        x: Tensor,
        at: KernelPoint,
        to: Reference,
        to_gradient: Tensor,
        to_x: Tensor,
        to_records: Sequence[Tensor],
        to_diagonal: Tensor | None = None,
        to_factors: Factors | None = None,
        to_normal: Tensor | None = None,
        to_stiffness: Tensor | None = None,
        to_energy: Tensor | None = None,
    ) -> None:
        """Adjoint of :meth:`at`: add the gradients of shapes and references.

        Args:
            x: The shapes. *Shape:* ``(B, V, 3)``.
            at: The energy there.
            to: The references.
            to_gradient: In the gradient. *Shape:* ``(B, V, 3)``.
            to_x: Is added to. *Shape:* ``(B, V, 3)``.
            to_records: Are added to.
            to_diagonal: In the blocks of the diagonal. *Shape:* ``(B, V, 6)``.
            to_factors: In the factors of products.
            to_normal: In the volume's gradient beyond that. *Shape:* ``(B, V, 3)``.
            to_stiffness: In the volume's stiffness. *Shape:* ``(B,)``.
            to_energy: In the energy. *Shape:* ``(B,)``.
        """
        b, n = x.shape[:2]
        for one, factors, received in zip(self.passes, at.factors, to_factors or at.factors, strict=True):
            records, to_own = (
                (each[one.number], None if one.other is None else each[one.other]) for each in (to.records, to_records)
            )
            values = n, x, *records, at.value, at.gradient, at.diagonal, *factors
            adjoints = None, to_x, *to_own, to_energy, to_gradient, to_diagonal, *received
            one.launch("linearise", b, *values, adjoints=adjoints)
        if not self.volumes:
            return
        i = self.volumes[0]
        to_moment = (to_gradient * at.normal).sum((1, 2))
        off = at.moment * inverse(at.stiffness, at.stiffness <= 0)
        to_volume, to_weight = at.stiffness * to_moment, 2 * off * to_moment
        if to_stiffness is not None:  # twice the weight
            to_weight = to_weight + 2 * to_stiffness
        if to_energy is not None:
            to_volume, to_weight = to_volume + at.moment * to_energy, to_weight + off**2 * to_energy
        to_whole_normal = at.moment[:, None, None] * to_gradient
        to_whole_normal = to_whole_normal if to_normal is None else to_whole_normal.add_(to_normal)
        to_sizes = x.new_zeros(b, 2, 3)
        to_sizes[:, 1, 0] = to_volume
        self.parts[i].back(x, to_sizes, to_whole_normal, to_x)
        to_records[i].add_(torch.stack([to_weight, -to_volume], -1)[:, None])


@dataclass(frozen=True, eq=False)
class _MergeRests(Operation[Seen]):
    """Rest shapes, weights, the stiffnesses of some terms, and perhaps a start as records, and what remains."""

    energy: KernelEnergy
    parts: Sequence[KernelTerm]
    relative: bool

    @property
    def n_differentiable(self) -> int:  # type: ignore[override]
        """Number of records."""
        return len(self.parts)

    def _arguments(self, i: int, seen: Seen, tensors: Sequence[Tensor]) -> list[Tensor | float | None]:
        """Arguments of the kernel before its results, or their gradients."""
        (x, total), (shapes, weights, *stiffness) = seen, tensors
        start = stiffness[-1] if len(stiffness) > len(self.parts) else None
        soft = None if self.parts[i].formulas.fullness is None else start
        relative = self.relative and soft is not None
        needle = NEEDLE_OF_STEPS if relative else NEEDLE
        sizes = needle**2, int(relative), shapes.shape[1], stiffness[i].shape[1]
        return [x.shape[1], x, weights, total, stiffness[i], soft, *sizes]

    def run(self, kept: list[Seen] | None, *tensors: Tensor) -> tuple[Tensor, ...]:
        shapes, records = tensors[0], []
        constant = shapes.new_zeros(len(shapes))
        for i, term in enumerate(self.parts):
            seen = term.shapes_to_merge(shapes.flatten(0, 1))
            n_rows = 6 if term.formulas.periodic else 2  # formulas.periodic_record, square_record
            records.append(shapes.new_empty(len(shapes), term.n_elements, n_rows))
            term.launch("merge", len(shapes), *self._arguments(i, seen, tensors), records[i], constant)
            if kept is not None:
                kept.append(seen)
        return *records, constant

    def back(self, kept: list[Seen], grads: Sequence[Tensor], *tensors: Tensor) -> tuple[Tensor | None, ...]:
        if not kept:
            self.run(kept, *tensors)
        gradients = tuple(torch.zeros_like(each) for each in tensors)
        to_shapes = gradients[0].flatten(0, 1)
        for i, term in enumerate(self.parts):
            to_seen = torch.zeros_like(kept[i][0]) if isinstance(term, KernelVolume) else to_shapes
            values = *self._arguments(i, kept[i], tensors), torch.empty_like(grads[i]), torch.empty_like(grads[-1])
            _, _, to_weights, _, to_stiffness, to_start, *sizes = self._arguments(i, (to_seen, None), gradients)
            adjoints = None, to_seen, to_weights, None, to_stiffness, to_start, *[None] * len(sizes), grads[i]
            term.launch("merge", len(tensors[0]), *values, adjoints=adjoints)
            if isinstance(term, KernelVolume):
                term.back(tensors[0].flatten(0, 1), to_seen, None, to_shapes)
        return gradients

    def by_torch(self, *tensors: Tensor) -> tuple[Tensor, ...]:
        shapes, weights, *stiffness = tensors
        start = stiffness.pop() if len(stiffness) > len(self.parts) else None
        extend = self.energy.energy.extend
        rows, begin = extend(shapes.movedim(-1, 0)), None if start is None else extend(start.movedim(-1, 0))
        pairs = zip(self.parts, stiffness, strict=True)
        merged = [term.part.merge_rests(rows, weights, factor, begin, self.relative) for term, factor in pairs]
        return *(record.mT.contiguous() for record, _ in merged), torch.stack([left.sum(-1) for _, left in merged]).sum(
            0
        )
