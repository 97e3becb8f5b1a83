"""A cube of twelve triangles, texts of mesh files, and the truth of a winding."""

from pathlib import Path

import numpy as np

CUBE = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], dtype=np.float64)
CUBE_FACES = np.concatenate(
    [
        [[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1]],
        [[2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3]],
    ]
)
TWO = np.stack([CUBE, CUBE * [1, 2, 1.5] + 0.1])


def obj(vertices, faces) -> str:
    lines = [f"v {x!r} {y!r} {z!r}" for x, y, z in np.asarray(vertices, dtype=float).tolist()]
    return "\n".join(lines + ["f " + " ".join(str(i + 1) for i in face) for face in faces]) + "\n"


def ply(vertices, faces, n_vertices=None, n_faces=None) -> str:
    header = (
        f"ply\nformat ascii 1.0\nelement vertex {n_vertices or len(vertices)}\nproperty double x\n"
        f"property double y\nproperty double z\nelement face {n_faces or len(faces)}\n"
        "property list uchar int vertex_indices\nend_header\n"
    )
    body = [" ".join(map(repr, v)) for v in np.asarray(vertices, dtype=float).tolist()]
    body += [" ".join(map(str, [len(face), *face])) for face in faces]
    return header + "\n".join(body) + "\n"


def write(path: Path, text: str | bytes) -> Path:
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return path


def edge_directions_oppose(faces) -> bool:
    """Independent truth of a closed, consistently wound mesh: every directed edge once, its reverse once."""
    directed = [(int(f[i]), int(f[(i + 1) % 3])) for f in faces for i in range(3)]
    return len(set(directed)) == len(directed) and all((b, a) in set(directed) for a, b in directed)
