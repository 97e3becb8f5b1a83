"""Figure 1, and its claim of compression: a gallop from six key-frames, and what a few amplitudes a frame add.

Printed are distances to the true frames between the key-frames, over the diagonal.
"""

from pathlib import Path

import torch

import torch_modal as tm
from torch_modal.data.samples import load_sample


def main(out: Path, overwrite: bool = True) -> list[str]:
    """Draw a cycle, and encode its true frames."""
    sample = load_sample("creature")
    frames = torch.stack([sample.keyframes, sample.truth], 1).flatten(0, 1)  # a true frame half-way
    keys = list(range(0, 12, 2))
    motion = tm.encode(frames, sample.faces, keys, 60, cyclic=True, progress=False)
    path = motion.decoder(0 * motion.amplitudes, motion.times)
    lines = []
    for name, x in (("path through six key-frames", path), ("with 60 amplitudes a frame", motion.decode())):
        apart = (x - frames)[1::2].norm(dim=-1).mean() / motion.decoder.size
        lines.append(f"{name}: {100 * float(apart):.3f} % of the diagonal")
    rows = {"key-frames, path": path[:5].detach(), "truth": frames[:5]}
    file = out / "paper-figure1.png"
    tm.render_sequence(rows, sample.faces, file, range(5), keyframe_indices=[0, 2, 4], overwrite=overwrite)
    return lines


if __name__ == "__main__":
    print("\n".join(main(Path())))
