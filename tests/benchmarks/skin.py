"""Motions as morph targets, as bones and as principal shapes: sizes and errors of GLB files.

    python tests/benchmarks/skin.py [--only hand]
    python tests/benchmarks/skin.py --picture docs/images/skin.png

The closing hand and a cycle of the galloping creature. Errors are root mean square distances over the diagonal of frame
0, of the files read back.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

import numpy as np
import torch
from known_motions import sculpted
from PIL import Image
from results import Table, add_keep

import torch_modal as tm
from torch_modal.data.samples import load_sample
from torch_modal.data.sequence import read_shapes
from torch_modal.geometry.inspect import diagonals

BONES, TARGETS = 40, 8
COLUMNS = ["", "a morph target for each frame", f"`bones={BONES}`", f"`targets={TARGETS}`"]
MOTIONS = {"hand": np.linspace(0, 1, 33), "creature": np.arange(48) / 8}
"""Times of the frames; those of the creature are a cycle."""


def frames_of(name: str) -> tuple[np.ndarray, np.ndarray]:
    """Frames ``(T, V, 3)`` and faces."""
    faces, posed = sculpted(name)
    return torch.stack([posed(float(when)) for when in MOTIONS[name]]).numpy(), faces.numpy()


def measure(name: str, folder: Path) -> list[str]:
    """A line of the table."""
    frames, faces = frames_of(name)
    cells = [f"{name}, {len(frames)} frames"]
    for i, form in enumerate([{}, {"bones": BONES}, {"targets": TARGETS}]):
        path = folder / f"{name}-{i}.glb"
        tm.save_animation(frames, faces, path, cyclic=name == "creature", max_targets=len(frames), **form)
        off = np.linalg.norm(read_shapes([path])[0] - frames, axis=-1)
        error = 100 * np.sqrt(np.square(off).mean()) / diagonals(frames[:1])[0]
        cells.append(f"{path.stat().st_size / 1e6:.2f} MB, {error:.3f} %")
    return cells


def draw(out: Path, folder: Path) -> None:
    """Draw the gallop as morph targets, as bones, and as principal shapes."""
    frames, faces = frames_of("creature")
    few = read_shapes([tm.save_animation(frames, faces, folder / "few.glb", targets=TARGETS)])[0]
    rows = {
        "morph targets": frames,
        f"{BONES} bones": tm.bake(frames, faces, BONES).shapes().numpy(),
        f"{TARGETS} targets": few,
    }
    shown = {name: torch.tensor(row[4::8][:5]) for name, row in rows.items()}
    view = load_sample("creature").view
    tm.render_sequence(shown, faces, out, columns=5, keyframe_indices=[], view=view, overwrite=True)
    Image.open(out).quantize(128).save(out, optimize=True)


def main() -> None:
    """Print and keep the table, or draw."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="+", default=list(MOTIONS), choices=list(MOTIONS))
    parser.add_argument("--picture", type=Path, metavar="FILE", help="draw the picture instead")
    add_keep(parser)
    given = parser.parse_args()
    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory() as folder:
        if given.picture:
            draw(given.picture, Path(folder))
            return
        with Table("skin", COLUMNS, given.keep, check="--only hand") as table:
            for name in given.only:
                table.add(*measure(name, Path(folder)))


if __name__ == "__main__":
    main()
