"""Landmarks: corresponding points, their files, and suggestions."""

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from scipy.spatial import cKDTree

from torch_modal.arrays import FloatArray, IntArray
from torch_modal.errors import MeshError
from torch_modal.keyframes.check import check_keyframes
from torch_modal.registration.consistency import farthest_points
from torch_modal.registration.spectrum import SpectralShape
from torch_modal.registration.surface import referenced

N_SUGGESTED = 14
# A tip has the largest mean geodesic distance within this radius, for a surface of unit area.
_TIP_RADIUS = 0.12


class LandmarkPoints(NamedTuple):
    """Positions on both meshes, each in its own coordinates. *Shape of each:* ``(n, 3)``."""

    template: FloatArray
    target: FloatArray


def landmark_points(landmarks: Any, template: FloatArray, target: FloatArray) -> LandmarkPoints:
    """Landmarks of `register` as points.

    Args:
        landmarks: None, pairs of vertex indices ``(n, 2)``, or two arrays of points ``(n, 3)``.
        template: *Shape:* ``(V, 3)``.
        target: *Shape:* ``(V_target, 3)``.

    Raises:
        MeshError: The shapes are wrong, or a vertex does not exist.
    """
    if landmarks is None:
        return LandmarkPoints(np.zeros((0, 3)), np.zeros((0, 3)))
    if isinstance(landmarks, (tuple, list)) and len(landmarks) == 2 and all(np.ndim(part) == 2 for part in landmarks):
        here, there = (_array(part).astype(np.float64) for part in landmarks)
        if here.shape != there.shape or here.shape[1] != 3 or not np.isfinite([here, there]).all():
            raise MeshError(
                f"landmarks are arrays of shapes {here.shape} and {there.shape}; two arrays of finite points (n, 3) "
                "are needed, the template's and the target's"
            )
        return LandmarkPoints(here, there)
    pairs = _array(landmarks)
    if pairs.size == 0:
        return LandmarkPoints(np.zeros((0, 3)), np.zeros((0, 3)))
    if pairs.ndim != 2 or pairs.shape[1] != 2 or pairs.dtype.kind not in "iu":
        raise MeshError(
            f"landmarks have shape {pairs.shape} and dtype {pairs.dtype}; pairs of vertex indices (n, 2) are needed, "
            "template first, or two arrays of points (n, 3)"
        )
    return LandmarkPoints(
        vertices_named(pairs[:, 0], template, "the template"), vertices_named(pairs[:, 1], target, "the target")
    )


def vertices_named(numbers: IntArray, vertices: FloatArray, mesh: str) -> FloatArray:
    """Positions of numbered vertices. *Shape:* ``(n,), (V, 3) -> (n, 3)``.

    Raises:
        MeshError: A vertex does not exist; ``mesh`` is the name in the message.
    """
    wrong = np.flatnonzero((numbers < 0) | (numbers >= len(vertices)))
    if len(wrong):
        raise MeshError(
            f"landmark {wrong[0]} names vertex {numbers[wrong[0]]} of {mesh}, which has {len(vertices)} vertices, "
            "counted from 0"
        )
    return vertices[numbers]


def _array(values: Any) -> Any:
    return values.detach().cpu().numpy() if isinstance(values, torch.Tensor) else np.asarray(values)


def read_landmarks(path: str | os.PathLike[str], n_meshes: int) -> IntArray | FloatArray:
    """Read a landmark file: a line for each landmark, a column for each mesh; ``#`` begins a comment.

    Args:
        path: A text file. Each line names one vertex of each mesh, counted from 0, or gives three coordinates for each.
        n_meshes: How many meshes the landmarks are for.

    Returns:
        Vertices, int64, *shape* ``(n, n_meshes)``, or points, float64, *shape* ``(n, n_meshes, 3)``.

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
    """Landmarks of a file as vertex indices; points give the nearest vertices. *Shape:* ``(n, K)``.

    Args:
        path: As for `read_landmarks`.
        shapes: Vertices of the K meshes. *Shape of each:* ``(V, 3)``.

    Raises:
        FileNotFoundError: There is no such file.
        MeshError: A line cannot be used, or a mesh has no such vertex.
    """
    table: Any = read_landmarks(path, len(shapes))
    if table.ndim == 3:
        return np.stack([cKDTree(shape).query(table[:, k])[1] for k, shape in enumerate(shapes)], axis=1)
    for k, shape in enumerate(shapes):
        vertices_named(table[:, k], shape, f"mesh {k}")
    return np.asarray(table, dtype=np.int64)


def suggest_landmarks(vertices: Any, faces: Any, n: int = N_SUGGESTED) -> IntArray:
    """Suggest vertices that are easy to identify on another mesh: tips first, then farthest points.

    Tips are local maxima of the mean geodesic distance: the ends of limbs, ears, noses.

    Args:
        vertices: Vertex positions. *Shape:* ``(V, 3)``.
        faces: Vertex indices. *Shape:* ``(F, 3)``.
        n: Number of landmarks.

    Returns:
        Vertex indices. *Shape:* ``(n,)``, fewer on a mesh with fewer vertices.

    Raises:
        MeshError: The mesh cannot work.
        MissingPackageError: The extra ``register`` is not installed.
    """
    checked = check_keyframes([vertices], faces, warn=False)
    points = checked.keyframes[0].detach().cpu().double().numpy()
    surface, used = referenced(points, checked.faces.cpu().numpy())
    shape = SpectralShape(surface)
    _, to_samples = farthest_points(shape, 4 * n)
    eccentricity = to_samples.mean(1)
    near = shape.neighbourhoods(_TIP_RADIUS)
    highest = np.where(near, eccentricity, -np.inf).max(1)
    tips = np.flatnonzero(eccentricity >= highest)
    tips = tips[np.argsort(-eccentricity[tips])][:n]
    chosen, _ = farthest_points(shape, n, start=tips)
    fine = surface.nearest_alike(shape.positions[chosen], shape.coarse.vertex_normals[chosen])
    return used[fine]
