"""Shapes and points drawn by matplotlib into cells of a figure, in view coordinates, a cell centred at the origin."""

from __future__ import annotations

import io
import warnings
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from torch_modal.arrays import FloatArray, IntArray
from torch_modal.errors import MeshWarning
from torch_modal.geometry.vectors import vertex_normals
from torch_modal.io.asset import Asset, linear_rgba

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from PIL import Image

ByteArray = NDArray[np.uint8]

DPI = 128  # a power of two: sizes in inches are exact
GAP = 12  # pixels between cells
LIGHTS = (((-2, 3, 4), 0.82), ((4, 1, 3), 0.30), ((0, -3, 2), 0.14))  # directions as the viewer sees them; brightness


class PaintedFaces(NamedTuple):
    """Triangles, cut into pieces of equal size, and colours to draw them with, RGB in [0, 1]."""

    faces: IntArray
    """*Shape:* ``(F, 3)``."""
    pieces: FloatArray
    """Barycentric coordinates of the corners of each piece of a face. *Shape:* ``(P, 3, 3)``."""
    colors: FloatArray
    """Of the corners of all pieces. *Shape:* ``(F P, 3, 3)``."""

    def interpolate(self, numbers: FloatArray) -> FloatArray:
        """Numbers of the vertices, at the corners of all pieces. *Shape:* ``(V, n) -> (F P, 3, n)``."""
        return _interpolate(self.pieces, numbers[self.faces])


def plain(colors: FloatArray, faces: IntArray) -> PaintedFaces:
    """Whole faces with colours of their vertices. *Shape:* ``(V, 3), (F, 3)``."""
    return PaintedFaces(faces, np.eye(3)[None], colors[faces])


def textured(asset: Asset, n: int) -> PaintedFaces:
    """Faces with the materials, textures and vertex colours of a file; each is cut into ``n²`` pieces."""
    at = [np.array([(i, j), (i + 1, j), (i, j + 1)]) for i in range(n) for j in range(n - i)]
    at += [np.array([(i, j + 1), (i + 1, j), (i + 1, j + 1)]) for i in range(n) for j in range(n - 1 - i)]
    steps = np.array(at) / n
    pieces = np.concatenate([1 - steps.sum(-1, keepdims=True), steps], -1)
    faces, colors = [], []
    for part in asset.parts():
        faces.append(part.vertices[part.triangles])
        paint = np.broadcast_to(np.array(part.material.color[:3]), (len(part.triangles) * len(pieces), 3, 3))
        if part.colors is not None:
            paint = paint * _interpolate(pieces, part.colors[part.triangles, :3])
        if part.material.texture is not None and part.texcoords is not None:
            picture = np.asarray(open_texture(part.material.name, part.material.texture).convert("RGB")) / 255
            places = _interpolate(pieces, part.texcoords[part.triangles]) % 1 * picture.shape[1::-1]
            x, y = np.moveaxis(places.astype(np.int64), -1, 0)
            texels = picture[np.minimum(y, len(picture) - 1), np.minimum(x, picture.shape[1] - 1)]
            paint = paint * linear_rgba(texels.reshape(-1, 3))[:, :3].reshape(texels.shape)
        colors.append(np.where(paint <= 0.0031308, 12.92 * paint, 1.055 * paint ** (1 / 2.4) - 0.055))
    return PaintedFaces(np.concatenate(faces), pieces, np.concatenate(colors))


def open_texture(name: str, texture: bytes) -> Image.Image:
    """Picture of the texture of a material; one white pixel, with a warning, if it cannot be read."""
    from PIL import Image

    try:
        picture = Image.open(io.BytesIO(texture))
        picture.load()
    except Exception as error:  # damaged pictures may raise any exception
        warnings.warn(f"the texture of {name!r} cannot be read, and is white: {error}", MeshWarning, stacklevel=6)
        return Image.new("RGB", (1, 1), "white")
    return picture


def _interpolate(pieces: FloatArray, corners: FloatArray) -> FloatArray:
    """*Shape:* ``(P, 3, 3), (F, 3, n) -> (F P, 3, n)``."""
    return np.einsum("pcb,fbn->fpcn", pieces, corners).reshape(-1, 3, corners.shape[-1])


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


def draw_shape(cell: Axes, points: FloatArray, surface: PaintedFaces) -> None:
    """Draw a surface with its vertices at points into a cell, from back to front. *Shape:* ``(V, 3)``."""
    from matplotlib.collections import TriMesh
    from matplotlib.tri import Triangulation

    lights = np.array([brightness / np.linalg.norm(place) * np.array(place) for place, brightness in LIGHTS])
    corners = surface.interpolate(points)
    order = corners[..., 2].mean(axis=1).argsort(kind="stable")
    normals = surface.interpolate(vertex_normals(points, surface.faces))
    normals *= np.where(normals[..., 2].sum(axis=1) < 0, -1.0, 1.0)[:, None, None]  # open meshes show their inside too
    shade = 0.25 + 0.85 * np.clip(normals @ lights.T, 0, None).sum(axis=2)
    rim = 0.75 + 0.25 * np.clip(normals[..., 2], 0, 1) ** 0.5  # darker outlines separate what overlaps
    paint = np.clip(surface.colors * (shade * rim)[..., None], 0, 1)
    x, y, _ = corners[order].reshape(-1, 3).T
    triangles = Triangulation(x, y, np.arange(len(x)).reshape(-1, 3))
    cell.add_collection(TriMesh(triangles, facecolors=paint[order].reshape(-1, 3), rasterized=True))


def draw_points(cell: Axes, points: FloatArray, color: tuple[float, ...]) -> None:
    """Draw dots into a cell, near ones darker and over far ones. *Shape:* ``(n, 3)``."""
    points = points[:: len(points) // 20_000 + 1]
    x, y, _ = points[points[:, 2].argsort(kind="stable")].T
    diameter = 72 / DPI * np.clip(120 / max(len(x), 1) ** 0.5, 3, 11)
    paint = 1 - np.linspace(0.4, 1, len(x))[:, None] * (1 - np.array(color))
    cell.scatter(x, y, diameter**2, paint, linewidths=0, rasterized=True)


def draw_image(points: FloatArray, surface: PaintedFaces, half_size: FloatArray, pixels: IntArray) -> ByteArray:
    """Image of a shape alone. Arguments as above. *Shape:* ``(height, width, 3)``."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    ((cell,),) = make_cells(1, 1, half_size, pixels)
    draw_shape(cell, points, surface)
    canvas = FigureCanvasAgg(cell.figure)
    canvas.draw()
    return np.array(canvas.buffer_rgba())[..., :3]
