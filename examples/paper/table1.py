"""Table 1: sizes and times, of the samples of this package and of the bodies of Figures 2 and 7, next to the paper's.

The paper's columns: vertices of the surface (#V) and of the tetrahedra (#N), key-frames (#K), dimension of the space
(#D). IT is tetrahedra and modes of all key-frames, without the cache; UT is one mid-shape of a pair whose layer is
ready: of the paper's own solve (Eq. 4), and of what this package does by default. Processor seconds of one core of this
machine; the paper's are of an Intel Core i7-3370 of 3.4 GHz.
"""

import threading
import time
from collections.abc import Sequence
from pathlib import Path

import _paths  # noqa: F401
import torch
from _bipeds import KINDS, biped

import torch_modal as tm
from torch_modal.data.samples import load_sample
from torch_modal.modes.surface import CanonicalSurface

N_MODES = 50
PAPER = {
    "creature": (
        "| paper: horse | 8431 | 51.4K | 6 | 100 | 69.24 | 0.32 |",
        "| paper: lion | 5000 | 29.5K | 2 | 60 | 39.10 | 0.09 |",
        "| paper: cat | 7207 | 41.4K | 2 | 60 | 58.36 | 0.09 |",
    ),
    "hand": ("| paper: hand | 13071 | 50.2K | 2 | 100 | 31.86 | 0.28 |",),
    "wader": ("| paper: flamingo | 26284 | 103K | 2 | 100 | 153.01 | 0.73 |",),
    "person": ("| paper: women | 25381 | 93.7K | 2 | 100 | 96.06 | 0.12 |",),
}
"""The paper's rows, after the body here that is most like them."""


def key_poses(name: str) -> tuple[torch.Tensor, torch.Tensor]:
    """Key-frames and faces of a sample or of a body."""
    if name in KINDS:
        body = biped(name, None)
        return torch.stack([torch.from_numpy(body.pose(t)) for t in (0.0, 1.0)]), torch.from_numpy(body.faces)
    sample = load_sample(name)
    return sample.keyframes, sample.faces


def main(out: Path, overwrite: bool = True, names: Sequence[str] = tuple(PAPER)) -> list[str]:
    """A row for each body."""
    head = "| model | #V | #N | #K | #D | IT, s | UT, s |"
    lines = [head, "|---" * 7 + "|"]
    for name in names:
        x, faces = key_poses(name)
        surface = CanonicalSurface.of(x[0].numpy(), faces.numpy())
        n = len(tm.Lattice().fill(surface, threading.Event()).vertices)
        start = time.process_time()
        bases = tm.extract_bases(x, faces, N_MODES, mesher="lattice", cache=False, progress=False)
        prepare = time.process_time() - start
        updates = []
        for preset in ("paper", "accurate"):
            layer = tm.MidShape(bases[:2], faces, preset=preset)
            with torch.no_grad():
                layer(*x[:2])
                start = time.process_time()
                layer(*x[:2])
            updates.append(f"{time.process_time() - start:.2f}")
        lines.append(
            f"| {name} | {x.shape[1]} | {n} | {len(x)} | {2 * N_MODES} | {prepare:.1f} | {' / '.join(updates)} |"
        )
        lines += PAPER[name]
    return lines


if __name__ == "__main__":
    print("\n".join(main(Path())))
