"""When the frames of an animation are shown."""

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
    fps: float = FPS
    """Pictures a second, for formats that have a fixed rate."""
    cyclic: bool = False
    ping_pong: bool = False
    """There and back again."""
    ease: bool = False
    """Slow at both ends, by half a period of a cosine."""
    parts: FloatArray | None = None
    """Which part of the duration has passed at each frame, from 0 on; even where None. *Shape:* ``(N,)``."""

    def knots(self, frames: IntArray, n_frames: int) -> tuple[FloatArray, IntArray]:
        """When each frame is fully shown, for formats that interpolate linearly between such times.

        Args:
            frames: Frame numbers that are kept, from the first to the last, ascending. *Shape:* ``(n,)``.
            n_frames: Of the sequence.

        Returns:
            Times in seconds, and indices into ``frames``. *Shape of both:* ``(T,)``.
        """
        if n_frames == 1:
            return np.zeros(1), np.zeros(1, np.int64)
        places = np.arange(len(frames))
        parts = self._parts(n_frames)[frames]
        if self.ease:
            parts = np.arccos(np.clip(1 - 2 * parts, -1, 1)) / np.pi
        times = self.duration * parts
        if self.cyclic:
            return np.append(times, self.duration), np.append(places, 0)
        if self.ping_pong:
            return np.concatenate([times, 2 * self.duration - times[-2::-1]]), np.concatenate([places, places[-2::-1]])
        return times, places

    def samples(self, n_frames: int) -> FloatArray:
        """Fractional frame numbers at the fixed rate; the first is not repeated at the end.

        *Shape:* ``(T,)``, from 0 to ``n_frames - 1`` (to ``n_frames``, if cyclic, which is frame 0 again).
        """
        if n_frames == 1:
            return np.zeros(1)
        steps = max(1, round(self.duration * self.fps))
        part = np.arange(steps if self.cyclic else steps + 1) / steps
        if self.ease:
            part = (1 - np.cos(np.pi * part)) / 2
        if self.ping_pong:
            part = np.concatenate([part, part[-2:0:-1]])
        known = self._parts(n_frames)
        known = np.append(known, 1.0) if self.cyclic else known
        return np.interp(part, known, np.arange(len(known)))

    def _parts(self, n_frames: int) -> FloatArray:
        if self.parts is not None:
            return self.parts
        return np.arange(n_frames) / (n_frames if self.cyclic else n_frames - 1)


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
    """Settle how a sequence is played.

    Args:
        n_frames: Of the sequence.
        n_keyframes: Of the sequence.
        duration: In seconds. Default: of ``fps`` frames a second where that is given; otherwise 1 s for a cycle, 2 s
            for two key-frames, and 1 s for each interval of more.
        fps: Frames a second. With a duration, only formats of a fixed rate (videos, point caches) depend on it.
        cyclic: The last frame leads on to the first.
        ping_pong: There and back again.
        ease: Slow at both ends.
        times: When the frames are, in any unit; of a cycle, with the time when it begins again. Default: evenly.

    Raises:
        ValueError: A number is not positive, a cycle is to turn back or to slow down, or times do not fit.
    """
    for name, value in (("duration", duration), ("fps", fps)):
        if value is not None and not (np.isfinite(value) and value > 0):
            raise ValueError(f"{name} must be a positive number, got {value}.")
    if cyclic and (ping_pong or ease):
        name = "ping_pong" if ping_pong else "ease"
        raise ValueError(f"{name} is for sequences that begin and end; a cyclic one does neither.")
    if duration is None:
        steps = n_frames if cyclic else n_frames - 1
        if fps is not None:
            duration = max(steps, 1) / fps
        elif cyclic:
            duration = SECONDS_OF_A_CYCLE
        else:
            duration = max(SECONDS_OF_A_PAIR, SECONDS_OF_AN_INTERVAL * (n_keyframes - 1))
    parts = None if times is None else _parts_of(np.asarray(times, np.float64), n_frames, cyclic)
    return Timing(float(duration), float(FPS if fps is None else fps), cyclic, ping_pong, ease, parts)


def _parts_of(times: FloatArray, n_frames: int, cyclic: bool) -> FloatArray:
    wanted = n_frames + cyclic
    if times.shape != (wanted,) or not np.isfinite(times).all() or (np.diff(times) <= 0).any():
        also = ", and the one when it begins again" if cyclic else ""
        raise ValueError(f"times must be {wanted} ascending numbers, one for each frame{also}; got {times.shape}.")
    if wanted == 1:
        return np.zeros(1)
    return ((times - times[0]) / (times[-1] - times[0]))[:n_frames]


def resample(frames: FloatArray, places: FloatArray) -> FloatArray:
    """Frames at fractional places, by straight lines between neighbours. *Shape:* ``(N, V, 3), (T,) -> (T, V, 3)``."""
    left = np.floor(places).astype(np.int64)
    part = (places - left)[:, None, None]
    following = frames[(left + 1) % len(frames)]
    return np.where(part > 0, (1 - part) * frames[left % len(frames)] + part * following, frames[left % len(frames)])
