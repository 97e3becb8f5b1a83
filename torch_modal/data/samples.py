"""Sample key-frames that come with the package, made by ``examples/samples/make_samples.py``."""

from pathlib import Path
from typing import Any, NamedTuple

import torch

from torch_modal.registration.load import load_keyframes

FOLDER = Path(__file__).parents[1] / "samples"
SAMPLES: dict[str, dict[str, Any]] = {
    "creature": {"true_times": (0.5, 1.5, 2.5, 3.5, 4.5, 5.5), "cyclic": True, "seconds": 1.0, "view": (22.0, 9.0)},
    "hand": {"true_times": (0.25, 0.5, 0.75), "cyclic": False, "seconds": 1.5, "view": (-55.0, 12.0)},
}
"""Further fields of each :class:`Sample`."""


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
    """True if the last key-frame leads on to the first."""
    seconds: float
    """Duration of the sequence."""
    view: tuple[float, float]
    """Azimuth and elevation, in degrees, from which it is seen well."""


def load_sample(name: str) -> Sample:
    """Read a sample: ``"creature"``, a gallop of six key-frames, or ``"hand"``, open and closed.

    Raises:
        ValueError: There is no such sample.
    """
    if name not in SAMPLES:
        raise ValueError(f"there is no sample {name!r}; there are {', '.join(SAMPLES)}")
    keyframes, faces = load_keyframes(sample_files(name))
    truth = load_keyframes(sample_files(name, "true")).keyframes
    return Sample(keyframes, faces, truth, **SAMPLES[name])


def sample_files(name: str, kind: str = "key") -> list[Path]:
    """The files of a sample's key-frames, or of its ``"true"`` frames between them."""
    return sorted((FOLDER / name).glob(f"{kind}-*.ply"))
