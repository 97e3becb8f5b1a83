"""Shapes of one connectivity with their nearest key-frames and labels."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from torch_modal.data.space import ShapeSpace


class ShapeBatch(NamedTuple):
    """Shapes with their key-frames and labels."""

    shapes: Tensor
    """*Shape:* ``(B, V, 3)``."""
    nearest: Tensor | None = None
    """Index of the key-frame whose modes a shape uses; None: the nearest one. On the CPU. *Shape:* ``(B,)``."""
    vertex_labels: Tensor | None = None
    """*Shape:* ``(B, V, ...)``."""
    shape_labels: Tensor | None = None
    """*Shape:* ``(B, ...)``."""

    @classmethod
    def of_keyframes(
        cls,
        space: ShapeSpace,
        like: Tensor | None = None,
        vertex_labels: Tensor | None = None,
        shape_labels: Tensor | None = None,
    ) -> "ShapeBatch":
        """The key-frames of a space in the dtype and on the device of a tensor, with labels.

        *Shape:* ``(K, V, ...), (K, ...)``.
        """
        return cls(space.keyframes(like), torch.arange(len(space)), vertex_labels, shape_labels)

    def rows(self, index: Tensor) -> "ShapeBatch":
        """Select shapes by their indices."""
        return ShapeBatch._make(None if tensor is None else tensor[index.to(tensor.device)] for tensor in self)

    def with_rows(self, index: Tensor, others: "ShapeBatch") -> "ShapeBatch":
        """Replace the shapes of these indices by others."""
        fields = (
            before if before is None or after is None else before.index_copy(0, index.to(before.device), after)
            for before, after in zip(self, others, strict=True)
        )
        return ShapeBatch._make(fields)

    def locate(self, space: ShapeSpace, dtype: torch.dtype) -> "ShapeBatch":
        """Convert the batch to a dtype, and find the nearest key-frame of each shape."""
        shapes = self.shapes.to(dtype)
        return self._replace(shapes=shapes, nearest=space.nearest(shapes) if self.nearest is None else self.nearest)

    def partners(
        self, chosen: Tensor, draw: Tensor, space: ShapeSpace, pool: "ShapeBatch | None"
    ) -> "ShapeBatch | None":
        """Choose a second shape for each of some shapes; None if there is no other.

        A shape that is alone, without labels, has partners among the key-frames.

        Args:
            chosen: The shapes. *Shape:* ``(n,)``.
            draw: Place of the partner among the other shapes, in [0, 1); for key-frames of a motion, the one before
                (below 0.5) or after. *Shape:* ``(n,)``.
            space: The space.
            pool: Its key-frames, if partners are drawn from these.

        Raises:
            ValueError: The pool has another number of shapes.
        """
        if pool is None and len(self.shapes) == 1 and self.vertex_labels is None and self.shape_labels is None:
            pool = ShapeBatch.of_keyframes(space, self.shapes)
        others, indices = self, chosen
        if pool is not None:
            if not isinstance(pool, ShapeBatch) or len(pool.shapes) != len(space):
                raise ValueError(f"a pool holds the {len(space)} key-frames: ShapeBatch.of_keyframes(space)")
            assert self.nearest is not None
            others, indices = pool.locate(space, self.shapes.dtype), self.nearest[chosen]
        size = len(others.shapes)
        if size < 2:
            return None
        if pool is not None and space.motion is not None:
            places = indices + torch.where(draw < 0.5, -1, 1)
            last = size - 1  # the key-frames at both ends have one neighbour
            return others.rows(places % size if space.cyclic else last - (last - places.abs()).abs())
        return others.rows((indices + (draw * (size - 1)).long().clamp(0, size - 2) + 1) % size)


def check_labels(shape: Sequence[int], labels: Mapping[str, Tensor | None]) -> None:
    """Raise a ValueError unless labels, if there are any, are for as many shapes and vertices."""
    for name, wanted in (("vertex_labels", tuple(shape)), ("shape_labels", tuple(shape[:1]))):
        value = labels.get(name)
        if value is not None and value.shape[: len(wanted)] != wanted:
            raise ValueError(f"{name} begin with the shape {wanted} of the shapes; got {tuple(value.shape)}")
