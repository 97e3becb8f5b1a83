"""Terms on a mesh by kernels, and passes over their elements."""

from collections.abc import Sequence
from functools import cached_property

import torch
from torch import Tensor, nn

from torch_modal.autograd import is_eager
from torch_modal.elastic.energy import AssembledTerm, Energy
from torch_modal.elastic.kernels.launch import kernels, launch, of_elements
from torch_modal.elastic.term import Formulas, Mesh, Term
from torch_modal.elastic.volume import Volume
from torch_modal.geometry.rigid import volumes_of


class KernelTerm(nn.Module):
    """A term on a mesh, by kernels.

    Args:
        part: The term.
        elements: The elements of the kernels; by default the elements of the term. *Shape:* ``(M, n)``.
    """

    elements: Tensor
    term: Term

    def __init__(self, part: AssembledTerm, elements: Tensor | None = None) -> None:
        super().__init__()
        self.part, self.n = part, len(part.corners) - 1
        self.__dict__["term"] = part.term  # not registered here: the layer owns it
        elements = part.corners.T if elements is None else elements
        self.register_buffer("elements", elements.int().contiguous(), persistent=False)
        self.n_elements = len(elements)

    def __getstate__(self) -> dict[str, object]:
        """Without formulas, which are no data."""
        return {name: value for name, value in self.__dict__.items() if name != "formulas"}

    @cached_property
    def formulas(self) -> Formulas:
        """The formulas that kernels are made from."""
        return self.term.kernel_formulas(self.n)  # type: ignore[return-value]  # :func:`by_kernels` has seen them

    def launch(self, name: str, dim: int, *arguments: object, adjoints: Sequence[object] = ()) -> None:
        """Run a kernel over the elements of so many samples, or its adjoint."""
        kernel = of_elements("merging", name, self.formulas)
        launch(kernel, (dim, self.n_elements), [self.elements, *arguments], adjoints and [None, *adjoints])

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
        self, term: tuple[int, KernelTerm], rider: tuple[int, KernelTerm] | None = None, own: Tensor | None = None
    ) -> None:
        super().__init__()
        self.number, self.term = term
        self.other = rider and rider[0]
        self.rider = rider and rider[1]
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

    def launch(self, name: str, dim: int, *arguments: object, adjoints: Sequence[object] = ()) -> None:
        """Run a kernel over the elements of so many samples, or its adjoint."""
        kernel = of_elements("elements", name, self.term.formulas, self.rider and self.rider.formulas)
        arguments = self.elements, self.own, self.n_own, *arguments
        launch(kernel, (dim, self.n_elements), arguments, adjoints and [None] * 3 + [*adjoints])


def passes_of(parts: Sequence[KernelTerm], n_vertices: int) -> list[Pass]:
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
