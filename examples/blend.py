"""A mean of six poses that no parameter describes, and a pose part-way to it.

    python examples/blend.py [OUT]

Weights of a :class:`torch_modal.Blend` may come from a network; here they are equal, and then half on one pose.
"""

import sys
from pathlib import Path

import torch

import torch_modal as tm


def main(out: Path) -> torch.Tensor:
    """Write the two blends as meshes; returns them. *Shape:* ``(2, V, 3)``."""
    keyframes, faces, *_ = tm.load_sample("creature")
    blend = tm.Blend(keyframes, faces)
    even = torch.full((len(keyframes),), 1 / len(keyframes), dtype=keyframes.dtype)
    first = 0.5 * even + 0.5 * torch.eye(len(keyframes), dtype=keyframes.dtype)[0]
    shapes = blend(keyframes, torch.stack([even, first]))
    tm.save_mesh(shapes, faces, out, "obj", stem="blend")
    return shapes


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "out/blend"))
