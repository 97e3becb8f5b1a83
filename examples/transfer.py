"""The gallop of one animal on another one, of other proportions and connectivity.

    python examples/transfer.py [--out FOLDER]

The sample creature gallops; a stout animal of other triangles, which stands in the pose of the first frame, learns it:
eight landmarks (nose, tail, paws, ears), one registration, one call. The stout animal has bones too, so that its true
gallop is known. Written are the motion as GLB and a picture: the sample above, the stout animal below.
"""

import argparse
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from samples.animals import animal, galloping, tips
from scipy.spatial import cKDTree

import torch_modal as tm


class Transferred(NamedTuple):
    """Mean distances from the true gallop, over the diagonal."""

    error: float
    copied: float
    """Of displacements that are copied to the stout animal, along the same map."""
    confidence: float


def main(out: Path, cell: float | None = None) -> Transferred:
    """Transfer, measure and write.

    Args:
        out: Folder for the files; it is made if missing.
        cell: Length of the edges of the stout animal.
    """
    out.mkdir(parents=True, exist_ok=True)
    frames, faces, *_ = tm.load_sample("creature")  # six key-frames of a stride
    rest, stout_faces, cones = animal("stout", cell)
    truth = torch.from_numpy(np.stack([galloping("stout", time, cell) for time in range(len(frames))]))
    # What a person would click on, in `torch-modal view`.
    slender_rest, _, slender_cones = animal("slender")
    first = galloping("slender", 0.0)[cKDTree(slender_rest).query(tips(slender_cones))[1]]
    landmarks = np.stack([first, truth[0].numpy()[cKDTree(rest).query(tips(cones))[1]]], axis=1)
    stout = truth[0], torch.from_numpy(stout_faces)

    found = tm.register(*stout, frames[0], faces, landmarks=landmarks[:, ::-1], same_subject=False)
    print(found.summary())
    moved = tm.transfer(frames, faces, *stout, registration=found)

    scale = float((truth[0].amax(0) - truth[0].amin(0)).norm())
    size = float((frames[0].amax(0) - frames[0].amin(0)).norm())
    steps = torch.stack([tm.Passengers(frames[0], faces, found.positions)(frame) for frame in frames])
    copied = truth[0] + scale / size * (steps - steps[:1])
    error, copy = (float((tm.align(x, truth) - truth)[1:].norm(dim=-1).mean()) / scale for x in (moved, copied))
    print(f"{100 * error:.2f} % of the diagonal off the true gallop; copied displacements {100 * copy:.2f} %")

    path = tm.interpolate(moved, stout[1], 2, cyclic=True, progress=False)
    tm.save_animation(path, stout[1], out / "stout.glb", cyclic=True)
    both = torch.cat([frames, moved - torch.tensor([0, 2.0, 0], dtype=moved.dtype)], 1)
    joined = torch.cat([faces, stout[1] + frames.shape[1]])
    tm.render_sequence({"above: sample\nbelow: stout": both}, joined, out / "transfer.png", keyframe_indices=[])
    print(f"stout.glb, transfer.png in {out}")
    return Transferred(error, copy, found.confidence)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("out/transfer"), help="default: %(default)s")
    main(parser.parse_args().out)
