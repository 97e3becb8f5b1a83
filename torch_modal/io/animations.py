"""A sequence as positions over time, for a mesh that exists already: MDD, PC2 and NPZ."""

import struct
from pathlib import Path

import numpy as np

from torch_modal.io.formats import Animation, resample


def write_point_cache(animation: Animation, path: Path) -> None:
    """Write float32 positions at the timing's rate, as LightWave's cache (MDD) or 3ds Max's (PC2, version 1).

    MDD is big-endian and has times in seconds; PC2 is little-endian, one sample a frame from frame 0 on.
    """
    sampled = resample(animation.shapes, animation.timing.samples())
    n, n_vertices = sampled.shape[:2]
    if path.suffix.lower() == ".mdd":
        order = ">"
        head = struct.pack(">2i", n, n_vertices) + (np.arange(n) / animation.timing.fps).astype(">f4").tobytes()
    else:
        order = "<"
        head = struct.pack("<12siiffi", b"POINTCACHE2\0", 1, n_vertices, 0.0, 1.0, n)
    path.write_bytes(head + sampled.astype(f"{order}f4").tobytes())


def write_npz(animation: Animation, path: Path) -> None:
    """Write arrays ``frames`` (N, V, 3), ``faces`` (F, 3), ``times`` (N,) in seconds, and ``keyframes``."""
    shapes, keyframes = animation.shapes, np.asarray(animation.keyframes, np.int64)
    times = animation.timing.knots()[0][: len(shapes)]
    np.savez_compressed(path, frames=shapes, faces=animation.faces, times=times, keyframes=keyframes)
