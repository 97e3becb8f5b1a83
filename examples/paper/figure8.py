"""Figure 8: between two poses of an animal, and from one animal to another.

The second is the example ``morph_animals.py``, which registers one on the other. Printed is how long the tail is
between the ends, over the mean of its length at both: in the paper, other methods twist it or make it shorter. Between
these two animals it hardly turns, and linear interpolation keeps it, too.
"""

import contextlib
import io
import tempfile
from pathlib import Path

import _paths  # noqa: F401
import morph_animals
import numpy as np
import torch
from _animals import animal, galloping
from torch import Tensor

import torch_modal as tm

TIMES = (0.0, 3.0)
"""Of the stride, in frames: stretched, and gathered."""


def tail_lengths(x: Tensor, cell: float | None) -> Tensor:
    """Through the middles of its parts. *Shape:* ``(N, V, 3) -> (N,)``."""
    rest, _, cones = animal("slender", cell)
    nearest = np.argmin([cone.distance(rest)[0] for cone in cones], axis=0)
    parts = [i for i, cone in enumerate(cones) if cone.bone.startswith("tail")]
    middles = torch.stack([x[:, nearest == i].mean(1) for i in parts], 1)
    return (middles[:, 1:] - middles[:, :-1]).norm(dim=-1).sum(1)


def main(out: Path, overwrite: bool = True, cell: float | None = None, across: bool = True) -> list[str]:
    """Draw both, or only the poses; ``cell`` is the length of the edges."""
    faces = torch.from_numpy(animal("slender", cell)[1])
    poses = torch.stack([torch.from_numpy(galloping("slender", time, cell)) for time in TIMES])
    pairs = {"poses": (poses, tm.subdivide(poses, faces, levels=2, progress=False))}
    if across:
        with tempfile.TemporaryDirectory() as scratch, contextlib.redirect_stdout(io.StringIO()):
            morph = morph_animals.main(Path(scratch), levels=2, cell=cell).frames
        pairs["shapes"] = (morph[[0, 4]], morph)
    lines = ["length of the tail at the quarters and half-way, over the mean of both ends:"]
    for name, (ends, between) in pairs.items():
        rows = {"linear": tm.linear_sequence(ends, [0, 4]), "torch_modal": between}
        file = out / f"paper-figure8-{name}.png"
        tm.render_sequence(rows, faces, file, keyframe_indices=[0, 4], overwrite=overwrite)
        for row, x in rows.items():
            lengths = tail_lengths(x, cell)
            ratios = lengths[1:4] / lengths[[0, 4]].mean()
            lines.append(f"{name:7s} {row:12s} " + " ".join(f"{float(ratio):.3f}" for ratio in ratios))
    return lines


if __name__ == "__main__":
    print("\n".join(main(Path())))
