"""Reading one mesh file, with its vertices in the order and number in which they stand there."""

import os
import re
from itertools import pairwise
from pathlib import Path

import numpy as np
import trimesh
from numpy.typing import NDArray

from torch_modal.errors import MeshError

SUFFIXES = (".obj", ".ply", ".off", ".glb", ".gltf")


def read_mesh(path: str | os.PathLike[str]) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Read one triangle mesh.

    Args:
        path: An OBJ, PLY, OFF, GLB or GLTF file. Polygons are cut into triangles.

    Returns:
        Vertices, *shape* ``(V, 3)``, in the file's units; faces, *shape* ``(F, 3)``.

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
        vertices, faces = _read_obj(path) if suffix == ".obj" else _read_with_trimesh(path)
    except MeshError:
        raise
    except Exception as error:  # A reader fed with garbage may raise anything; the file's name must not get lost.
        reason = " ".join(str(error).split()) or type(error).__name__
        raise MeshError(f"{path}: cannot be read as {suffix[1:].upper()} ({reason[:200]})") from error

    if len(faces) == 0:
        what = f" (a point cloud of {len(vertices)} vertices)" if len(vertices) else ""
        raise MeshError(f"{path}: no faces in this file{what}; key-frames are surfaces of triangles")
    if faces.min() < 0 or faces.max() >= len(vertices):
        face = int(np.flatnonzero(((faces < 0) | (faces >= len(vertices))).any(axis=1))[0])
        raise MeshError(
            f"{path}: face {face} uses the vertices {faces[face].tolist()}, but the file has {len(vertices)} "
            f"vertices (counted from 0); the file is damaged"
        )
    return vertices, faces


def require_same_mesh(
    first: str | os.PathLike[str],
    vertices: NDArray[np.float64],
    faces: NDArray[np.int64],
    other: str | os.PathLike[str],
    other_vertices: NDArray[np.float64],
    other_faces: NDArray[np.int64],
) -> None:
    """Refuse a file whose vertices or faces do not match those of the first."""
    hint = "all key-frames need the same vertices and faces, in the same vertex order"
    for what, mine, its in (("vertices", vertices, other_vertices), ("faces", faces, other_faces)):
        if len(mine) != len(its):
            raise MeshError(f"{other} has {len(its)} {what}, {first} has {len(mine)}; {hint}")
    if np.array_equal(faces, other_faces):
        return
    rows = np.sort(np.concatenate([faces, other_faces]), axis=1)
    _, ids = np.unique(rows, axis=0, return_inverse=True)
    mine, its = np.split(ids.reshape(-1), 2)
    strange = np.flatnonzero(~np.isin(its, mine))
    missing = np.flatnonzero(~np.isin(mine, its))
    if len(strange) or len(missing):
        # Equal numbers of faces: where something is strange or missing, its first place is shown.
        where = (
            f"face {strange[0]} of {other}, vertices {other_faces[strange[0]].tolist()}, is not in {first}"
            if len(strange)
            else f"face {missing[0]} of {first}, vertices {faces[missing[0]].tolist()}, is not in {other}"
        )
        raise MeshError(
            f"{where} ({max(len(strange), len(missing))} of {len(faces)} faces differ); {hint}; polygons "
            "that start at another corner are cut along another diagonal, so export triangles"
        )


def _read_with_trimesh(path: Path) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """PLY, OFF, GLB, GLTF; the transforms of a scene are applied and its meshes joined."""
    # Without process=False vertices are merged; with fix_texture a PLY is split at texture seams.
    options = {"fix_texture": False} if path.suffix.lower() == ".ply" else {}
    mesh = trimesh.load_mesh(path, process=False, maintain_order=True, **options)
    vertices = np.array(mesh.vertices, dtype=np.float64).reshape(-1, 3)
    faces = np.array(mesh.faces, dtype=np.int64).reshape(-1, 3)
    promised = _promised_counts(path)
    if promised and promised[1] and (len(vertices) != promised[0] or len(faces) < promised[1]):
        raise MeshError(
            f"{path}: the header promises {promised[0]} vertices and {promised[1]} faces, the file holds "
            f"{len(vertices)} and {len(faces)}; it was cut off or is damaged"
        )
    return vertices, faces


def _promised_counts(path: Path) -> tuple[int, int] | None:
    """Vertices and faces that the header of a PLY or OFF file announces; trimesh accepts cut-off files."""
    with path.open("rb") as file:
        head = file.read(1 << 16)
    if path.suffix.lower() == ".ply":
        head = head.partition(b"end_header")[0]
        found = [re.search(rb"^\s*element\s+%s\s+(\d+)" % name, head, re.M) for name in (b"vertex", b"face")]
        counts = [int(match.group(1)) if match else 0 for match in found]
    elif path.suffix.lower() == ".off":
        words = re.sub(rb"^\s*\w*OFF", b"", re.sub(rb"#[^\n]*", b"", head)).split()
        if not all(word.isdigit() for word in words[:2]):
            return None
        counts = [int(word) for word in words[:2]]
    else:
        return None
    return counts[0], counts[1]


def _read_obj(path: Path) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """The ``v`` lines as they are, the first index of each corner of the ``f`` lines.

    trimesh has no options for this: with texture coordinates it drops unused vertices and splits and reorders
    the rest at seams, and with several materials it repeats all vertices per material and reorders the faces.
    """
    vertices: list[list[float]] = []
    faces: list[tuple[int, int, int]] = []
    text = path.read_bytes().decode("utf-8", errors="replace").replace("\\\r\n", " ").replace("\\\n", " ")
    for line in text.splitlines():
        words = line.partition("#")[0].split()
        if not words:
            continue
        if words[0] == "v":
            if len(words) < 4:
                raise MeshError(f"{path}: vertex line with fewer than three numbers: {line.strip()[:60]!r}")
            vertices.append([float(word) for word in words[1:4]])
        elif words[0] == "f":
            corners = [int(word.partition("/")[0]) for word in words[1:]]
            if len(corners) < 3 or 0 in corners:
                raise MeshError(
                    f"{path}: face line with fewer than three corners or index 0 (OBJ counts from 1): "
                    f"{line.strip()[:60]!r}"
                )
            # Negative indices count back from the last vertex that was read so far.
            corners = [corner - 1 if corner > 0 else len(vertices) + corner for corner in corners]
            faces.extend((corners[0], b, c) for b, c in pairwise(corners[1:]))
    return np.array(vertices, dtype=np.float64).reshape(-1, 3), np.array(faces, dtype=np.int64).reshape(-1, 3)
