"""A picture of meshes with numbered vertices, from which a person types landmarks."""

from __future__ import annotations

import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np

from torch_modal.arrays import FloatArray, IntArray
from torch_modal.io.files import write_file
from torch_modal.io.formats import PICTURES
from torch_modal.io.write import check_suffix, refuse_existing
from torch_modal.view.drawing import ByteArray, Scene, draw
from torch_modal.view.picture import BETWEEN_COLOR, KEYFRAME_COLOR, view_rotation

PIXELS = 700  # the longer side of a view
MARKER = (0.85, 0.0, 0.35)
_MARKER_SIZE = 0.012  # of the larger half of a view
_LABEL_ROOM = 0.14  # beside the mesh, of its larger half
_SIDES = (0.0, 180.0)  # degrees about the upright axis


class MarkedMesh(NamedTuple):
    """A mesh and vertices of it that are to be numbered."""

    label: str
    vertices: FloatArray
    faces: IntArray
    marked: IntArray


def render_landmarks(
    meshes: Sequence[MarkedMesh],
    out: str | Path,
    renderer: Literal["auto", "pyvista", "matplotlib"] = "auto",
    overwrite: bool = False,
) -> Path:
    """Draw each mesh from two sides, with the numbers of vertices beside those that are seen.

    Args:
        meshes: A row of the picture each.
        out: File to write, ``*.png`` or ``*.pdf``.
        renderer: As for :func:`~torch_modal.view.picture.render_sequence`.
        overwrite: Replace the file if it exists.

    Returns:
        The file.

    Raises:
        ValueError: The file has another extension.
        FileExistsError: The file exists and ``overwrite`` is off.
    """
    path = Path(out)
    fmt = check_suffix(path, PICTURES)[1:]
    refuse_existing(path, overwrite)
    write_file(path, _sheet([(mesh, _views(mesh, renderer)) for mesh in meshes], fmt))
    return path


def _views(mesh: MarkedMesh, renderer: str) -> list[tuple[ByteArray, IntArray, FloatArray]]:
    """For each side: the image, the vertices that are seen, and their pixels."""
    rotation = view_rotation(mesh.vertices, None, None)
    turned = []
    for degrees in _SIDES:
        c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
        points = mesh.vertices @ rotation.T @ np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]]).T
        turned.append(points - 0.5 * (points.min(0) + points.max(0)))
    half = np.max([np.abs(points[:, :2]).max(0) for points in turned], axis=0)
    half = half + _LABEL_ROOM * half.max()
    half = np.maximum(half, 0.3 * half.max())
    pixels = np.maximum((PIXELS * half / half.max()).round(), 1).astype(np.int64)

    size = _MARKER_SIZE * half.max()
    octahedron = np.concatenate([np.eye(3), -np.eye(3)]) * size
    sides = [[0, 1, 2], [1, 3, 2], [3, 4, 2], [4, 0, 2], [1, 0, 5], [3, 1, 5], [4, 3, 5], [0, 4, 5]]
    faces, colors = [mesh.faces], [np.tile(BETWEEN_COLOR, (len(mesh.vertices), 1))]
    shapes = [[points] for points in turned]
    for number, vertex in enumerate(mesh.marked):
        faces.append(np.array(sides) + len(mesh.vertices) + 6 * number)
        colors.append(np.tile(MARKER, (6, 1)))
        for points, parts in zip(turned, shapes, strict=True):
            parts.append(points[vertex] + octahedron)
    paint = (255 * np.concatenate(colors)).round().astype(np.uint8)
    scene = Scene(
        np.stack([np.concatenate(parts) for parts in shapes]),
        np.stack([paint] * len(turned)),
        np.concatenate(faces),
        half,
        pixels,
    )
    images = draw(scene, renderer)
    found = []
    for image, points in zip(images, turned, strict=True):
        places = (points[mesh.marked][:, :2] / half * [1, -1] + 1) / 2 * pixels
        seen = _is_marker(image, places)
        found.append((image, mesh.marked[seen], places[seen]))
    return found


def _is_marker(image: ByteArray, places: FloatArray) -> Any:
    """Whether the marker's colour shows at the pixels: nothing lies before it."""
    column, row = np.clip(places.round().astype(int), 0, np.array(image.shape[1::-1]) - 1).T
    red, green, _ = image[row, column].astype(int).T
    return red > green + 60


def _sheet(rows: list[tuple[MarkedMesh, list[tuple[ByteArray, IntArray, FloatArray]]]], fmt: str) -> bytes:
    """Rows of views with their numbers, on white paper."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    dpi, title = 100, 40
    widths = [sum(image.shape[1] for image, _, _ in views) for _, views in rows]
    heights = [views[0][0].shape[0] + title for _, views in rows]
    total = np.array([max(widths), sum(heights)], dtype=float)
    figure = Figure(figsize=tuple(total / dpi), dpi=dpi, facecolor="white")
    FigureCanvasAgg(figure)
    top = 0.0
    for mesh, views in rows:
        figure.text(0.01, 1 - (top + 0.5 * title) / total[1], mesh.label, fontsize=13, va="center", color="#333333")
        left = 0.0
        for image, numbers, places in views:
            height, width = image.shape[:2]
            axes = figure.add_axes(
                (left / total[0], 1 - (top + title + height) / total[1], width / total[0], height / total[1])
            )
            axes.imshow(image, aspect="auto", interpolation="none")
            axes.set_axis_off()
            for number, (x, y) in zip(numbers, places, strict=True):
                axes.text(
                    x + 9,
                    y - 9,
                    str(number),
                    fontsize=10,
                    color="black",
                    bbox={"boxstyle": "round,pad=0.15", "fc": "white", "ec": KEYFRAME_COLOR, "alpha": 0.85},
                    clip_on=False,
                )
            left += width
        top += title + views[0][0].shape[0]
    stream = io.BytesIO()
    figure.savefig(stream, format=fmt, dpi=dpi)
    return stream.getvalue()
