"""Sequences of shapes from files: numbered meshes, a folder of them, or a GLB that `save_animation` wrote."""

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from torch_modal.arrays import FloatArray, IntArray
from torch_modal.data.tree import natural
from torch_modal.errors import MeshError
from torch_modal.io.gltf_asset import GltfAsset
from torch_modal.io.read import open_asset
from torch_modal.registration.load import load_keyframes

FRAME_SUFFIXES = (".ply", ".obj", ".off")
GENERATOR = "torch_modal"


def read_shapes(paths: Sequence[str | os.PathLike[str]]) -> tuple[FloatArray, IntArray, dict[str, Any]]:
    """Read a sequence: shapes ``(N, V, 3)``, their faces ``(F, 3)``, and options of :func:`torch_modal.show`.

    From mesh files in their order; or one folder, of which the files of one kind are taken in the order of the numbers
    in their names; or one GLB that :func:`torch_modal.save_animation` wrote, with all its frames.
    """
    files = [Path(path) for path in paths]
    if len(files) == 1 and files[0].is_dir():
        folder = files[0]
        meshes = [path for path in folder.iterdir() if path.is_file() and path.suffix.lower() in FRAME_SUFFIXES]
        files = sorted(meshes, key=lambda path: natural(path.name))
        kinds = sorted({path.suffix.lower() for path in files})
        if len(kinds) != 1:
            what, listed = ("meshes of several kinds", kinds) if kinds else ("no meshes", FRAME_SUFFIXES)
            raise MeshError(f"{folder}: {what} ({', '.join(listed)}) in this folder; name the files instead")
    if len(files) == 1 and files[0].suffix.lower() == ".glb" and files[0].is_file():
        asset = open_asset(files[0])
        assert isinstance(asset, GltfAsset)
        animation = _animation(files[0], asset)
        if animation is not None:
            return animation[0], asset.faces, animation[1]
    keyframes, faces = load_keyframes(files)
    return keyframes.numpy(), faces.numpy(), {}


def _animation(path: Path, asset: GltfAsset) -> tuple[FloatArray, dict[str, Any]] | None:
    """Frames of a GLB, from morph targets or bones, and options of `show`; None without an animation of shapes."""
    document = asset.document
    try:
        ours = document.root["asset"].get("generator") == GENERATOR
        if len(asset.morphs()) == 1 and not (ours and document.get("skins")):
            return None
        if not ours or len(document.get("animations")) != 1:
            raise MeshError(
                f"{path}: morph targets that save_animation did not write, so their times are not known; export one "
                "mesh a frame instead"
            )
        (animation,) = document.get("animations")
        extras = animation["extras"]
        seconds = document.floats(animation["samplers"][0]["input"])[:, 0]
        kept = [int(number) for number in extras["frames"]]
        keyframes = [kept.index(number) for number in extras["keyframes"] if number in kept]
        back = bool(extras.get("ping_pong"))
        frames, n = asset.play(), len(kept)
        closed = len(seconds) == n + 1 and not back
        if len(frames) != len(seconds) or len(seconds) != (2 * n - 1 if back else n + closed):
            raise ValueError(f"{len(frames)} shapes, {n} frames, {len(seconds)} times")
        rate = float(extras["fps"])
    except MeshError:
        raise
    except Exception as error:  # Damaged files may raise any exception; the message names the file.
        reason = " ".join(str(error).split()) or type(error).__name__
        raise MeshError(f"{path}: cannot be read as an animation of this package ({reason[:200]})") from error
    options: dict[str, Any] = {"keyframe_indices": keyframes or None, "cyclic": closed, "fps": rate}
    # Steps in time differ where frames of a long sequence were left out, or with ease.
    times = seconds[:n]
    even = np.allclose(np.diff(times), times[-1] / (n - 1), rtol=1e-4)
    if not even or kept != list(range(n)):
        options["fps"] = float((n - 1) / times[-1])
    if not even:
        options["times"] = times.tolist()
    return frames[:n], options
