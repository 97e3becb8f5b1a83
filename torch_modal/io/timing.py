"""When the frames of an animation are shown."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

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

    def knots(self, frames: IntArray, n_frames: int) -> tuple[FloatArray, IntArray]:
        """When each frame is fully shown, for formats that interpolate linearly between such times.

        Args:
            frames: Numbers of the frames that there are, from the first to the last, ascending. *Shape:* ``(n,)``.
            n_frames: Of the sequence.

        Returns:
            Times in seconds; which of the ``frames`` is shown, as places in that list. *Shape of both:* ``(T,)``.
        """
        if n_frames == 1:
            return np.zeros(1), np.zeros(1, np.int64)
        places = np.arange(len(frames))
        parts = frames / (n_frames if self.cyclic else n_frames - 1)
        if self.ease:
            parts = np.arccos(np.clip(1 - 2 * parts, -1, 1)) / np.pi
        times = self.duration * parts
        if self.cyclic:
            return np.append(times, self.duration), np.append(places, 0)
        if self.ping_pong:
            return np.concatenate([times, 2 * self.duration - times[-2::-1]]), np.concatenate([places, places[-2::-1]])
        return times, places

    def samples(self, n_frames: int) -> FloatArray:
        """Places in the sequence at the fixed rate, fractions among them; what repeats is not there twice.

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
        return part * (n_frames if self.cyclic else n_frames - 1)


def make_timing(
    n_frames: int,
    n_keyframes: int = 2,
    *,
    duration: float | None = None,
    fps: float | None = None,
    cyclic: bool = False,
    ping_pong: bool = False,
    ease: bool = False,
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

    Raises:
        ValueError: A number is not positive, or a cycle is to turn back or to slow down.
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
    return Timing(float(duration), float(FPS if fps is None else fps), cyclic, ping_pong, ease)


def resample(frames: FloatArray, places: FloatArray) -> FloatArray:
    """Frames at fractional places, by straight lines between neighbours. *Shape:* ``(N, V, 3), (T,) -> (T, V, 3)``."""
    left = np.floor(places).astype(np.int64)
    part = (places - left)[:, None, None]
    following = frames[(left + 1) % len(frames)]
    return np.where(part > 0, (1 - part) * frames[left % len(frames)] + part * following, frames[left % len(frames)])
