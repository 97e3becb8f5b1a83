"""Terms on a mesh by kernels, and passes over their elements."""

from collections.abc import Sequence
from functools import cached_property

import torch
from torch import Tensor, nn

from torch_modal.autograd import is_eager
from torch_modal.elastic import formulas
from torch_modal.elastic.energy import AssembledTerm
from torch_modal.elastic.kernels.launch import kernels, launch, of_elements
from torch_modal.elastic.term import Formulas, Mesh, Term
from torch_modal.elastic.volume import Volume
from torch_modal.geometry.rigid import volumes_of


class KernelTerm(nn.Module):
    """A term on a mesh, by kernels."""

    elements: Tensor
    term: Term

    def __init__(self, part: AssembledTerm, mesh: Mesh) -> None:
        super().__init__()
        self.part, self.n = part, len(part.corners) - 1
        self.__dict__["term"] = part.term  # not registered here: the layer owns it
        self.register_buffer("elements", part.corners.T.int().contiguous(), persistent=False)
        self.n_elements = self.elements.shape[0]
        #: True if elements have vertices beyond those of the mesh.
        self.extends = bool((part.corners >= mesh.n_vertices).any())

    def __getstate__(self) -> dict[str, object]:
        """Without formulas, which are no data."""
        return {name: value for name, value in self.__dict__.items() if name not in ("formulas", "formulas_of_sum")}

    @cached_property
    def formulas(self) -> Formulas:
        """The formulas that kernels are made from."""
        return self.term.kernel_formulas(self.n)  # type: ignore[return-value]  # :func:`has_kernels` has seen them

    def launch(self, name: str, dim: int, *arguments: object, adjoints: Sequence[object] = ()) -> None:
        """Run a kernel over the elements of each sample, or its adjoint."""
        kernel = of_elements("merging", name, self.formulas)
        launch(kernel, (dim, self.n_elements), [self.elements, *arguments], adjoints and [None, *adjoints])

    def shapes_to_merge(self, shapes: Tensor) -> tuple[Tensor, Tensor | None]:
        """Shapes that elements are merged of, ``(N, n, 3)``, and the sum of the measures if weights need their mean."""
        if not self.formulas.uses_mean:
            return shapes, None
        sizes = shapes.new_zeros(len(shapes), 2, 3)
        self.launch("total", len(shapes), shapes.shape[1], shapes, sizes, None)
        return shapes, sizes


class KernelTotal(KernelTerm):
    """A total by kernels: one element, which begins at zero, and whose vector consists of the sum of the measures."""

    summands: Tensor

    def __init__(self, part: AssembledTerm, mesh: Mesh) -> None:
        super().__init__(part, mesh)
        self.register_buffer("summands", self.elements, persistent=False)
        self.register_buffer("elements", torch.tensor([[0, 1]]).int(), persistent=False)
        self.n_elements = 1

    @cached_property
    def formulas(self) -> Formulas:
        """Overrides the base class: formulas of the one element."""
        own: Formulas = self.term.kernel_formulas(self.n)  # type: ignore[assignment]
        name = "total_of_angles" if own.periodic else "total"
        made = formulas.sum_of_total, formulas.linearised_sum_of_total, own.weight
        return Formulas(name, 1, *made, periodic=own.periodic)

    @cached_property
    def formulas_of_sum(self) -> Formulas:
        """The formulas of the measures that are added up."""
        own: Formulas = self.term.kernel_formulas(self.n)  # type: ignore[assignment]
        return own._replace(weight=None, periodic=False)

    def sum(self, dim: int, *arguments: object, area: bool = False, adjoints: Sequence[object] = ()) -> None:
        """Run the kernel that adds up the measures of some shapes, and areas if the weight needs them, or its adjoint.

        Arguments are the number of vertices, shapes, sums ``(N, 2, 3)``, and gradients of these or None.
        """
        kernel = of_elements("merging", "total", self.formulas_of_sum)
        launch(kernel, (dim, len(self.summands)), [self.summands, *arguments], adjoints and [None, *adjoints])

    def shapes_to_merge(self, shapes: Tensor) -> tuple[Tensor, Tensor | None]:
        """Overrides the base class."""
        sizes = shapes.new_zeros(len(shapes), 2, 3)
        self.sum(len(shapes), shapes.shape[1], shapes, sizes, None, area=True)
        return sizes, None

    def back(self, x: Tensor, to_sizes: Tensor, to_normal: Tensor | None, to_x: Tensor) -> None:
        """Adjoint of the sum and its gradient: adds the gradient in the shapes."""
        normal = None if to_normal is None else torch.empty_like(to_normal)
        values, adjoints = [x.shape[1], x, torch.empty_like(to_sizes), normal], [None, to_x, to_sizes, to_normal]
        self.sum(len(x), *values, area=True, adjoints=adjoints)


class KernelVolume(KernelTotal):
    """The volume of a mesh, by kernels. Cones join the boundary of an open surface to its centre."""

    formulas = KernelTerm.formulas

    def __init__(self, part: AssembledTerm, mesh: Mesh) -> None:
        super().__init__(part, mesh)
        chain, centre = torch.tensor(mesh.connectivity.boundary_chain), mesh.centre
        self.n_faces, self.extends = self.summands.shape[0], len(chain) > 0
        cones = torch.cat([chain.flip(1), torch.full_like(chain[:, :1], centre)], 1)
        self.summands = torch.cat([mesh.faces, cones]).int()

    def sum(self, dim: int, *arguments: object, area: bool = False, adjoints: Sequence[object] = ()) -> None:
        """Overrides the base class."""
        values = [self.summands, *arguments, self.n_faces if area else 0]
        launch(kernels("volume").sizes, (dim, len(self.summands)), values, adjoints and [None, *adjoints])


def volumes_by_kernel(x: Tensor, faces: Tensor) -> Tensor:
    """:func:`torch_modal.geometry.rigid.volumes_of` in one pass, without a gradient; of faces of int32."""
    if not is_eager(x):
        return volumes_of(x, faces)
    shapes = x.detach().double().flatten(0, -3).contiguous()
    sizes = shapes.new_zeros(len(shapes), 2, 3)
    arguments = [faces, shapes.shape[1], shapes, sizes, None, 0]
    launch(kernels("volume").sizes, (len(shapes), len(faces)), arguments)
    return sizes[:, 1, 0].view(x.shape[:-2]).to(x)


def has_kernels(part: AssembledTerm) -> bool:
    """True for a term that kernels compute."""
    n = len(part.corners) - 1
    return n <= 3 and part.term.kernel_formulas(n) is not None


def by_kernels(part: AssembledTerm, mesh: Mesh) -> KernelTerm:
    """A term by kernels."""
    kind = KernelVolume if type(part.term) is Volume else KernelTotal if part.term.total else KernelTerm
    return kind(part, mesh)


class Pass(nn.Module):
    """A pass over the elements of a term, perhaps fused with a term of edges, each with its number.

    ``own`` has the element that begins with each edge, or -1. *Shape:* ``(E,)``.
    """

    elements: Tensor
    own: Tensor | None

    def __init__(
        self, term: tuple[int, KernelTerm], fused: tuple[int, KernelTerm] | None = None, own: Tensor | None = None
    ) -> None:
        super().__init__()
        self.number, self.term = term
        self.other = fused and fused[0]
        self.fused = fused and fused[1]
        elements = self.term.elements
        if self.fused is not None and own is not None:
            # Where there is no element, all further vertices are the first.
            edges, n = self.fused.elements, elements.shape[1]
            alone = torch.cat([edges, edges[:, :1].expand(-1, n - 2)], 1)
            elements = torch.where((own < 0)[:, None], alone, elements[own.clamp_min(0)]).contiguous()
        #: Numbers of elements of the term and the fused one, and of the factors of each: gradient, and two stiffnesses.
        self.sizes = [part and (part.n_elements, 3 * part.formulas.n + 2) for part in (self.term, self.fused)]
        self.n_elements, self.n_own = len(elements), self.term.n_elements
        self.register_buffer("elements", elements, persistent=False)
        self.register_buffer("own", None if own is None else own.int(), persistent=False)

    def of_terms(self, values: Sequence[Tensor]) -> tuple[Tensor, Tensor | None]:
        """The values of the term and of the fused one, from the values of all terms."""
        return values[self.number], None if self.other is None else values[self.other]

    def launch(self, name: str, dim: int, *arguments: object, adjoints: Sequence[object] = ()) -> None:
        """Run a kernel over the elements of each sample, or its adjoint."""
        kernels = of_elements("elements", "convex", self.term.formulas, self.fused and self.fused.formulas)
        arguments = self.elements, self.own, self.n_own, *arguments
        launch(getattr(kernels, name), (dim, self.n_elements), arguments, adjoints and [None] * 3 + [*adjoints])


def passes_of(parts: Sequence[KernelTerm], n_vertices: int) -> list[Pass]:
    """Group the terms but totals into passes: edges are fused with elements that begin with them."""
    terms = [(i, part) for i, part in enumerate(parts) if not isinstance(part, KernelTotal)]
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
