"""Reading mesh files; the order and number of vertices stay."""

import os
from pathlib import Path

import numpy as np

from torch_modal.arrays import FloatArray, IntArray
from torch_modal.errors import MeshError
from torch_modal.io.asset import Asset
from torch_modal.io.gltf_asset import GltfAsset
from torch_modal.io.obj import ObjAsset
from torch_modal.io.ply import OffAsset, PlyAsset

READERS: dict[str, type[Asset]] = {
    ".obj": ObjAsset,
    ".ply": PlyAsset,
    ".off": OffAsset,
    ".glb": GltfAsset,
    ".gltf": GltfAsset,
}
SUFFIXES = tuple(READERS)


def read_mesh(path: str | os.PathLike[str]) -> tuple[FloatArray, IntArray]:
    """Read the positions and triangles of a file.

    Args:
        path: As for :func:`open_asset`.

    Returns:
        Vertices, *shape* ``(V, 3)``, in the file's units; faces, *shape* ``(F, 3)``.

    Raises:
        FileNotFoundError, MeshError: As for :func:`open_asset`.
    """
    asset = open_asset(path)
    return asset.positions, asset.faces


def open_asset(path: str | os.PathLike[str]) -> Asset:
    """Read a mesh file with all its content.

    Args:
        path: An OBJ, PLY, OFF, GLB or GLTF file.

    Returns:
        The asset: ``positions`` and ``faces`` are those of :func:`torch_modal.load_keyframes`; ``write`` makes the
        same file with other positions.

    Raises:
        FileNotFoundError: There is no such file.
        MeshError: The file holds no mesh that can be read, or one without shared vertices (STL).
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if suffix == ".stl":
        raise MeshError(
            f"{path}: STL stores loose triangles without shared, ordered vertices, so key-frames cannot be "
            "matched vertex by vertex; export OBJ, PLY, OFF or GLB instead"
        )
    if suffix not in SUFFIXES:
        raise MeshError(f"{path}: unknown extension {suffix!r}; supported are {', '.join(SUFFIXES)}")
    if not path.exists():
        raise FileNotFoundError(f"{path}: no such file")
    if not path.is_file():
        raise MeshError(f"{path}: not a file")
    try:
        if not path.stat().st_size:
            raise MeshError(f"{path}: the file is empty")
        asset = READERS[suffix](path)
    except MeshError:
        raise
    except Exception as error:  # Damaged files may raise any exception; the message names the file.
        reason = " ".join(str(error).split()) or type(error).__name__
        raise MeshError(f"{path}: cannot be read as {suffix[1:].upper()} ({reason[:200]})") from error
    vertices, faces = asset.positions, asset.faces
    if len(faces) == 0:
        what = f" (a point cloud of {len(vertices)} vertices)" if len(vertices) else ""
        raise MeshError(f"{path}: no faces in this file{what}; key-frames are surfaces of triangles")
    if faces.min() < 0 or faces.max() >= len(vertices):
        face = int(np.flatnonzero(((faces < 0) | (faces >= len(vertices))).any(axis=1))[0])
        raise MeshError(
            f"{path}: face {face} uses the vertices {faces[face].tolist()}, but the file has {len(vertices)} "
            f"vertices (counted from 0); the file is damaged"
        )
    return asset


def require_same_mesh(
    first: str | os.PathLike[str],
    vertices: FloatArray,
    faces: IntArray,
    other: str | os.PathLike[str],
    other_vertices: FloatArray,
    other_faces: IntArray,
) -> None:
    """Raise unless the vertices and faces of a file match those of the first."""
    hint = "all key-frames need the same vertices and faces, in the same vertex order"
    for what, mine, its in (("vertices", vertices, other_vertices), ("faces", faces, other_faces)):
        if len(mine) != len(its):
            raise MeshError(f"{other} has {len(its)} {what}, {first} has {len(mine)}; {hint}")
    if np.array_equal(faces, other_faces):
        return
    rows = np.sort(np.concatenate([faces, other_faces]), axis=1)
    _, ids = np.unique(rows, axis=0, return_inverse=True)
    mine, its = np.split(ids.reshape(-1), 2)
    strange, missing = (np.flatnonzero(~np.isin(some, others)) for some, others in ((its, mine), (mine, its)))
    if len(strange) or len(missing):
        # Of equally many faces, some may be strange, or missing, or both.
        file, rows, found, whole = (
            (other, other_faces, strange, first) if len(strange) else (first, faces, missing, other)
        )
        raise MeshError(
            f"face {found[0]} of {file}, vertices {rows[found[0]].tolist()}, is not in {whole} "
            f"({max(len(strange), len(missing))} of {len(faces)} faces differ); {hint}; polygons "
            "that start at another corner are cut along another diagonal, so export triangles"
        )
