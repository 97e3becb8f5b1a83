"""Positions and triangles alone: read from PLY and OFF by trimesh, written as PLY, OBJ and OFF."""

from pathlib import Path
from typing import Any

import numpy as np

from torch_modal.arrays import FloatArray, IntArray
from torch_modal.errors import MeshError
from torch_modal.io.formats import mesh_format


def read_triangles(path: Path, n_vertices: int, n_faces: int) -> tuple[FloatArray, IntArray]:
    """Vertices ``(V, 3)`` as they stand in the file, faces ``(F, 3)``.

    Args:
        path: The file.
        n_vertices: From its header.
        n_faces: From its header, polygons included; 0 if unknown.

    Raises:
        MeshError: The file was cut off, which trimesh accepts.
    """
    import trimesh

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


@mesh_format(".ply")
def ply_bytes(vertices: FloatArray, faces: IntArray, asset: Any = None) -> bytes:
    """Binary, float32."""
    header = (
        "ply\nformat binary_little_endian 1.0\n"
        f"element vertex {len(vertices)}\nproperty float x\nproperty float y\nproperty float z\n"
        f"element face {len(faces)}\nproperty list uchar int vertex_indices\nend_header\n"
    )
    rows = np.empty(len(faces), dtype=[("count", "u1"), ("corners", "<i4", 3)])
    rows["count"], rows["corners"] = 3, faces
    return header.encode("ascii") + vertices.astype("<f4").tobytes() + rows.tobytes()


# In both text formats repr() gives the fewest digits that read back as the same float64.
@mesh_format(".obj")
def obj_bytes(vertices: FloatArray, faces: IntArray, asset: Any = None) -> bytes:
    """Text, float64."""
    points = "".join(f"v {x!r} {y!r} {z!r}\n" for x, y, z in vertices.tolist())
    return (points + "".join(f"f {a} {b} {c}\n" for a, b, c in (faces + 1).tolist())).encode("ascii")


@mesh_format(".off")
def off_bytes(vertices: FloatArray, faces: IntArray, asset: Any = None) -> bytes:
    """Text, float64."""
    points = "".join(f"{x!r} {y!r} {z!r}\n" for x, y, z in vertices.tolist())
    triangles = "".join(f"3 {a} {b} {c}\n" for a, b, c in faces.tolist())
    return f"OFF\n{len(vertices)} {len(faces)} 0\n{points}{triangles}".encode("ascii")
