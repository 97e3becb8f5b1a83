"""Key-frames as integers, each predicted from an earlier one, and back to the same positions on every machine."""

from collections.abc import Sequence

import numpy as np

from torch_modal.arrays import FloatArray, IntArray
from torch_modal.codec.header import N_SHIFTS
from torch_modal.codec.hierarchy import VertexHierarchy
from torch_modal.codec.range_coder import IntegerDecoder, IntegerEncoder

FINER = 1024
"""Cells of the grid of decoded key-frames in a step of their integers."""


class QuantizedKeyframes:
    """Key-frames rounded to integers.

    Args:
        hierarchy: Of their mesh.
        keyframes: In units in which their size is about one. *Shape:* ``(K, V, 3)``.
        step: Of the integers of their finest level.
    """

    def __init__(self, hierarchy: VertexHierarchy, keyframes: FloatArray, step: float) -> None:
        self.hierarchy, self.step = hierarchy, step
        self.numbers: list[list[IntArray]] = []
        self.guides: list[int] = []
        self.shifts: list[int] = []
        decoded: list[FloatArray] = []
        for i, x in enumerate(keyframes):
            best = np.inf
            for guide in sorted({0, i - 1}) if i else [-1]:
                numbers, shape = hierarchy.encode(x, step, decoded[guide] if i else None)
                size = sum(float(np.log2(1 + 2 * np.abs(each)).sum()) for each in numbers)
                if size < best:
                    best, found = size, (guide, numbers, shape)
            guide, numbers, shape = found
            shift = _safest_shift(shape, step)
            decoded.append(on_grid(shape, step, shift))
            self.numbers.append(numbers)
            self.guides.append(guide)
            self.shifts.append(shift)
        #: The shapes that a reader has. *Shape:* ``(K, V, 3)``.
        self.decoded = np.stack(decoded)

    @property
    def flat(self) -> IntArray:
        """All integers, key-frame by key-frame, from coarse to fine."""
        return np.concatenate([each.reshape(-1) for numbers in self.numbers for each in numbers])

    def write(self, encoder: IntegerEncoder) -> None:
        """Append the integers."""
        encoder.write(self.flat, *_kinds(self.hierarchy, len(self.numbers)))


def read_keyframes(
    decoder: IntegerDecoder, hierarchy: VertexHierarchy, step: float, guides: Sequence[int], shifts: Sequence[int]
) -> tuple[FloatArray, IntArray]:
    """The decoded key-frames ``(K, V, 3)``, and their integers."""
    flat = decoder.read(*_kinds(hierarchy, len(guides)))
    ends = np.cumsum([3 * len(level.vertices) for level in hierarchy.levels])
    shapes: list[FloatArray] = []
    for own, guide, shift in zip(flat.reshape(len(guides), -1), guides, shifts, strict=True):
        numbers = [part.reshape(-1, 3) for part in np.split(own, ends[:-1])]
        shapes.append(on_grid(hierarchy.decode(numbers, step, shapes[guide] if shapes else None), step, shift))
    return np.stack(shapes), flat


def on_grid(x: FloatArray, step: float, shift: int) -> FloatArray:
    """A shape on the finer grid, the same on every machine."""
    cell, offset = step / FINER, shift / N_SHIFTS
    return (np.floor(x / cell + offset) + (0.5 - offset)) * cell


def _safest_shift(x: FloatArray, step: float) -> int:
    """The grid whose boundaries are furthest from all vertices."""
    cells = x / (step / FINER)

    def margin(shift: int) -> float:
        fraction = np.mod(cells + shift / N_SHIFTS, 1)
        return float(np.minimum(fraction, 1 - fraction).min())

    return max(range(N_SHIFTS), key=margin)


def _kinds(hierarchy: VertexHierarchy, n_keyframes: int) -> tuple[IntArray, int]:
    """The integers of a level have one distribution in the first key-frame, another in all that have a guide."""
    n = len(hierarchy.levels)
    one = np.repeat(np.arange(n), [3 * len(level.vertices) for level in hierarchy.levels])
    return np.concatenate([one, np.tile(one + n, n_keyframes - 1)]), 2 * n
