"""Point caches: positions over time, for a mesh that is already there."""

import io
import struct
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from torch_modal.io.timing import Timing, resample
from torch_modal.io.write import write_file

FloatArray = NDArray[np.float64]


def save_mdd(shapes: FloatArray, path: Path, timing: Timing) -> Path:
    """Write an MDD file (LightWave's): big-endian counts, times in seconds, float32 positions.

    Args:
        shapes: *Shape:* ``(N, V, 3)``.
        path: The file, which is replaced.
        timing: Samples are taken at its rate.
    """
    sampled = resample(shapes, timing.samples(len(shapes)))
    times = np.arange(len(sampled)) / timing.fps
    head = struct.pack(">2i", len(sampled), shapes.shape[1])
    write_file(path, head + times.astype(">f4").tobytes() + sampled.astype(">f4").tobytes())
    return path


def save_pc2(shapes: FloatArray, path: Path, timing: Timing) -> Path:
    """Write a PC2 file (3ds Max's point cache, version 1): one sample a frame from frame 0 on, float32 positions.

    Args:
        shapes: *Shape:* ``(N, V, 3)``.
        path: The file, which is replaced.
        timing: Samples are taken at its rate.
    """
    sampled = resample(shapes, timing.samples(len(shapes)))
    head = struct.pack("<12siiffi", b"POINTCACHE2\0", 1, shapes.shape[1], 0.0, 1.0, len(sampled))
    write_file(path, head + sampled.astype("<f4").tobytes())
    return path


def save_npz(
    shapes: FloatArray, faces: NDArray[np.int64], path: Path, timing: Timing, keyframes: Sequence[int]
) -> Path:
    """Write ``frames`` (N, V, 3), ``faces`` (F, 3), ``times`` (N,) in seconds and ``keyframes``, all as they are.

    Args:
        shapes: *Shape:* ``(N, V, 3)``.
        faces: *Shape:* ``(F, 3)``.
        path: The file, which is replaced.
        timing: Gives the times of one pass.
        keyframes: Numbers of frames.
    """
    times = timing.knots(np.arange(len(shapes)), len(shapes))[0][: len(shapes)]
    stream = io.BytesIO()
    np.savez_compressed(stream, frames=shapes, faces=faces, times=times, keyframes=np.asarray(keyframes, np.int64))
    write_file(path, stream.getvalue())
    return path
