"""Registration of a sequence of meshes, each from its predecessor."""

import os
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch

from torch_modal.arrays import FloatArray, IntArray
from torch_modal.errors import MeshError
from torch_modal.io.read import read_mesh, require_same_mesh
from torch_modal.keyframes.check import Keyframes
from torch_modal.registration.landmarks import read_landmarks, vertices_named
from torch_modal.registration.register import register

ADVICE = (
    "give landmarks, five or more: a text file with a line for each, which names one vertex of each mesh, counted from "
    "0 (--landmarks FILE, landmarks=...); `torch-modal view MESH MESH --landmarks` opens a page to pick them on"
)


def register_files(
    paths: Sequence[str | os.PathLike[str]],
    *,
    landmarks: Any = None,
    report: Callable[[str], None] = lambda line: None,
    **options: Any,
) -> Keyframes:
    """Read meshes and register the first one's connectivity to the others; see `load_keyframes`.

    Args:
        paths: A file for each mesh.
        landmarks: See `landmark_table`.
        report: Called with a line about each registration.
        **options: Further arguments of `register`.

    Raises:
        MeshError: A file cannot be read, landmarks do not fit the meshes, or a registration is doubtful.
    """
    meshes = [read_mesh(path) for path in paths]
    marks = landmark_table(landmarks, [vertices for vertices, _ in meshes])
    vertices, faces = meshes[0]
    shapes = [vertices]
    for k in range(1, len(meshes)):
        there, there_faces = meshes[k]
        if is_same_mesh(vertices, faces, there, there_faces):
            shapes.append(there)
            continue
        pair = None if marks is None else (marks[:, k - 1], marks[:, k])
        found = register(shapes[-1], faces, there, there_faces, landmarks=pair, **options)
        report(f"{os.fspath(paths[k])} registered from {os.fspath(paths[k - 1])}: {found.summary()}")
        if found.doubtful:
            raise MeshError(
                f"the registration of {os.fspath(paths[k])} from {os.fspath(paths[k - 1])} is doubtful: "
                f"{found.summary()}; {'; '.join(found.warnings)}. To help it, {ADVICE}"
            )
        shapes.append(found.positions.numpy())
    return Keyframes(torch.from_numpy(np.stack(shapes)), torch.from_numpy(faces))


def landmark_table(landmarks: Any, shapes: Sequence[FloatArray]) -> FloatArray | None:
    """Landmarks of all meshes as points. *Shape:* ``(n, K, 3)``.

    Args:
        landmarks: None, a landmark file, vertices ``(n, K)``, or points ``(n, K, 3)``.
        shapes: Vertices of the K meshes.

    Raises:
        MeshError: Landmarks do not match the meshes.
    """
    if landmarks is None:
        return None
    if isinstance(landmarks, (str, os.PathLike)):
        landmarks = read_landmarks(landmarks, len(shapes))
    table = landmarks.detach().cpu().numpy() if isinstance(landmarks, torch.Tensor) else np.asarray(landmarks)
    if table.ndim == 3 and table.shape[1:] == (len(shapes), 3):
        return table.astype(np.float64)
    if table.ndim != 2 or table.shape[1] != len(shapes) or table.dtype.kind not in "iu":
        raise MeshError(
            f"landmarks have shape {table.shape} and dtype {table.dtype}; for {len(shapes)} meshes they are vertex "
            f"numbers (n, {len(shapes)}) or points (n, {len(shapes)}, 3)"
        )
    return np.stack([vertices_named(table[:, k], shape, f"mesh {k}") for k, shape in enumerate(shapes)], axis=1)


def is_same_mesh(vertices: FloatArray, faces: IntArray, others: FloatArray, other_faces: IntArray) -> bool:
    """Whether two meshes have the same connectivity."""
    try:
        require_same_mesh("", vertices, faces, "", others, other_faces)
    except MeshError:
        return False
    return True
