"""Observations from files: clouds, meshes as clouds, and tables of markers."""

import os
from collections.abc import Iterator, Sequence
from math import isfinite
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torch_modal.completion.observation import LEAST_POINTS, Observation
from torch_modal.errors import MeshError
from torch_modal.geometry.vectors import vertex_normals
from torch_modal.io.points import PointFile
from torch_modal.io.read import open_asset

COLUMNS = ("time", "vertex", "x", "y", "z")


def load_observations(
    paths: Sequence[str | os.PathLike[str]], n_vertices: int, times: Sequence[float] | None = None, **options: Any
) -> list[Observation]:
    """Read clouds (PLY), meshes as clouds of their vertices with normals, and markers (CSV): one for each file or time.

    Points without finite coordinates are left out. Files of markers name their columns, ``time,vertex,x,y,z``, in the
    first line. ``times`` are the times of the clouds in their order (default: 0, 1, 2, ...), ``options`` are ``noise``
    and ``view`` of :class:`torch_modal.Observation`. A ValueError names the file and what to do.
    """
    files, observations = [Path(path) for path in paths], []
    clouds = [file for file in files if file.suffix.lower() != ".csv"]
    when = list(range(len(clouds)) if times is None else times)
    if len(when) != len(clouds):
        what = f"{len(when)} times for {len(clouds)} clouds ({', '.join(map(str, clouds[:3]))}, ...)"
        raise ValueError(f"{what}: give one for each cloud or mesh, in their order; CSV files hold their own times")
    places = {name: options.pop(name) for name in ("view", "camera") if options.get(name) is not None}
    for name, rows in places.items():
        places[name] = rows.expand(len(clouds), 3) if rows.numel() == 3 else rows
        if len(places[name]) != len(clouds):
            raise ValueError(f"{name} has {len(rows)} rows for {len(clouds)} clouds: give one, or one for each")
    for file in files:
        if file in clouds:
            each = {name: rows[clouds.index(file)] for name, rows in places.items()}
            points, normals = _cloud(file)
            observations.append(Observation(when.pop(0), points, normals, **options, **each))
        else:
            observations += [Observation(t, x, vertices=i, **options) for t, i, x in _markers(file, n_vertices)]
    return observations


def _enough(points: Any, name: str) -> Tensor:
    if len(points) < LEAST_POINTS:
        raise MeshError(f"{name}: {len(points)} points; an observation needs {LEAST_POINTS} or more, so leave it out")
    return torch.as_tensor(points, dtype=torch.float64)


def _cloud(path: Path) -> tuple[Tensor, Tensor | None]:
    """Points and normals. *Shape:* ``(n, 3), (n, 3)``."""
    cloud = PointFile(path) if path.suffix.lower() == ".ply" else None
    if cloud is not None and not cloud.n_faces:
        normals = cloud.normals if cloud.normals.any() else cloud.normals[:, :0]  # zero for splats
        table = np.concatenate([cloud.positions, normals], axis=1)
    else:
        mesh = open_asset(path)
        table = np.concatenate([mesh.positions, vertex_normals(mesh.positions, mesh.faces)], axis=1)
        table = table[np.unique(mesh.faces)]
    points = _enough(table[np.isfinite(table).all(axis=1)], str(path))
    return points[:, :3], points[:, 3:] if points.shape[1] > 3 else None


def _markers(path: Path, n_vertices: int) -> Iterator[tuple[float, Tensor, Tensor]]:
    """Each time with its vertices and their places. *Shape:* ``(n,), (n, 3)``."""
    text = path.read_text(encoding="utf-8-sig", errors="replace")
    names, *rows = [[word.strip(" \"'").lower() for word in line.split(",")] for line in text.splitlines() or [""]]
    if not {*COLUMNS} <= {*names}:
        raise MeshError(f"{path}: the first line names the columns, {','.join(COLUMNS)}; got {','.join(names)[:80]!r}")
    seen: dict[float, list[list[float]]] = {}
    for number, row in enumerate(rows, 2):
        cells = dict(zip(names, row, strict=False))
        try:
            time, vertex, *place = (float(cells.get(name) or "nan") for name in COLUMNS)
        except ValueError as error:
            raise MeshError(f"{path}, line {number}: {error}; leave coordinates of lost markers empty") from None
        if all(map(isfinite, place)):
            if not (isfinite(time) and vertex.is_integer() and 0 <= vertex < n_vertices):
                what = f"{path}, line {number}: vertex {vertex:g} at the time {time:g}"
                raise MeshError(f"{what}; vertices are 0 to {n_vertices - 1} of the template, and times are finite")
            seen.setdefault(time, []).append([vertex, *place])
    for time, markers in seen.items() or [(0.0, [])]:
        table = _enough(markers, f"{path}, time {time:g}")
        yield time, table[:, 0].long(), table[:, 1:]
