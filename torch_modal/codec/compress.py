"""From frames to a small file with a guaranteed error."""

import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from threadpoolctl import threadpool_limits
from torch import Tensor

from torch_modal.arrays import IntArray
from torch_modal.autograd import one_thread
from torch_modal.codec.amplitudes import column_steps, from_sines, runs, to_sines
from torch_modal.codec.compact import pack, to_callers_units
from torch_modal.codec.file import compact_bytes, read
from torch_modal.codec.hierarchy import VertexHierarchy
from torch_modal.codec.modes import reproducible_modes
from torch_modal.codec.positions import QuantizedKeyframes
from torch_modal.codec.selection import FrameSequence, choose_keyframes, with_worst
from torch_modal.codec.sequence import ERROR, ModalSequence, fitted
from torch_modal.extras import require_installed
from torch_modal.io.files import write_atomically
from torch_modal.progress import Progress

SELECTION_SHARE = 0.7
"""Share of the error that frames between key-frames may have when these are selected, before anything is rounded."""
KEYFRAME_SHARE = 0.9
"""Share of the error that rounding the key-frames takes at first."""
SMALLER_SHARE, MIN_KEYFRAME_SHARE = 0.85, 0.5
"""If frames between key-frames just miss the error, key-frames take less, down to a limit; then there are more."""
FAR = 1.5
"""Frames that exceed the error this many times get more key-frames at once."""
N_SAMPLES = 3
"""Frames of an interval that are fitted to estimate its error."""
FIT_SHARE = 0.97
"""Share of the error that is allowed before amplitudes are rounded."""
MOTION_STEP = 1e-3
"""Steps of rotations in radians, and of translations in units of the diagonal, over the step of amplitudes."""
MAX_ROUNDS = 12
HALVINGS = 5


@dataclass(frozen=True)
class Compressed:
    """Summary of a written file.

    Attributes:
        n_bytes: Size of the file.
        n_faces_bytes: Bytes of it that are the connectivity.
        keyframes: Frame numbers of the key-frames.
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
        error: Largest mean distance of a frame's vertices, over the diagonal of the first frame.
        n_modes: Amplitudes of a frame.
        keyframes: Where to begin with, as for :func:`torch_modal.encode`; more are added if the error needs them.
        times: As for :func:`torch_modal.encode`.
        cyclic: As for :func:`torch_modal.encode`, like the following.
        cache_dir: Where modes are cached.
        cache: Whether they are.
        progress: See :data:`torch_modal.progress.Progress`.

    Raises:
        MeshError: Frames that cannot be used.
        ValueError: Numbers that cannot be used, or an error that could not be reached.
        MissingPackageError: Without the extra ``compress``.
        OSError: The file cannot be written.
    """
    require_installed(("constriction",), "compress", "a small file of a motion")
    motion = FrameSequence.checked(frames, faces, times, cyclic)
    caching = {"cache_dir": cache_dir, "cache": cache}
    with one_thread(), threadpool_limits(1):
        keys = choose_keyframes(motion, keyframes, n_modes, SELECTION_SHARE * error, caching, progress)
        data, report = _Compression(motion, error, n_modes, caching, progress).run(keys)
    write_atomically(Path(path), data)
    return report


class _Attempt(NamedTuple):
    """Rounded key-frames, and amplitudes fitted to them that are not rounded."""

    keys: list[int]
    rounded: QuantizedKeyframes
    motion: ModalSequence


class _Compression:
    """The search for the fewest bytes within an error."""

    def __init__(
        self, motion: FrameSequence, error: float, n_modes: int, caching: dict[str, Any], progress: Progress
    ) -> None:
        self.motion, self.x = motion, motion.frames
        self.error, self.n_modes, self.caching, self.progress = error, n_modes, caching, progress
        used = self.x[0, motion.faces.unique()]
        self.size = float((used.amax(0) - used.amin(0)).norm())
        self.scale = _single(self.size)
        self.origin = [_single(value) for value in used.mean(0).tolist()]
        self.triangles = motion.faces.numpy().astype(np.int64)
        self.hierarchy = VertexHierarchy(self.triangles, self.x.shape[1])

    def run(self, keys: list[int]) -> tuple[bytes, Compressed]:
        """The file, from key-frames to begin with."""
        share, limit = KEYFRAME_SHARE, FIT_SHARE * self.error
        for _ in range(MAX_ROUNDS):
            attempt = self.attempt(keys, share, self.samples(keys))
            if float(attempt.motion.errors.max()) <= limit:
                attempt = self.attempt(keys, share)
                if float(attempt.motion.errors.max()) <= limit:
                    return self.packed(attempt)
            worst = float(attempt.motion.errors.max())
            more = with_worst(keys, attempt.motion.errors, limit)
            if worst > FAR * self.error or share * SMALLER_SHARE < MIN_KEYFRAME_SHARE:
                # If key-frames themselves exceed the error, only finer steps help.
                share, keys = (KEYFRAME_SHARE, more) if more != keys else (share * SMALLER_SHARE, keys)
            else:
                share *= SMALLER_SHARE
        raise self.unreachable(worst)

    def unreachable(self, best: float) -> ValueError:
        return ValueError(
            f"the error of {self.error:g} could not be kept: the best found is {best:.2g}; give a larger one"
        )

    def rounded(self, keys: list[int], error: float) -> QuantizedKeyframes:
        """Key-frames in about the largest steps with which none exceeds an error."""
        y = (self.x[keys].numpy() - np.asarray(self.origin)) / self.scale
        best, low, high = None, error, 40 * error
        for _ in range(HALVINGS):
            step = _single((low * high) ** 0.5)
            tried = QuantizedKeyframes(self.hierarchy, y, step)
            if float(self.distances(self.shapes(tried), self.x[keys]).max()) <= error:
                best, low = tried, step
            else:
                high = step
        return best or QuantizedKeyframes(self.hierarchy, y, _single(error))

    def shapes(self, rounded: QuantizedKeyframes) -> Tensor:
        return to_callers_units(rounded.decoded, self.origin, self.scale)

    def distances(self, x: Tensor, y: Tensor) -> Tensor:
        """Mean of each frame, over the diagonal. *Shape:* ``(N, V, 3) -> (N,)``."""
        return (x - y).norm(dim=-1).mean(1) / self.size

    def errors(self, decoded: ModalSequence) -> Tensor:
        """Distances of all frames, a few decoded at a time. *Shape:* ``(T,)``."""
        rows = torch.arange(len(self.x)).split(64)
        return torch.cat([self.distances(decoded.decode(decoded.times[part]), self.x[part]) for part in rows])

    def samples(self, keys: list[int]) -> list[int]:
        """Key-frames, and a few frames between any two of them."""
        found = set(keys)
        for run in runs(keys, len(self.x), self.motion.cyclic):
            found |= set(np.linspace(run.start, run.stop - 1, N_SAMPLES + 2).round().astype(int).tolist()[1:-1])
        return sorted(found)

    def attempt(self, keys: list[int], share: float, only: list[int] | None = None) -> _Attempt:
        """Round key-frames and fit frames; errors of other frames than ``only`` are zero."""
        rounded = self.rounded(keys, share * self.error)
        shapes = self.shapes(rounded)
        modes = reproducible_modes(shapes[0], self.motion.faces, self.n_modes, **self.caching)
        return _Attempt(keys, rounded, fitted(self.motion, keys, shapes, modes, self.progress, only))

    def packed(self, attempt: _Attempt) -> tuple[bytes, Compressed]:
        """The file with the largest steps of amplitudes within the error, which is read again as a check."""
        keys, rounded, exact = attempt
        between = runs(keys, len(self.x), self.motion.cyclic)
        series = torch.cat([exact.amplitudes, exact.motions], 1).numpy()

        def tried(step: float) -> tuple[IntArray, list[float], float]:
            steps = [step, *[_single(step * MOTION_STEP)] * 2]
            columns = column_steps(exact.n_modes, *steps)
            numbers = to_sines(series, columns, between)
            found = torch.from_numpy(from_sines(numbers, columns, between))
            new = replace(exact, amplitudes=found[:, : exact.n_modes], motions=found[:, exact.n_modes :])
            new.__dict__["decoder"] = exact.decoder
            return numbers, steps, float(self.errors(new).max())

        low, high = 1e-3 * self.error / 0.01, 10 * self.error / 0.01
        sines, steps, _ = tried(_single(low))
        for _ in range(HALVINGS + 2):
            step = _single((low * high) ** 0.5)
            new = tried(step)
            if new[2] <= self.error:
                (sines, steps, _), low = new, step
            else:
                high = step
        packed, n_faces_bytes = pack(
            self.triangles, keys, self.motion.cyclic, rounded, sines, steps, exact.modes, self.origin, self.scale
        )
        data = compact_bytes(packed, self.motion.times)
        errors = self.errors(ModalSequence(**read(data, "the file", **self.caching)))
        if float(errors.max()) > self.error:
            raise self.unreachable(float(errors.max()))
        return data, Compressed(len(data), n_faces_bytes, keys, errors)


def _single(x: float) -> float:
    """A number in single precision, as in the file."""
    return float(np.float32(x))
