"""Eq. 5 in the amplitudes of a modal space by kernels of NVIDIA Warp, where that is installed."""

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor, nn

from torch_modal import trees
from torch_modal.autograd import plain
from torch_modal.elastic.energy import Energy, RestShapes
from torch_modal.elastic.kernels.function import fused
from torch_modal.elastic.kernels.launch import kernels, launch
from torch_modal.elastic.modal import Derivatives, ModalEnergy, Placement, gram
from torch_modal.elastic.term import Mesh
from torch_modal.elastic.warp_shell import ShellReference, WarpShell

# Columns that a kernel takes at a time.
_BLOCK = 8

MOST_NUMBERS = 2**27
"""Of an array that all samples of a batch have at a time (1 GiB): kernels index with 32 bits, and memory is finite."""


class WarpModalEnergy(ModalEnergy):
    """:class:`ModalEnergy` whose values and derivatives come from kernels, in float64.

    It does so for placements with a :class:`ShellReference`, which shapes are not extended for; others, and what is
    differentiated once more, are torch's.

    Args:
        energy: Of stretch, bend and volume, in this order.
        mesh: Its mesh.
        columns: Directions of the space. *Shape:* ``(n, V, 3)``.
    """

    flat: Tensor
    blocks: Tensor
    tabulated = False  # kernels have their own tables

    def __init__(self, energy: Energy, mesh: Mesh, columns: Tensor) -> None:
        super().__init__(energy, columns)
        self.shell = WarpShell(energy, mesh)
        self.register_buffer("flat", columns.flatten(1).contiguous(), persistent=False)
        rows = self.columns.permute(2, 1, 0).flatten(0, 1)
        blocks = nn.functional.pad(rows, (0, -(len(columns) + 2) % _BLOCK + 2)).contiguous()
        #: Columns of each component of each vertex and of the centre, with room for two more, and zeros.
        self.register_buffer("blocks", blocks, persistent=False)

    def reference(self, rests: RestShapes, base: Tensor | None = None) -> ShellReference:
        """As in the base class."""
        return self.shell.reference(rests, base)

    def place(self, base: Tensor, reference: Any, anchors: Tensor | None = None) -> Placement:
        """As in the base class."""
        if not isinstance(reference, ShellReference):
            return super().place(base, reference, anchors)
        return Placement(base.double(), reference)  # type: ignore[arg-type]

    def _plain(self, placement: Placement) -> Placement | None:
        """The placement for torch; None where it is for kernels."""
        if not isinstance(placement.reference, ShellReference):
            return placement
        values = placement.base, *placement.reference
        if torch.is_grad_enabled() or not plain(*values):
            return self.unpacked(placement)
        return None

    def unpacked(self, placement: Placement) -> Placement:
        """A placement for kernels as one for torch."""
        base, reference = trees.mapped(placement, lambda value: value.to(self.columns.dtype))
        return super().place(base, self.shell.unpacked(reference))

    # ------------------------------------------------------------------------------------------------------- the shapes
    def _shapes(self, a: Tensor, base: Tensor) -> Tensor:
        """*Shape:* ``(..., B, n) -> (D * B, V, 3)``."""
        a, flat = a.double(), self.flat.double()
        if a.dim() == 2:
            return torch.addmm(base.flatten(1), a, flat).view_as(base)
        return ((a @ flat).unflatten(-1, (-1, 3)) + base).flatten(0, -3)

    def rows(self, a: Tensor, placement: Placement) -> Tensor:
        """As in the base class."""
        if not isinstance(placement.reference, ShellReference):
            return super().rows(a, placement)
        x = self._shapes(a, placement.base).unflatten(0, a.shape[:-1])
        return self.energy.extend(x.movedim(-1, 0))

    def value(self, a: Tensor, placement: Placement) -> Tensor:
        """As in the base class."""
        plain = self._plain(placement)
        if plain is not None:
            return super().value(a.to(plain.base), plain).to(placement.base)
        to: Any = placement.reference
        found = self.shell.value(self._shapes(a, placement.base), to)
        return found.unflatten(0, a.shape[:-1]) + to.constant

    def derivatives(self, a: Tensor, placement: Placement, second_order: bool = True) -> Derivatives:
        """As in the base class."""
        plain = self._plain(placement)
        if plain is not None:
            found = super().derivatives(a.to(plain.base), plain, second_order)
            return trees.mapped(found, lambda value: value.to(placement.base))
        chunks = self._chunks(a, placement)
        parts = [self._derivatives(*chunk, second_order) for chunk in chunks]
        if len(parts) == 1:
            return parts[0]
        joined = [None if each[0] is None else torch.cat(each) for each in zip(*parts, strict=True)]
        return Derivatives(*joined)  # type: ignore[arg-type]

    def _chunks(self, a: Tensor, placement: Placement) -> list[tuple[Tensor, Placement]]:
        """Samples whose derivatives are taken at a time."""
        shell, width = self.shell, self.blocks.shape[1]
        rows = shell.n_edges + shell.n_hinges + 1, len(self.blocks)
        most = max(1, MOST_NUMBERS // (width * max(rows)))
        if len(a) <= most:
            return [(a, placement)]
        every = [slice(i, i + most) for i in range(0, len(a), most)]
        return [(a[own], trees.rows(placement, own)) for own in every]

    def _derivatives(self, a: Tensor, placement: Placement, second_order: bool) -> Derivatives:
        to: Any = placement.reference
        x, shell = self._shapes(a, placement.base), self.shell
        (b, n), blocks = (len(x), len(self.columns)), self.blocks.double()
        n_measures = shell.n_edges + shell.n_hinges
        # One row for each measure, the last for the volume; the residuals are a column like the others.
        jacobian, totals = x.new_empty(b, n_measures + 1, blocks.shape[1]), x.new_zeros(b, 2)
        given = [shell.constants, x, to.elements, blocks, n, blocks.shape[1] // _BLOCK, n_measures + 1]
        launch(kernels("modal").jacobian, (b, shell.n_edges), [*given, jacobian, jacobian, totals])
        volume, normal = shell.volume(x)
        root, off, last = to.stiffness.sqrt()[:, None], volume - to.volume, jacobian[:, -1]
        last[:, :n] = normal.flatten(1) @ self.flat.double().mT
        last[:, n] = off
        last *= root
        last[:, n + 1 :] = 0
        gradient = (jacobian.mT @ jacobian[..., n : n + 1])[:, :n, 0]
        inner = gram(jacobian, second_order)[:, :n, :n]
        stiffest, stiffness = inner.diagonal(dim1=-2, dim2=-1).amax(-1), to.stiffness + totals[:, 0]
        rounding = torch.finfo(x.dtype).eps * x.abs().amax((-1, -2))
        curved = None
        if second_order:
            pushed = x.new_zeros(b, *blocks.shape)
            given = [shell.constants, x, to.elements, shell.centre(x), to.stiffness * off, blocks]
            dim = b, max(shell.n_edges, shell.n_faces)
            launch(kernels("modal").curved_columns, dim, [*given, blocks.shape[1] // _BLOCK, pushed])
            curved = (blocks.mT @ pushed)[:, :n, :n]
        value = totals[:, 1] + 0.5 * to.stiffness * off**2 + to.constant
        return Derivatives(value, gradient, inner, curved, rounding * (stiffest * stiffness).sqrt())

    def value_and_gradient(self, a: Tensor, placement: Placement) -> tuple[Tensor, Tensor]:
        """As in the base class."""
        plain = self._plain(placement)
        if plain is not None:
            value, gradient = super().value_and_gradient(a.to(plain.base), plain)
            return value.to(placement.base), gradient.to(placement.base)
        to: Any = placement.reference
        value, x = self.shell.value_and_gradient(self._shapes(a, placement.base), to)
        return value + to.constant, x.flatten(1) @ self.flat.double().mT

    def gradient(self, a: Tensor, placement: Placement) -> Tensor:
        """As in the base class."""
        to: Any = placement.reference
        if not isinstance(to, ShellReference):
            return super().gradient(a, placement)
        return fused(_Gradient(self), a, placement.base, *to[:3])[0].to(placement.base)


class _Gradient:
    """Gradient in the amplitudes, from these, the base, and the tensors of a reference but for its constant."""

    n_results = n_differentiable = 1

    def __init__(self, modal: WarpModalEnergy) -> None:
        self.modal = modal

    def run(self, kept: list[Any] | None, a: Tensor, *place: Tensor) -> tuple[Tensor, ...]:
        """See :class:`~torch_modal.elastic.kernels.function.Operation`."""
        return (self.modal.value_and_gradient(a, self._placement(*place))[1],)

    def back(self, kept: list[Any], grads: Sequence[Tensor], a: Tensor, *place: Tensor) -> tuple[Tensor | None, ...]:
        """See :class:`~torch_modal.elastic.kernels.function.Operation`."""
        modal, (base, to) = self.modal, self._placement(*place)
        x, moved = modal._shapes(a, base), modal._shapes(grads[0], torch.zeros_like(base))
        to_base, to_reference = torch.zeros_like(x), ShellReference(*map(torch.zeros_like, to))
        modal.shell.from_point(x, modal.shell.at(x, to), to, moved, to_base, to_reference)
        return to_base.flatten(1) @ modal.flat.double().mT, to_base, *to_reference[:3]

    def by_torch(self, a: Tensor, *place: Tensor) -> tuple[Tensor, ...]:
        """See :class:`~torch_modal.elastic.kernels.function.Operation`."""
        plain = self.modal.unpacked(self._placement(*place))
        return (ModalEnergy.gradient(self.modal, a.to(plain.base), plain).to(a),)

    @staticmethod
    def _placement(base: Tensor, elements: Tensor, stiffness: Tensor, volume: Tensor) -> Any:
        to: Any = ShellReference(elements, stiffness, volume, torch.zeros_like(volume))
        return Placement(base, to)
