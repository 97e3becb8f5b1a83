"""A sequence as numbered meshes."""

from itertools import chain
from os.path import realpath
from pathlib import Path

from torch_modal.arrays import Array, FloatArray, IntArray
from torch_modal.io.asset import Asset
from torch_modal.io.files import write_files
from torch_modal.io.formats import MESH_FORMATS
from torch_modal.io.write import check_frames, check_suffix, refuse_existing, to_numpy


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

    Vertices and faces keep their order. OBJ and OFF are text and hold float64 exactly; PLY is binary and holds float32
    (about seven digits), which is what viewers expect: take OBJ where the files are computed with again.

    With an asset, each file is a copy of the asset's with other positions: polygons, texture coordinates, materials,
    groups and everything else stay, normals turn with the surface, and material libraries and textures are copied too.

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
        OSError: A file cannot be written. Then none is, and existing files stay.

    Warns:
        MeshWarning: The format cannot hold what the asset carries.
    """
    shapes, triangles = check_frames(frames, faces)
    suffix = (".ply" if asset is None else asset.suffix) if fmt is None else f".{fmt}"
    if suffix not in MESH_FORMATS:
        raise ValueError(f"fmt must be one of {', '.join(known[1:] for known in MESH_FORMATS)}, got {fmt!r}")
    if not stem or Path(stem).name != stem:
        raise ValueError(f"stem must be the start of a file name, without folders, got {stem!r}")
    folder = Path(out)
    if folder.exists() and not folder.is_dir():
        raise NotADirectoryError(f"{folder} is a file; out must be a folder")
    digits = max(3, len(str(len(shapes) - 1)))
    paths = [folder / f"{stem}-{number:0{digits}d}{suffix}" for number in range(len(shapes))]
    _write(shapes, triangles, paths, asset, overwrite)
    return paths


def save_mesh(
    vertices: Array, faces: Array, out: str | Path, overwrite: bool = False, asset: Asset | None = None
) -> Path:
    """Write one shape in the format of the file's extension. Everything else is as for :func:`torch_modal.save_frames`.

    Args:
        vertices: Vertex positions. *Shape:* ``(V, 3)``.
        faces: Vertex indices. *Shape:* ``(F, 3)``.
        out: The file: ``.ply``, ``.obj``, ``.off`` or ``.glb``.
        overwrite: Replace files that exist. Materials and textures of equal content need no overwriting.
        asset: The mesh file whose materials, texture coordinates and other content the shape keeps.
    """
    path = Path(out)
    shapes, triangles = check_frames(to_numpy(vertices)[None], faces, "vertices[None]")
    check_suffix(path, MESH_FORMATS)
    _write(shapes, triangles, [path], asset, overwrite)
    return path


def _write(shapes: FloatArray, faces: IntArray, paths: list[Path], asset: Asset | None, overwrite: bool) -> None:
    """Write shapes to files of one folder and one format; none is written if one of them cannot be."""
    folder, suffix = paths[0].parent, paths[0].suffix.lower()
    for path in paths:
        refuse_existing(path, overwrite)
    extra_files: list[tuple[Path, bytes]] = []
    fmt, same_format = MESH_FORMATS[suffix], asset is not None and asset.suffix == suffix
    if asset is not None:
        asset.check(shapes)
        asset.warn_lost(paths[0].name, asset.keeps if same_format else fmt.holds)
    if asset is not None and same_format:
        companions = {folder / name: data for name, data in asset.companions.items()}
        if taken := companions.keys() & paths:
            raise ValueError(f"{taken.pop()} is the name of a texture or library of {asset.path.name}; take another")
        if realpath(folder) != realpath(asset.path.parent):  # where they are
            extra_files = [(p, data) for p, data in companions.items() if not (p.is_file() and p.read_bytes() == data)]
        for path, _ in extra_files:
            refuse_existing(path, overwrite)
        files = ((path, asset.with_positions(x)) for path, x in zip(paths, shapes, strict=True))
    else:
        files = ((path, fmt.write(x, faces, asset)) for path, x in zip(paths, shapes, strict=True))
    write_files(chain(extra_files, files))
