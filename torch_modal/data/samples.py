"""The sample key-frames that come with the package; ``examples/make_samples.py`` made them."""

from pathlib import Path
from typing import NamedTuple

import torch

from torch_modal.registration.load import load_keyframes

FOLDER = Path(__file__).parents[1] / "samples"


class _Description(NamedTuple):
    n_keyframes: int
    cyclic: bool
    true_times: tuple[float, ...]
    first_true: int
    seconds: float
    view: tuple[float, float]


SAMPLES = {
    "creature": _Description(6, True, (0.5, 1.5, 2.5, 3.5, 4.5, 5.5), 0, 1.0, (22.0, 9.0)),
    "hand": _Description(2, False, (0.25, 0.5, 0.75), 1, 1.5, (-55.0, 12.0)),
}


class Sample(NamedTuple):
    """Key-frames, and the true shapes between them: the same joint curves at other times."""

    keyframes: torch.Tensor
    """*Shape:* ``(K, V, 3)``, Y up."""
    faces: torch.Tensor
    """*Shape:* ``(F, 3)``."""
    truth: torch.Tensor
    """Frames between the key-frames. *Shape:* ``(T, V, 3)``."""
    true_times: tuple[float, ...]
    """Times of these, in intervals of key-frames: 0.5 is half-way between the first two. T numbers."""
    cyclic: bool
    """Whether the last key-frame leads on to the first."""
    seconds: float
    """How long the sequence lasts."""
    view: tuple[float, float]
    """Azimuth and elevation, in degrees, from which it is seen well."""


def load_sample(name: str) -> Sample:
    """Read a sample: ``"creature"``, a gallop of six key-frames, or ``"hand"``, open and closed.

    Raises:
        ValueError: There is no such sample.
    """
    if name not in SAMPLES:
        raise ValueError(f"there is no sample {name!r}; there are {', '.join(SAMPLES)}")
    given = SAMPLES[name]
    keyframes, faces = load_keyframes(sample_files(name))
    true_files = [FOLDER / name / f"true-{given.first_true + i}.ply" for i in range(len(given.true_times))]
    truth = load_keyframes(true_files).keyframes
    return Sample(keyframes, faces, truth, given.true_times, given.cyclic, given.seconds, given.view)


def sample_files(name: str) -> list[Path]:
    """The files of a sample's key-frames."""
    return [FOLDER / name / f"key-{i}.ply" for i in range(SAMPLES[name].n_keyframes)]
