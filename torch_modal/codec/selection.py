"""Choice of the frames of a motion that serve as its key-frames."""

from collections.abc import Sequence
from itertools import pairwise
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torch_modal.codec.fit import fit
from torch_modal.codec.modes import reproducible_modes
from torch_modal.keyframes.arrays import checked_times
from torch_modal.keyframes.check import check_keyframes
from torch_modal.motion.decoder import ModalDecoder
from torch_modal.progress import Progress, ProgressReport

N_SAMPLES = 5
"""Frames of an interval that are fitted to estimate its error."""


class FrameSequence(NamedTuple):
    """The frames of a motion, after the checks of the border."""

    frames: Tensor
    """float64. *Shape:* ``(T, V, 3)``."""
    faces: Tensor
    """*Shape:* ``(F, 3)``."""
    times: Tensor
    """Of the frames; of a cycle, also when the first comes again. *Shape:* ``(T,)`` or ``(T + 1,)``."""
    cyclic: bool
    """Whether the last frame leads on to the first."""

    @classmethod
    def checked(cls, frames: Any, faces: Any, times: Any, cyclic: bool) -> "FrameSequence":
        """What a caller passes.

        Raises:
            MeshError: Frames that cannot be used.
            ValueError: Times that do not ascend or do not fit the frames.
        """
        shapes, triangles = check_keyframes(frames, faces, min_keyframes=2, warn=False)
        x = shapes.detach().cpu().double()
        return cls(x, triangles.cpu(), checked_times(times, len(x), cyclic), cyclic)

    def ends(self, keys: Sequence[int]) -> list[int]:
        """Ends of the intervals: key-frames, and of a cycle the number of frames."""
        return [*keys, len(self.frames)] if self.cyclic else list(keys)


class IntervalErrors:
    """Errors of intervals between key-frames, each computed once for its key-frames and their neighbours.

    Args:
        motion: The frames.
        modes: Of the first frame. *Shape:* ``(k, V, 3)``.
    """

    def __init__(self, motion: FrameSequence, modes: Tensor) -> None:
        self.motion = motion
        frames = motion.frames
        self._decoder = ModalDecoder(frames[:2], motion.faces, torch.arange(2).double(), frames[0], modes)
        self._known: dict[tuple[int, ...], dict[int, float]] = {}

    def errors(self, keys: Sequence[int]) -> list[dict[int, float]]:
        """Errors of a few frames of each interval, by their numbers."""
        return [self._of_interval(list(keys), i) for i in range(len(self.motion.ends(keys)) - 1)]

    def mean(self, keys: Sequence[int]) -> float:
        """Estimated mean over all frames."""
        total = 0.0
        for found, (start, end) in zip(self.errors(keys), pairwise(self.motion.ends(keys)), strict=True):
            if found:
                total += sum(found.values()) / len(found) * (end - start - 1)
        return total / len(self.motion.frames)

    def _of_interval(self, keys: list[int], i: int) -> dict[int, float]:
        start, end = self.motion.ends(keys)[i : i + 2]
        inner = range(start + 1, end)
        if not inner:
            return {}
        around = self._around(keys, i)
        name = (*around, start)
        if name not in self._known:
            places = torch.linspace(0, len(inner) - 1, min(N_SAMPLES, len(inner))).round().long().tolist()
            self._known[name] = self._fitted(around, [inner[p] for p in places])
        return self._known[name]

    def _around(self, keys: list[int], i: int) -> list[int]:
        """The four key-frames that the path of an interval depends on; later periods of a cycle count on."""
        n, period = len(keys), len(self.motion.frames)
        if self.motion.cyclic:
            return [keys[j % n] + period * (j // n) for j in range(i - 1, i + 3)]
        return keys[max(i - 1, 0) : i + 3]

    def _fitted(self, around: list[int], samples: list[int]) -> dict[int, float]:
        frames, times, period = self.motion.frames, self.motion.times, len(self.motion.frames)
        duration = times[-1] - times[0] if self.motion.cyclic else times[0] * 0
        # Of a cycle of two, neighbours are the same shapes at other times.
        key_times = torch.stack([times[key % period] + duration * (key // period) for key in around])
        decoder = self._decoder.through(frames[[key % period for key in around]], key_times)
        found = fit(decoder, frames, times[:period], [], only=samples)
        return {f: float(found.errors[f]) for f in samples}


def choose_keyframes(
    motion: FrameSequence,
    keyframes: Sequence[int] | int | None,
    n_modes: int,
    error: float,
    caching: dict[str, Any],
    progress: Progress = None,
) -> list[int]:
    """The key-frames that a caller names, or those that are selected. Arguments as for :func:`torch_modal.encode`."""
    if not isinstance(keyframes, (int, type(None))):
        return _checked_keys(keyframes, motion)
    modes = reproducible_modes(motion.frames[0], motion.faces, n_modes, **caching)
    return select_keyframes(motion, modes.modes, keyframes, error, progress)


def with_worst(keys: Sequence[int], errors: Tensor, error: float) -> list[int]:
    """Key-frames, and the worst frame of each interval that has one above an error."""
    ends = [*keys, len(errors)]
    worst = [a + int(errors[a:b].argmax()) for a, b in pairwise(ends)]
    return sorted({*keys, *(f for f in worst if float(errors[f]) > error)})


def select_keyframes(
    motion: FrameSequence, modes: Tensor, n_keyframes: int | None, error: float, progress: Progress = None
) -> list[int]:
    """Key-frames by insertion at the worst frame, then by exchange with frames nearby.

    Args:
        motion: The frames.
        modes: Of the first frame. *Shape:* ``(k, V, 3)``.
        n_keyframes: How many; None: as few as the error needs.
        error: The largest that a frame should have.
        progress: See :data:`torch_modal.progress.Progress`.

    Raises:
        ValueError: More key-frames than frames, or fewer than two.
    """
    n = len(motion.frames)
    if n_keyframes is not None and not 2 <= n_keyframes <= n:
        raise ValueError(f"keyframes is a number from 2 to the {n} frames, or their places; got {n_keyframes}")
    intervals = IntervalErrors(motion, modes)
    keys = [0, n // 2] if motion.cyclic else [0, n - 1]
    with ProgressReport(n_keyframes or n, "key-frames", progress) as bar:
        while len(keys) < (n_keyframes or n):
            found, ends = intervals.errors(keys), list(pairwise(motion.ends(keys)))
            if n_keyframes is None:
                scores = [max(each.values(), default=0.0) for each in found]
                if max(scores) <= error:
                    break
            else:
                scores = [sum(each.values()) * (b - a - 1) for each, (a, b) in zip(found, ends, strict=True)]
            worst = scores.index(max(scores))
            keys = sorted([*keys, _split(found[worst], *ends[worst])])
            bar.update()
        return keys if n_keyframes is None else _exchanged(keys, intervals)


def _split(errors: dict[int, float], start: int, end: int) -> int:
    """The frame at the centre of an interval's errors."""
    if not errors:
        raise ValueError("there are no frames left between the key-frames")
    total = sum(errors.values())
    place = sum(f * e for f, e in errors.items()) / total if total > 0 else (start + end) / 2
    return min(max(round(place), start + 1), end - 1)


def _exchanged(keys: list[int], intervals: IntervalErrors) -> list[int]:
    """Key-frames moved one at a time, by steps that halve, as long as the mean error falls."""
    n, cyclic = len(intervals.motion.frames), intervals.motion.cyclic
    step = max(1, n // (4 * len(keys)))
    best = intervals.mean(keys)
    while step:
        improved = False
        for j in range(1, len(keys) if cyclic else len(keys) - 1):
            low, high = keys[j - 1] + 1, (keys[j + 1] if j + 1 < len(keys) else n) - 1
            for place in {min(max(keys[j] + side * step, low), high) for side in (-1, 1)} - {keys[j]}:
                tried = [*keys[:j], place, *keys[j + 1 :]]
                mean = intervals.mean(tried)
                if mean < best * (1 - 1e-3):
                    best, keys, improved = mean, tried, True
        if not improved:
            step //= 2
    return keys


def _checked_keys(keyframes: Any, motion: FrameSequence) -> list[int]:
    keys, last = [int(i) for i in keyframes], len(motion.frames) - 1
    required = "the first frame" if motion.cyclic else "the first and the last frame"
    ends = {0} if motion.cyclic else {0, last}
    ascending = all(a < b for a, b in pairwise(keys))
    if len(keys) < 2 or not ascending or not ends <= set(keys) or keys[-1] > last or keys[0] < 0:
        raise ValueError(
            f"keyframes are two or more ascending frame numbers from 0 to {last}, with {required} among them; "
            f"got {keys}"
        )
    return keys
