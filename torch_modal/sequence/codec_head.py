"""What stands before the numbers of a small file: how many there are, and what they mean, in few bytes."""

import struct
from itertools import pairwise
from typing import NamedTuple

N_SHIFTS = 64
"""Ways to lay the grid of finished key-frames."""
MOST_NUMBERS = 2**31
MOST_PROBES = 64
N_COUNTS = 11
FLOATS = struct.Struct("<8f8s")


class Head(NamedTuple):
    """Counts, units and a digest."""

    n_vertices: int
    n_faces: int
    n_frames: int
    n_modes: int
    n_clusters: int
    n_probes: int
    n_face_bytes: int
    cyclic: int
    reference: int
    """Which key-frame the modes belong to."""
    seed: int
    """Of the modes' directions."""
    keys: list[int]
    """Frames that are key-frames."""
    guides: list[int]
    """Which key-frame helps each; -1: none."""
    shifts: list[int]
    """How the grid of each lies."""
    floats: list[float]
    """Of single precision: the origin, the step of key-frames, of amplitudes, of turns and of moves, the scale."""
    digest: bytes
    """Eight bytes."""

    def data(self) -> bytes:
        """The bytes; the digest covers them too, as they are with zeros in its place."""
        keys = [b - a for a, b in pairwise([0, *self.keys])]
        whole = [len(keys), *self[:10], *keys, *(guide + 1 for guide in self.guides), *self.shifts]
        return b"".join(_written(number) for number in whole) + FLOATS.pack(*self.floats, self.digest)


def read_head(data: bytes) -> tuple[Head, int]:
    """A head, whose numbers fit each other, and how many bytes it takes.

    Raises:
        ValueError: They do not, or the bytes are damaged.
    """
    place = 0

    def numbers(count: int) -> list[int]:
        nonlocal place
        found = []
        for _ in range(count):
            number, place = _read(data, place)
            found.append(number)
        return found

    n_keys, *counts = numbers(N_COUNTS)
    if not 2 <= n_keys <= len(data) or any(c > MOST_NUMBERS for c in counts) or min(counts[:6]) < 1:
        raise ValueError("its header is damaged")
    keys, guides, shifts = numbers(n_keys), [guide - 1 for guide in numbers(n_keys)], numbers(n_keys)
    for i in range(1, n_keys):
        keys[i] += keys[i - 1]
    if len(data) < place + FLOATS.size:
        raise ValueError("its header is cut off")
    *floats, digest = FLOATS.unpack_from(data, place)
    head = Head._make([*counts, keys, guides, shifts, floats, digest])
    _check(head)
    return head, place + FLOATS.size


def _check(head: Head) -> None:
    keys, last = head.keys, head.n_frames - 1
    if head.n_clusters > head.n_modes or head.n_probes > MOST_PROBES or head.cyclic > 1:
        raise ValueError("its header is damaged")
    if not all(abs(x) < 1e30 for x in head.floats) or min(head.floats[3:]) <= 0:
        raise ValueError("its header is damaged")
    if keys[0] != 0 or any(a >= b for a, b in pairwise(keys)) or keys[-1] > last:
        raise ValueError("its header names key-frames that it does not have")
    if not head.cyclic and keys[-1] != last:
        raise ValueError("its header names key-frames that it does not have")
    if head.guides[0] != -1 or any(not 0 <= guide < i for i, guide in enumerate(head.guides) if i):
        raise ValueError("its key-frames are predicted in no known way")
    if max(head.shifts) >= N_SHIFTS:
        raise ValueError("its header is damaged")


def _written(number: int) -> bytes:
    """Seven bits a byte, the lowest first (LEB128)."""
    found = bytearray()
    while number >= 128:
        found.append(128 | number & 127)
        number >>= 7
    return bytes([*found, number])


def _read(data: bytes, place: int) -> tuple[int, int]:
    number = 0
    for shift in range(0, 70, 7):
        if place >= len(data):
            break
        byte, place = data[place], place + 1
        number |= (byte & 127) << shift
        if byte < 128:
            return number, place
    raise ValueError("its header is damaged or cut off")
