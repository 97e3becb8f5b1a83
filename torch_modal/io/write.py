"""Writing of shapes as meshes, and the checks of arrays and paths that all writers share."""

from collections.abc import Collection, Iterable
from itertools import chain
from os.path import realpath
from pathlib import Path

import numpy as np

from torch_modal.arrays import AnyArray, Array, ArrayLike, FloatArray, IntArray
from torch_modal.io.asset import Asset
from torch_modal.io.files import write_files
from torch_modal.io.formats import MESH_FORMATS


def to_numpy(array: ArrayLike) -> AnyArray:
    """A torch tensor (any device, with or without gradient) or NumPy array as a NumPy array."""
    if hasattr(array, "detach"):
        tensor = array.detach().cpu()
        # NumPy has no bfloat16; float64 holds every torch float exactly.
        return (tensor.double() if tensor.is_floating_point() else tensor).numpy()
    return np.asarray(array)


def check_frames(frames: Array, faces: Array, name: str = "frames") -> tuple[FloatArray, IntArray]:
    """Shapes ``(N, V, 3)`` as float64 and faces ``(F, 3)`` as int64, after the checks that every output needs.

    Raises:
        ValueError: A shape is wrong, a value is not finite, or a face names a vertex that does not exist; the message
            calls the shapes ``name``.
    """
    shapes, triangles = to_numpy(frames), to_numpy(faces)
    if shapes.ndim != 3 or shapes.shape[2] != 3 or 0 in shapes.shape:
        raise ValueError(f"{name} must have shape (N, V, 3) with N, V >= 1, got {shapes.shape}")
    if triangles.ndim != 2 or triangles.shape[1] != 3 or len(triangles) == 0:
        raise ValueError(f"faces must have shape (F, 3), triangles, with F >= 1, got {triangles.shape}")
    if triangles.dtype.kind not in "iu":
        raise ValueError(f"faces must hold integers, got {triangles.dtype}")
    if triangles.min() < 0 or triangles.max() >= shapes.shape[1]:
        raise ValueError(
            f"faces must index the {shapes.shape[1]} vertices of {name} from 0, "
            f"got indices from {triangles.min()} to {triangles.max()}"
        )
    shapes = shapes.astype(np.float64)
    # Every format but OBJ and OFF stores float32, where larger numbers become infinite.
    bad = ~(np.abs(shapes) <= np.finfo(np.float32).max).all(axis=(1, 2))
    if bad.any():
        raise ValueError(
            f"{name} must hold finite numbers within float32; {int(bad.sum())} of {len(shapes)} shapes "
            f"do not, the first is number {int(bad.argmax())}"
        )
    return shapes, triangles.astype(np.int64)


def check_indices(indices: Iterable[int], n_frames: int, name: str) -> list[int]:
    """Frame numbers, each once and in order; negative ones are refused, not wrapped."""
    numbers = sorted({int(index) for index in indices})
    if numbers and (numbers[0] < 0 or numbers[-1] >= n_frames):
        raise ValueError(f"{name} must be numbers of frames, from 0 to {n_frames - 1}; got {list(indices)}")
    return numbers


def check_suffix(path: Path, suffixes: Collection[str]) -> str:
    """The suffix of a file in small letters, with its dot; raises a ValueError if it is not among ``suffixes``."""
    suffix = path.suffix.lower()
    if suffix not in suffixes:
        raise ValueError(f"out must end in {' or '.join(suffixes)}, got {path.name!r}")
    return suffix


def refuse_existing(path: Path, overwrite: bool = True) -> None:
    """Raise an OSError, before any work is done, if ``path`` is a folder, or exists and may not be replaced."""
    if path.is_dir():
        raise IsADirectoryError(f"{path} is a folder; name a file")
    if path.exists() and not overwrite:
        raise FileExistsError(f"{path} exists, and may not be replaced (--overwrite)")


def save_mesh(
    shapes: Array,
    faces: Array,
    out: str | Path,
    fmt: str | None = None,
    *,
    stem: str = "frame",
    overwrite: bool = True,
    asset: Asset | None = None,
) -> list[Path]:
    """Write one shape as a mesh file, or several as ``frame-000.ply``, ``frame-001.ply``, ... of a folder.

    Vertices and faces keep their order. OBJ has nine digits, as float32 needs, OFF, VTK and VTP float64, others
    float32; STL has no vertices.

    With an asset, each file is a copy of the asset's with other positions: polygons, texture coordinates, materials,
    groups and everything else stay, normals turn with the surface, and material libraries and textures are copied too.

    Args:
        shapes: Vertex positions, in the caller's coordinates. *Shape:* ``(V, 3)``, or ``(N, V, 3)``.
        faces: Vertex indices. *Shape:* ``(F, 3)``.
        out: Of one shape, the file: ``.ply``, ``.obj``, ``.off``, ``.glb``, ``.stl``, ``.vtk`` or ``.vtp``. Of several,
            their folder. Folders are made if missing.
        fmt: Format of several, as ``"ply"``; by default the asset's, or PLY. Another
            format than the asset's gets the bare mesh (GLB: also materials and textures), with a warning of what is
            lost.
        stem: Start of the names of several.
        overwrite: Whether files that exist are replaced. Files with other numbers, of a longer sequence, stay.
        asset: The mesh file that the shapes come from, see :func:`torch_modal.open_asset`.

    Returns:
        The files, in the order of the shapes.

    Raises:
        ValueError: ``shapes``, ``faces``, ``fmt`` or the ending of ``out`` cannot be used; the message says why.
        FileExistsError: One of the files exists and ``overwrite`` is off; then none is written.
        OSError: A file cannot be written. Then none is, and existing files stay.

    Warns:
        MeshWarning: The format cannot hold what the asset carries.
    """
    one = to_numpy(shapes).ndim == 2
    frames, triangles = check_frames(to_numpy(shapes)[None] if one else shapes, faces, "shapes")
    if one:
        check_suffix(Path(out), MESH_FORMATS)
        paths = [Path(out)]
    else:
        suffix = (".ply" if asset is None else asset.suffix) if fmt is None else f".{fmt}"
        if suffix not in MESH_FORMATS:
            raise ValueError(f"fmt must be one of {', '.join(known[1:] for known in MESH_FORMATS)}, got {fmt!r}")
        digits = max(3, len(str(len(frames) - 1)))
        paths = [Path(out) / f"{stem}-{number:0{digits}d}{suffix}" for number in range(len(frames))]
    _write(frames, triangles, paths, asset, overwrite)
    return paths


def _write(shapes: FloatArray, faces: IntArray, paths: list[Path], asset: Asset | None, overwrite: bool) -> None:
    """Write shapes to files of one folder and one format; none is written if one of them cannot be."""
    folder, suffix = paths[0].parent, paths[0].suffix.lower()
    for path in paths:
        refuse_existing(path, overwrite)
    extra_files: list[tuple[Path, bytes]] = []
    if asset is not None:
        asset.check(shapes, paths[0], MESH_FORMATS[suffix].holds)
    if asset is None or asset.suffix != suffix:
        files = ((path, MESH_FORMATS[suffix].write(x, faces, asset)) for path, x in zip(paths, shapes, strict=True))
    else:
        companions = {folder / name: data for name, data in asset.companions.items()}
        if taken := companions.keys() & paths:
            raise ValueError(f"{taken.pop()} is the name of a texture or library of {asset.path.name}; take another")
        if realpath(folder) != realpath(asset.path.parent):  # where they are
            extra_files = [(p, data) for p, data in companions.items() if not (p.is_file() and p.read_bytes() == data)]
        for path, _ in extra_files:
            refuse_existing(path, overwrite)
        files = ((path, asset.with_positions(x)) for path, x in zip(paths, shapes, strict=True))
    write_files(chain(extra_files, files))
