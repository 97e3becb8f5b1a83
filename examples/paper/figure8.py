"""Figure 8: between two poses of an animal, and from one animal to another.

The second is the example ``morph_animals.py``, which registers one on the other. Printed is how long the tail is
between the ends, over the mean of its length at both: in the paper, other methods twist it or make it shorter. Between
these two animals it hardly turns, and linear interpolation keeps it, too.
"""

import contextlib
import io
import tempfile
from collections.abc import Sequence
from pathlib import Path

import _paths  # noqa: F401
import morph_animals
import numpy as np
import torch
from results import Table, wanted
from samples.animals import animal, galloping
from torch import Tensor

import torch_modal as tm
from torch_modal.times import fill_linear

COLUMNS = ["length of the tail between", "", "a quarter", "half-way", "three quarters"]
LABELS = 2
CHECK = "poses"
TIMES = (0.0, 3.0)
"""Of the stride, in frames: stretched, and gathered."""


def tail_lengths(x: Tensor) -> Tensor:
    """Through the middles of its parts. *Shape:* ``(N, V, 3) -> (N,)``."""
    rest, _, cones = animal("slender")
    nearest = np.argmin([cone.distance(rest)[0] for cone in cones], axis=0)
    parts = [i for i, cone in enumerate(cones) if cone.bone.startswith("tail")]
    middles = torch.stack([x[:, nearest == i].mean(1) for i in parts], 1)
    return (middles[:, 1:] - middles[:, :-1]).norm(dim=-1).sum(1)


def morph() -> Tensor:
    """From one animal to the other, without what the example prints."""
    with tempfile.TemporaryDirectory() as scratch, contextlib.redirect_stdout(io.StringIO()):
        return morph_animals.main(Path(scratch), levels=2).frames


def main(table: Table, out: Path | None, only: Sequence[str]) -> None:
    """Draw both."""
    faces = torch.from_numpy(animal("slender")[1])
    pairs = {
        "poses": lambda: tm.interpolate(
            torch.stack([torch.from_numpy(galloping("slender", time)) for time in TIMES]), faces, 2, progress=False
        ),
        "shapes": morph,
    }
    for between, subdivided in pairs.items():
        if wanted(between, only):
            own = subdivided()
            rows = {"linear": fill_linear(own[[0, 4]], [0, 4]), "torch_modal": own}
            for name, x in rows.items():
                lengths = tail_lengths(x)
                ratios = lengths[1:4] / lengths[[0, 4]].mean()
                table.add(between, name, *(f"{float(ratio):.3f}" for ratio in ratios))
            if out:
                file = out / f"paper-figure8-{between}.png"
                tm.render_sequence(rows, faces, file, keyframe_indices=[0, 4])
