"""Directions that amplitudes belong to, on the fine and on the coarse mesh."""

import itertools
from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

import torch
from torch import Tensor, nn

from torch_modal.autograd import lasting


class Directions(NamedTuple):
    """Displacements of the fine vertices, as they were given."""

    given: Tensor
    """*Shape:* ``(m, V, 3)``."""
    turn: Tensor | None = None
    """The rotation into the frame. *Shape:* ``(3, 3)``."""

    def turned(self, x: Tensor) -> Tensor:
        """Vectors of the given coordinates in those of the frame. *Shape:* ``(..., 3)``."""
        return x if self.turn is None else x @ self.turn.mT


# Names of what columns are combined from.
_PARTS = ("_mix", "_given", "_turn")


class Columns(nn.Module):
    """The same directions on the fine and on the coarse mesh.

    On the fine mesh they are combinations of others, which several pairs have, and which are as large: so they are
    written out only where somebody asks for them.

    Args:
        mixes: Combinations of directions, whose sum the columns are. *Shape of each:* ``(n, m)``.
        parts: These directions.
        coarse: Orthonormal under the coarse vertex weights. *Shape:* ``(n, V_coarse, 3)``.
        weights: Of the coarse vertices. *Shape:* ``(V_coarse,)``.
    """

    coarse: Tensor
    weighted: Tensor
    _fine: Tensor | None

    def __init__(self, mixes: Sequence[Tensor], parts: Sequence[Directions], coarse: Tensor, weights: Tensor) -> None:
        super().__init__()
        for i, (mix, part) in enumerate(zip(mixes, parts, strict=True)):
            for name, tensor in zip(_PARTS, (mix, *part), strict=True):
                self.register_buffer(f"{name}_{i}", tensor, persistent=False)
        self._n_parts = len(parts)
        self._shape = [len(coarse), *parts[0].given.shape[1:]]
        self.register_buffer("_fine", None, persistent=False)
        self.register_buffer("coarse", coarse, persistent=False)
        #: Maps coarse shapes to amplitudes. *Shape:* ``(3 V_coarse, n)``.
        self.register_buffer("weighted", (coarse * weights[:, None]).flatten(1).mT.contiguous(), persistent=False)

    def __len__(self) -> int:
        """How many."""
        return self._shape[0]

    @property
    def fine(self) -> Tensor:
        """On the fine mesh, kept. *Shape:* ``(n, V, 3)``."""
        if self._fine is None:
            self._fine = lasting(self.combine)(torch.eye(len(self)).to(self.coarse))
        return self._fine

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> "Columns":
        """In a lower precision than they were made in, what their directions have in common would not cancel."""
        after = fn(self.coarse)
        if (after.dtype, after.device) != (self.coarse.dtype, self.coarse.device) and self._n_parts:
            self.fine  # noqa: B018
            for i, name in itertools.product(range(self._n_parts), _PARTS):
                delattr(self, f"{name}_{i}")
            self._n_parts = 0
        return super()._apply(fn, recurse)

    def combine(self, a: Tensor) -> Tensor:
        """Fine displacement of given amplitudes. *Shape:* ``(..., n) -> (..., V, 3)``."""
        rows = a.reshape(-1, len(self))
        return self.added(a.new_zeros(len(rows), *self._shape[1:]), rows).unflatten(0, a.shape[:-1])

    def added(self, x: Tensor, a: Tensor) -> Tensor:
        """Fine shapes with that of given amplitudes added. *Shape:* ``(B, V, 3), (B, n) -> (B, V, 3)``."""
        # Not by what may have been written out since: the same amplitudes give the same bits every time.
        if not self._n_parts:
            return torch.addmm(x.flatten(1), a, self.fine.flatten(1)).view_as(x)
        for mix, part in self._parts():
            own, given = a @ mix, part.given.flatten(1)
            if part.turn is None:
                x = torch.addmm(x.flatten(1), own, given).view_as(x)
            else:
                x = torch.addmm(x.flatten(0, 1), (own @ given).view(-1, 3), part.turn.mT).view_as(x)
        return x

    def at(self, vertices: Tensor) -> Tensor:
        """Those of some of the vertices. *Shape:* ``(P,) -> (n, P, 3)``."""
        if not self._n_parts:
            return self.fine[:, vertices]
        found = [part.turned(torch.tensordot(mix, part.given[:, vertices], 1)) for mix, part in self._parts()]
        return torch.stack(found).sum(0)

    def _parts(self) -> Iterator[tuple[Tensor, Directions]]:
        for i in range(self._n_parts):
            mix, given, turn = (getattr(self, f"{name}_{i}") for name in _PARTS)
            yield mix, Directions(given, turn)
