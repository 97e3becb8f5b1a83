"""Landmarks: corresponding points of meshes, and their files."""

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from scipy.spatial import cKDTree

from torch_modal.arrays import ArrayLike, FloatArray, IntArray
from torch_modal.errors import MeshError
from torch_modal.io.write import to_numpy

Landmarks: TypeAlias = "ArrayLike | str | os.PathLike[str] | None"
"""None, a file, vertices ``(n, K)`` or points ``(n, K, 3)``."""


def landmark_table(landmarks: Landmarks, shapes: Sequence[FloatArray]) -> FloatArray:
    """Landmarks as points of all K meshes, from None, a file, vertices ``(n, K)`` or points. *Shape:* ``(n, K, 3)``.

    Raises:
        FileNotFoundError: There is no such file.
        MeshError: Landmarks do not match the meshes, or a vertex does not exist.
    """
    n = len(shapes)
    table: Any = np.zeros(0)
    if isinstance(landmarks, (str, os.PathLike)):
        table = read_landmarks(landmarks, n)
    elif landmarks is not None:
        table = to_numpy(landmarks)
    if table.size == 0:
        return np.zeros((0, n, 3))
    if table.ndim == 3 and table.shape[1:] == (n, 3) and table.dtype.kind in "iuf" and np.isfinite(table).all():
        return table.astype(np.float64)  # type: ignore[no-any-return]
    if table.ndim != 2 or table.shape[1] != n or table.dtype.kind not in "iu":
        raise MeshError(
            f"landmarks have shape {table.shape} and dtype {table.dtype}; for {n} meshes they are vertex numbers (n, "
            f"{n}) or finite points (n, {n}, 3)"
        )
    for i, k in np.argwhere((table < 0) | (table >= [len(vertices) for vertices in shapes])):
        raise MeshError(
            f"landmark {i} names vertex {table[i, k]} of mesh {k}, which has {len(shapes[k])} vertices, both counted "
            "from 0"
        )
    return np.stack([vertices[column] for column, vertices in zip(table.T, shapes, strict=True)], axis=1)


def read_landmarks(path: str | os.PathLike[str], n_meshes: int) -> IntArray | FloatArray:
    """Read a landmark file: vertices ``(n, n_meshes)``, int64, or points ``(n, n_meshes, 3)``, float64.

    Each line of the text names one vertex of each mesh, counted from 0, or gives three coordinates for each; ``#``
    begins a comment.

    Raises:
        FileNotFoundError: There is no such file.
        MeshError: A line cannot be used.
    """
    rows: list[list[float]] = []
    for number, line in enumerate(Path(path).read_text(errors="replace").splitlines(), 1):
        words = line.partition("#")[0].replace(",", " ").split()
        if not words:
            continue
        try:
            row = [float(word) for word in words]
        except ValueError:
            row = []
        named = len(row) == n_meshes and all(value.is_integer() and value >= 0 for value in row)
        placed = len(row) == 3 * n_meshes and np.isfinite(row).all()
        if not (named or placed) or (rows and len(row) != len(rows[0])):
            raise MeshError(
                f"{path}, line {number}: {line.strip()[:60]!r} is no landmark for {n_meshes} meshes; each line holds "
                f"{n_meshes} vertex numbers, which count from 0, or {3 * n_meshes} coordinates, all lines alike"
            )
        rows.append(row)
    if not rows:
        raise MeshError(f"{path}: no landmarks in this file; write a line for each, with a vertex number for each mesh")
    table = np.array(rows)
    return table.astype(np.int64) if table.shape[1] == n_meshes else table.reshape(-1, n_meshes, 3)


def landmark_vertices(path: str | os.PathLike[str], shapes: Sequence[FloatArray]) -> IntArray:
    """Vertices nearest to the landmarks of a file. *Shape:* ``(n, K)``."""
    points = landmark_table(path, shapes)
    return np.stack([cKDTree(shape).query(points[:, k])[1] for k, shape in enumerate(shapes)], axis=1)
