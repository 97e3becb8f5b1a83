"""The compact coding of a motion: header, faces, then key-frames, amplitudes and modes by the range coder.

All counts that are read are bounded by what the file can hold before anything is allocated.
"""

import hashlib
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torch_modal.arrays import FloatArray, IntArray
from torch_modal.codec import amplitudes
from torch_modal.codec.faces import check_unpacked_size, pack_faces, unpack_faces
from torch_modal.codec.header import CompactHeader, read_header
from torch_modal.codec.hierarchy import VertexHierarchy
from torch_modal.codec.modes import ReproducibleModes
from torch_modal.codec.positions import QuantizedKeyframes, read_keyframes
from torch_modal.codec.range_coder import IntegerDecoder, IntegerEncoder

PROBE_UNIT = 8192
"""Integers in one, for the probe of the modes."""


def pack(
    faces: IntArray,
    keys: list[int],
    cyclic: bool,
    keyframes: QuantizedKeyframes,
    sines: IntArray,
    steps: Sequence[float],
    modes: ReproducibleModes,
    origin: Sequence[float],
    scale: float,
) -> tuple[bytes, int]:
    """The bytes, and how many of them are the faces.

    Args:
        faces: *Shape:* ``(F, 3)``.
        keys: Frame numbers of the key-frames.
        cyclic: Whether the last frame leads on to the first.
        keyframes: Relative to the origin, in units of the scale.
        sines: Of amplitudes and rigid motions. *Shape:* ``(T, k + 6)``.
        steps: Of amplitudes, rotations and translations, in single precision.
        modes: Of the first key-frame.
        origin: In the caller's units, in single precision.
        scale: The diagonal, in single precision.
    """
    clusters = modes.clusters.numpy()
    probe = np.rint(PROBE_UNIT * modes.probe().numpy()).astype(np.int64)
    encoder = IntegerEncoder()
    keyframes.write(encoder)
    amplitudes.write_sines(encoder, sines, amplitudes.runs(keys, len(sines), cyclic))
    encoder.write(np.concatenate([clusters, probe]), np.repeat([0, 1], [len(clusters), len(probe)]), 2)
    packed_faces = pack_faces(faces)
    header = CompactHeader(
        n_vertices=keyframes.decoded.shape[1],
        n_faces=len(faces),
        n_frames=len(sines),
        n_modes=sines.shape[1] - 6,
        n_clusters=len(clusters),
        n_probes=len(probe),
        n_face_bytes=len(packed_faces),
        cyclic=int(cyclic),
        reference=0,
        seed=modes.seed,
        keys=keys,
        guides=keyframes.guides,
        shifts=keyframes.shifts,
        floats=[*origin, keyframes.step, *steps, scale],
        digest=b"",
    )
    contents = (faces, _bits(keyframes.decoded), keyframes.flat, sines, clusters, probe)
    header = header._replace(digest=_digest(header, *contents))
    return header.data() + packed_faces + encoder.data(), len(packed_faces)


def unpack(data: bytes, times: Tensor | None) -> dict[str, Any]:
    """All parts of a sequence but its modes, and what these are computed from.

    Args:
        data: What :func:`pack` made.
        times: Of the frames, if the file has any; of a cycle, also when the first comes again.

    Raises:
        ValueError: The data are damaged, or claim to hold more than they can.
    """
    header, start = read_header(data)
    v, t, k, keys, cyclic = header.n_vertices, header.n_frames, header.n_modes, header.keys, bool(header.cyclic)
    end = start + header.n_face_bytes
    faces = unpack_faces(data[start:end], header.n_faces)
    if faces.min() < 0 or faces.max() >= v or 3 * header.n_faces < v // 1000:
        raise ValueError("it names vertices that it does not have")
    check_unpacked_size(3 * len(keys) * v + t * (k + 6), len(data))  # a number takes a byte, or less
    decoder, between = IntegerDecoder(data[end:]), amplitudes.runs(keys, t, cyclic)
    hierarchy = VertexHierarchy(faces, v)
    x, numbers = read_keyframes(decoder, hierarchy, header.floats[3], header.guides, header.shifts)
    sines = amplitudes.read_sines(decoder, (t, k + 6), between)
    kinds = np.repeat([0, 1], [header.n_clusters, header.n_probes])
    clusters, probe = np.split(decoder.read(kinds, 2), [header.n_clusters])
    if _digest(header, faces, _bits(x), numbers, sines, clusters, probe) != header.digest:
        raise ValueError("its contents are not what was written: it is damaged")
    if times is None:
        times = torch.arange(t + cyclic, dtype=torch.float64)
    if times.shape != (t + cyclic,) or times.dtype != torch.float64:
        raise ValueError("its times are damaged")
    series = amplitudes.from_sines(sines, amplitudes.column_steps(k, *header.floats[4:7]), between)
    return {
        "keyframes": to_callers_units(x, header.floats[:3], header.floats[7]),
        "faces": torch.from_numpy(np.ascontiguousarray(faces)),
        "keyframe_times": times[[*keys, t]] if cyclic else times[keys],
        "times": times[:t],
        "amplitudes": torch.from_numpy(series[:, :k]),
        "motions": torch.from_numpy(series[:, k:]),
        "errors": torch.full((t,), torch.nan, dtype=torch.float64),
        "clusters": torch.from_numpy(clusters),
        "probe": torch.from_numpy(probe / PROBE_UNIT),
        "reference": header.reference,
        "seed": header.seed,
    }


def to_callers_units(x: FloatArray, origin: Sequence[float], scale: float) -> Tensor:
    """Positions by one multiplication and one sum, which are the same on all machines."""
    return torch.from_numpy(np.asarray(origin, dtype=np.float64) + np.float64(scale) * x)


def _digest(header: CompactHeader, *arrays: IntArray) -> bytes:
    """Eight bytes of all contents, which differ after damage and on a machine that decodes otherwise."""
    found = hashlib.sha256(header._replace(digest=b"").data())
    for array in arrays:
        found.update(np.ascontiguousarray(array, dtype="<i8").tobytes())
    return found.digest()[:8]


def _bits(x: FloatArray) -> IntArray:
    """Floating-point numbers as the integers that their bits are."""
    return np.ascontiguousarray(x, dtype="<f8").view("<i8")
