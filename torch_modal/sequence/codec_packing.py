"""The compact coding of a motion: whole numbers of key-frames, amplitudes and rigid motions, and faces.

Key-frames are rounded level by level (:mod:`torch_modal.sequence.codec_levels`). Amplitudes and rigid motions are zero
at key-frames, so that what lies between two of them is a sum of sines, of which few are large; these are rounded. A
range coder packs both, LZMA the faces. All that is read is bounded by what the file can hold.
"""

import hashlib
import lzma
from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import fft
from torch import Tensor

from torch_modal.sequence.codec_entropy import Reader, Writer
from torch_modal.sequence.codec_head import MOST_NUMBERS, N_SHIFTS, Head, read_head
from torch_modal.sequence.codec_levels import DEAD, Levels

PACKED = "packed"
FREE_BYTES = 2**24
"""Anything may unpack to this many."""
MOST_PER_BYTE = 1000
"""And beyond that to this many for each byte."""
FILTERS = [{"id": lzma.FILTER_LZMA1, "preset": 9, "lc": 0, "lp": 0, "pb": 0, "dict_size": 2**20}]
FINER = 1024
"""Steps of the grid of finished key-frames in a step of their numbers."""
BANDS = (8, 24)
"""Modes, and sines (:data:`SINES`), whose numbers have a distribution of their own."""
SINES = (1, 2)
PROBE_UNIT = 8192
"""Of the modes' probe, whole numbers in one."""

IntArray = NDArray[np.int64]
FloatArray = NDArray[np.float64]


# ---------------------------------------------------------------------------------------------------------------- faces
def squeeze(numbers: IntArray) -> bytes:
    """Whole numbers, the smaller the better, as bytes: a plane for each byte of a number."""
    flat = numbers.reshape(-1)
    folded = np.where(flat > 0, 2 * flat - 1, -2 * flat).astype(np.uint64)
    width = max(1, (int(folded.max(initial=0)).bit_length() + 7) // 8)
    planes = b"".join(((folded >> np.uint64(8 * i)) & np.uint64(255)).astype(np.uint8).tobytes() for i in range(width))
    return bytes([width]) + lzma.compress(planes, lzma.FORMAT_RAW, filters=FILTERS)


def unsqueeze(data: bytes, count: int) -> IntArray:
    """The inverse of :func:`squeeze`.

    Args:
        data: Of a file.
        count: How many numbers there must be.

    Raises:
        ValueError: There are others, or the bytes are damaged.
    """
    width = data[0] if data else 0
    if not 1 <= width <= 8 or not 0 <= count <= MOST_NUMBERS:
        raise ValueError("one of its parts is damaged")
    size = width * count
    require_room(size, len(data))
    unpacker = lzma.LZMADecompressor(lzma.FORMAT_RAW, filters=FILTERS)
    try:
        planes = unpacker.decompress(data[1:], max_length=size)
        more = b"" if unpacker.eof else unpacker.decompress(b"", max_length=1)
    except (lzma.LZMAError, EOFError):
        raise ValueError("one of its parts is damaged") from None
    if len(planes) != size or more:
        raise ValueError("one of its parts is damaged or cut off")
    folded = np.zeros(count, dtype=np.uint64)
    for i in range(width):
        folded |= np.frombuffer(planes, np.uint8, count, i * count).astype(np.uint64) << np.uint64(8 * i)
    half = ((folded + np.uint64(1)) >> np.uint64(1)).astype(np.int64)
    return np.where(folded & np.uint64(1), half, -half)


def require_room(n_bytes: int, packed: int) -> None:
    """Refuse what claims to hold more than it can.

    Raises:
        ValueError: It does.
    """
    if n_bytes > FREE_BYTES + MOST_PER_BYTE * packed:
        raise ValueError(f"it claims to hold {n_bytes} bytes in {packed}")


def as_tensor(data: bytes) -> Tensor:
    """Bytes of a file."""
    return torch.from_numpy(np.frombuffer(data, dtype=np.uint8).copy())


def as_bytes(packed: Tensor | None) -> bytes:
    """The inverse.

    Raises:
        ValueError: They are not there, or are something else.
    """
    if packed is None or packed.dtype != torch.uint8 or packed.dim() != 1 or len(packed) < 2:
        raise ValueError("one of its parts is missing")
    return packed.numpy().tobytes()


def pack_faces(faces: IntArray) -> bytes:
    """Corners as differences from face to face."""
    return squeeze(np.diff(faces, axis=0, prepend=0).T)


def unpack_faces(data: bytes, n_faces: int) -> IntArray:
    """The inverse."""
    return np.cumsum(unsqueeze(data, 3 * n_faces).reshape(3, n_faces), axis=1).T


# ----------------------------------------------------------------------------------------------------------- key-frames
class RoundedShapes:
    """Key-frames that have been rounded, each with the help of an earlier one.

    Args:
        levels: Of their mesh.
        shapes: In units in which their size is about one. *Shape:* ``(K, V, 3)``.
        step: Of the numbers of their finest level.
    """

    def __init__(self, levels: Levels, shapes: FloatArray, step: float) -> None:
        self.step = step
        self.numbers: list[list[IntArray]] = []
        self.guides: list[int] = []
        self.shifts: list[int] = []
        grids: list[FloatArray] = []
        for i, x in enumerate(shapes):
            tried = []
            for guide in sorted({0, i - 1}) if i else [-1]:
                numbers, found = levels.rounded(x, step, grids[guide] if i else None)
                size = sum(float(np.log2(1 + 2 * np.abs(each)).sum()) for each in numbers)
                tried.append((size, guide, numbers, found))
            _, guide, numbers, found = min(tried, key=lambda one: one[0])
            shift = _quiet_shift(found, step)
            grids.append(finished(found, step, shift))
            self.numbers.append(numbers)
            self.guides.append(guide)
            self.shifts.append(shift)
        #: What a reader will have. *Shape:* ``(K, V, 3)``.
        self.shapes = np.stack(grids)


def finished(x: FloatArray, step: float, shift: int) -> FloatArray:
    """A shape on the finer grid, the same wherever it is computed."""
    cell, offset = step / FINER, shift / N_SHIFTS
    return (np.floor(x / cell + offset) + (0.5 - offset)) * cell


def _quiet_shift(x: FloatArray, step: float) -> int:
    """The grid whose boundaries are furthest from all vertices."""
    parts = x / (step / FINER)

    def margin(shift: int) -> float:
        apart = np.mod(parts + shift / N_SHIFTS, 1)
        return float(np.minimum(apart, 1 - apart).min())

    return max(range(N_SHIFTS), key=margin)


def _shape_kinds(levels: Levels, n_keyframes: int) -> tuple[IntArray, int]:
    """Numbers of a level have one distribution in the first key-frame, another in all that have a guide."""
    n = len(levels.levels)
    one = np.concatenate([np.full(3 * len(level.vertices), i) for i, level in enumerate(levels.levels)])
    return np.concatenate([one, np.tile(one + n, n_keyframes - 1)]), 2 * n


def write_shapes(writer: Writer, levels: Levels, rounded: RoundedShapes) -> None:
    """All key-frames."""
    flat = np.concatenate([each.reshape(-1) for numbers in rounded.numbers for each in numbers])
    writer.numbers(flat, *_shape_kinds(levels, len(rounded.numbers)))


def read_shapes(
    reader: Reader, levels: Levels, step: float, guides: Sequence[int], shifts: Sequence[int]
) -> tuple[FloatArray, IntArray]:
    """The key-frames, and their numbers."""
    kinds, n_kinds = _shape_kinds(levels, len(guides))
    flat = reader.numbers(kinds, n_kinds)
    ends = np.cumsum([3 * len(level.vertices) for level in levels.levels])
    shapes: list[FloatArray] = []
    for own, guide, shift in zip(flat.reshape(len(guides), -1), guides, shifts, strict=True):
        numbers = [part.reshape(-1, 3) for part in np.split(own, ends[:-1])]
        found = levels.shape(numbers, step, shapes[guide] if shapes else None)
        shapes.append(finished(found, step, shift))
    return np.stack(shapes), flat


# ----------------------------------------------------------------------------------------------------------- amplitudes
def runs(keys: Sequence[int], n_frames: int, cyclic: bool) -> list[slice]:
    """Frames between neighbouring key-frames."""
    ends = [*keys, n_frames] if cyclic else list(keys)
    return [slice(a + 1, b) for a, b in pairwise(ends) if b > a + 1]


def to_sines(series: FloatArray, steps: FloatArray, between: list[slice]) -> IntArray:
    """Columns over time, zero at key-frames, as rounded sines of each run. *Shape:* ``(T, n), (n,) -> (T, n)``."""
    found = np.zeros(series.shape, dtype=np.int64)
    for run in between:
        parts = fft.dst(series[run], type=1, norm="ortho", axis=0) / steps
        found[run] = (np.sign(parts) * np.floor(np.abs(parts) + 0.5 - DEAD)).astype(np.int64)
    return found


def from_sines(numbers: IntArray, steps: FloatArray, between: list[slice]) -> FloatArray:
    """The inverse, of rounded numbers."""
    found = np.zeros(numbers.shape)
    for run in between:
        found[run] = fft.idst(numbers[run] * steps, type=1, norm="ortho", axis=0)
    return found


def _series_kinds(n_modes: int, between: list[slice]) -> tuple[IntArray, int]:
    """By bands of modes, and rigid motions, and by bands of sines. *Shape:* ``(frames between, n_modes + 6)``."""
    columns = np.append(np.searchsorted(BANDS, np.arange(n_modes), side="right"), [len(BANDS) + 1] * 6)
    rows = [np.searchsorted(SINES, np.arange(run.stop - run.start), side="right") for run in between]
    n = len(SINES) + 1
    kinds = columns * n + np.concatenate([*rows, np.zeros(0, dtype=np.int64)])[:, None]
    return kinds.reshape(-1).astype(np.int64), n * (len(BANDS) + 2)


def write_series(writer: Writer, numbers: IntArray, between: list[slice]) -> None:
    """Sines of amplitudes and rigid motions. *Shape:* ``(T, k + 6)``."""
    flat = np.concatenate([*(numbers[run].reshape(-1) for run in between), []]).astype(np.int64)
    writer.numbers(flat, *_series_kinds(numbers.shape[1] - 6, between))


def read_series(reader: Reader, shape: tuple[int, int], between: list[slice]) -> IntArray:
    """The inverse."""
    flat = reader.numbers(*_series_kinds(shape[1] - 6, between))
    found, start = np.zeros(shape, dtype=np.int64), 0
    for run in between:
        end = start + (run.stop - run.start) * shape[1]
        found[run] = flat[start:end].reshape(-1, shape[1])
        start = end
    return found


# ---------------------------------------------------------------------------------------------------------- all of it
def digest(head: Head, *arrays: IntArray) -> bytes:
    """By which damage is seen, and a machine that predicts otherwise."""
    found = hashlib.sha256(head._replace(digest=b"").data())
    for array in arrays:
        found.update(np.ascontiguousarray(array, dtype="<i8").tobytes())
    return found.digest()[:8]


def exactly(x: FloatArray) -> IntArray:
    """Floating-point numbers as the whole numbers that their bits are."""
    return np.ascontiguousarray(x, dtype="<f8").view("<i8")


def positions(x: FloatArray, origin: Sequence[float], scale: float) -> Tensor:
    """In the caller's units; one multiplication and one sum, which are the same on all machines."""
    return torch.from_numpy(np.asarray(origin, dtype=np.float64) + np.float64(scale) * x)


def unpack(tensors: dict[str, Tensor]) -> dict[str, Any]:
    """All parts of a sequence, but its modes, with the key-frame and the directions that these belong to.

    Raises:
        ValueError: They are damaged, or claim to hold more than they can.
    """
    data = as_bytes(tensors.get("packed"))
    head, start = read_head(data)
    v, t, k, keys, cyclic = head.n_vertices, head.n_frames, head.n_modes, head.keys, bool(head.cyclic)
    end = start + head.n_face_bytes
    faces = unpack_faces(data[start:end], head.n_faces)
    if faces.min() < 0 or faces.max() >= v or 3 * head.n_faces < v // 1000:
        raise ValueError("it names vertices that it does not have")
    require_room(3 * len(keys) * v + t * (k + 6), len(data))  # a number takes a byte, or less
    origin, steps, scale = head.floats[:3], head.floats[3:7], head.floats[7]
    reader, between = Reader(data[end:]), runs(keys, t, cyclic)
    x, numbers = read_shapes(reader, Levels(faces, v), steps[0], head.guides, head.shifts)
    series = read_series(reader, (t, k + 6), between)
    few = np.repeat([0, 1], [head.n_clusters, head.n_probes])
    clusters, probe = np.split(reader.numbers(few, 2), [head.n_clusters])
    if digest(head, faces, exactly(x), numbers, series, clusters, probe) != head.digest:
        raise ValueError("its contents are not what was written: it is damaged")
    when = tensors.get("times")
    if when is None:
        when = torch.arange(t + cyclic, dtype=torch.float64)
    if when.shape != (t + cyclic,) or when.dtype != torch.float64:
        raise ValueError("its times are damaged")
    found = torch.from_numpy(from_sines(series, series_steps(k, *steps[1:]), between))
    return {
        "keyframes": positions(x, origin, scale),
        "faces": torch.from_numpy(np.ascontiguousarray(faces)),
        "keyframe_times": when[[*keys, t]] if cyclic else when[keys],
        "times": when[:t],
        "amplitudes": found[:, :k],
        "motions": found[:, k:],
        "errors": torch.full((t,), torch.nan, dtype=torch.float64),
        "clusters": torch.from_numpy(clusters),
        "probe": torch.from_numpy(probe / PROBE_UNIT),
        "reference": head.reference,
        "seed": head.seed,
    }


def series_steps(n_modes: int, of_amplitudes: float, of_turns: float, of_moves: float) -> FloatArray:
    """Of all columns. *Shape:* ``(k + 6,)``."""
    return np.array([of_amplitudes] * n_modes + [of_turns] * 3 + [of_moves] * 3)
