"""Motions as morph targets, as bones and as principal shapes: sizes and errors of GLB files.

    python tests/benchmarks/skin.py [--only hand]
    python tests/benchmarks/skin.py --peer
    python tests/benchmarks/skin.py --long
    python tests/benchmarks/skin.py --picture docs/images/skin.png

The closing hand and a cycle of the galloping creature. Errors are root mean square distances over the diagonal of frame
0, of the files read back. ``--peer`` compares with Dem Bones (``pip install py-dem-bones``), with four weights for each
vertex: both skins are written by `save_animation` and played at the frames, and half-way between them, where the true
motion is known. Seconds are processor time on one thread. ``--long`` times the command on 100 OBJ files of 10,000
vertices.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from known_motions import sculpted
from PIL import Image
from results import Table, add_keep, geometric_mean

import torch_modal as tm
from torch_modal.cli.main import main as command
from torch_modal.data.samples import load_sample
from torch_modal.data.sequence import read_shapes
from torch_modal.geometry.inspect import diagonals
from torch_modal.geometry.skin import Skin

BONES, TARGETS = 40, 8
COLUMNS = ["", "a morph target for each frame", f"`bones={BONES}`", f"`targets={TARGETS}`"]
PEER_COLUMNS = ["", "bones"]
PEER_COLUMNS += [f"{who}, {what}" for what in ("at frames", "between", "time") for who in ("Dem Bones", "`bake`")]
MOTIONS = {"hand": np.linspace(0, 1, 33), "creature": np.arange(48) / 8}
"""Times of the frames; those of the creature are a cycle."""


def frames_of(name: str, times: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Frames ``(T, V, 3)``, by default at the times of the motion, and faces."""
    faces, posed = sculpted(name)
    when = MOTIONS[name] if times is None else times
    return torch.stack([posed(float(time)) for time in when]).numpy(), faces.numpy()


def measure(name: str, folder: Path) -> list[str]:
    """A line of the table."""
    frames, faces = frames_of(name)
    cells = [f"{name}, {len(frames)} frames"]
    for i, form in enumerate([{}, {"bones": BONES}, {"targets": TARGETS}]):
        path = folder / f"{name}-{i}.glb"
        tm.save_animation(frames, faces, path, cyclic=name == "creature", **form)
        off = np.linalg.norm(read_shapes([path])[0] - frames, axis=-1)
        error = 100 * np.sqrt(np.square(off).mean()) / diagonals(frames[:1])[0]
        cells.append(f"{path.stat().st_size / 1e6:.2f} MB, {error:.3f} %")
    return cells


def by_dem_bones(frames: np.ndarray, faces: np.ndarray, bones: int) -> Skin:
    """The skin of Dem Bones, with its own settings."""
    from py_dem_bones import solve_skinning

    made = solve_skinning(frames[0], frames, bone_count=bones, faces=faces)
    rest, weights, transforms = map(torch.tensor, (frames[0], made.weights.T, made.transforms))
    return Skin(rest, weights, transforms, 0.0, 0.0)


def played_errors(skin: Skin, shapes: np.ndarray, faces: np.ndarray, folder: Path) -> list[float]:
    """Errors of the written skin at the frames, and half-way between them; shapes are at both in turns."""
    path = tm.save_animation(shapes[::2], faces, folder / "skin.glb", fps=1, bones=skin)
    off = np.square(tm.load_sequence(path, fps=2).frames.numpy() - shapes).sum(-1)
    return [
        float(np.sqrt(off[part].mean()) / diagonals(shapes[:1])[0]) for part in (slice(0, None, 2), slice(1, None, 2))
    ]


def compare(name: str, bones: int, folder: Path) -> list[float]:
    """Errors at frames and between them, and seconds: of Dem Bones and of `bake` in turns."""
    at = MOTIONS[name]
    shapes, faces = frames_of(name, np.linspace(at[0], at[-1], 2 * len(at) - 1))
    columns = []
    methods: list[Callable[..., Skin]] = [by_dem_bones, tm.bake]
    for method in methods:
        started = time.process_time()
        skin = method(shapes[::2], faces, bones)
        seconds = time.process_time() - started
        columns.append([*played_errors(skin, shapes, faces, folder), seconds])
    return [value for both in zip(*columns, strict=True) for value in both]


def measure_long(folder: Path) -> None:
    """Print the processor time of the command on 100 OBJ files of 10,000 vertices."""
    frames, faces = frames_of("creature", 6 * np.arange(100) / 100)
    more = 10_000 - frames.shape[1]
    first, middle = faces[:more], frames.shape[1] + np.arange(more)  # faces that get a vertex in their middle
    frames = np.concatenate([frames, frames[:, first].mean(2)], 1)
    thirds = [np.stack([first[:, k], first[:, (k + 1) % 3], middle], 1) for k in range(3)]
    tm.save_mesh(frames, np.concatenate([faces[more:], *thirds]), folder / "frames", "obj")
    started = time.process_time()
    assert command(["bake", str(folder / "frames"), "--bones", "40", "--out", str(folder / "a.glb")]) == 0
    print(f"{time.process_time() - started:.1f} s of processor time")


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
    tm.render_sequence(shown, faces, out, columns=5, keyframe_indices=[], view=view)
    Image.open(out).quantize(128).save(out, optimize=True)


def main() -> None:
    """Print and keep the table, or draw."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="+", default=list(MOTIONS), choices=list(MOTIONS))
    parser.add_argument("--peer", action="store_true", help="compare with Dem Bones")
    parser.add_argument("--long", action="store_true", help="time the command on 100 files of 10,000 vertices")
    parser.add_argument("--picture", type=Path, metavar="FILE", help="draw the picture instead")
    add_keep(parser)
    given = parser.parse_args()
    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory() as folder:
        if given.picture:
            draw(given.picture, Path(folder))
        elif given.long:
            measure_long(Path(folder))
        elif given.peer:
            with Table("skin-peer", PEER_COLUMNS, given.keep, timed=PEER_COLUMNS[-2:], labels=2) as table:
                rows = {(name, n): compare(name, n, Path(folder)) for name in given.only for n in (10, 20, 40)}
                for (name, n), (*errors, theirs, ours) in rows.items():
                    shown = [f"{100 * error:.3f} %" for error in errors]
                    table.add(name, str(n), *shown, f"{theirs:.1f} s", f"{ours:.1f} s")
                pairs = [[row[2 * k + 1] / row[2 * k] for row in rows.values()] for k in range(3)]
                ratios = [f"{geometric_mean(ratio):.2f}" for ratio in pairs]
                table.add("`bake` over Dem Bones", "", "", ratios[0], "", ratios[1], "", ratios[2])
        else:
            with Table("skin", COLUMNS, given.keep, check="--only hand") as table:
                for name in given.only:
                    table.add(*measure(name, Path(folder)))


if __name__ == "__main__":
    main()
