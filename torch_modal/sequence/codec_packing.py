"""The compact coding of a motion: whole numbers, predicted, and packed by LZMA (a range coder of Python's library).

Key-frames are rounded to a grid, and predicted vertex by vertex; amplitudes and rigid motions are rounded to steps, and
predicted from the frame before. All that is read is bounded by what the file can hold.
"""

import hashlib
import lzma
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torch_modal.sequence.codec_prediction import WAYS, generations, residuals, restored

PACKED = "packed"
MOST_NUMBERS = 2**31
FREE_BYTES = 2**24
"""Anything may unpack to this many."""
MOST_PER_BYTE = 1000
"""And beyond that to this many for each byte."""
FILTERS = [{"id": lzma.FILTER_LZMA1, "preset": 9, "lc": 0, "lp": 0, "pb": 0, "dict_size": 2**20}]

IntArray = NDArray[np.int64]


def squeeze(numbers: IntArray) -> Tensor:
    """Whole numbers, the smaller the better, as bytes: a plane for each byte of a number."""
    flat = numbers.reshape(-1)
    folded = np.where(flat > 0, 2 * flat - 1, -2 * flat).astype(np.uint64)
    width = max(1, (int(folded.max(initial=0)).bit_length() + 7) // 8)
    planes = b"".join(((folded >> np.uint64(8 * i)) & np.uint64(255)).astype(np.uint8).tobytes() for i in range(width))
    data = bytes([width]) + lzma.compress(planes, lzma.FORMAT_RAW, filters=FILTERS)
    return torch.from_numpy(np.frombuffer(data, dtype=np.uint8).copy())


def unsqueeze(packed: Tensor | None, count: int) -> IntArray:
    """The inverse of :func:`squeeze`.

    Args:
        packed: Bytes, of a file.
        count: How many numbers there must be.

    Raises:
        ValueError: There are others, or the bytes are damaged.
    """
    if packed is None or packed.dtype != torch.uint8 or packed.dim() != 1 or len(packed) < 2:
        raise ValueError("one of its parts is missing")
    data = packed.numpy().tobytes()
    width = data[0]
    if not 1 <= width <= 8 or not 0 <= count <= MOST_NUMBERS:
        raise ValueError("one of its parts is damaged")
    size = width * count
    if size > FREE_BYTES + MOST_PER_BYTE * len(data):
        raise ValueError(f"it claims to hold {count} numbers in {len(data)} bytes")
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


def pack_faces(faces: IntArray) -> Tensor:
    """Corners as differences from face to face."""
    return squeeze(np.diff(faces, axis=0, prepend=0).T)


def unpack_faces(packed: Tensor | None, n_faces: int) -> IntArray:
    """The inverse."""
    return np.cumsum(unsqueeze(packed, 3 * n_faces).reshape(3, n_faces), axis=1).T


def pack_shapes(grid: IntArray, faces: IntArray) -> tuple[Tensor, list[list[int]]]:
    """Key-frames on a grid, each by the best way, and the best of the key-frames before as its guide.

    Args:
        grid: *Shape:* ``(K, V, 3)``.
        faces: *Shape:* ``(F, 3)``.

    Returns:
        All of them, and the way and the guide of each.
    """
    plan = generations(faces, grid.shape[1])
    parts, ways = [], []
    for n, x in enumerate(grid):
        tried = {(0, 0): residuals(x, plan, WAYS[0], None)}
        for guide in {0, n - 1} if n else set():
            tried |= {(way, guide): residuals(x, plan, WAYS[way], grid[guide]) for way in (1, 2)}
        best = min(tried, key=lambda key: len(squeeze(tried[key].T)))
        parts.append(tried[best].T)
        ways.append(list(best))
    return squeeze(np.stack(parts)), ways


def unpack_shapes(packed: Tensor | None, ways: Any, faces: IntArray, shape: tuple[int, int, int]) -> IntArray:
    """The inverse."""
    n, v, _ = shape
    left = unsqueeze(packed, n * v * 3).reshape(n, 3, v).transpose(0, 2, 1)
    usable = isinstance(ways, list) and len(ways) == n
    if not usable or any(w not in ([[0, 0]] + [[a, b] for a in (1, 2) for b in range(i)]) for i, w in enumerate(ways)):
        raise ValueError("its key-frames are predicted in no known way")
    if np.abs(left).max(initial=0) > 2**40:
        raise ValueError("its key-frames are damaged")
    plan = generations(faces, v)
    grid = np.zeros(shape, dtype=np.int64)
    for i, (way, guide) in enumerate(ways):
        grid[i] = restored(np.ascontiguousarray(left[i]), plan, WAYS[way], grid[guide])
    return grid


def pack_series(numbers: IntArray) -> tuple[Tensor, int]:
    """Columns over time, as differences of the order that packs best. *Shape:* ``(T, n)``."""
    tried = []
    for order in range(3):
        left = numbers
        for _ in range(order):
            left = np.diff(left, axis=0, prepend=0)
        tried.append(squeeze(left.T))
    order = min(range(3), key=lambda i: len(tried[i]))
    return tried[order], order


def unpack_series(packed: Tensor | None, order: Any, shape: tuple[int, int]) -> IntArray:
    """The inverse."""
    numbers = unsqueeze(packed, shape[0] * shape[1]).reshape(shape[1], shape[0]).T
    if order not in (0, 1, 2):
        raise ValueError("its amplitudes are predicted in no known way")
    for _ in range(order):
        numbers = np.cumsum(numbers, axis=0)
    return numbers


def digest(*arrays: IntArray) -> str:
    """By which damage is seen, and a machine that predicts otherwise."""
    found = hashlib.sha256()
    for array in arrays:
        found.update(np.ascontiguousarray(array, dtype="<i8").tobytes())
    return found.hexdigest()[:16]


def positions(grid: IntArray, low: list[float], step: float) -> Tensor:
    """Of a grid; one multiplication and one sum, which are the same on all machines."""
    return torch.from_numpy(np.asarray(low, dtype=np.float64) + np.float64(step) * grid.astype(np.float64))


def unpack(tensors: dict[str, Tensor], header: dict[str, Any]) -> dict[str, Tensor]:
    """All parts of a sequence, but its modes.

    Raises:
        ValueError: They are damaged, or claim to hold more than they can.
    """
    k, v, f, t, n = (header.get(name) for name in ("keyframes", "vertices", "faces", "frames", "modes"))
    steps, low, keys = header.get("steps"), header.get("low"), header.get("keys")
    counts = (k, v, f, t, n)
    if any(isinstance(c, bool) or not isinstance(c, int) or not 1 <= c <= MOST_NUMBERS for c in counts):
        raise ValueError("its header is damaged")
    if not _numbers(steps, 4) or not _numbers(low, 3) or any(s <= 0 for s in steps):  # type: ignore[union-attr]
        raise ValueError("its header is damaged")
    assert isinstance(k, int) and isinstance(v, int) and isinstance(f, int) and isinstance(t, int)
    assert isinstance(n, int) and isinstance(steps, list) and isinstance(low, list)
    if not isinstance(keys, list) or len(keys) != k or any(type(i) is not int or not 0 <= i < t for i in keys):
        raise ValueError("its header names key-frames that it does not have")
    faces = unpack_faces(tensors.get("faces"), f)
    if faces.min() < 0 or faces.max() >= v or 3 * f < v // 1000:
        raise ValueError("it names vertices that it does not have")
    grid = unpack_shapes(tensors.get("keyframes"), header.get("ways"), faces, (k, v, 3))
    orders = header.get("orders")
    if not isinstance(orders, list) or len(orders) != 2:
        raise ValueError("its header is damaged")
    a = unpack_series(tensors.get("amplitudes"), orders[0], (t, n))
    motions = unpack_series(tensors.get("motions"), orders[1], (t, 6))
    clusters = unsqueeze(tensors.get("clusters"), int(header.get("clusters", 0)))
    pivots = unsqueeze(tensors.get("pivots"), n)
    if digest(faces, grid, a, motions, clusters, pivots) != header.get("digest"):
        raise ValueError("its contents are not what was written: it is damaged")
    when, probe = tensors.get("times"), tensors.get("probe")
    cyclic = bool(header.get("cyclic"))
    if when is None:
        when = torch.arange(t + cyclic, dtype=torch.float64)
    if when.shape != (t + cyclic,) or when.dtype != torch.float64 or probe is None or probe.dtype != torch.float32:
        raise ValueError("its times or its probe are damaged")
    scale = np.array([steps[2]] * 3 + [steps[3]] * 3)
    return {
        "keyframes": positions(grid, low, steps[0]),
        "faces": torch.from_numpy(np.ascontiguousarray(faces)),
        "keyframe_times": when[[*keys, t]] if cyclic else when[keys],
        "times": when[:t],
        "amplitudes": torch.from_numpy(steps[1] * a.astype(np.float64)),
        "motions": torch.from_numpy(scale * motions.astype(np.float64)),
        "errors": torch.full((t,), torch.nan, dtype=torch.float64),
        "clusters": torch.from_numpy(clusters),
        "pivots": torch.from_numpy(pivots),
        "probe": probe.double(),
    }


def _numbers(found: Any, n: int) -> bool:
    return isinstance(found, list) and len(found) == n and all(type(s) is float and np.isfinite(s) for s in found)
