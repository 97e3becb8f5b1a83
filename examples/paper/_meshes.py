"""The public meshes of deformation transfer (Sumner and Popovic 2004), some of which the paper shows.

They may not be redistributed, so ``run.py --meshes DIR`` reads them where you have unpacked them: ``DIR/horse-gallop``,
``DIR/lion-poses`` and ``DIR/cat-poses``, each a folder of OBJ files.
"""

from pathlib import Path

import torch
from torch import Tensor

import torch_modal as tm

FOLDERS = {"horse": "horse-gallop", "lion": "lion-poses", "cat": "cat-poses"}


def poses(folder: Path, name: str) -> tuple[Tensor, Tensor]:
    """All poses of an animal in the order of their files, without the reference, and its faces.

    *Shape:* ``(T, V, 3), (F, 3)``.

    Raises:
        SystemExit: The folder has not two poses.
    """
    files = sorted(file for file in (folder / FOLDERS[name]).glob("*.obj") if "reference" not in file.stem)
    if len(files) < 2:
        raise SystemExit(
            f"{folder / FOLDERS[name]} has {len(files)} OBJ files; the poses of the {name} are needed there"
        )
    return tm.load_keyframes(files)


def gallop(folder: Path) -> tuple[Tensor, Tensor, Tensor]:
    """Six even key-frames of the horse's cycle, its faces, and the true frames half-way between them."""
    frames, faces = poses(folder, "horse")
    if len(frames) < 12:
        raise SystemExit(f"{folder / FOLDERS['horse']} has {len(frames)} frames; the gallop has 48, and 12 are needed")
    twelve = frames[torch.linspace(0, len(frames), 13)[:-1].round().long()]
    return twelve[::2], faces, twelve[1::2]
