"""The header of a compact motion: counts, units and a digest.

It is binary because it takes 80 bytes in files of 1 to 10 kB; as JSON it would take about 400.
"""

import struct
from itertools import pairwise
from typing import NamedTuple

N_SHIFTS = 64
"""Offsets of the grid of decoded key-frames."""
MAX_COUNT = 2**31
MAX_PROBES = 64
N_COUNTS = 11
FLOATS = struct.Struct("<8f8s")


class CompactHeader(NamedTuple):
    """Counts, units and a digest, in the order of the file."""

    n_vertices: int
    n_faces: int
    n_frames: int
    n_modes: int
    n_clusters: int
    n_probes: int
    n_face_bytes: int
    cyclic: int
    reference: int
    """The key-frame that the modes belong to."""
    seed: int
    """Of the directions that fix the modes' signs."""
    keys: list[int]
    """Frame numbers of the key-frames."""
    guides: list[int]
    """The key-frame that each is predicted from; -1 for none."""
    shifts: list[int]
    """Grid offset of each key-frame."""
    floats: list[float]
    """Single precision: the origin, the steps of key-frames, amplitudes, rotations and translations, the scale."""
    digest: bytes
    """Eight bytes."""

    def data(self) -> bytes:
        """The bytes."""
        key_steps = [b - a for a, b in pairwise([0, *self.keys])]
        integers = [len(key_steps), *self[:10], *key_steps, *(guide + 1 for guide in self.guides), *self.shifts]
        return b"".join(map(_encoded, integers)) + FLOATS.pack(*self.floats, self.digest)


def read_header(data: bytes) -> tuple[CompactHeader, int]:
    """Read and check a header; also returns how many bytes it takes.

    Raises:
        ValueError: Its numbers do not fit each other, or the bytes are damaged.
    """
    place = 0

    def integers(count: int) -> list[int]:
        nonlocal place
        found = []
        for _ in range(count):
            number, place = _decoded(data, place)
            found.append(number)
        return found

    n_keys, *counts = integers(N_COUNTS)
    if not 2 <= n_keys <= len(data) or any(c > MAX_COUNT for c in counts) or min(counts[:6]) < 1:
        raise ValueError("its header is damaged")
    keys, guides, shifts = integers(n_keys), [guide - 1 for guide in integers(n_keys)], integers(n_keys)
    for i in range(1, n_keys):
        keys[i] += keys[i - 1]
    if len(data) < place + FLOATS.size:
        raise ValueError("its header is cut off")
    *floats, digest = FLOATS.unpack_from(data, place)
    header = CompactHeader._make([*counts, keys, guides, shifts, floats, digest])
    _check(header)
    return header, place + FLOATS.size


def _check(header: CompactHeader) -> None:
    keys, last = header.keys, header.n_frames - 1
    ascending = keys[0] == 0 and all(a < b for a, b in pairwise(keys))
    if not ascending or not (keys[-1] <= last if header.cyclic else keys[-1] == last):
        raise ValueError("its header names key-frames that it does not have")
    if header.guides[0] != -1 or any(not 0 <= guide < i for i, guide in enumerate(header.guides) if i):
        raise ValueError("its key-frames are predicted in no known way")
    counts_fit = header.n_clusters <= header.n_modes and header.n_probes <= MAX_PROBES and header.cyclic <= 1
    floats_fit = all(abs(x) < 1e30 for x in header.floats) and min(header.floats[3:]) > 0
    if not counts_fit or not floats_fit or max(header.shifts) >= N_SHIFTS:
        raise ValueError("its header is damaged")


def _encoded(number: int) -> bytes:
    """Seven bits a byte, the lowest first (LEB128)."""
    found = bytearray()
    while number >= 128:
        found.append(128 | number & 127)
        number >>= 7
    return bytes([*found, number])


def _decoded(data: bytes, place: int) -> tuple[int, int]:
    number = 0
    for i, byte in enumerate(data[place : place + 10]):
        number |= (byte & 127) << 7 * i
        if byte < 128:
            return number, place + i + 1
    raise ValueError("its header is damaged or cut off")
