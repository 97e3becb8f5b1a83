"""Choice of the frames of a motion that serve as its key-frames."""

from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import torch
from torch import Tensor

from torch_modal.codec.fit import fit
from torch_modal.keyframes.check import check_keyframes
from torch_modal.modes.extract import extract_modes
from torch_modal.motion.decoder import ModalDecoder
from torch_modal.progress import Progress, ProgressReport
from torch_modal.times import Times, check_times

LARGEST_ERROR = 0.002  # default for the largest mean distance of a frame's vertices, over the diagonal
FRAMES_TO_FIT = 5  # frames of an interval that are fitted to estimate its error


def select_keyframes(
    frames: Any,
    faces: Any,
    n_keyframes: int | None = None,
    *,
    error: float = LARGEST_ERROR,
    n_modes: int = 60,
    times: Times = None,
    cyclic: bool = False,
    cache_dir: str | None = None,
    cache: bool = True,
    progress: Progress = None,
) -> list[int]:
    """Select the frames of a motion that serve best as its key-frames.

    Key-frames are inserted one by one where the errors of the frames between are largest; a given number of them is
    then moved while the mean error falls. Errors are the errors of :func:`torch_modal.encode`, estimated from a few
    frames of each interval.

    Args:
        frames: A motion of one connectivity, in any units. *Shape:* ``(T, V, 3)``.
        faces: Vertex indices. *Shape:* ``(F, 3)``.
        n_keyframes: How many. Default: as few as the ``error`` needs.
        error: Largest estimated mean distance of a frame's vertices, over the diagonal.
        n_modes: Amplitudes of a frame; fewer need more key-frames.
        times: As for :func:`torch_modal.encode`, like the following.
        cyclic: Whether the last frame leads on to the first.
        cache_dir: Folder where modes are cached.
        cache: Whether they are.
        progress: See :data:`torch_modal.progress.Progress`.

    Returns:
        Ascending frame numbers, with the first, and, if not cyclic, the last.

    Raises:
        MeshError: Frames that cannot be used.
        ValueError: Times or numbers that cannot be used.
    """
    x, triangles, when = check_motion(frames, faces, times, cyclic)
    modes = extract_modes(x[0], triangles, n_modes, cache_dir=cache_dir, cache=cache).modes
    return Selection(x, triangles, when, cyclic, modes).run(n_keyframes, error, progress)


def check_motion(frames: Any, faces: Any, times: Any, cyclic: bool) -> tuple[Tensor, Tensor, Tensor]:
    """Checked frames (float64), faces and times; raises as :func:`torch_modal.encode`."""
    shapes, triangles = check_keyframes(frames, faces, min_keyframes=2, warn=False)
    return shapes.detach().cpu().double(), triangles.cpu(), check_times(times, len(shapes), cyclic)


class Selection:
    """Search for the key-frames of a checked motion with modes of its first frame, ``(k, V, 3)``.

    The error of an interval is computed once.
    """

    def __init__(self, frames: Tensor, faces: Tensor, times: Tensor, cyclic: bool, modes: Tensor) -> None:
        self.frames, self.times, self.cyclic = frames, times, cyclic
        self._decoder = ModalDecoder(frames[:2], faces, torch.arange(2).double(), frames[0], modes)
        self._known: dict[tuple[int, ...], dict[int, float]] = {}  # errors of the intervals that were fitted

    def run(self, n_keyframes: int | None, error: float, progress: Progress = None) -> list[int]:
        """The key-frames; see :func:`select_keyframes`.

        Raises:
            ValueError: More key-frames than frames, or fewer than two.
        """
        n = len(self.frames)
        if n_keyframes is not None and not 2 <= n_keyframes <= n:
            raise ValueError(f"n_keyframes must be from 2 to the number of frames, {n}; got {n_keyframes}")
        keys = [0, n // 2] if self.cyclic else [0, n - 1]
        with ProgressReport(n_keyframes or n, "key-frames", progress) as bar:
            while len(keys) < (n_keyframes or n):
                intervals = self.intervals(keys)
                if n_keyframes is None:
                    scores = [max(errors.values(), default=0.0) for errors, _, _ in intervals]
                    if max(scores) <= error:
                        break
                else:
                    scores = [sum(errors.values()) * (b - a - 1) for errors, a, b in intervals]
                errors, a, b = intervals[scores.index(max(scores))]
                total = sum(errors.values())
                centre = sum(f * e for f, e in errors.items()) / total if total > 0 else (a + b) / 2
                keys = sorted([*keys, min(max(round(centre), a + 1), b - 1)])
                bar.update()
        return keys if n_keyframes is None else self._move_keyframes(keys)

    def intervals(self, keys: Sequence[int]) -> list[tuple[dict[int, float], int, int]]:
        """Errors of a few frames of each interval between key-frames, by their numbers, and its first and last frame.

        The last interval of a cycle ends at the number of frames.
        """
        result, n, period = [], len(keys), len(self.frames)
        for i, (a, b) in enumerate(pairwise([*keys, period] if self.cyclic else keys)):
            # The path of an interval depends on four key-frames; numbers go on in later periods of a cycle.
            if self.cyclic:
                around = [keys[j % n] + period * (j // n) for j in range(i - 1, i + 3)]
            else:
                around = list(keys[max(i - 1, 0) : i + 3])
            name = (*around, a)
            if name not in self._known and b - a > 1:
                samples = torch.linspace(a + 1, b - 1, min(FRAMES_TO_FIT, b - a - 1)).round().long()
                cycles, frames = (torch.tensor(around) // period, torch.tensor(around) % period)
                times = self.times[frames] + (self.times[-1] - self.times[0]) * cycles
                decoder = self._decoder.with_keyframes(self.frames[frames], times)
                errors = fit(decoder, self.frames[samples], self.times[samples]).errors
                self._known[name] = dict(zip(samples.tolist(), errors.tolist(), strict=True))
            result.append((self._known.get(name, {}), a, b))
        return result

    def mean(self, keys: Sequence[int]) -> float:
        """Estimated mean error of all frames."""
        each = [sum(e.values()) / max(len(e), 1) * (b - a - 1) for e, a, b in self.intervals(keys)]
        return sum(each) / len(self.frames)

    def _move_keyframes(self, keys: list[int]) -> list[int]:
        """Move key-frames one at a time, by steps that halve, as long as the mean error falls."""
        n = len(self.frames)
        step = max(1, n // (4 * len(keys)))
        best = self.mean(keys)
        while step:
            before = best
            for j in range(1, len(keys) if self.cyclic else len(keys) - 1):
                low, high = keys[j - 1] + 1, (keys[j + 1] if j + 1 < len(keys) else n) - 1
                for place in {min(max(keys[j] + side * step, low), high) for side in (-1, 1)} - {keys[j]}:
                    moved = [*keys[:j], place, *keys[j + 1 :]]
                    if (mean := self.mean(moved)) < best * (1 - 1e-3):
                        best, keys = mean, moved
            if best == before:
                step //= 2
        return keys
