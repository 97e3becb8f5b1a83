"""Reading mesh files; the order and number of vertices stay."""

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from torch_modal.arrays import FloatArray, IntArray
from torch_modal.errors import MeshError, MissingPackageError
from torch_modal.io.asset import Asset
from torch_modal.io.gltf_asset import GltfAsset
from torch_modal.io.obj import ObjAsset
from torch_modal.io.ply import OffAsset, PlyAsset
from torch_modal.io.stl import StlAsset
from torch_modal.io.vtk import VtkAsset

READERS: dict[str, type[Asset]] = {
    ".obj": ObjAsset,
    ".ply": PlyAsset,
    ".off": OffAsset,
    ".glb": GltfAsset,
    ".gltf": GltfAsset,
    ".stl": StlAsset,
    ".vtk": VtkAsset,
    ".vtp": VtkAsset,
    ".vtu": VtkAsset,
}
SUFFIXES = tuple(READERS)
Mesh = tuple[FloatArray, IntArray]  # vertices and faces


@contextlib.contextmanager
def mesh_errors(problem: str) -> Iterator[None]:
    """Raise a MeshError of this problem for any exception, as damaged files may raise all kinds."""
    try:
        yield
    except (MeshError, MissingPackageError):
        raise
    except Exception as error:
        reason = " ".join(str(error).split()) or type(error).__name__
        raise MeshError(f"{problem} ({reason[:200]})") from error


def open_asset(path: str | os.PathLike[str]) -> Asset:
    """Read a mesh file with all its content.

    Args:
        path: An OBJ, PLY, OFF, GLB, GLTF, STL, VTK, VTP or VTU file; the last three need the extra ``vtk``.

    Returns:
        The asset: ``positions`` and ``faces`` are as from :func:`torch_modal.load_keyframes`;
        :func:`torch_modal.save_mesh` writes the same file with other positions.

    Raises:
        FileNotFoundError: There is no such file.
        MeshError: The file holds no mesh that can be read.
        MissingPackageError: The extra ``vtk`` is needed and not installed.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if not os.path.lexists(path):
        raise FileNotFoundError(f"{str(path)[:300]}: no such file or folder")
    if suffix not in READERS and not path.is_dir():
        raise MeshError(f"{path}: unknown extension {suffix!r}; supported are {', '.join(SUFFIXES)}")
    if not os.path.isfile(path):
        raise MeshError(f"{path}: not a file, or a link to none")
    with mesh_errors(f"{path}: cannot be read as {suffix[1:].upper()}"):
        if not path.stat().st_size:
            raise MeshError(f"{path}: the file is empty")
        asset = READERS[suffix](path)
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
    first: str | os.PathLike[str], mesh: Mesh, other: str | os.PathLike[str], other_mesh: Mesh
) -> None:
    """Raise a MeshError unless two files have equally many vertices and the same faces."""
    hint = "all key-frames need the same vertices and faces, in the same vertex order"
    if os.fspath(first).lower().endswith(".stl"):
        hint += "; STL files have no vertices, so that equal corners are merged: export OBJ or PLY, or register"
    for what, mine, its in zip(("vertices", "faces"), mesh, other_mesh, strict=True):
        if len(mine) != len(its):
            raise MeshError(f"{other} has {len(its)} {what}, {first} has {len(mine)}; {hint}")
    if np.array_equal(mesh[1], other_mesh[1]):
        return
    here, there = ({*map(frozenset, faces.tolist())} for _, faces in (mesh, other_mesh))
    if strange := here ^ there:
        raise MeshError(
            f"the face with the vertices {min(map(sorted, strange))} is in one of {first} and {other} only (so are "
            f"{len(strange)} faces); {hint}; polygons that start at another corner are cut along another diagonal, so "
            "export triangles"
        )
