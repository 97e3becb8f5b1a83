"""README's moving picture: the sample hand and creature, by torch_modal (left) and linear interpolation (right).

python docs/moving_picture.py
"""

from pathlib import Path

import torch
from torch import Tensor

import torch_modal as tm
from torch_modal.data.samples import load_sample
from torch_modal.geometry.rotations import exp
from torch_modal.motion.subdivide import keyframe_places
from torch_modal.times import fill_linear

FRAMES = 36


def seen(x: Tensor, azimuth: float, elevation: float) -> Tensor:
    """Turned so that the default view is from there, and of size one. *Shape:* ``(T, V, 3)``."""
    across, up = (
        exp(torch.deg2rad(torch.tensor(angle)).double()) for angle in ([elevation, 0.0, 0.0], [0.0, -azimuth, 0.0])
    )
    x = x - 0.5 * (x[0].amax(0) + x[0].amin(0))
    return (x / (x[0].amax(0) - x[0].amin(0)).norm()) @ (across @ up).mT


def main(out: Path) -> None:
    """Draw one cycle of both."""
    shapes, faces, n = [], [], 0
    for name, order, row, size in (("hand", [0, 1], 0.0, 0.75), ("creature", range(6), -0.75, 1.0)):
        sample = load_sample(name)
        keyframes = sample.keyframes[list(order)]
        bases = tm.extract_bases(keyframes, sample.faces)
        # Two key-frames there and back again are a cycle too.
        own = tm.interpolate(
            keyframes, sample.faces, 4, bases=bases, cyclic=True, smooth=name != "hand", n_frames=FRAMES
        )
        places = keyframe_places(len(keyframes), 4, cyclic=True, n_frames=FRAMES)
        linear = fill_linear(keyframes, places)[:FRAMES]
        for x, place in ((own, -0.55), (linear, 0.55)):
            shapes.append(size * seen(x, *sample.view) + torch.tensor([place, row, 0.0]))
            faces.append(sample.faces + n)
            n += x.shape[1]
    tm.save_animation(torch.cat(shapes, 1), torch.cat(faces), out, 16, cyclic=True, duration=2.0)


if __name__ == "__main__":
    main(Path(__file__).parent / "images" / "moving.gif")
