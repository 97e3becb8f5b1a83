"""Motions as bones and as principal shapes, beside morph targets and py-dem-bones.

    python tests/benchmarks/skin.py [--peer FOLDER]
    python tests/benchmarks/skin.py --picture docs/images/skin.png

The closing hand, a cycle of the galloping creature and, where they are, the longest clip of each of six animals. Errors
are root mean square distances over the diagonal of frame 0, in percent, those of targets of the file read back; `file`
is the largest difference between a file and its skin. Bytes are over those of a morph target for each frame, seconds of
one thread. FOLDER is that of `pip install --target FOLDER --no-deps py-dem-bones==0.13.1` (Python 3.10 to 3.12).
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch
from cases import DATA
from motions import sculpted
from PIL import Image

sys.path.append(str(Path(__file__).parents[1]))  # beside the tests
import gltf_validator

import torch_modal as tm
from torch_modal.data.samples import load_sample
from torch_modal.geometry.inspect import diagonals
from torch_modal.view.page_input import read_shapes

BONES, TARGETS = 40, 8


def cases() -> Iterator[tuple[str, Any, Any, bool]]:
    """Names, frames ``(T, V, 3)``, faces, and whether the frames are a cycle."""
    for name, times in (("hand", np.linspace(0, 1, 33)), ("creature", np.arange(48) / 8)):
        faces, posed = sculpted(name)
        yield name, torch.stack([posed(float(when)) for when in times]).numpy(), faces.numpy(), name == "creature"
    for file in sorted((DATA / "animals").glob("*.npz")):
        with np.load(file) as stored:
            clip = int(np.argmax(stored["clip_lengths"]))
            start, n = int(stored["clip_starts"][clip]), int(stored["clip_lengths"][clip])
            frames = stored["frames"][start : start + n].astype(np.float64)
            yield f"{file.stem}, {stored['clip_names'][clip]}", frames, stored["faces"].astype(np.int64), False


def measure(peer: Path | None, folder: Path) -> None:
    """Print the table."""
    solve: Any = None
    if peer is not None:
        sys.path.append(str(peer))
        from py_dem_bones import solve_skinning as solve  # type: ignore[import-not-found,no-redef]
    heads = "T V bones error s bytes file 8-targets bytes peer s ratio".split()
    print(f"{'':32s}" + "".join(f"{head:>10s}" for head in heads) + "  MB; glTF's validator")
    sizes, ratios = [], []
    for name, frames, faces, cyclic in cases():
        diagonal = diagonals(frames[:1])[0]
        started = time.process_time()
        skin = tm.bake(frames, faces, BONES)
        row = [*frames.shape[:2], skin.weights.shape[1], 100 * skin.error, time.process_time() - started]
        paths = [
            tm.save_animation(frames, faces, folder / f"{name}-{i}.glb", cyclic=cyclic, max_targets=len(frames), **form)
            for i, form in enumerate([{}, {"bones": skin}, {"targets": TARGETS}])
        ]
        size, *others = (path.stat().st_size for path in paths)
        boned, few = (read_shapes([path])[0] for path in paths[1:])
        sizes.append(others[0] / size)
        row += [sizes[-1], np.linalg.norm(boned - skin.shapes().numpy(), axis=-1).max() / diagonal]
        row += [100 * np.sqrt(np.square(few - frames).sum(-1).mean()) / diagonal, others[1] / size]
        if solve is not None:
            started = time.process_time()
            found = solve(frames[0], frames, BONES, faces=faces.tolist(), max_influences=4)
            seconds, points = time.process_time() - started, np.pad(frames[0], ((0, 0), (0, 1)), constant_values=1)
            bones = np.asarray(found.transforms)[:, :, :3]
            off = np.einsum("jv,tjab,vb->tva", found.weights, bones, points, optimize=True) - frames
            error = np.sqrt(np.square(off).sum(-1).mean()) / diagonal
            ratios.append(skin.error / error)
            row += [100 * error, seconds, ratios[-1]]
        issues = sum(len(gltf_validator.issues(path)) for path in paths)
        said = f"{issues} errors and warnings" if gltf_validator.is_there() else "not there"
        megabytes = " ".join(f"{n / 1e6:.2f}" for n in (size, *others))
        print(f"{name:32s}" + "".join(f"{x:10.4g}" for x in row) + f"  {megabytes}; {said}", flush=True)
    print(f"bytes of skins, mean: {np.mean(sizes):.4f}")
    if ratios:
        print(f"error over py-dem-bones, geometric mean: {np.exp(np.mean(np.log(ratios))):.3f}")


def draw(out: Path, folder: Path) -> None:
    """Draw the gallop as morph targets, as bones, and as principal shapes."""
    _, frames, faces, _ = list(cases())[1]
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


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--peer", type=Path, metavar="FOLDER", help="where py-dem-bones is installed")
    parser.add_argument("--picture", type=Path, metavar="FILE", help="draw the picture instead")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory() as temporary:
        if arguments.picture:
            draw(arguments.picture, Path(temporary))
        else:
            measure(arguments.peer, Path(temporary))
