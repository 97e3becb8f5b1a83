"""Amplitudes and rigid motions over time as integers: rounded coefficients of sines between key-frames.

They are zero at key-frames, so that between two of them they are a sum of sines (the discrete sine transform), of which
few are large.
"""

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from scipy import fft

from torch_modal.arrays import FloatArray, IntArray
from torch_modal.codec.hierarchy import whole
from torch_modal.codec.range_coder import IntegerDecoder, IntegerEncoder

MODE_BANDS, SINE_BANDS = (8, 24), (1, 2)
"""Where bands of modes, and of sines, end; each pair of bands has a distribution of its own."""


def runs(keys: Sequence[int], n_frames: int, cyclic: bool) -> list[slice]:
    """Frames between neighbouring key-frames."""
    ends = [*keys, n_frames] if cyclic else list(keys)
    return [slice(a + 1, b) for a, b in pairwise(ends) if b > a + 1]


def column_steps(n_modes: int, amplitude: float, rotation: float, translation: float) -> FloatArray:
    """Steps of all columns: amplitudes and rigid motion. *Shape:* ``(k + 6,)``."""
    return np.array([amplitude] * n_modes + [rotation] * 3 + [translation] * 3)


def to_sines(series: FloatArray, steps: FloatArray, between: list[slice]) -> IntArray:
    """Columns over time, zero at key-frames, as rounded sines of each run. *Shape:* ``(T, n), (n,) -> (T, n)``."""
    found = np.zeros(series.shape, dtype=np.int64)
    for run in between:
        found[run] = whole(fft.dst(series[run], type=1, norm="ortho", axis=0) / steps)
    return found


def from_sines(numbers: IntArray, steps: FloatArray, between: list[slice]) -> FloatArray:
    """The inverse, of rounded numbers."""
    found = np.zeros(numbers.shape)
    for run in between:
        found[run] = fft.idst(numbers[run] * steps, type=1, norm="ortho", axis=0)
    return found


def write_sines(encoder: IntegerEncoder, numbers: IntArray, between: list[slice]) -> None:
    """Append the sines of amplitudes and rigid motions. *Shape:* ``(T, k + 6)``."""
    rows, kinds, n_kinds = _kinds(numbers.shape[1], between)
    encoder.write(numbers[rows].reshape(-1), kinds, n_kinds)


def read_sines(decoder: IntegerDecoder, shape: tuple[int, int], between: list[slice]) -> IntArray:
    """The inverse of :func:`write_sines`."""
    found = np.zeros(shape, dtype=np.int64)
    rows, kinds, n_kinds = _kinds(shape[1], between)
    found[rows] = decoder.read(kinds, n_kinds).reshape(-1, shape[1])
    return found


def _kinds(n_columns: int, between: list[slice]) -> tuple[IntArray, IntArray, int]:
    """Frames between key-frames; for each of their numbers, its pair of bands; and how many pairs there are."""
    empty = np.zeros(0, dtype=np.int64)
    rows = np.concatenate([empty, *(np.arange(run.start, run.stop) for run in between)])
    sines = np.concatenate([empty, *(np.arange(run.stop - run.start) for run in between)])
    columns = np.append(np.searchsorted(MODE_BANDS, np.arange(n_columns - 6), side="right"), [len(MODE_BANDS) + 1] * 6)
    n = len(SINE_BANDS) + 1
    kinds = columns * n + np.searchsorted(SINE_BANDS, sines, side="right")[:, None]
    return rows, kinds.reshape(-1), n * (len(MODE_BANDS) + 2)
