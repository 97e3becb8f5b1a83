"""Shapes read back from files: numbered meshes, a folder of them, or an animated GLB that `save_animation` wrote."""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from torch_modal.errors import MeshError
from torch_modal.io.write import FloatArray, IntArray
from torch_modal.keyframes.load import load_keyframes

FRAME_SUFFIXES = (".ply", ".obj", ".off")
GENERATOR = "torch_modal"


class Shapes(NamedTuple):
    """A sequence of shapes of one connectivity, and what its files say of it."""

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
    return sorted(found, key=lambda path: [int(p) if p.isdigit() else p for p in re.split(r"(\d+)", path.name)])


def _read_animation(path: Path) -> Shapes | None:
    """The frames of a GLB with morph targets; None if it has none, and is a mesh that stands still.

    What `save_animation` writes is read back: one primitive, POSITION of float32, frame 0 and a target for each further
    frame, which shows fully at its time. Of other programs' files it is not known what their targets are.
    """
    import pygltflib as gl

    try:
        gltf = gl.GLTF2().load_binary(str(path))
        blob = gltf.binary_blob() or b""
        primitives = [primitive for mesh in gltf.meshes for primitive in mesh.primitives]
        if not any(primitive.targets for primitive in primitives):
            return None
        if gltf.asset.generator != GENERATOR or len(primitives) != 1 or len(gltf.animations) != 1:
            raise MeshError(
                f"{path}: morph targets that save_animation did not write, so their times are not known; export one "
                "mesh a frame instead"
            )
        (primitive,), (animation,) = primitives, gltf.animations
        base = _accessor(gltf, blob, primitive.attributes.POSITION)
        moved = [_accessor(gltf, blob, target["POSITION"]) for target in primitive.targets]
        faces = _accessor(gltf, blob, primitive.indices).reshape(-1, 3).astype(np.int64)
        seconds = _accessor(gltf, blob, animation.samplers[0].input).reshape(-1).astype(np.float64)
        kept, fps = [int(number) for number in animation.extras["frames"]], float(animation.extras["fps"])
        places = {number: place for place, number in enumerate(kept)}
        keyframes = [places[number] for number in animation.extras["keyframes"] if number in places]
        frames = base.astype(np.float64)[None] + np.stack([np.zeros_like(base), *moved])
        closed = len(seconds) == len(frames) + 1
        if len(kept) != len(frames) or len(seconds) - closed != len(frames):
            raise ValueError(f"{len(frames)} shapes, {len(kept)} frames, {len(seconds)} times")
    except MeshError:
        raise
    except Exception as error:  # A reader fed with garbage may raise anything; the file's name must not get lost.
        reason = " ".join(str(error).split()) or type(error).__name__
        raise MeshError(f"{path}: cannot be read as an animation of this package ({reason[:200]})") from error
    # Frames left out of a long sequence leave wider steps in time, and fewer frames a second.
    even = kept == list(range(len(kept)))
    rate = fps if even else (len(frames) - 1) / (seconds[len(frames) - 1] - seconds[0])
    times = None if even else seconds[: len(frames)].tolist()
    return Shapes(frames, faces, keyframes or None, rate, times, closed)


def _accessor(gltf: Any, blob: bytes, number: int) -> Any:
    """The rows of an accessor. Raises ValueError where the file does not hold them."""
    import pygltflib as gl

    accessor = gltf.accessors[number]
    view = gltf.bufferViews[accessor.bufferView]
    kind = {gl.FLOAT: "<f4", gl.UNSIGNED_SHORT: "<u2", gl.UNSIGNED_INT: "<u4"}[accessor.componentType]
    width = {gl.SCALAR: 1, gl.VEC3: 3}[accessor.type]
    start = (view.byteOffset or 0) + (accessor.byteOffset or 0)
    rows = np.frombuffer(blob, kind, accessor.count * width, start)
    return rows.reshape(accessor.count, width)
