"""Shapes and faces of a page: quantised, predicted from earlier frames, deflated, as base64 text.

decode.js reads it back. All sequences of a page share one grid of 16 bits a coordinate, whose step is the longest side
of the box around everything, divided by 65,535. So a position is off by at most half of that, 8e-6 of the longest side.

Two frames predict the next one of a smooth motion well. Frame n is stored as

    r_n = q_n - 2 q_{n-1} + q_{n-2}    (mod 2^16)                                                      (1)

with r_1 = q_1 - q_0, small numbers around zero. They are folded to positive numbers (0, -1, 1, -2, ... -> 0, 1, 2,
3, ...), split into planes of low and of high bytes (almost all zeros), and deflated.
"""

import base64
import zlib
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from torch_modal.arrays import FloatArray, IntArray

LEVELS = 65_535
"""Steps of the grid along the longest side."""


class Grid(NamedTuple):
    """Quantisation: position = origin + step * number."""

    origin: FloatArray  # (3,)
    step: float


def grid_of(sequences: Sequence[FloatArray]) -> Grid:
    """The grid of the bounding box of all shapes ``(N, V, 3)`` of all sequences."""
    low = np.min([frames.min(axis=(0, 1)) for frames in sequences], axis=0)
    high = np.max([frames.max(axis=(0, 1)) for frames in sequences], axis=0)
    longest = float((high - low).max())
    return Grid(low, longest / LEVELS if longest > 0 else 1.0)


def quantise(frames: FloatArray, grid: Grid) -> NDArray[np.uint16]:
    """Shapes in whole steps of the grid. *Shape:* ``(N, V, 3)``."""
    return np.clip(np.rint((frames - grid.origin) / grid.step), 0, LEVELS).astype(np.uint16)


def pack_frames(numbers: NDArray[np.uint16]) -> str:
    """Shapes ``(N, V, 3)`` in whole steps as text."""
    residual = numbers.copy()
    residual[1:] -= numbers[:-1]  # wraps, here and in the page
    residual[2:] -= numbers[1:-1] - numbers[:-2]
    return _pack(_positive(residual.view(np.int16)).transpose(0, 2, 1))  # all x of a frame, then all y, all z


def pack_faces(faces: IntArray) -> str:
    """Faces ``(F, 3)`` as text: the difference of each corner from the one before."""
    steps = faces.reshape(-1).astype(np.int32)
    steps[1:] -= steps[:-1].copy()
    return _pack(_positive(steps))


def _positive(numbers: NDArray[np.signedinteger]) -> NDArray[np.unsignedinteger]:
    """0, -1, 1, -2, ... as 0, 1, 2, 3, ..., of the same width."""
    bits = 8 * numbers.dtype.itemsize
    return ((numbers << 1) ^ (numbers >> (bits - 1))).view(f"u{numbers.dtype.itemsize}")


def _pack(numbers: NDArray[np.unsignedinteger]) -> str:
    """Planes of bytes, the lowest first, deflated (zlib's format), as base64."""
    little = np.ascontiguousarray(numbers, dtype=numbers.dtype.newbyteorder("<"))
    planes = little.view(np.uint8).reshape(-1, numbers.dtype.itemsize).T
    return base64.b64encode(zlib.compress(planes.tobytes(), 9)).decode("ascii")
