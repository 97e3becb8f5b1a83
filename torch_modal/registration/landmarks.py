"""Landmarks: corresponding points of meshes, and their files."""

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from torch_modal.arrays import FloatArray, IntArray
from torch_modal.errors import MeshError
from torch_modal.io.write import to_numpy


def landmark_table(landmarks: Any, shapes: Sequence[FloatArray]) -> FloatArray:
    """Landmarks as points of all K meshes, from None, a file, vertices ``(n, K)`` or points. *Shape:* ``(n, K, 3)``.

    Raises:
        FileNotFoundError: There is no such file.
        MeshError: Landmarks do not match the meshes, or a vertex does not exist.
    """
    n, given = len(shapes), np.zeros(0) if landmarks is None else landmarks
    table: Any = read_landmarks(given, n) if isinstance(given, (str, os.PathLike)) else to_numpy(given)
    if table.size == 0:
        return np.zeros((0, n, 3))
    if table.ndim == 3 and table.shape[1:] == (n, 3) and table.dtype.kind in "iuf" and np.isfinite(table).all():
        return table.astype(np.float64)  # type: ignore[no-any-return]
    if table.ndim != 2 or table.shape[1] != n or table.dtype.kind not in "iu":
        raise MeshError(
            f"landmarks have shape {table.shape} and dtype {table.dtype}; for {n} meshes they are vertex numbers (n, "
            f"{n}) or finite points (n, {n}, 3)"
        )
    for k, (own, vertices) in enumerate(zip(table.T, shapes, strict=True)):
        wrong = np.flatnonzero((own < 0) | (own >= len(vertices)))
        if len(wrong):
            raise MeshError(
                f"landmark {wrong[0]} names vertex {own[wrong[0]]} of mesh {k}, which has {len(vertices)} vertices, "
                "both counted from 0"
            )
    return np.stack([vertices[own] for own, vertices in zip(table.T, shapes, strict=True)], axis=1)


def read_landmarks(path: str | os.PathLike[str], n_meshes: int) -> IntArray | FloatArray:
    """Read a landmark file: vertices ``(n, n_meshes)``, int64, or points ``(n, n_meshes, 3)``, float64.

    Each line of the text names one vertex of each mesh, counted from 0, or gives three coordinates for each; ``#``
    begins a comment.

    Raises:
        FileNotFoundError: There is no such file.
        MeshError: A line cannot be used.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file")
    rows: list[list[float]] = []
    for number, line in enumerate(path.read_text(errors="replace").splitlines(), 1):
        words = line.partition("#")[0].replace(",", " ").split()
        if not words:
            continue
        try:
            row = [float(word) for word in words]
        except ValueError:
            row = []
        if (
            not np.isfinite(row).all()
            or len(row) not in (n_meshes, 3 * n_meshes)
            or (rows and len(row) != len(rows[0]))
        ):
            raise MeshError(
                f"{path}, line {number}: {line.strip()[:60]!r} is no landmark for {n_meshes} meshes; each line holds "
                f"{n_meshes} vertex numbers, counted from 0, or {3 * n_meshes} coordinates, all lines alike"
            )
        if len(row) == n_meshes and any(value != int(value) or value < 0 for value in row):
            raise MeshError(
                f"{path}, line {number}: vertex numbers are whole and count from 0, got {line.strip()[:60]!r}"
            )
        rows.append(row)
    if not rows:
        raise MeshError(f"{path}: no landmarks in this file; write a line for each, with a vertex number for each mesh")
    table = np.array(rows)
    return table.astype(np.int64) if table.shape[1] == n_meshes else table.reshape(-1, n_meshes, 3)


def landmark_vertices(path: str | os.PathLike[str], shapes: Sequence[FloatArray]) -> IntArray:
    """Landmarks of a file as vertex indices; points give the nearest vertices. *Shape:* ``(n, K)``."""
    table: Any = read_landmarks(path, len(shapes))
    points = landmark_table(table, shapes)
    if table.ndim == 2:
        return np.asarray(table, dtype=np.int64)
    return np.stack([cKDTree(shape).query(points[:, k])[1] for k, shape in enumerate(shapes)], axis=1)
