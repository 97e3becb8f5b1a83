"""One animal becomes another, in another pose: two bodies of their own tessellations, as in Fig. 8 of the paper.

    python examples/morph_animals.py [--out FOLDER] [--levels L]

A slender animal is laid onto a stout one by eight landmarks (nose, tail, paws, ears), which gives both one
connectivity; from there on it is a pair of key-frames like any other. Written are the landmarks as the text file that
the command line reads, both animals as OBJ, the morph as GLB, and a picture beside linear interpolation. The same in
the shell, with the files that this writes:

    torch-modal register slender.obj stout.obj --across --landmarks landmarks.txt --out stout-as-slender.obj
    torch-modal interpolate slender.obj stout-as-slender.obj --levels 3 --out morph.glb
"""

import argparse
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from samples.animals import animal, galloping, tips
from scipy.spatial import cKDTree

import torch_modal as tm
from torch_modal.motion.subdivide import keyframe_places
from torch_modal.registration.report import Registration
from torch_modal.times import fill_linear

TIMES = {"slender": 0.0, "stout": 4.5}
"""Of their strides, in frames: stretched, and about to push off with the hind legs."""


class Morph(NamedTuple):
    """What came out."""

    registration: Registration
    frames: torch.Tensor
    """From the slender animal to the stout one. *Shape:* ``(N, V, 3)``."""
    faces: torch.Tensor
    """*Shape:* ``(F, 3)``."""
    folder: Path


def main(out: Path, levels: int = 3, cell: float | None = None) -> Morph:
    """Sculpt, register, morph and write.

    Args:
        out: Folder for the files; it is made if missing.
        levels: Of `interpolate`: ``2**levels`` frames from one to the other.
        cell: Length of the edges of the slender animal; 1.15 times that of the stout one.
    """
    out.mkdir(parents=True, exist_ok=True)
    cells = {"slender": cell, "stout": cell and 1.15 * cell}
    bodies = {name: animal(name, size) for name, size in cells.items()}
    # What a person would click on, in `torch-modal view slender.obj stout.obj --landmarks`.
    landmarks = np.stack([cKDTree(rest).query(tips(cones))[1] for rest, _, cones in bodies.values()], axis=1)
    np.savetxt(out / "landmarks.txt", landmarks, fmt="%d", header="slender  stout")
    (_, faces, _), (_, stout_faces, _) = bodies.values()
    slender, stout = (galloping(name, TIMES[name], cells[name]) for name in bodies)
    tm.save_mesh(slender, faces, out / "slender.obj")
    tm.save_mesh(stout, stout_faces, out / "stout.obj")
    registration = tm.register(slender, faces, stout, stout_faces, landmarks=landmarks, same_subject=False)
    print(registration.summary())

    keyframes = torch.stack([torch.from_numpy(slender), registration.positions])
    frames = tm.interpolate(keyframes, faces, levels)
    places = keyframe_places(2, levels)
    tm.save_animation(frames, faces, out / "morph.glb", keyframe_indices=places, ping_pong=True)
    rows = {"torch_modal": frames, "linear": fill_linear(keyframes, places)}
    tm.render_sequence(rows, faces, out / "morph.png", columns=5, keyframe_indices=places)
    print(f"{len(frames)} frames of {len(slender)} vertices in {out}: morph.glb, morph.png")
    return Morph(registration, frames, torch.from_numpy(faces), out)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("out/morph"), help="default: %(default)s")
    parser.add_argument("--levels", type=int, default=3, help="default: %(default)s")
    given = parser.parse_args()
    main(given.out, given.levels)
