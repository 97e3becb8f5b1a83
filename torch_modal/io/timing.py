"""Times of the frames of an animation."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from torch_modal.arrays import FloatArray, IntArray

SECONDS_OF_A_PAIR = 2.0
SECONDS_OF_A_CYCLE = 1.0
SECONDS_OF_AN_INTERVAL = 1.0
FPS = 24.0


class Timing(NamedTuple):
    """How a sequence is played."""

    duration: float
    """Of the whole sequence once, in seconds; for a cycle, with the step back to its start."""
    fps: float
    """Pictures a second, for formats that have a fixed rate."""
    cyclic: bool
    ping_pong: bool
    """There and back again."""
    ease: bool
    """Slow at both ends, by half a period of a cosine."""
    parts: FloatArray
    """Time of each frame over the duration, from 0 on. *Shape:* ``(N,)``."""

    def knots(self, frames: IntArray | None = None) -> tuple[FloatArray, IntArray]:
        """Times at which frames are fully shown, for formats that interpolate linearly between them.

        Args:
            frames: Frame numbers that are kept, from the first to the last, ascending. Default: all. *Shape:* ``(n,)``.

        Returns:
            Times in seconds, and indices into ``frames``. *Shape of both:* ``(T,)``.
        """
        parts = self.parts if frames is None else self.parts[frames]
        places = np.arange(len(parts))
        if len(parts) == 1:
            return np.zeros(1), places
        if self.ease:
            parts = np.arccos(np.clip(1 - 2 * parts, -1, 1)) / np.pi
        times = self.duration * parts
        if self.cyclic:
            return np.append(times, self.duration), np.append(places, 0)
        if self.ping_pong:
            return np.concatenate([times, 2 * self.duration - times[-2::-1]]), np.concatenate([places, places[-2::-1]])
        return times, places

    def samples(self) -> FloatArray:
        """Fractional frame numbers at the fixed rate, without the repeated ends of loops.

        *Shape:* ``(T,)``, from 0 to ``N - 1`` (to ``N``, if cyclic, which is frame 0 again).
        """
        if len(self.parts) == 1:
            return np.zeros(1)
        steps = max(1, round(self.duration * self.fps))
        part = np.arange(steps if self.cyclic else steps + 1) / steps
        if self.ease:
            part = (1 - np.cos(np.pi * part)) / 2
        if self.ping_pong:
            part = np.concatenate([part, part[-2:0:-1]])
        known = np.append(self.parts, 1.0) if self.cyclic else self.parts
        return np.interp(part, known, np.arange(len(known)))


def make_timing(
    n_frames: int,
    n_keyframes: int = 2,
    *,
    duration: float | None = None,
    fps: float | None = None,
    cyclic: bool = False,
    ping_pong: bool = False,
    ease: bool = False,
    times: Sequence[float] | FloatArray | None = None,
) -> Timing:
    """Check and complete the settings of an animation.

    Args:
        n_frames: Of the sequence.
        n_keyframes: Of the sequence.
        duration: In seconds. Default: of ``fps`` frames a second where that is given; otherwise 1 s for a cycle, 2 s
            for two key-frames, and 1 s for each interval of more.
        fps: Frames a second. With a duration, only formats of a fixed rate (videos, point caches) depend on it.
        cyclic: The last frame leads on to the first.
        ping_pong: There and back again.
        ease: Slow at both ends.
        times: Of the frames, in any unit; of a cycle, also when it begins again. Default: evenly spaced.

    Raises:
        ValueError: A number is not positive, a cycle is to turn back or to slow down, or times do not fit.
    """
    for name, value in (("duration", duration), ("fps", fps)):
        if value is not None and not (np.isfinite(value) and value > 0):
            raise ValueError(f"{name} must be a positive number, got {value}.")
    if cyclic and (ping_pong or ease):
        name = "ping_pong" if ping_pong else "ease"
        raise ValueError(f"{name} is for sequences that begin and end; a cyclic one does neither.")
    steps = max(n_frames if cyclic else n_frames - 1, 1)
    if duration is None:
        if fps is not None:
            duration = steps / fps
        elif cyclic:
            duration = SECONDS_OF_A_CYCLE
        else:
            duration = max(SECONDS_OF_A_PAIR, SECONDS_OF_AN_INTERVAL * (n_keyframes - 1))
    parts = np.arange(n_frames) / steps
    if times is not None:
        given, wanted = np.asarray(times, np.float64), n_frames + cyclic
        if given.shape != (wanted,) or not np.isfinite(given).all() or (np.diff(given) <= 0).any():
            also = ", and the one when it begins again" if cyclic else ""
            raise ValueError(f"times must be {wanted} ascending numbers, one for each frame{also}; got {given.shape}.")
        parts = parts if wanted == 1 else ((given - given[0]) / (given[-1] - given[0]))[:n_frames]
    return Timing(float(duration), float(FPS if fps is None else fps), cyclic, ping_pong, ease, parts)


def resample(frames: FloatArray, places: FloatArray) -> FloatArray:
    """Linear interpolation at fractional frame numbers. *Shape:* ``(N, V, 3), (T,) -> (T, V, 3)``."""
    left = np.floor(places).astype(np.int64)
    part = (places - left)[:, None, None]
    following = frames[(left + 1) % len(frames)]
    return np.where(part > 0, (1 - part) * frames[left % len(frames)] + part * following, frames[left % len(frames)])
