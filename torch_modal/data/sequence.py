"""Sequences of shapes from files: numbered meshes, a folder or a pattern of them, an animated GLB, Alembic or NPZ."""

import glob
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from torch_modal.arrays import FloatArray, IntArray
from torch_modal.data.tree import mesh_files, natural
from torch_modal.errors import MeshError
from torch_modal.io.alembic import read_alembic
from torch_modal.io.asset import Asset
from torch_modal.io.formats import FPS
from torch_modal.io.gltf import key_times
from torch_modal.io.gltf_asset import GltfAsset
from torch_modal.io.read import SUFFIXES, mesh_errors, open_asset
from torch_modal.io.write import check_frames
from torch_modal.registration.load import load_keyframes

GENERATOR = "torch_modal"
FASTEST = 60.0
"""Most frames a second at which the animations of others are sampled by default."""

Shapes = tuple[FloatArray, IntArray, dict[str, Any]]
Paths = str | os.PathLike[str] | Sequence[str | os.PathLike[str]]


class ShapeSequence(NamedTuple):
    """Shapes of one connectivity at even times."""

    frames: Tensor
    """Float64. *Shape:* ``(N, V, 3)``."""
    faces: Tensor
    """Vertex indices, int64. *Shape:* ``(F, 3)``."""
    fps: float
    """Frames a second."""


def load_sequence(paths: Paths, fps: float | None = None, **registration: Any) -> ShapeSequence:
    """Read a sequence of shapes.

    Args:
        paths: Mesh files in their order; a folder of them, or a pattern such as ``"out/mesh_*.glb"``, in the order of
            their numbers; one GLB or GLTF file, with its first animation (morph targets, skeletons and moving nodes);
            or one NPZ file with ``frames``, ``faces`` and perhaps ``times``. Of a folder with numbered and other
            meshes, the numbered ones are read.
        fps: Frames a second. An animation is sampled at this rate; by default at the rate of its keys, at most 60.
            Of other files it is only the result's ``fps``: 24 by default, or from the ``times`` of the NPZ file.
        registration: Options of :func:`torch_modal.load_keyframes`, such as ``register=True`` for mesh files of
            different connectivity.

    Returns:
        Frames, faces and frames a second.

    Raises:
        FileNotFoundError: A file does not exist, or no file fits the pattern.
        MeshError: A file cannot be read, a folder holds no meshes or several kinds of them, or the connectivity
            differs; further errors as of :func:`torch_modal.load_keyframes`.
        ValueError: ``fps`` is not positive.
    """
    if fps is not None and not 0 < fps < np.inf:
        raise ValueError(f"fps must be a positive number, got {fps}")
    frames, faces, options = read_shapes(paths, fps, **registration)
    return ShapeSequence(torch.from_numpy(frames), torch.from_numpy(faces), fps or options.get("fps", FPS))


def sequence_files(paths: Paths) -> list[Path]:
    """Files of a sequence in their order, with folders and patterns resolved. Raises as :func:`load_sequence`."""
    files = [Path(path) for path in ([paths] if isinstance(paths, (str, os.PathLike)) else paths)]
    if len(files) != 1 or (os.path.lexists(files[0]) and not files[0].is_dir()):
        return files
    (start,) = files
    if start.is_dir():
        meshes = [path for path in mesh_files(start) if any(map(str.isdigit, path.stem))] or mesh_files(start)
        kinds = sorted({path.suffix.lower() for path in meshes})
        if len(kinds) != 1:
            what, listed = ("meshes of several kinds", kinds) if kinds else ("no meshes", list(SUFFIXES))
            raise MeshError(f"{start}: {what} ({', '.join(listed)}) in this folder; name the files instead")
    elif glob.has_magic(str(start)):
        meshes = [Path(path) for path in glob.glob(str(start), recursive=True)]
        if not meshes:
            raise FileNotFoundError(f"{start}: no file fits this pattern")
    else:
        return files
    return sorted(meshes, key=lambda path: natural(path.as_posix()))


def smooth_in_time(frames: Tensor, period: float, cyclic: bool = False) -> Tensor:
    """Halve what oscillates with a period, in frames; faster changes vanish, and slower ones hardly change.

    Least squares with a penalty on second differences; straight motions stay. *Shape:* ``(N, V, 3)``.

    Raises:
        ValueError: The period is not positive.
    """
    if not period > 0:
        raise ValueError(f"smooth must be a positive number of frames, got {period}")
    eye = torch.eye(len(frames)).to(frames)
    second = eye.roll(1, 1) - 2 * eye + eye.roll(-1, 1)
    second = second if cyclic else second[1:-1]
    penalty = 1 / (2 * np.sin(np.pi / max(period, 2))) ** 4
    return torch.linalg.solve(eye + penalty * second.mT @ second, frames.flatten(1)).view_as(frames)


def read_shapes(paths: Paths, fps: float | None = None, **registration: Any) -> Shapes:
    """Read a sequence: shapes ``(N, V, 3)``, their faces ``(F, 3)``, and options of :func:`torch_modal.show`.

    Arguments as for :func:`load_sequence`.
    """
    files = sequence_files(paths)
    suffix = files[0].suffix.lower() if len(files) == 1 and files[0].is_file() else ""
    if suffix == ".npz":
        return _arrays(files[0])
    if suffix == ".abc":
        with mesh_errors(f"{files[0]}: cannot be read as Alembic"):
            return read_alembic(files[0])
    if suffix in (".glb", ".gltf"):
        asset = open_asset(files[0])
        assert isinstance(asset, GltfAsset)
        with mesh_errors(f"{files[0]}: its animation cannot be read"):
            animation = _animation(asset, fps)
        if animation is not None:
            return animation[0], asset.faces, animation[1]
    keyframes, faces = load_keyframes(files, **registration)
    return keyframes.numpy(), faces.numpy(), {}


def sequence_asset(paths: Paths) -> Asset | None:
    """The first file of a sequence with all that is in it; None where that is no mesh file."""
    file = sequence_files(paths)[0]
    return open_asset(file) if file.suffix.lower() in SUFFIXES else None


def _arrays(path: Path) -> Shapes:
    """Shapes of an NPZ file."""
    with mesh_errors(f"{path}: needs arrays frames (N, V, 3) and faces (F, 3)"), np.load(path) as arrays:
        frames, faces = check_frames(arrays["frames"], arrays["faces"])
        times = arrays["times"] if "times" in arrays else np.zeros(0)
        seconds = float(times[-1] - times[0]) if times.shape == (len(frames),) else 0.0
    return frames, faces, {"fps": (len(frames) - 1) / seconds} if seconds > 0 else {}


def _animation(asset: GltfAsset, fps: float | None) -> tuple[FloatArray, dict[str, Any]] | None:
    """Frames of an animated GLB, and options of `show`; None without an animation."""
    keys = key_times(asset.document)
    if not len(keys):
        return None
    (animation, *_), written = asset.document.get("animations"), asset.document.root["asset"].get("generator")
    extras = animation.get("extras", {})
    if fps is not None or written != GENERATOR or "frames" not in extras:
        steps = np.diff(keys)
        rate = fps or min(1 / steps[steps > 1 / (2 * FASTEST)].min(initial=1.0), FASTEST)
        rate = round(rate) if abs(rate - round(rate)) < 0.01 * rate else rate
        n = int((keys[-1] - keys[0]) * rate + 1.001)
        return asset.play(keys[0] + np.arange(n) / rate), {"fps": float(rate)}
    n = len(extras["frames"])
    keyframes = [number for number in extras["keyframes"] if number < n]
    back, rate = bool(extras.get("ping_pong")), float(extras["fps"])
    closed = len(keys) == n + 1 and not back
    if len(keys) != (2 * n - 1 if back else n + closed):
        raise ValueError(f"{n} frames, {len(keys)} times")
    times = keys[:n]
    options: dict[str, Any] = {"keyframe_indices": keyframes or None, "cyclic": closed, "fps": rate}
    if not np.allclose(np.diff(times), times[-1] / (n - 1), rtol=1e-4):
        options |= {"fps": float((n - 1) / times[-1]), "times": times.tolist()}
    return asset.play(times), options
