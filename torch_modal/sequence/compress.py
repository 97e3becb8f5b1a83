"""From frames to a small file whose error is promised, and checked."""

import contextlib
import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from threadpoolctl import threadpool_limits
from torch import Tensor

from torch_modal.geometry.connectivity import Connectivity
from torch_modal.io.files import write_atomically
from torch_modal.keyframes.check import check_keyframes
from torch_modal.progress import Progress
from torch_modal.sequence import codec_packing as packing
from torch_modal.sequence.codec import ERROR, ModalSequence, encode, fitted, with_worst
from torch_modal.sequence.codec_file import probe, read_bytes, to_bytes
from torch_modal.sequence.codec_modes import fixed_modes
from torch_modal.sequence.times import checked_times

OF_SELECTION = 0.7
"""Of the error, what is left for shapes between key-frames when these are chosen, before anything is rounded."""
OF_KEYFRAMES = 0.85
"""What rounding adds to key-frames."""
MOST_OF_EDGE = 0.5
"""Of the median edge, the step of the grid: beyond, triangles would be noise, and their modes with them."""
OF_AMPLITUDES = 0.15
OF_MOTIONS = 0.05
PER_STEP = 0.48
"""Mean length of what rounding adds to a point, in steps of the grid."""
MAX_ROUNDS = 12


@dataclass(frozen=True)
class Compressed:
    """What was written.

    Attributes:
        n_bytes: Size of the file.
        n_faces_bytes: What of it is the connectivity.
        keyframes: Which frames are key-frames.
        errors: Mean distance of the vertices of each frame over the diagonal of the first, from reading the file again.
            *Shape:* ``(T,)``.
    """

    n_bytes: int
    n_faces_bytes: int
    keyframes: list[int]
    errors: Tensor


def compress(
    frames: Any,
    faces: Any,
    path: str | os.PathLike[str],
    error: float = ERROR,
    n_modes: int = 60,
    *,
    keyframes: Sequence[int] | int | None = None,
    times: Tensor | Sequence[float] | None = None,
    cyclic: bool = False,
    cache_dir: str | None = None,
    cache: bool = True,
    progress: Progress = None,
) -> Compressed:
    """Write a motion as a ``.tms`` file, to be read by :meth:`torch_modal.ModalSequence.load`.

    The same frames give the same bytes, whatever the number of threads. The order of vertices and faces is kept.

    Args:
        frames: A motion of one connectivity. *Shape:* ``(T, V, 3)``.
        faces: Vertex indices. *Shape:* ``(F, 3)``.
        path: The file; its folder must exist.
        error: Mean distance of the vertices over the diagonal of the first frame that no frame is above.
        n_modes: Amplitudes of a frame.
        keyframes: Where to begin with, as for :func:`torch_modal.encode`; more are added if the error asks for them.
        times: As for :func:`torch_modal.encode`.
        cyclic: Likewise.
        cache_dir: Likewise.
        cache: Likewise.
        progress: Likewise.

    Raises:
        MeshError: Frames that cannot be used.
        ValueError: Numbers that cannot be used, or an error that could not be kept.
        OSError: The file cannot be written.
    """
    data, report = compressed(
        frames,
        faces,
        error,
        n_modes,
        keyframes=keyframes,
        times=times,
        cyclic=cyclic,
        cache_dir=cache_dir,
        cache=cache,
        progress=progress,
    )
    write_atomically(Path(path), data)
    return report


def compressed(
    frames: Any,
    faces: Any,
    error: float,
    n_modes: int,
    *,
    keyframes: Sequence[int] | int | None,
    times: Tensor | Sequence[float] | None,
    cyclic: bool,
    cache_dir: str | None,
    cache: bool,
    progress: Progress,
) -> tuple[bytes, Compressed]:
    """The bytes of the file. Arguments as for :func:`compress`."""
    shapes, working_faces = check_keyframes(frames, faces, min_keyframes=2, warn=False)
    x, triangles = shapes.detach().cpu().double(), working_faces.cpu()
    when = checked_times(times, len(x), cyclic)
    kept = {"cache_dir": cache_dir, "cache": cache}
    with one_thread():
        first = encode(
            x,
            triangles,
            keyframes,
            n_modes,
            error=OF_SELECTION * error,
            times=when,
            cyclic=cyclic,
            progress=progress,
            **kept,  # type: ignore[arg-type]
        )
        keys = torch.nonzero(first.is_keyframe).flatten().tolist()
        part = 1.0
        for _ in range(MAX_ROUNDS):
            data, found, of_faces = _attempt(x, triangles, when, keys, cyclic, error, part, n_modes, kept, progress)
            if float(found.max()) <= error:
                return data, Compressed(len(data), of_faces, keys, found)
            more = with_worst(keys, found, error)
            # What key-frames exceed, only a finer grid can mend.
            if more == keys or float(found[keys].max()) > error:
                part *= 0.7
            keys = more
    raise ValueError(
        f"the error of {error:g} could not be kept: the best found is {float(found.max()):.2g}; give a larger one"
    )


def _attempt(
    x: Tensor,
    faces: Tensor,
    when: Tensor,
    keys: list[int],
    cyclic: bool,
    error: float,
    part: float,
    n_modes: int,
    kept: dict[str, Any],
    progress: Progress,
) -> tuple[bytes, Tensor, int]:
    """The file of given key-frames, the errors of its frames, and the bytes of its connectivity."""
    used = x[0, faces.unique()]
    size = float((used.amax(0) - used.amin(0)).norm())
    low = x[keys].amin((0, 1)).tolist()
    edges = torch.from_numpy(Connectivity(faces.numpy(), x.shape[1]).edges.copy())
    short = float(x[0, edges].diff(dim=1).norm(dim=-1).median())
    step = part * min(OF_KEYFRAMES * error * size / PER_STEP, MOST_OF_EDGE * short)
    grid = np.floor((x[keys].numpy() - np.asarray(low)) / step + 0.5).astype(np.int64)
    rounded = packing.positions(grid, low, step)
    modes = fixed_modes(rounded[0], faces, n_modes, **kept)
    found = fitted(x, faces, when, rounded, keys, cyclic, modes, progress)
    k = found.n_modes
    of_amplitudes = part * OF_AMPLITUDES * error * (12 / k) ** 0.5 / 0.01
    of_turns, of_moves = 8 * part * OF_MOTIONS * error, 2 * part * OF_MOTIONS * error
    a = np.rint(found.amplitudes.numpy() / of_amplitudes).astype(np.int64)
    m = np.rint(found.motions.numpy() / ([of_turns] * 3 + [of_moves] * 3)).astype(np.int64)
    triangles = faces.numpy().astype(np.int64)
    shapes, ways = packing.pack_shapes(grid, triangles)
    (packed_a, order_a), (packed_m, order_m) = packing.pack_series(a), packing.pack_series(m)
    clusters, pivots = modes.clusters.numpy(), modes.pivots.numpy()
    tensors = {
        "faces": packing.pack_faces(triangles),
        "keyframes": shapes,
        "amplitudes": packed_a,
        "motions": packed_m,
        "clusters": packing.squeeze(clusters),
        "pivots": packing.squeeze(pivots),
        "probe": probe(modes).float(),
    }
    if not torch.equal(when, torch.arange(len(when), dtype=torch.float64)):
        tensors["times"] = when
    header = {
        "coding": packing.PACKED,
        "reference": 0,
        "keyframes": len(keys),
        "vertices": x.shape[1],
        "faces": len(triangles),
        "frames": len(x),
        "modes": k,
        "clusters": len(clusters),
        "keys": keys,
        "cyclic": cyclic,
        "low": low,
        "steps": [step, of_amplitudes, of_turns, of_moves],
        "ways": ways,
        "orders": [order_a, order_m],
        "digest": packing.digest(triangles, grid, a, m, clusters, pivots),
    }
    data = to_bytes(tensors, header)
    read = ModalSequence(**read_bytes(data, "the file", **kept))
    errors = (read.decode() - x).norm(dim=-1).mean(1) / size
    return data, errors, len(tensors["faces"])


@contextlib.contextmanager
def one_thread() -> Iterator[None]:
    """Sums do not depend on the number of threads inside."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        with threadpool_limits(1):
            yield
    finally:
        torch.set_num_threads(before)
