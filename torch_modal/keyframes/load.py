"""Key-frames from files."""

import os
from collections.abc import Sequence

import numpy as np
import torch

from torch_modal.errors import MeshError
from torch_modal.io.read import read_mesh, require_same_mesh
from torch_modal.keyframes.check import Keyframes


def load_keyframes(paths: Sequence[str | os.PathLike[str]]) -> Keyframes:
    """Read key-frames from OBJ, PLY, OFF, GLB or GLTF files.

    Vertices keep the order and number in which they stand in the files. Faces may differ between the files in
    their order, first corner and winding; those of the first file are used. What may be wrong with the
    meshes themselves is said by `check_keyframes`, which everything that takes key-frames calls.

    Args:
        paths: One file per key-frame, in the order of the sequence.

    Returns:
        Positions, float64, *shape* ``(K, V, 3)``, in the files' units; faces, int64, *shape* ``(F, 3)``.

    Raises:
        FileNotFoundError: A file does not exist.
        MeshError: A file cannot be read, or differs from the first in its number of vertices or in its faces.
    """
    if isinstance(paths, (str, bytes, os.PathLike)):
        raise MeshError(f"paths is one path, {os.fspath(paths)!r}; pass a list with one file per key-frame")
    paths = list(paths)
    if not paths:
        raise MeshError("paths is empty; pass one file per key-frame")
    vertices, faces = read_mesh(paths[0])
    shapes = [vertices]
    for path in paths[1:]:
        other_vertices, other_faces = read_mesh(path)
        require_same_mesh(paths[0], vertices, faces, path, other_vertices, other_faces)
        shapes.append(other_vertices)
    return Keyframes(torch.from_numpy(np.stack(shapes)), torch.from_numpy(faces))
