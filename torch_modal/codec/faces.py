"""Faces as bytes: differences from face to face, packed by LZMA."""

import lzma

import numpy as np

from torch_modal.arrays import IntArray
from torch_modal.codec.header import MAX_COUNT

FREE_BYTES = 2**24
"""Any data may unpack to this many bytes."""
MAX_RATIO = 1000
"""Beyond that, to this many bytes for each packed byte."""
FILTERS = [{"id": lzma.FILTER_LZMA1, "preset": 9, "lc": 0, "lp": 0, "pb": 0, "dict_size": 2**20}]


def pack_faces(faces: IntArray) -> bytes:
    """Vertex indices, in their order. *Shape:* ``(F, 3)``."""
    return pack_integers(np.diff(faces, axis=0, prepend=0).T)


def unpack_faces(data: bytes, n_faces: int) -> IntArray:
    """The inverse of :func:`pack_faces`.

    Raises:
        ValueError: The bytes are damaged.
    """
    return np.cumsum(unpack_integers(data, 3 * n_faces).reshape(3, n_faces), axis=1).T


def pack_integers(numbers: IntArray) -> bytes:
    """Integers, the smaller the better, as bytes: a plane for each byte of a number."""
    flat = numbers.reshape(-1)
    folded = np.where(flat > 0, 2 * flat - 1, -2 * flat).astype("<u8")
    width = max(1, (int(folded.max(initial=0)).bit_length() + 7) // 8)
    planes = folded.view(np.uint8).reshape(-1, 8)[:, :width].T
    return bytes([width]) + lzma.compress(planes.tobytes(), lzma.FORMAT_RAW, filters=FILTERS)


def unpack_integers(data: bytes, count: int) -> IntArray:
    """The inverse of :func:`pack_integers`.

    Args:
        data: From a file.
        count: How many numbers there must be.

    Raises:
        ValueError: There are more or fewer, or the bytes are damaged.
    """
    width = data[0] if data else 0
    if not 1 <= width <= 8 or not 0 <= count <= MAX_COUNT:
        raise ValueError("one of its parts is damaged")
    size = width * count
    check_unpacked_size(size, len(data))
    unpacker = lzma.LZMADecompressor(lzma.FORMAT_RAW, filters=FILTERS)
    try:
        planes = unpacker.decompress(data[1:], max_length=size)
        more = b"" if unpacker.eof else unpacker.decompress(b"", max_length=1)
    except (lzma.LZMAError, EOFError):
        raise ValueError("one of its parts is damaged") from None
    if len(planes) != size or more:
        raise ValueError("one of its parts is damaged or cut off")
    rows = np.zeros((count, 8), dtype=np.uint8)
    rows[:, :width] = np.frombuffer(planes, np.uint8).reshape(width, count).T
    folded = rows.view("<u8").reshape(-1)
    half = ((folded + np.uint64(1)) >> np.uint64(1)).astype(np.int64)
    return np.where(folded & np.uint64(1), half, -half)


def check_unpacked_size(n_bytes: int, packed: int) -> None:
    """Refuse data that claim to hold more than they can.

    Raises:
        ValueError: They do.
    """
    if n_bytes > FREE_BYTES + MAX_RATIO * packed:
        raise ValueError(f"it claims to hold {n_bytes} bytes in {packed}")
