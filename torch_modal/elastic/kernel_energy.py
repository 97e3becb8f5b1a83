"""An energy by kernels, in float64: each term in one pass over its elements, where torch takes dozens.

The torch code is the reference of the tests, runs where Warp is not installed, and computes second derivatives.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from torch_modal.autograd import is_eager
from torch_modal.elastic.bend import NEEDLE, NEEDLE_OF_STEPS
from torch_modal.elastic.energy import AssembledTerm, Energy, Reference, RestShapes
from torch_modal.elastic.kernels.function import Operation
from torch_modal.elastic.kernels.launch import kernels, launch, of_elements
from torch_modal.elastic.term import Mesh
from torch_modal.elastic.volume import Volume
from torch_modal.geometry.rigid import volumes_of
from torch_modal.geometry.vectors import inverse


class KernelPoint(NamedTuple):
    """The energy at given shapes, with factors of products with the convex Hessian."""

    value: Tensor
    """But for the constant. *Shape:* ``(B,)``."""
    gradient: Any
    """*Shape:* ``(B, V, 3)``."""
    diagonal: Any
    """Blocks of the convex Hessian's diagonal, packed, if wanted. *Shape:* ``(B, V, 6)``."""
    factors: list[Any]
    """Factors of the term and of the term that rides on it, for each pass. *Shape of each:* ``(B, M, f)``."""
    normal: Any
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


class KernelTerm(nn.Module):
    """A term on a mesh, by kernels.

    Args:
        part: The term.
        elements: The elements of the kernels; by default the elements of the term. *Shape:* ``(M, n)``.
    """

    elements: Tensor
    term: Any
    bound: dict[Any, Any]
    """Kernels by kind and name, from their first launch on."""

    def __init__(self, part: AssembledTerm, elements: Tensor | None = None) -> None:
        super().__init__()
        self.part, self.n, self.bound = part, len(part.corners) - 1, {}
        self.__dict__["term"] = part.term  # not registered here: the layer owns it
        elements = part.corners.T if elements is None else elements
        self.register_buffer("elements", elements.int().contiguous(), persistent=False)
        self.n_elements = len(elements)

    def __getstate__(self) -> dict[str, Any]:
        """Without formulas and kernels, which are no data."""
        return {name: value for name, value in self.__dict__.items() if name != "formulas"} | {"bound": {}}

    @cached_property
    def formulas(self) -> Any:
        """The formulas that kernels are made from."""
        return self.term.kernel_formulas(self.n)

    def launch(self, name: str, dim: int, *arguments: Any, adjoints: Sequence[Tensor | None] = ()) -> None:
        """Run a kernel over the elements of so many samples, or its adjoint."""
        key = name, bool(adjoints)
        if key not in self.bound:
            self.bound[key] = getattr(of_elements("backward" if adjoints else "forward", self.formulas), name)
        launch(self.bound[key], (dim, self.n_elements), [self.elements, *arguments], adjoints and [None, *adjoints])

    def shapes_to_merge(self, shapes: Tensor) -> tuple[Tensor, Tensor | None]:
        """The shapes that elements are merged of, and all measures together, where their mean counts.

        *Shape:* ``(N, V, 3) -> (N, n, 3), (N,)``.
        """
        if not self.formulas.uses_mean:
            return shapes, None
        total = shapes.new_zeros(len(shapes))
        self.launch("total", len(shapes), shapes.shape[1], shapes, total)
        return shapes, total


class KernelVolume(KernelTerm):
    """The volume of a mesh, by kernels; rest shapes are merged as elements of volume and area.

    Shapes of an open surface are extended by their centre, which cones join to the boundary.

    Args:
        part: The term.
        mesh: The mesh.
        used: Vertices of faces.
    """

    faces: Tensor
    used: Tensor

    def __init__(self, part: AssembledTerm, mesh: Mesh, used: Tensor) -> None:
        super().__init__(part, torch.tensor([[0, 1]]))
        chain = torch.tensor(mesh.connectivity.boundary_chain)
        self.closed, self.n_faces = len(chain) == 0, len(mesh.faces)
        cones = torch.cat([chain.flip(1), torch.full_like(chain[:, :1], mesh.centre)], 1)
        self.register_buffer("faces", torch.cat([mesh.faces, cones]).int(), persistent=False)
        self.register_buffer("used", used, persistent=False)

    def extend(self, x: Tensor) -> Tensor:
        """The vertices, and of an open surface the mean of the vertices of faces. *Shape:* ``(B, V, 3)``."""
        return x if self.closed else torch.cat([x, x[:, self.used].mean(1, keepdim=True)], 1)

    def fold(self, extended: Tensor) -> Tensor:
        """The adjoint of :meth:`extend`."""
        if self.closed:
            return extended
        share = extended[:, -1:] / len(self.used)
        return extended[:, :-1].index_add(1, self.used, share.expand(-1, len(self.used), -1))

    def at(self, x: Tensor, gradient: bool = False, area: bool = False) -> tuple[Tensor, Tensor | None]:
        """Volumes, and areas if wanted, as the first two components of the second vertex of an element.

        Returns:
            *Shape:* ``(B, 2, 3)``; the gradients of the volumes if wanted, *shape* ``(B, V, 3)``.
        """
        extended, sizes = self.extend(x), x.new_zeros(len(x), 2, 3)
        normal = torch.zeros_like(extended) if gradient else None
        arguments = [self.faces, extended.shape[1], extended, sizes, self.n_faces if area else 0, normal]
        launch(kernels("volume").sizes, (len(x), len(self.faces)), arguments)
        return sizes, None if normal is None else self.fold(normal)

    def shapes_to_merge(self, shapes: Tensor) -> tuple[Tensor, Tensor | None]:
        """Overrides the base class."""
        return self.at(shapes, area=True)

    def back(self, x: Tensor, to_sizes: Tensor, to_normal: Tensor | None, to_x: Tensor) -> None:
        """Adjoint of :meth:`at`: adds the gradient."""
        extended = self.extend(x)
        to_extended = to_x if self.closed else torch.zeros_like(extended)
        to_normal = None if to_normal is None else self.extend(to_normal)
        normal = None if to_normal is None else torch.empty_like(to_normal)
        values = [self.faces, extended.shape[1], extended, torch.empty_like(to_sizes), self.n_faces, normal]
        adjoints = [None, None, to_extended, to_sizes, None, to_normal]
        launch(kernels("volume").sizes, (len(x), len(self.faces)), values, adjoints)
        if not self.closed:
            to_x.add_(self.fold(to_extended))


def volumes_by_kernel(x: Tensor, faces: Tensor) -> Tensor:
    """:func:`torch_modal.geometry.rigid.volumes_of` in one pass, without a gradient; of faces of int32."""
    if not is_eager(x):
        return volumes_of(x, faces)
    shapes = x.detach().double().flatten(0, -3).contiguous()
    sizes = shapes.new_zeros(len(shapes), 2, 3)
    arguments = [faces, shapes.shape[1], shapes, sizes, 0, None]
    launch(kernels("volume").sizes, (len(shapes), len(faces)), arguments)
    return sizes[:, 1, 0].view(x.shape[:-2]).to(x)


def by_kernels(energy: Energy, mesh: Mesh) -> list[KernelTerm | None]:
    """The terms of an energy by kernels; None for one that torch computes: all but one volume, for example."""
    terms: list[KernelTerm | None] = []
    for summand in energy.parts:
        n = len(summand.corners) - 1
        if type(summand.term) is Volume and not any(isinstance(each, KernelVolume) for each in terms):
            terms.append(KernelVolume(summand, mesh, energy.used))
            continue
        fits = summand.term.anchors is None and 1 <= n <= 3 and bool((summand.corners < mesh.n_vertices).all())
        serves = fits and not energy.sampled and summand.term.kernel_formulas(n) is not None
        terms.append(KernelTerm(summand) if serves else None)
    return terms


class Pass(nn.Module):
    """A pass over elements: a term, and perhaps one of edges that rides on it.

    Args:
        term: The number of the term, and the term.
        rider: The number of the other, and the other.
        own: For each edge the element that begins with it, or -1. *Shape:* ``(E,)``.
    """

    elements: Tensor
    own: Tensor | None

    def __init__(
        self, term: tuple[int, KernelTerm], rider: tuple[Any, Any] = (None, None), own: Tensor | None = None
    ) -> None:
        super().__init__()
        self.number, self.term = term
        self.other, self.rider = rider
        self.bound: dict[Any, Any] = {}
        elements = self.term.elements
        if self.rider is not None and own is not None:
            # Where there is no element, all further vertices are the first.
            edges, n = self.rider.elements, elements.shape[1]
            alone = torch.cat([edges, edges[:, :1].expand(-1, n - 2)], 1)
            elements = torch.where((own < 0)[:, None], alone, elements[own.clamp_min(0)]).contiguous()
        #: Numbers of elements of the term and the rider, and of the factors of each: gradient, and two stiffnesses.
        self.sizes = [part and (part.n_elements, 3 * part.formulas.n + 2) for part in (self.term, self.rider)]
        self.n_elements, self.n_own = len(elements), self.term.n_elements
        self.register_buffer("elements", elements, persistent=False)
        self.register_buffer("own", None if own is None else own.int(), persistent=False)

    def launch(self, name: str, dim: int, *arguments: Any, adjoints: Sequence[Tensor | None] = ()) -> None:
        """Run a kernel over the elements of so many samples, or its adjoint."""
        key = name, bool(adjoints)
        if key not in self.bound:
            given = self.term.formulas, self.rider and self.rider.formulas
            self.bound[key] = getattr(of_elements("convex_adjoint" if adjoints else "convex", *given), name)
        arguments = self.elements, self.own, self.n_own, *arguments
        launch(self.bound[key], (dim, self.n_elements), arguments, adjoints and [None] * 3 + [*adjoints])

    def __getstate__(self) -> dict[str, Any]:
        """Without kernels, which are no data."""
        return {**self.__dict__, "bound": {}}


def _passes(parts: Sequence[KernelTerm], n_vertices: int) -> list[Pass]:
    """The terms but the volume in as few passes as may be: edges ride on elements that begin with them."""
    terms = [(i, part) for i, part in enumerate(parts) if not isinstance(part, KernelVolume)]
    ends = torch.tensor([n_vertices, 1])
    for edges in (term for term in terms if term[1].formulas.even):
        keys = edges[1].elements.long().sort(1)[0] @ ends
        order = keys.argsort()
        for term in (term for term in terms if term[1].formulas.n > 1):
            keys_of_term = term[1].elements[:, :2].long().sort(1)[0] @ ends
            at = order[torch.searchsorted(keys[order], keys_of_term).clamp_max(len(keys) - 1)]
            if len(keys_of_term) and bool((keys[at] == keys_of_term).all()) and len(at.unique()) == len(at):
                numbers = torch.full_like(keys, -1).index_copy(0, at, torch.arange(len(at)))
                others = [each for each in terms if each not in (edges, term)]
                return [Pass(term, edges, numbers), *map(Pass, others)]
    return [*map(Pass, terms)]


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
        #: Numbers of the volume, and of the other terms.
        self.volumes = [i for i, term in enumerate(parts) if isinstance(term, KernelVolume)]
        self.terms = [i for i in range(len(parts)) if i not in self.volumes]
        #: Numbers of the terms whose rest shapes are merged by kernels, and by torch.
        self.weighed = [i for i, term in enumerate(parts) if term.formulas.weight is not None]
        self.unweighed = [i for i in range(len(parts)) if i not in self.weighed]
        #: The terms in passes over elements, each alone or with another that rides on it.
        self.passes: Any = nn.ModuleList(_passes(parts, energy.n_vertices))
        #: True if kernels know the adjoints of all terms.
        self.exact = all(parts[i].formulas.exact for i in self.terms)

    def reference(self, rests: RestShapes, start: Tensor | None = None, relative: bool = False) -> Reference:
        """Merge rest shapes into one reference (Eq. 8); arguments as :meth:`RestShapes.reference`."""
        records: dict[int, Tensor] = {}
        constant = rests.weights.new_zeros(len(rests.weights), dtype=torch.float64)
        for numbers, by_kernels in ((self.weighed, True), (self.unweighed, False)):
            if numbers:
                tensors = [rests.shapes, rests.weights, *(rests.stiffness[i] for i in numbers)]
                tensors += [] if start is None else [start]
                parts = [self.parts[i] for i in numbers]
                *merged, left = _MergeRests(self, parts, relative)(*tensors, kernels=by_kernels)
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
        if not self.volumes:
            zeros = torch.zeros_like(energy)
            return KernelPoint(energy, gradient, diagonal, factors, torch.zeros_like(x), zeros, zeros)
        number = self.volumes[0]
        sizes, normal = self.parts[number].at(x, order > 0)
        weight, value = to.records[number][:, 0].unbind(1)
        stiffness = 2 * weight
        off = sizes[:, 1, 0] - value
        moment = stiffness * off
        energy = torch.addcmul(energy, moment, off, value=0.5)
        if gradient is not None:
            gradient.addcmul_(moment[:, None, None], normal)
        return KernelPoint(energy, gradient, diagonal, factors, normal, moment, stiffness)

    def product(
        self, factors: Sequence[Any], dim: tuple[int, int], fields: Tensor, start: int, out: Tensor, out_start: int,
        scalars: Tensor | None = None, first: int = 0,
    ) -> None:  # fmt: skip
        """The convex Hessian but for the volume's part times fields of so many samples and vertices.

        Fields, results and scalars begin at the given places of their arrays.
        """
        for one, pass_factors in zip(self.passes, factors, strict=True):
            one.launch("product", *dim, fields, start, *pass_factors, out, out_start, scalars, first)

    def back(
        self,
        x: Tensor,
        at: KernelPoint,
        to: Reference,
        to_gradient: Tensor,
        to_x: Tensor,
        to_records: Sequence[Tensor],
        to_diagonal: Tensor | None = None,
        to_factors: Sequence[Any] | None = None,
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
class _MergeRests(Operation):
    """Rest shapes, weights, the stiffnesses of some terms, and perhaps a start as records, and what remains."""

    energy: KernelEnergy
    parts: Sequence[KernelTerm]
    relative: bool

    @property
    def n_differentiable(self) -> int:  # type: ignore[override]
        """Number of records."""
        return len(self.parts)

    @property
    def n_results(self) -> int:  # type: ignore[override]
        """Records, and the constant."""
        return len(self.parts) + 1

    def _arguments(self, i: int, seen: tuple[Tensor, Tensor | None], tensors: Sequence[Tensor]) -> list[Any]:
        """Arguments of the kernel before its results, or their gradients."""
        (x, total), (shapes, weights, *stiffness) = seen, tensors
        start = stiffness[-1] if len(stiffness) > len(self.parts) else None
        soft = None if self.parts[i].formulas.fullness is None else start
        relative = self.relative and soft is not None
        needle = NEEDLE_OF_STEPS if relative else NEEDLE
        sizes = needle**2, int(relative), shapes.shape[1], stiffness[i].shape[1]
        return [x.shape[1], x, weights, total, stiffness[i], soft, *sizes]

    def run(self, kept: list[Any] | None, *tensors: Tensor) -> tuple[Tensor, ...]:
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

    def back(self, kept: list[Any], grads: Sequence[Tensor], *tensors: Tensor) -> tuple[Tensor | None, ...]:
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
