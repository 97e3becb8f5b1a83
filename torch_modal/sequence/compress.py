"""From frames to a small file whose error is promised, and checked."""

import contextlib
import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits
from torch import Tensor

from torch_modal.extras import require_installed
from torch_modal.io.files import write_atomically
from torch_modal.keyframes.check import check_keyframes
from torch_modal.keyframes.times import checked_times
from torch_modal.progress import Progress
from torch_modal.sequence import codec_packing as packing
from torch_modal.sequence.codec import ERROR, ModalSequence, chosen_keys, fitted, with_worst
from torch_modal.sequence.codec_entropy import Writer
from torch_modal.sequence.codec_file import probe, read_bytes, to_bytes
from torch_modal.sequence.codec_head import Head
from torch_modal.sequence.codec_levels import Levels
from torch_modal.sequence.codec_modes import fixed_modes

OF_SELECTION = 0.7
"""Of the error, what is left for shapes between key-frames when these are chosen, before anything is rounded."""
OF_KEYFRAMES = 0.9
"""What rounding takes of it at key-frames, at first."""
LESS, LEAST_OF_KEYFRAMES = 0.85, 0.5
"""Where shapes between just fail to keep the error, it takes less, down to a limit; then key-frames are added."""
FAR = 1.5
"""Errors of so many times the promised one ask for more key-frames at once."""
N_PROBES = 3
"""Frames of an interval that are fitted to judge it."""
OF_FIT = 0.97
"""What it may be before amplitudes are rounded."""
AMPLITUDES_TO_MOTIONS = 1e-3, 1e-3
"""Steps of turns in radians, and of moves in units of the diagonal, over the step of amplitudes."""
MAX_ROUNDS = 12
HALVINGS = 5


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
        MissingPackageError: Without the extra ``compress``.
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
    require_installed(("constriction",), "compress", "a small file of a motion")
    shapes, working_faces = check_keyframes(frames, faces, min_keyframes=2, warn=False)
    x, triangles = shapes.detach().cpu().double(), working_faces.cpu()
    when = checked_times(times, len(x), cyclic)
    kept = {"cache_dir": cache_dir, "cache": cache}
    with one_thread():
        problem = _Problem(x, triangles, when, cyclic, error, n_modes, kept, progress)
        keys = chosen_keys(x, triangles, when, keyframes, n_modes, OF_SELECTION * error, cyclic, kept, progress)
        part, limit = OF_KEYFRAMES, OF_FIT * error
        for _ in range(MAX_ROUNDS):
            attempt = problem.attempt(keys, part, problem.probes(keys))
            if float(attempt.errors.max()) <= limit:
                attempt = problem.attempt(keys, part)
                if float(attempt.errors.max()) <= limit:
                    return problem.packed(attempt)
            worst = float(attempt.errors.max())
            more = with_worst(keys, attempt.errors, limit)
            if worst > FAR * error or part * LESS < LEAST_OF_KEYFRAMES:
                # What key-frames exceed, only finer steps can mend.
                part, keys = (OF_KEYFRAMES, more) if more != keys else (part * LESS, keys)
            else:
                part *= LESS
    raise ValueError(f"the error of {error:g} could not be kept: the best found is {worst:.2g}; give a larger one")


def single(x: float) -> float:
    """A number of single precision, as a file keeps it."""
    return float(np.float32(x))


class _Attempt(NamedTuple):
    """Rounded key-frames, and what was fitted beside them."""

    keys: list[int]
    rounded: packing.RoundedShapes
    motion: ModalSequence

    @property
    def errors(self) -> Tensor:
        """Before amplitudes are rounded."""
        return self.motion.errors


class _Problem:
    """Frames, and what is promised of them.

    Args:
        x: *Shape:* ``(T, V, 3)``.
        faces: *Shape:* ``(F, 3)``.
        when: Of the frames; if cyclic, one more.
        cyclic: Whether the last frame leads on to the first.
        error: Mean distance over the diagonal of the first frame.
        n_modes: Amplitudes of a frame.
        kept: Where modes are kept.
        progress: See :data:`torch_modal.progress.Progress`.
    """

    def __init__(
        self,
        x: Tensor,
        faces: Tensor,
        when: Tensor,
        cyclic: bool,
        error: float,
        n_modes: int,
        kept: dict[str, Any],
        progress: Progress,
    ) -> None:
        self.x, self.faces, self.when, self.cyclic = x, faces, when, cyclic
        self.error, self.n_modes, self.kept, self.progress = error, n_modes, kept, progress
        used = x[0, faces.unique()]
        self.size = float((used.amax(0) - used.amin(0)).norm())
        #: The unit of what is rounded, and where it is counted from.
        self.scale = single(self.size)
        self.origin = [single(value) for value in used.mean(0).tolist()]
        self.triangles = faces.numpy().astype(np.int64)
        self.levels = Levels(self.triangles, x.shape[1])

    def rounded(self, keys: list[int], error: float) -> packing.RoundedShapes:
        """Key-frames in the widest steps, about, with which none is off by more than an error."""
        y = (self.x[keys].numpy() - np.asarray(self.origin)) / self.scale
        best, low, high = None, error, 40 * error
        for _ in range(HALVINGS):
            step = single((low * high) ** 0.5)
            tried = packing.RoundedShapes(self.levels, y, step)
            shapes = packing.positions(tried.shapes, self.origin, self.scale)
            if float(self.distances(shapes, self.x[keys]).max()) <= error:
                best, low = tried, step
            else:
                high = step
        return best or packing.RoundedShapes(self.levels, y, single(error))

    def distances(self, x: Tensor, y: Tensor) -> Tensor:
        """Mean of each frame, over the diagonal. *Shape:* ``(N, V, 3) -> (N,)``."""
        return (x - y).norm(dim=-1).mean(1) / self.size

    def errors(self, motion: ModalSequence) -> Tensor:
        """Distances of all its frames, of which few are held at a time. *Shape:* ``(T,)``."""
        rows = torch.arange(len(self.x)).split(64)
        return torch.cat([self.distances(motion.decode(motion.times[part]), self.x[part]) for part in rows])

    def probes(self, keys: list[int]) -> list[int]:
        """A few frames between any two key-frames, and these."""
        found = set(keys)
        for run in packing.runs(keys, len(self.x), self.cyclic):
            found |= set(np.linspace(run.start, run.stop - 1, N_PROBES + 2).round().astype(int).tolist()[1:-1])
        return sorted(found)

    def attempt(self, keys: list[int], part: float, only: list[int] | None = None) -> _Attempt:
        """Of so much of the error at key-frames; errors of other frames than ``only`` are zero."""
        rounded = self.rounded(keys, part * self.error)
        shapes = packing.positions(rounded.shapes, self.origin, self.scale)
        modes = fixed_modes(shapes[0], self.faces, self.n_modes, **self.kept)
        motion = fitted(self.x, self.faces, self.when, shapes, keys, self.cyclic, modes, self.progress, only)
        return _Attempt(keys, rounded, motion)

    def packed(self, attempt: _Attempt) -> tuple[bytes, Compressed]:
        """The file with the widest steps of amplitudes that keep the error, which is read again."""
        motion, k = attempt.motion, attempt.motion.n_modes
        between = packing.runs(attempt.keys, len(self.x), self.cyclic)
        series = torch.cat([motion.amplitudes, motion.motions], 1).numpy()
        decoder = motion.decoder

        def tried(step: float) -> tuple[NDArray[np.int64], list[float], float]:
            three = [step, *(single(step * ratio) for ratio in AMPLITUDES_TO_MOTIONS)]
            steps = packing.series_steps(k, *three)
            numbers = packing.to_sines(series, steps, between)
            found = torch.from_numpy(packing.from_sines(numbers, steps, between))
            new = replace(motion, amplitudes=found[:, :k], motions=found[:, k:])
            new.__dict__["decoder"] = decoder
            return numbers, three, float(self.errors(new).max())

        low, high = 1e-3 * self.error / 0.01, 10 * self.error / 0.01
        best = tried(single(low))
        for _ in range(HALVINGS + 2):
            step = single((low * high) ** 0.5)
            new = tried(step)
            if new[2] <= self.error:
                best, low = new, step
            else:
                high = step
        data, of_faces = self._file(attempt, *best[:2])
        read = ModalSequence(**read_bytes(data, "the file", **self.kept))
        errors = self.errors(read)
        if float(errors.max()) > self.error:
            raise ValueError(
                f"the error of {self.error:g} could not be kept: the best found is {float(errors.max()):.2g}; give a "
                "larger one"
            )
        return data, Compressed(len(data), of_faces, attempt.keys, errors)

    def _file(self, attempt: _Attempt, series: NDArray[np.int64], steps: list[float]) -> tuple[bytes, int]:
        """The bytes, and how many of them are the connectivity."""
        keys, rounded, motion = attempt
        between = packing.runs(keys, len(self.x), self.cyclic)
        clusters = motion.modes.clusters.numpy()
        told = np.rint(packing.PROBE_UNIT * probe(motion.modes).numpy()).astype(np.int64)
        writer = Writer()
        packing.write_shapes(writer, self.levels, rounded)
        packing.write_series(writer, series, between)
        writer.numbers(np.concatenate([clusters, told]), np.repeat([0, 1], [len(clusters), len(told)]), 2)
        flat = np.concatenate([each.reshape(-1) for numbers in rounded.numbers for each in numbers])
        faces = packing.pack_faces(self.triangles)
        head = Head(
            n_vertices=self.x.shape[1],
            n_faces=len(self.faces),
            n_frames=len(self.x),
            n_modes=motion.n_modes,
            n_clusters=len(clusters),
            n_probes=len(told),
            n_face_bytes=len(faces),
            cyclic=int(self.cyclic),
            reference=motion.reference,
            seed=motion.modes.seed,
            keys=keys,
            guides=rounded.guides,
            shifts=rounded.shifts,
            floats=[*self.origin, rounded.step, *steps, self.scale],
            digest=b"",
        )
        exact = packing.exactly(rounded.shapes)
        head = head._replace(digest=packing.digest(head, self.triangles, exact, flat, series, clusters, told))
        tensors = {"packed": packing.as_tensor(head.data() + faces + writer.data())}
        if not torch.equal(self.when, torch.arange(len(self.when), dtype=torch.float64)):
            tensors["times"] = self.when
        return to_bytes(tensors, {"coding": packing.PACKED}), len(faces)


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
