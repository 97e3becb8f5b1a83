"""Positions over time, for a mesh that is already there: MDD, PC2 and NPZ."""

import struct
from pathlib import Path

import numpy as np

from torch_modal.io.formats import Animation, animation_format
from torch_modal.io.timing import resample


@animation_format(".mdd")
def write_mdd(animation: Animation, path: Path) -> None:
    """LightWave's: big-endian counts, times in seconds, float32 positions, sampled at the rate of the timing."""
    shapes, timing = animation.shapes, animation.timing
    sampled = resample(shapes, timing.samples())
    times = np.arange(len(sampled)) / timing.fps
    head = struct.pack(">2i", len(sampled), shapes.shape[1])
    path.write_bytes(head + times.astype(">f4").tobytes() + sampled.astype(">f4").tobytes())


@animation_format(".pc2")
def write_pc2(animation: Animation, path: Path) -> None:
    """3ds Max's, version 1: one sample a frame from frame 0 on, float32 positions."""
    shapes = animation.shapes
    sampled = resample(shapes, animation.timing.samples())
    head = struct.pack("<12siiffi", b"POINTCACHE2\0", 1, shapes.shape[1], 0.0, 1.0, len(sampled))
    path.write_bytes(head + sampled.astype("<f4").tobytes())


@animation_format(".npz")
def write_npz(animation: Animation, path: Path) -> None:
    """Arrays ``frames`` (N, V, 3), ``faces`` (F, 3), ``times`` (N,) in seconds and ``keyframes``, all as they are."""
    shapes, keyframes = animation.shapes, np.asarray(animation.keyframes, np.int64)
    times = animation.timing.knots()[0][: len(shapes)]
    np.savez_compressed(path, frames=shapes, faces=animation.faces, times=times, keyframes=keyframes)
