"""Motions through many key-frames, and what is known to lie between them."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
import torch
from cases import KeyframeSet, keyframes_of
from torch import Tensor

sys.path.append(str(Path(__file__).parents[2] / "examples"))
from samples import make_samples

Truth = Callable[[float], Tensor]

# The hand closes, holds on, and opens again in part. Its key-frames are unevenly spaced in time.
CLOSED, LETS_GO, OPENED = 1.2, 2.0, 3.0
STOP_TIMES = (0.0, 0.3, 0.8, CLOSED, LETS_GO, 2.3, OPENED)


@dataclass(frozen=True, eq=False)
class Motion:
    """Key-frames in time."""

    name: str
    shapes: KeyframeSet
    times: tuple[float, ...]
    """Of the key-frames; if cyclic, also when the first comes again."""
    measured: tuple[float, ...]
    """When shapes are measured."""
    truth: Truth | None
    """The true shape at a time that is measured. *Shape:* ``(V, 3)``."""
    cyclic: bool = False
    known_anywhere: bool = False
    """Whether the truth is known at any time."""

    @property
    def diagonal(self) -> float:
        """Of the bounding box of the first key-frame."""
        x = self.shapes.keyframes[0]
        return float((x.amax(0) - x.amin(0)).norm())

    def located(self, t: float) -> tuple[int, float]:
        """The interval of a time, and how far along it is."""
        i = min(int(np.searchsorted(self.times, t, side="right")) - 1, len(self.times) - 2)
        return i, (t - self.times[i]) / (self.times[i + 1] - self.times[i])


def fractions(times: tuple[float, ...], *parts: float) -> tuple[float, ...]:
    """The same parts of each interval."""
    return tuple(float(a + u * (b - a)) for a, b in pairwise(times) for u in parts)


def sculpted(name: str) -> tuple[Tensor, Truth]:
    """Faces of a sample, and its shape at any time of its own."""
    body = make_samples.sculpted(name)
    return torch.from_numpy(body.faces), lambda time: torch.from_numpy(body.frame(time))


def closed_part(time: float) -> float:
    """How far the hand with a stop is closed: each move has neither speed nor acceleration at its ends."""

    def eased(start: float, end: float) -> float:
        u = min(max((time - start) / (end - start), 0.0), 1.0)
        return u**3 * (10 - 15 * u + 6 * u * u)

    return eased(0.0, CLOSED) - 0.75 * eased(LETS_GO, OPENED)


def gallop() -> Iterator[Motion]:
    """The sample creature."""
    faces, posed = sculpted("creature")
    times = tuple(float(i) for i in range(7))
    shapes = KeyframeSet(torch.stack([posed(t) for t in times[:-1]]), faces)
    yield Motion("creature", shapes, times, fractions(times, 0.25, 0.5, 0.75), posed, cyclic=True, known_anywhere=True)


def grip() -> Iterator[Motion]:
    """A hand that closes, rests, and opens, with uneven times of key-frames."""
    faces, grasp = sculpted("hand")

    def posed(time: float) -> Tensor:
        return grasp(closed_part(time))

    shapes = KeyframeSet(torch.stack([posed(t) for t in STOP_TIMES]), faces)
    measured = fractions(STOP_TIMES, 0.25, 0.5, 0.75)
    yield Motion("hand with a stop", shapes, STOP_TIMES, measured, posed, known_anywhere=True)


def hand_path() -> Iterator[Motion]:
    """The rigged hand that closes; its frames are an even motion."""
    found = keyframes_of("mh-hand-path")
    if found is None:
        return
    frames, faces = found
    for kept in ((0, 2, 4, 6, 8), (0, 4, 8)):
        rest = tuple(float(i) for i in range(9) if i not in kept)
        name = "mh-hand-path " + ",".join(map(str, kept))
        shapes = KeyframeSet(frames[list(kept)], faces)
        yield Motion(name, shapes, tuple(map(float, kept)), rest, lambda t, frames=frames: frames[round(t)])


MOTIONS: dict[str, Callable[[], Iterator[Motion]]] = {
    "gallop": gallop,
    "hand-path": hand_path,
    "grip": grip,
}
