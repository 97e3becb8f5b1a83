"""Positions and triangles of PLY and OFF files, by trimesh."""

import re
from pathlib import Path

import numpy as np
import trimesh
from numpy.typing import NDArray

from torch_modal.errors import MeshError


def read_triangles(path: Path) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Vertices ``(V, 3)`` as they stand in the file, faces ``(F, 3)``.

    Raises:
        MeshError: The file was cut off.
    """
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
