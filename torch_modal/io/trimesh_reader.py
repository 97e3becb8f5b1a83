"""Positions and triangles of PLY and OFF files, by trimesh."""

from pathlib import Path

import numpy as np
import trimesh

from torch_modal.arrays import FloatArray, IntArray
from torch_modal.errors import MeshError


def read_triangles(path: Path, n_vertices: int, n_faces: int) -> tuple[FloatArray, IntArray]:
    """Vertices ``(V, 3)`` as they stand in the file, faces ``(F, 3)``.

    Args:
        path: The file.
        n_vertices: From its header.
        n_faces: From its header, polygons included; 0 if unknown.

    Raises:
        MeshError: The file was cut off, which trimesh accepts.
    """
    # Without process=False vertices are merged; with fix_texture a PLY is split at texture seams.
    options = {"fix_texture": False} if path.suffix.lower() == ".ply" else {}
    mesh = trimesh.load_mesh(path, process=False, maintain_order=True, **options)
    vertices = np.array(mesh.vertices, dtype=np.float64).reshape(-1, 3)
    faces = np.array(mesh.faces, dtype=np.int64).reshape(-1, 3)
    if n_faces and (len(vertices) != n_vertices or len(faces) < n_faces):
        raise MeshError(
            f"{path}: the header promises {n_vertices} vertices and {n_faces} faces, the file holds {len(vertices)} "
            f"and {len(faces)}; it was cut off or is damaged"
        )
    return vertices, faces
