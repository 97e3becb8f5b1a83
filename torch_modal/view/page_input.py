"""Shapes read back from files: numbered meshes, a folder of them, or an animated GLB that `save_animation` wrote."""

import os
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from torch_modal.arrays import FloatArray, IntArray
from torch_modal.data.tree import natural
from torch_modal.errors import MeshError
from torch_modal.io.gltf_asset import GltfAsset
from torch_modal.io.read import open_asset
from torch_modal.registration.load import load_keyframes

FRAME_SUFFIXES = (".ply", ".obj", ".off")
GENERATOR = "torch_modal"


class Shapes(NamedTuple):
    """A sequence of shapes of one connectivity, with the metadata of its files."""

    frames: FloatArray
    """*Shape:* ``(N, V, 3)``."""
    faces: IntArray
    """*Shape:* ``(F, 3)``."""
    keyframe_indices: list[int] | None
    """Which of the frames are key-frames, where that is known."""
    fps: float | None
    """Frames a second, where that is known."""
    times: list[float] | None
    """When each frame is shown in seconds, where they are not evenly spaced."""
    cyclic: bool
    """Whether the last frame leads on to the first."""


def read_shapes(paths: Sequence[str | os.PathLike[str]]) -> Shapes:
    """Read a sequence of shapes.

    Args:
        paths: Mesh files in their order; or one folder, of which the files of one kind are taken in the order of the
            numbers in their names; or one GLB that :func:`torch_modal.save_animation` wrote, with all its frames.

    Returns:
        The shapes, in the files' coordinates.

    Raises:
        FileNotFoundError: A file does not exist.
        MeshError: A file cannot be read, or does not match the first; a folder holds no meshes, or of several kinds.
    """
    files = [Path(path) for path in paths]
    if len(files) == 1 and files[0].is_dir():
        files = _numbered(files[0])
    if len(files) == 1 and files[0].suffix.lower() == ".glb" and files[0].is_file():
        animation = _read_animation(files[0])
        if animation is not None:
            return animation
    keyframes, faces = load_keyframes(files)
    return Shapes(keyframes.numpy(), faces.numpy(), None, None, None, False)


def _numbered(folder: Path) -> list[Path]:
    """The meshes of a folder in the order of the numbers in their names: 2 before 10."""
    found = [path for path in folder.iterdir() if path.suffix.lower() in FRAME_SUFFIXES and path.is_file()]
    kinds = sorted({path.suffix.lower() for path in found})
    if not kinds:
        raise MeshError(f"{folder}: no meshes in this folder ({', '.join(FRAME_SUFFIXES)}); name files instead")
    if len(kinds) > 1:
        raise MeshError(f"{folder}: meshes of several kinds ({', '.join(kinds)}); name the files instead")
    return sorted(found, key=lambda path: natural(path.name))


def _read_animation(path: Path) -> Shapes | None:
    """The frames of a GLB with morph targets; None if it has none.

    Reads files of `save_animation`: frame 0 and a target for each further frame, which is shown at its time. The
    meaning of other programs' targets is unknown.
    """
    asset = open_asset(path)
    assert isinstance(asset, GltfAsset)
    document = asset.document
    try:
        frames = asset.morphs()
        if len(frames) == 1:
            return None
        if document.root["asset"].get("generator") != GENERATOR or len(document.get("animations")) != 1:
            raise MeshError(
                f"{path}: morph targets that save_animation did not write, so their times are not known; export one "
                "mesh a frame instead"
            )
        (animation,) = document.get("animations")
        extras = animation["extras"]
        seconds = document.floats(animation["samplers"][0]["input"])[:, 0]
        kept = [int(number) for number in extras["frames"]]
        places = {number: place for place, number in enumerate(kept)}
        keyframes = [places[number] for number in extras["keyframes"] if number in places]
        n, back = len(frames), bool(extras.get("ping_pong"))
        closed = len(seconds) == n + 1 and not back
        if len(kept) != n or len(seconds) != (2 * n - 1 if back else n + closed):
            raise ValueError(f"{n} shapes, {len(kept)} frames, {len(seconds)} times")
    except MeshError:
        raise
    except Exception as error:  # Damaged files may raise any exception; the message names the file.
        reason = " ".join(str(error).split()) or type(error).__name__
        raise MeshError(f"{path}: cannot be read as an animation of this package ({reason[:200]})") from error
    # Frames left out of a long sequence leave wider steps in time; so does ease.
    times = seconds[:n]
    even = np.allclose(np.diff(times), times[-1] / (n - 1), rtol=1e-4)
    rate = float(extras["fps"]) if even and kept == list(range(n)) else float((n - 1) / times[-1])
    return Shapes(frames, asset.faces, keyframes or None, rate, None if even else times.tolist(), closed)
