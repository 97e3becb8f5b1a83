"""Eq. 5 in the amplitudes of a modal space by kernels of NVIDIA Warp, where that is installed."""

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor, nn

from torch_modal import trees
from torch_modal.autograd import made_outside, traced, transformed
from torch_modal.backends.warp.launch import Constants, kernels, launch
from torch_modal.backends.warp.shell import ShellReference, WarpShell
from torch_modal.energy.modal_energy import Derivatives, ModalEnergy, Placement
from torch_modal.energy.term import Mesh

# Columns that a kernel takes at a time.
_BLOCK = 8

# Columns of a product with itself that are multiplied at a time.
_BLOCKS_OF_PRODUCTS = 16

MOST_NUMBERS = 2**27
"""Of an array that all samples of a batch have at a time (1 GiB): kernels index with 32 bits, and memory is finite."""


class WarpModalEnergy(ModalEnergy):
    """:class:`ModalEnergy` whose values and derivatives come from kernels, in float64.

    It does so for placements with a :class:`ShellReference`, which shapes are not extended for; others, and what is
    differentiated once more, are torch's.

    Args:
        shell: The energy on the mesh that the columns live on.
        mesh: That mesh.
        columns: Directions of the space. *Shape:* ``(n, V, 3)``.
    """

    flat: Tensor
    blocks: Tensor

    def __init__(self, shell: WarpShell, mesh: Mesh, columns: Tensor) -> None:
        super().__init__(shell.energy, columns)
        self._shell = (shell,)
        places = self.curvature.places.int().cpu()
        on_edges, on_hinges, on_faces = places.split([shell.n_edges, 6 * shell.n_hinges, 3 * shell.n_faces])
        edges = places.new_zeros(shell.n_edges, 7)
        edges[:, 0] = on_edges
        edges[shell.interior.cpu(), 1:] = on_hinges.view(6, -1).T
        arrays = {
            "edges": edges,
            "faces": on_faces.view(3, -1).T.contiguous(),
            "pairs": self.curvature.pairs.int().cpu(),
        }
        #: Places of second derivatives, as an argument of kernels.
        self.slots = Constants("modal", "Slots", **arrays)
        self.register_buffer("flat", columns.flatten(1).contiguous(), persistent=False)
        rows = self.columns.permute(2, 1, 0).flatten(0, 1)
        blocks = nn.functional.pad(rows, (0, -(len(columns) + 2) % _BLOCK + 2)).contiguous()
        #: Columns of each component of each vertex and of the centre, with room for two more, and zeros.
        self.register_buffer("blocks", blocks, persistent=False)

    def _prepare(self) -> None:
        """Do nothing: kernels have their own tables, and torch's are built on first use."""
        self._kept: tuple[Tensor, Any] | None = None

    @property
    def tables(self) -> Any:
        """As in the base class, for the present columns, which functional_call may have replaced."""
        if self._kept is None or self._kept[0] is not self.columns:
            self._kept = self.columns, made_outside(self._made_tables)
        return self._kept[1]

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> "WarpModalEnergy":
        """Nothing is made in a lower precision, or on another device, than the columns came in."""
        after = fn(self.columns)
        if (after.dtype, after.device) == (self.columns.dtype, self.columns.device):
            return super()._apply(fn, recurse)
        tables = self.tables
        super()._apply(fn, recurse)
        self._kept = self.columns, tables._apply(fn)
        return self

    @property
    def shell(self) -> WarpShell:
        """The kernels."""
        return self._shell[0]

    def place(self, base: Tensor, reference: Any, anchors: Tensor | None = None) -> Placement:
        """As in the base class."""
        if not isinstance(reference, ShellReference):
            return super().place(base, reference, anchors)
        return Placement(base.double(), reference)  # type: ignore[arg-type]

    def _plain(self, placement: Placement, direction: Tensor | None = None) -> Placement | None:
        """The placement for torch; None where it, and a direction in the amplitudes, are for kernels."""
        if not isinstance(placement.reference, ShellReference):
            return placement
        values = placement.base, *placement.reference, direction
        if torch.is_grad_enabled() or any(x is not None and (traced(x) or transformed(x)) for x in values):
            base, reference = trees.mapped(placement, lambda value: value.to(self.columns.dtype))
            return super().place(base, self.shell.unpacked(reference))
        return None

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
        most = max(1, MOST_NUMBERS // max(width * max(rows), 18 * len(self.curvature.pairs)))
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
        jacobian, stiffness = x.new_empty(b, n_measures + 1, blocks.shape[1]), to.stiffness.clone()
        given = [shell.constants, x, to.elements, blocks, n, blocks.shape[1] // _BLOCK, n_measures + 1]
        launch(kernels("modal").jacobian, (b, shell.n_edges), [*given, jacobian, jacobian, stiffness])
        volume, normal = shell.volume(x)
        root, off, last = to.stiffness.sqrt()[:, None], volume - to.volume, jacobian[:, -1]
        last[:, :n] = normal.flatten(1) @ self.flat.double().mT
        last[:, n] = off
        last *= root
        last[:, n + 1 :] = 0
        products = gram(jacobian)
        gradient, inner = products[:, :n, n], products[:, :n, :n]
        stiffest = inner.diagonal(dim1=-2, dim2=-1).amax(-1)
        rounding = torch.finfo(x.dtype).eps * x.abs().amax((-1, -2))
        curved = self._second(x, to.stiffness * off, placement) if second_order else None
        return Derivatives(gradient, inner, curved, rounding * (stiffest * stiffness).sqrt())

    def value_and_gradient(self, a: Tensor, placement: Placement) -> tuple[Tensor, Tensor]:
        """As in the base class."""
        plain = self._plain(placement)
        if plain is not None:
            value, gradient = super().value_and_gradient(a.to(plain.base), plain)
            return value.to(placement.base), gradient.to(placement.base)
        to: Any = placement.reference
        value, x = self.shell.value_and_gradient(self._shapes(a, placement.base), to)
        return value + to.constant, x.flatten(1) @ self.flat.double().mT

    def _second(self, x: Tensor, moment: Tensor, placement: Placement) -> Tensor:
        to: Any = placement.reference
        shell, n_pairs = self.shell, len(self.curvature.pairs)
        found = x.new_zeros(len(x), 2 * n_pairs, 3, 3)
        given = [shell.constants, self.slots, x, to.elements, shell.centre(x), moment, found]
        launch(kernels("modal").curvature, (len(x), max(shell.n_edges, shell.n_faces)), given)
        columns, n = self.blocks.double(), len(self.columns)
        pushed = x.new_zeros(len(x), *columns.shape)
        given = [self.slots, found, columns, len(columns) // 3, columns.shape[1] // _BLOCK, pushed]
        launch(kernels("modal").curved_columns, (len(x), n_pairs), given)
        return (columns.mT @ pushed)[:, :n, :n]

    def pull_back(self, a: Tensor, direction: Tensor, placement: Placement) -> Placement:
        """As in the base class."""
        to: Any = placement.reference
        if not isinstance(to, ShellReference):
            return super().pull_back(a, direction, placement)
        plain = self._plain(placement, direction)
        if plain is not None:
            pulled = super().pull_back(a.to(plain.base), direction.to(plain.base), plain)
            return self._repacked(pulled, placement)
        base, shell = placement.base, self.shell
        x, moved = self._shapes(a, base), self._shapes(direction, torch.zeros_like(base))
        at = shell.at(x, to)
        to_base, to_reference = torch.zeros_like(x), ShellReference(*(torch.zeros_like(value) for value in to))
        shell.from_point(x, at, to, moved, to_base, to_reference)
        return Placement(to_base, to_reference)  # type: ignore[arg-type]

    def _repacked(self, found: Placement, placement: Placement) -> Placement:
        """Gradients in a placement for torch as those in the one for kernels that it was made of."""
        given, skeleton = trees.leaves(placement), trees.skeleton(placement)

        def run(*values: Tensor) -> tuple[Tensor, ...]:
            return tuple(trees.leaves(self._plain(trees.filled(skeleton, values))))

        pulled = torch.func.vjp(run, *given)[1](tuple(trees.leaves(found)))
        return trees.filled(skeleton, pulled)  # type: ignore[no-any-return]


def gram(x: Tensor) -> Tensor:
    """``x^T x``; on a CPU in rows of blocks, from the diagonal on. *Shape:* ``(B, m, n) -> (B, n, n)``."""
    n = x.shape[-1]
    if x.device.type != "cpu":
        return x.mT @ x
    found = x.new_empty(len(x), n, n)
    for i in range(0, n, _BLOCKS_OF_PRODUCTS):
        own = slice(i, i + _BLOCKS_OF_PRODUCTS)
        right = torch.bmm(x[..., own].mT, x[..., i:])
        found[:, i:, own], found[:, own, i:] = right.mT, right
    return found
