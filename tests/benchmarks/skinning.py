"""Motions as bones, scored as papers on skinning decomposition score them.

    python tests/benchmarks/skinning.py FOLDER [--bones 10 20 30] [--peer]

The folder has the frames of one motion, one connectivity, as numbered files (``NAME-01.obj``, ``NAME-02.obj``, ...);
others, such as a reference pose, are not read where there are numbered ones. The score is

    E_RMS = 1000 |V - V'|_F / sqrt(3 frames vertices)

for frames ``V`` and the skin's ``V'``, scaled so that the bounding box of the first frame has a diagonal of 2. Four
bones move a vertex at most. The published numbers are from the paper and of its data, a gallop of 48 frames; they were
not measured here. ``--peer`` measures Dem Bones (``pip install py-dem-bones``), with its own settings, on the folder.
Seconds are of one processor, for all numbers of bones.
"""

import argparse
import time
import warnings
from collections.abc import Callable
from pathlib import Path

import numpy as np
from results import Table, add_keep
from skin import by_dem_bones
from timing import limit_threads

import torch_modal as tm
from torch_modal.arrays import FloatArray, IntArray
from torch_modal.geometry.inspect import diagonals
from torch_modal.geometry.skin import Skin

PUBLISHED = {"Le and Deng 2014, published, of a gallop": {10: 5.65, 20: 2.80, 30: 1.76}}
"""Scores by the number of bones."""


def e_rms(found: FloatArray, truth: FloatArray) -> float:
    """Score of a motion. *Shape:* ``(T, V, 3)`` each."""
    return float(1000 * 2 / diagonals(truth[:1])[0] * np.sqrt(np.mean(np.square(found - truth))))


def load(folder: Path) -> tuple[FloatArray, IntArray]:
    """Frames ``(T, V, 3)`` and faces of a folder."""
    try:
        motion = tm.load_sequence(folder)
    except (OSError, tm.MeshError) as error:
        raise SystemExit(str(error)) from None
    if len(motion.frames) < 2:
        raise SystemExit(f"{folder} has one frame; a motion needs two or more")
    return motion.frames.double().numpy(), motion.faces.numpy()


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--bones", type=int, nargs="+", default=[10, 20, 30])
    parser.add_argument("--peer", action="store_true", help="measure Dem Bones too")
    add_keep(parser)
    options = parser.parse_args()
    limit_threads()
    warnings.simplefilter("ignore")
    frames, faces = load(options.folder)
    methods: dict[str, Callable[..., Skin]] = {
        "`bake`": tm.bake,
        **({"Dem Bones": by_dem_bones} if options.peer else {}),
    }
    columns = ["", "frames", "vertices", *(f"{n} bones" for n in options.bones), "s"]
    with Table("skinning", columns, options.keep, columns[-1:]) as table:
        for name, method in methods.items():
            start = time.process_time()
            skins = [method(frames, faces, n) for n in options.bones]
            seconds = time.process_time() - start
            scores = [f"{e_rms(skin.shapes().numpy(), frames):.2f}" for skin in skins]
            table.add(name, str(len(frames)), str(frames.shape[1]), *scores, f"{seconds:.1f}")
        for name, published in PUBLISHED.items():
            table.add(name, "48", "-", *(f"{published[n]:.2f}" if n in published else "-" for n in options.bones), "-")


if __name__ == "__main__":
    main()
