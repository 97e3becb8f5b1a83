"""Which frames of a motion serve as its key-frames."""

from collections.abc import Sequence

import torch
from torch import Tensor

from torch_modal.nn.modal_decoder import ModalDecoder
from torch_modal.progress import Progress, ProgressReport
from torch_modal.sequence.codec_fit import fit

PROBES = 5
"""Frames of an interval that are fitted to judge it."""


class Judge:
    """Errors of intervals between key-frames, each computed once for its key-frames and their neighbours.

    Args:
        frames: *Shape:* ``(T, V, 3)``.
        faces: *Shape:* ``(F, 3)``.
        when: Of the frames; if cyclic, one more. *Shape:* ``(T,)`` or ``(T + 1,)``.
        modes: Of the first frame. *Shape:* ``(k, V, 3)``.
        cyclic: Whether the last frame leads on to the first.
    """

    def __init__(self, frames: Tensor, faces: Tensor, when: Tensor, modes: Tensor, cyclic: bool) -> None:
        self.frames, self.when, self.cyclic = frames, when, cyclic
        self._decoder = ModalDecoder(frames[:2], faces, torch.arange(2).double(), frames[0], modes)
        self._known: dict[tuple[int, ...], dict[int, float]] = {}

    def ends(self, keys: Sequence[int]) -> list[int]:
        """Key-frames, and of a cycle the frame number when it begins again."""
        return [*keys, len(self.frames)] if self.cyclic else list(keys)

    def errors(self, keys: Sequence[int]) -> list[dict[int, float]]:
        """Errors of some frames of each interval."""
        return [self._of_interval(keys, i) for i in range(len(self.ends(keys)) - 1)]

    def total(self, keys: Sequence[int]) -> float:
        """The mean over all frames."""
        summed, ends = 0.0, self.ends(keys)
        for i, found in enumerate(self.errors(keys)):
            if found:
                summed += sum(found.values()) / len(found) * (ends[i + 1] - ends[i] - 1)
        return summed / len(self.frames)

    def _of_interval(self, keys: Sequence[int], i: int) -> dict[int, float]:
        ends = self.ends(keys)
        inner = range(ends[i] + 1, ends[i + 1])
        if not inner:
            return {}
        around = self._around(list(keys), i)
        name = (*around, ends[i])
        if name not in self._known:
            places = torch.linspace(0, len(inner) - 1, min(PROBES, len(inner))).round().long().tolist()
            self._known[name] = self._fitted(around, [inner[p] for p in places])
        return self._known[name]

    def _around(self, keys: list[int], i: int) -> list[int]:
        """The four key-frames that the path of an interval depends on; later turns of a cycle count on."""
        n, period = len(keys), len(self.frames)
        if self.cyclic:
            return [keys[j % n] + period * (j // n) for j in range(i - 1, i + 3)]
        return keys[max(i - 1, 0) : i + 3]

    def _fitted(self, around: list[int], probes: list[int]) -> dict[int, float]:
        period = len(self.frames)
        turn = self.when[-1] - self.when[0] if self.cyclic else self.when[0] * 0
        # Of a cycle of two, neighbours are the same shapes at other times.
        times = torch.stack([self.when[key % period] + turn * (key // period) for key in around])
        shapes = self.frames[[key % period for key in around]]
        decoder = self._decoder.through(shapes, times)
        found = fit(decoder, self.frames, self.when[:period], [], only=probes)
        return {f: float(found.errors[f]) for f in probes}


def select_keyframes(
    frames: Tensor,
    faces: Tensor,
    when: Tensor,
    modes: Tensor,
    n_keyframes: int | None,
    error: float,
    cyclic: bool,
    progress: Progress = None,
) -> list[int]:
    """Key-frames by insertion at the worst frame, then by exchange with frames nearby.

    Args:
        frames: *Shape:* ``(T, V, 3)``.
        faces: *Shape:* ``(F, 3)``.
        when: Of the frames; if cyclic, one more.
        modes: Of the first frame. *Shape:* ``(k, V, 3)``.
        n_keyframes: How many; None: as few as the error asks for.
        error: That no frame should be above.
        cyclic: Whether the last frame leads on to the first.
        progress: See :data:`torch_modal.progress.Progress`.

    Raises:
        ValueError: More key-frames than frames, or fewer than two.
    """
    n = len(frames)
    if n_keyframes is not None and not 2 <= n_keyframes <= n:
        raise ValueError(f"keyframes is a number from 2 to the {n} frames, or their places; got {n_keyframes}")
    judge = Judge(frames, faces, when, modes, cyclic)
    keys = [0, n // 2] if cyclic else [0, n - 1]
    with ProgressReport(n_keyframes or n, "key-frames", progress) as bar:
        while len(keys) < (n_keyframes or n):
            found = judge.errors(keys)
            if n_keyframes is None:
                worst = max(range(len(found)), key=lambda i: max(found[i].values(), default=0.0))
                if max(found[worst].values(), default=0.0) <= error:
                    break
            else:
                ends = judge.ends(keys)
                worst = max(range(len(found)), key=lambda i: sum(found[i].values()) * (ends[i + 1] - ends[i] - 1))
            keys = sorted([*keys, _split(found[worst], judge.ends(keys)[worst], judge.ends(keys)[worst + 1])])
            bar.update()
        return _exchanged(keys, judge, cyclic) if n_keyframes is not None else keys


def _split(errors: dict[int, float], start: int, end: int) -> int:
    """Where an interval is cut: at the centre of its errors."""
    if not errors:
        raise ValueError("there are no frames left between the key-frames")
    total = sum(errors.values())
    place = sum(f * e for f, e in errors.items()) / total if total > 0 else (start + end) / 2
    return min(max(round(place), start + 1), end - 1)


def _exchanged(keys: list[int], judge: Judge, cyclic: bool) -> list[int]:
    """Key-frames moved one at a time, by steps that halve, as long as the mean error falls."""
    n = len(judge.frames)
    step = max(1, n // (4 * len(keys)))
    best = judge.total(keys)
    while step:
        improved = False
        for j in range(1, len(keys) if cyclic else len(keys) - 1):
            low, high = keys[j - 1] + 1, (keys[j + 1] if j + 1 < len(keys) else n) - 1
            for place in {min(max(keys[j] + side * step, low), high) for side in (-1, 1)} - {keys[j]}:
                tried = [*keys[:j], place, *keys[j + 1 :]]
                total = judge.total(tried)
                if total < best * (1 - 1e-3):
                    best, keys, improved = total, tried, True
        if not improved:
            step //= 2
    return keys
