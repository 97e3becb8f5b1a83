"""Key-frames from files."""

import os
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch

from torch_modal.errors import MeshError
from torch_modal.io.read import read_mesh, require_same_mesh
from torch_modal.keyframes.check import Keyframes
from torch_modal.progress import Progress


def load_keyframes(
    paths: Sequence[str | os.PathLike[str]],
    *,
    register: bool = False,
    landmarks: Any = None,
    same_subject: bool = True,
    cache_dir: str | os.PathLike[str] | None = None,
    cache: bool = True,
    progress: Progress = None,
    report: Callable[[str], None] = lambda line: None,
) -> Keyframes:
    """Read key-frames from OBJ, PLY, OFF, GLB or GLTF files.

    Vertices keep their order. Faces may differ between the files in order, first corner and winding; those of the first
    file are used. `check_keyframes` reports flaws of the meshes.

    With ``register``, the meshes may have any connectivity: the first one is registered to each, from its predecessor.
    A mesh with the connectivity of the first is not registered.

    Args:
        paths: One file per key-frame, in the order of the sequence.
        register: Whether to register meshes of another connectivity, see :func:`torch_modal.register`.
        landmarks: For the registration: a landmark file, vertices ``(n, K)``, or points ``(n, K, 3)``, a column for
            each of the K meshes.
        same_subject: Whether all are poses of one body; if not, five landmarks or more are needed.
        cache_dir: Folder of the cache; by default ``TORCH_MODAL_CACHE`` or the user's cache folder.
        cache: Whether registrations are kept on disk and found there.
        progress: Of the registration, see :data:`torch_modal.progress.Progress`.
        report: Called with a line about each registration.

    Returns:
        Positions, float64, *shape* ``(K, V, 3)``, in the files' units; faces, int64, *shape* ``(F, 3)``.

    Raises:
        FileNotFoundError: A file does not exist.
        MeshError: A file cannot be read, or differs from the first in its number of vertices or in its faces; or,
            with ``register``, a registration is doubtful.
        MissingPackageError: With ``register``, the extra of that name is not installed.
    """
    if isinstance(paths, (str, bytes, os.PathLike)):
        raise MeshError(f"paths is one path, {os.fspath(paths)!r}; pass a list with one file per key-frame")
    paths = list(paths)
    if not paths:
        raise MeshError("paths is empty; pass one file per key-frame")
    if register:
        from torch_modal.registration.sequence import register_files

        return register_files(
            paths,
            landmarks=landmarks,
            same_subject=same_subject,
            cache_dir=cache_dir,
            cache=cache,
            progress=progress,
            report=report,
        )
    if landmarks is not None:
        raise MeshError("landmarks are for registration; pass register=True too")
    vertices, faces = read_mesh(paths[0])
    shapes = [vertices]
    for path in paths[1:]:
        other_vertices, other_faces = read_mesh(path)
        require_same_mesh(paths[0], vertices, faces, path, other_vertices, other_faces)
        shapes.append(other_vertices)
    return Keyframes(torch.from_numpy(np.stack(shapes)), torch.from_numpy(faces))
