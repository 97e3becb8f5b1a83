"""The energy of shapes at many times, around what is held apart: values, gradients and products with its Hessian."""

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from torch_modal.energy.energy import Energy
from torch_modal.energy.terms import Bend, Mesh, Stretch
from torch_modal.nn import trees
from torch_modal.nn.between import Between, fine_chunk
from torch_modal.nn.contact import Contacts
from torch_modal.nn.frame import Pair
from torch_modal.nn.fused_shell import FusedShell
from torch_modal.nn.held import Held, rest_shapes
from torch_modal.nn.launch import kernels, launch
from torch_modal.nn.relax import ConvexHessian
from torch_modal.nn.samples import Samples


class Region:
    """Vertices that move on their own, and the energy of the faces around them.

    Vertices farther away are moved by the modes only. There the energy has no term that sees all vertices at once, such
    as the volume: the modes keep that.

    Args:
        member: In-betweens of the pair of key-frames.
        samples: Of that pair, with the times of the shapes.
        pair: The key-frames in the frame.
        near: The vertices that may move. *Shape:* ``(V,)``.
    """

    def __init__(self, member: Between, samples: Samples, pair: Pair, near: Tensor) -> None:
        mesh, to = member.mesh, samples.t.device
        faces = mesh.faces[near[mesh.faces].any(1)]
        #: The vertices of the region, and of faces that reach into it. *Shape:* ``(R,)``.
        self.vertices = faces.unique()
        self.numbers = torch.full((mesh.n_vertices,), -1).index_copy(0, self.vertices, torch.arange(len(self.vertices)))
        #: One where they may move. *Shape:* ``(R,)``.
        self.free = near[self.vertices].to(samples.t)
        local = Mesh.of(self.numbers[faces], len(self.vertices))
        every = zip(member.terms, samples.stiffness, strict=True)
        chosen = [(term, k) for term, k in every if not term.total and not term.sampled and _is_number(term.stiffness)]
        terms, stiffness = [term for term, _ in chosen], [k for _, k in chosen]
        energy = Energy(local, terms).to(to)
        fused = member.fused is not None and [type(term) for term in terms] == [Stretch, Bend]
        kind: Any = _Fused if fused else _ByTorch
        self.energy = kind(member, samples, pair, self.vertices, local, energy, stiffness)
        self.held: Held | None = None

    def hold(self, held: Contacts) -> "Region":
        """Hold vertices and faces apart, of all times."""
        self.held = Held(held, self.numbers.to(held.elements.device), len(self.vertices))
        return self

    def value(self, rows: Tensor) -> Tensor:
        """Summed over all times. *Shape:* ``(3, T, R) -> ()``."""
        own = self.energy.value(rows).sum()
        return own if self.held is None else own + self.held.value(rows.flatten(1)).sum()

    def linearised(self, rows: Tensor) -> tuple[Tensor, Tensor, Tensor, Any]:
        """At given shapes, *shape* ``(3, T, R)``.

        Returns:
            The value; the gradients, *shape* ``(3, T, R)``; the blocks of the Hessians' diagonals, *shape*
            ``(3, 3, T, R)``; and what :meth:`product` needs.
        """
        value, gradient, blocks, hessian = self.energy.linearised(rows)
        if self.held is None:
            return value, gradient, blocks, (hessian, None)
        at, shape = self.held.linearised(rows.flatten(1)), rows.shape[1:]
        gradient = gradient.flatten(1).index_add(1, at.corners, at.gradient).unflatten(1, shape)
        blocks = blocks.flatten(2).index_add(2, at.corners, at.blocks).unflatten(2, shape)
        return value + at.value.sum(), gradient, blocks, (hessian, at)

    def product(self, hessians: Any, field: Tensor) -> Tensor:
        """The convex Hessians times displacements. *Shape:* ``(3, T, R) -> (3, T, R)``."""
        hessian, at = hessians
        found: Tensor = self.energy.product(hessian, field)
        if at is not None:
            found.flatten(1).index_add_(1, at.corners, at.product(field.flatten(1))[0])
        return found


class _ByTorch:
    """Any terms, by chunks that fit into caches."""

    def __init__(
        self,
        member: Between,
        samples: Samples,
        pair: Pair,
        vertices: Tensor,
        local: Mesh,
        energy: Energy,
        stiffness: Sequence[Tensor],
    ) -> None:
        self.energy = energy
        self.references = member.fine_reference(samples, pair, energy, vertices, list(stiffness))
        self.size = fine_chunk(len(vertices), samples.t.device)

    def _parts(self, rows: Tensor) -> Any:
        for i in range(0, rows.shape[1], self.size):
            own = slice(i, i + self.size)
            yield trees.rows(self.references, own), self.energy.extend(rows[:, own].contiguous()), own

    def value(self, rows: Tensor) -> Tensor:
        return torch.cat([self.energy.value(x, reference) for reference, x, _ in self._parts(rows)])

    def linearised(self, rows: Tensor) -> tuple[Tensor, Tensor, Tensor, Any]:
        value, gradients, diagonals, hessians = rows.new_zeros(()), [], [], []
        for reference, x, own in self._parts(rows):
            at = self.energy.linearise(x, reference)
            hessian = ConvexHessian(self.energy, at)
            value = value + self.energy.value_at(at, reference).sum()
            gradients.append(self.energy.fold(self.energy.gradient(at)))
            diagonals.append(hessian.diagonal()[..., : rows.shape[-1]])
            hessians.append((own, hessian))
        return value, torch.cat(gradients, 1), torch.cat(diagonals, 2), hessians

    def product(self, hessians: Any, field: Tensor) -> Tensor:
        energy = self.energy
        products = [energy.fold(hessian(energy.extend(field[:, own].contiguous()))) for own, hessian in hessians]
        return torch.cat(products, 1)


class _Fused:
    """Stretch and bend of Eq. 5, by kernels."""

    def __init__(
        self,
        member: Between,
        samples: Samples,
        pair: Pair,
        vertices: Tensor,
        local: Mesh,
        energy: Energy,
        stiffness: Sequence[Tensor],
    ) -> None:
        to = samples.t.device
        self.shell = FusedShell(energy, local).to(to)
        chosen = vertices.to(to)
        first, second = (x[:, chosen] for x in rest_shapes(member, samples, pair))
        given = [value.double().contiguous() for value in (first, second, samples.t, *stiffness)]
        # A stiffness of nothing for the volume.
        self.reference = self.shell.reference(*given, given[2].new_zeros(len(given[2]), 1))

    def value(self, rows: Tensor) -> Tensor:
        return self.shell.value(_points(rows), self.reference).to(rows)

    def linearised(self, rows: Tensor) -> tuple[Tensor, Tensor, Tensor, Any]:
        at = self.shell.at(_points(rows), self.reference)
        xx, xy, xz, yy, yz, zz = at.diagonal.to(rows).unbind(-1)
        blocks = torch.stack([xx, xy, xz, xy, yy, yz, xz, yz, zz]).unflatten(0, (3, 3))
        return at.energy.sum().to(rows), at.gradient.to(rows).movedim(-1, 0), blocks, (at.edges, at.hinges)

    def product(self, hessians: Any, field: Tensor) -> Tensor:
        x = _points(field)
        out, form = torch.zeros_like(x), x.new_zeros(len(x))
        record = self.shell.record
        launch(kernels("shell").product, (len(x), len(record)), [x, record, *hessians, x.shape[1], out, form])
        return out.to(field).movedim(-1, 0)


def _points(rows: Tensor) -> Tensor:
    """*Shape:* ``(3, T, R) -> (T, R, 3)``."""
    return rows.movedim(0, -1).double().contiguous()


def _is_number(stiffness: Any) -> bool:
    return not isinstance(stiffness, Tensor) or stiffness.numel() == 1
