"""A sequence as numbered meshes, and the checks of arrays and paths that all writers share."""

from __future__ import annotations

import os
from collections.abc import Collection, Sequence
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from torch_modal.arrays import Array, FloatArray, IntArray
from torch_modal.io.files import write_files
from torch_modal.io.formats import MESH_FORMATS

if TYPE_CHECKING:
    from torch_modal.io.asset import Asset


def save_frames(
    frames: Array,
    faces: Array,
    out: str | Path,
    fmt: str | None = None,
    stem: str = "frame",
    overwrite: bool = False,
    asset: Asset | None = None,
) -> list[Path]:
    """Write every shape as a mesh of its own: ``frame-000.ply``, ``frame-001.ply``, ...

    Vertices and faces keep their order. OBJ and OFF are text and hold float64 exactly; PLY is binary and
    holds float32 (about seven digits), which is what viewers expect: take OBJ where the files are computed
    with again.

    With an asset, each file is that of the asset with other positions: polygons, texture coordinates, materials, groups
    and all else stay, normals turn with the surface, and material libraries and textures are copied beside the files.

    Args:
        frames: Vertex positions, in the caller's coordinates. *Shape:* ``(N, V, 3)``.
        faces: Vertex indices. *Shape:* ``(F, 3)``.
        out: Folder; it is made if missing.
        fmt: ``"ply"``, ``"obj"``, ``"off"`` or ``"glb"``; by default the asset's, or PLY. Another format than the
            asset's gets the bare mesh (GLB: also materials and textures), with a warning of what is lost.
        stem: Start of the file names.
        overwrite: Replace files that exist. Files with other numbers, of a longer sequence, stay.
        asset: The mesh file that the frames come from, see :func:`torch_modal.open_asset`.

    Returns:
        The files, in the order of the frames.

    Raises:
        ValueError: ``frames``, ``faces``, ``fmt`` or ``stem`` cannot be used; the message says why.
        FileExistsError: One of the files exists and ``overwrite`` is off; then none is written.
        NotADirectoryError: ``out`` is a file.
        OSError: A file cannot be written. None is, and those that were there stay.

    Warns:
        MeshWarning: The format cannot hold what the asset carries.
    """
    shapes, triangles = check_frames(frames, faces)
    if asset is not None:
        asset.check(shapes)
    suffix = (".ply" if asset is None else asset.suffix) if fmt is None else f".{fmt}"
    if suffix not in MESH_FORMATS:
        raise ValueError(f"fmt must be one of {', '.join(known[1:] for known in MESH_FORMATS)}, got {fmt!r}.")
    if not stem or Path(stem).name != stem:
        raise ValueError(f"stem must be the start of a file name, without folders, got {stem!r}.")
    folder = Path(out)
    if folder.exists() and not folder.is_dir():
        raise NotADirectoryError(f"{folder} is a file; out must be a folder.")
    digits = max(3, len(str(len(shapes) - 1)))
    paths = [folder / f"{stem}-{number:0{digits}d}{suffix}" for number in range(len(shapes))]
    _write(shapes, triangles, paths, suffix, asset, overwrite)
    return paths


def save_mesh(
    vertices: Array, faces: Array, out: str | os.PathLike[str], overwrite: bool = False, asset: Asset | None = None
) -> Path:
    """Write one shape; the file's extension says the format. All else is as for `save_frames`.

    Args:
        vertices: Vertex positions. *Shape:* ``(V, 3)``.
        faces: Vertex indices. *Shape:* ``(F, 3)``.
        out: The file.
        overwrite: Replace the file if it exists.
        asset: The mesh file whose materials, texture coordinates and all else the shape keeps.

    Raises:
        ValueError: The arrays or the extension cannot be used.
        FileExistsError: The file exists and ``overwrite`` is off.
    """
    path = Path(out)
    shapes, triangles = check_frames(to_numpy(vertices)[None], faces, "vertices[None]")
    suffix = check_suffix(path, MESH_FORMATS)
    _write(shapes, triangles, [path], suffix, asset, overwrite)
    return path


def _write(
    shapes: FloatArray, faces: IntArray, paths: list[Path], suffix: str, asset: Asset | None, overwrite: bool
) -> None:
    """Each shape to its file, all in one folder and of one format; none if one of them cannot be written."""
    for path in paths:
        refuse_existing(path, overwrite)
    fmt = MESH_FORMATS[suffix]
    own = asset is not None and asset.suffix == suffix
    if asset is not None:
        asset.warn_lost(paths[0].name, asset.keeps if own else fmt.holds)
    beside = asset.missing_companions(paths[0].parent, overwrite) if asset is not None and own else []
    data = (asset.with_positions(x) if asset is not None and own else fmt.write(x, faces, asset) for x in shapes)
    write_files(chain(beside, zip(paths, data, strict=True)))


# ------------------------------------------------------------------------------------------------------------ checks
def to_numpy(array: Array) -> NDArray[Any]:
    """A torch tensor (any device, with or without gradient) or NumPy array as a NumPy array."""
    if hasattr(array, "detach"):
        tensor = array.detach().cpu()
        # NumPy has no bfloat16; float64 holds every torch float exactly.
        return (tensor.double() if tensor.is_floating_point() else tensor).numpy()
    return np.asarray(array)


def check_frames(frames: Array, faces: Array, name: str = "frames") -> tuple[FloatArray, IntArray]:
    """Shapes and faces as NumPy arrays, after the checks that every output needs.

    Args:
        frames: Vertex positions. *Shape:* ``(N, V, 3)``.
        faces: Vertex indices. *Shape:* ``(F, 3)``.
        name: Of ``frames``, for messages.

    Returns:
        ``frames`` as float64, ``faces`` as int64.

    Raises:
        ValueError: A shape is wrong, a value is not finite, or a face names a vertex that does not exist.
    """
    shapes, triangles = to_numpy(frames), to_numpy(faces)
    if shapes.ndim != 3 or shapes.shape[2] != 3 or 0 in shapes.shape:
        hint = "; one shape alone is frames[None]" if shapes.ndim == 2 else ""
        raise ValueError(f"{name} must have shape (N, V, 3) with N, V >= 1, got {shapes.shape}{hint}.")
    if triangles.ndim != 2 or triangles.shape[1] != 3 or len(triangles) == 0:
        raise ValueError(f"faces must have shape (F, 3), triangles, with F >= 1, got {triangles.shape}.")
    if triangles.dtype.kind not in "iu":
        raise ValueError(f"faces must hold integers, got {triangles.dtype}.")
    if triangles.min() < 0 or triangles.max() >= shapes.shape[1]:
        raise ValueError(
            f"faces must index the {shapes.shape[1]} vertices of {name} from 0, "
            f"got indices from {triangles.min()} to {triangles.max()}."
        )
    shapes = shapes.astype(np.float64)
    # Every format but OBJ and OFF stores float32, where larger numbers become infinite.
    bad = ~(np.abs(shapes) <= np.finfo(np.float32).max).all(axis=(1, 2))
    if bad.any():
        raise ValueError(
            f"{name} must hold finite numbers within float32; {int(bad.sum())} of {len(shapes)} shapes "
            f"do not, the first is number {int(bad.argmax())}."
        )
    return shapes, triangles.astype(np.int64)


def check_indices(indices: Sequence[int], n_frames: int, name: str) -> list[int]:
    """Frame numbers, each once and in order; negative ones are refused, not wrapped."""
    numbers = sorted({int(index) for index in indices})
    if numbers and (numbers[0] < 0 or numbers[-1] >= n_frames):
        raise ValueError(f"{name} must be numbers of frames, from 0 to {n_frames - 1}; got {list(indices)}.")
    return numbers


def check_suffix(path: Path, suffixes: Collection[str], name: str = "out") -> str:
    """The suffix of a file in small letters, with its dot.

    Args:
        path: The file.
        suffixes: Those that can be written.
        name: Of the argument, for the message.

    Raises:
        ValueError: It is none of those.
    """
    suffix = path.suffix.lower()
    if suffix not in suffixes:
        *others, last = suffixes
        wanted = f"{', '.join(others)} or {last}" if others else last
        raise ValueError(f"{name} must end in {wanted}, got {path.name!r}.")
    return suffix


def refuse_existing(path: Path, overwrite: bool) -> None:
    """Raise before any work is done if ``path`` may not be written."""
    if path.is_dir():
        raise IsADirectoryError(f"{path} is a folder; name a file.")
    if path.exists() and not overwrite:
        raise FileExistsError(f"{path} exists; pass overwrite=True (--overwrite) to replace it.")
