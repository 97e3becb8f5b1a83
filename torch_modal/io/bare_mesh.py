"""Positions and triangles alone as PLY, OBJ and OFF."""

from typing import Any

import numpy as np

from torch_modal.arrays import FloatArray, IntArray
from torch_modal.io.formats import mesh_format


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
