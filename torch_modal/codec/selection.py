"""Choice of the frames of a motion that serve as its key-frames."""

import functools

import torch
from torch import Tensor

from torch_modal.arrays import ArrayLike
from torch_modal.codec.fit import fit
from torch_modal.keyframes.check import check_keyframes
from torch_modal.motion.decoder import ModalDecoder
from torch_modal.progress import Progress, ProgressReport
from torch_modal.times import Times, check_times

LARGEST_ERROR = 0.002  # default for the largest mean distance of a frame's vertices, over the diagonal
FRAMES_TO_FIT = 3  # frames of an interval that are fitted to estimate its error


def check_motion(frames: ArrayLike, faces: ArrayLike, times: Times, cyclic: bool) -> tuple[Tensor, Tensor, Tensor]:
    """Checked frames (float64), faces and times; raises as :func:`torch_modal.encode`."""
    shapes, triangles = check_keyframes(frames, faces, min_keyframes=2, warn=False)
    return shapes.detach().cpu().double(), triangles.cpu(), check_times(times, len(shapes), cyclic)


def insert_keyframes(
    frames: Tensor,
    faces: Tensor,
    times: Tensor,
    cyclic: bool,
    modes: Tensor,
    n_keyframes: int | None,
    error: float,
    progress: Progress = None,
) -> list[int]:
    """Key-frames of a checked motion with modes of its first frame, ``(k, V, 3)``.

    Each new one is put into the interval that costs the most, and a given number of them is then moved while that
    lowers the error, estimated from a few frames of each interval.

    Raises:
        ValueError: More key-frames than frames, or fewer than two.
    """
    n = len(frames)
    if n_keyframes is not None and not 2 <= n_keyframes <= n:
        raise ValueError(f"n_keyframes must be from 2 to the number of frames, {n}; got {n_keyframes}")
    decoder = ModalDecoder(frames[:2], faces, torch.arange(2).double(), frames[0], modes)

    @functools.cache
    def fit_interval(a: int, b: int, around: tuple[int, ...]) -> tuple[Tensor, Tensor]:
        """Some frames between two key-frames, and their errors, from the key-frames that the path depends on."""
        samples = torch.linspace(a + 1, b - 1, min(FRAMES_TO_FIT, b - a - 1)).round().long()
        cycles, keys = torch.tensor(around) // n, torch.tensor(around) % n
        path = decoder.with_keyframes(frames[keys], times[keys] + (times[-1] - times[0]) * cycles)
        return samples, fit(path, frames[samples], times[samples], bar.update).errors

    def fit_intervals(keys: list[int]) -> list[tuple[int, int, Tensor, Tensor]]:
        """Ends, samples and errors of all intervals with frames between."""
        # Numbers of a cycle go on in the periods before and after.
        every = [keys[-1] - n, *keys, n, n + keys[1]] if cyclic else keys
        ends = [(i, every[i], every[i + 1]) for i in range(cyclic, len(every) - 1 - cyclic)]
        return [(a, b, *fit_interval(a, b, tuple(every[max(i - 1, 0) : i + 3]))) for i, a, b in ends if b > a + 1]

    def sum_errors(keys: list[int]) -> float:
        """Estimated sum of the errors of all frames."""
        return sum(float(errors.mean()) * (b - a - 1) for a, b, _, errors in fit_intervals(keys))

    keys = [0, n // 2] if cyclic else [0, n - 1]
    with ProgressReport(None, "frames fitted for the choice of key-frames", progress, unit="frame") as bar:
        while len(keys) < (n_keyframes or n):
            intervals = fit_intervals(keys)
            if n_keyframes is None:
                chosen = [each for each in intervals if float(each[3].max()) > error]
                if not chosen:
                    break
            else:
                chosen = [max(intervals, key=lambda each: float(each[3].sum()) * (each[1] - each[0] - 1))]
            for a, b, samples, errors in chosen:
                centre = float((samples * errors).sum() / errors.sum()) if errors.any() else (a + b) / 2
                keys.append(min(max(round(centre), a + 1), b - 1))
            keys.sort()
        least, step = sum_errors(keys), 0 if n_keyframes is None else max(1, n // (4 * len(keys)))
        while step:
            before = least
            for j in range(1, len(keys) - (not cyclic)):
                for place in (keys[j] - step, keys[j] + step):
                    moved = [*keys[:j], place, *keys[j + 1 :]]
                    if moved == sorted({*moved} & {*range(n)}) and (total := sum_errors(moved)) < least * (1 - 1e-3):
                        least, keys = total, moved
            step //= 2 if least == before else 1
    return keys
