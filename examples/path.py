"""A smooth motion through poses at uneven times, and the speed at which its fastest vertex moves.

python examples/path.py [OUT.glb]
"""

import sys
from pathlib import Path

import torch

import torch_modal as tm


def main(out: Path) -> torch.Tensor:
    """Write the motion; returns its speeds, in diagonals a second. *Shape:* ``(T - 1,)``."""
    keyframes, faces, *_ = tm.load_sample("creature")
    times = [0.0, 0.1, 0.3, 0.4, 0.5, 0.8, 1.0]  # of the six poses, and when the first comes again
    path = tm.Path(keyframes, faces, times, cyclic=True)
    at = torch.linspace(0, 1, 49, dtype=keyframes.dtype)
    with torch.no_grad():
        frames = path(keyframes, at)
    tm.save_animation(frames[:-1], faces, out, cyclic=True, times=at.tolist(), duration=1)
    diagonal = (keyframes[0].amax(0) - keyframes[0].amin(0)).norm()
    return frames.diff(dim=0).norm(dim=-1).amax(1) / at.diff() / diagonal


if __name__ == "__main__":
    speeds = main(Path(sys.argv[1] if len(sys.argv) > 1 else "path.glb"))
    print(f"from {float(speeds.min()):.2f} to {float(speeds.max()):.2f} diagonals a second")
