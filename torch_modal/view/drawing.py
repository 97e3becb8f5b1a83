"""Shapes and points drawn by matplotlib into cells of a figure, in view coordinates, a cell centred at the origin."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from torch_modal.arrays import FloatArray, IntArray
from torch_modal.geometry.vectors import vertex_normals

ByteArray = NDArray[np.uint8]

DPI = 128  # a power of two: sizes in inches are exact
GAP = 12  # pixels between cells
LIGHTS = (((-2, 3, 4), 0.82), ((4, 1, 3), 0.30), ((0, -3, 2), 0.14))  # directions as the viewer sees them; brightness


def make_cells(n_rows: int, n_columns: int, half_size: FloatArray, pixels: IntArray) -> Any:
    """Blank axes ``(n_rows, n_columns)`` that fill a new figure.

    Args:
        n_rows: Number of rows.
        n_columns: Number of columns.
        half_size: Half width and half height of a cell.
        pixels: Width and height of a cell.
    """
    from matplotlib.figure import Figure

    (x, y), (width, height) = half_size, pixels.tolist()
    size = n_columns * (width + GAP) - GAP, n_rows * (height + GAP) - GAP
    figure = Figure(figsize=(size[0] / DPI, size[1] / DPI), dpi=DPI)
    layout = {"left": 0, "right": 1, "bottom": 0, "top": 1, "wspace": GAP / width, "hspace": GAP / height}
    limits = {"xlim": (-x, x), "ylim": (-y, y)}
    cells = figure.subplots(n_rows, n_columns, squeeze=False, subplot_kw=limits, gridspec_kw=layout)
    for cell in cells.flat:
        cell.set_axis_off()
    return cells


def draw_shape(cell: Any, points: FloatArray, colors: FloatArray, faces: IntArray) -> None:
    """Draw faces into a cell, from back to front. *Shape:* ``(V, 3), (V, 3), (F, 3)``; colours are RGB in [0, 1]."""
    from matplotlib.collections import TriMesh
    from matplotlib.tri import Triangulation

    lights = np.array([brightness / np.linalg.norm(place) * np.array(place) for place, brightness in LIGHTS])
    corners = points[faces]
    order = corners[..., 2].mean(axis=1).argsort(kind="stable")
    normals = vertex_normals(points, faces)[faces]
    normals *= np.where(normals[..., 2].sum(axis=1) < 0, -1.0, 1.0)[:, None, None]  # open meshes show their inside too
    shade = 0.25 + 0.85 * np.clip(normals @ lights.T, 0, None).sum(axis=2)
    rim = 0.75 + 0.25 * np.clip(normals[..., 2], 0, 1) ** 0.5  # darker outlines separate what overlaps
    paint = np.clip(colors[faces] * (shade * rim)[..., None], 0, 1)
    x, y, _ = corners[order].reshape(-1, 3).T
    triangles = Triangulation(x, y, np.arange(len(x)).reshape(-1, 3))
    cell.add_collection(TriMesh(triangles, facecolors=paint[order].reshape(-1, 3), rasterized=True))


def draw_points(cell: Any, points: FloatArray, color: tuple[float, ...]) -> None:
    """Draw dots into a cell, near ones darker and over far ones. *Shape:* ``(n, 3)``."""
    points = points[:: len(points) // 20_000 + 1]
    x, y, _ = points[points[:, 2].argsort(kind="stable")].T
    diameter = 72 / DPI * np.clip(120 / max(len(x), 1) ** 0.5, 3, 11)
    paint = 1 - np.linspace(0.4, 1, len(x))[:, None] * (1 - np.array(color))
    cell.scatter(x, y, diameter**2, paint, linewidths=0, rasterized=True)


def draw_image(
    points: FloatArray, colors: FloatArray, faces: IntArray, half_size: FloatArray, pixels: IntArray
) -> ByteArray:
    """Image of a shape alone. Arguments as above. *Shape:* ``(height, width, 3)``."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    ((cell,),) = make_cells(1, 1, half_size, pixels)
    draw_shape(cell, points, colors, faces)
    canvas = FigureCanvasAgg(cell.figure)
    canvas.draw()
    return np.array(canvas.buffer_rgba())[..., :3]
