"""Shapes and points drawn into images by matplotlib, in view coordinates, the cell centred at the origin."""

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torch_modal.arrays import FloatArray, IntArray
from torch_modal.geometry.vectors import vertex_normals

ByteArray = NDArray[np.uint8]

SMOOTH_FACES = 30_000  # drawn at least
LIGHTS = (((-2, 3, 4), 0.82), ((4, 1, 3), 0.30), ((0, -3, 2), 0.14))  # directions as the viewer sees them; brightness
OVERSAMPLING = 2  # drawn larger without antialiasing (which would show every seam), then averaged


def draw_shape(
    points: FloatArray, colors: FloatArray, faces: IntArray, half_size: FloatArray, pixels: IntArray
) -> ByteArray:
    """Faces from back to front, each in one shade. *Shape:* ``(V, 3), (V, 3), (F, 3) -> (height, width, 3)``.

    Args:
        points: Vertices.
        colors: RGB in [0, 1].
        faces: Vertex indices.
        half_size: Half width and half height of the cell.
        pixels: Width and height of the image.
    """
    from matplotlib.collections import PolyCollection

    lights = np.array([brightness / np.linalg.norm(place) * np.array(place) for place, brightness in LIGHTS])
    # Position, normal and colour of each corner of each face, in small enough faces to look smooth.
    corners = np.concatenate([points, vertex_normals(points, faces), colors], axis=1)[faces]
    while len(corners) < SMOOTH_FACES:  # each as four, cut at the middles of its sides
        a, b, c = corners.swapaxes(0, 1)
        ab, bc, ca = (a + b) / 2, (b + c) / 2, (c + a) / 2
        quarters = [(a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)]
        corners = np.concatenate([np.stack(quarter, axis=1) for quarter in quarters])
    middle = corners.mean(axis=1)
    normals = middle[:, 3:6] / np.maximum(np.linalg.norm(middle[:, 3:6], axis=1, keepdims=True), 1e-12)
    normals *= np.where(normals[:, 2:] < 0, -1.0, 1.0)  # open meshes show their inside too
    shade = 0.25 + 0.85 * np.clip(normals @ lights.T, 0, None).sum(axis=1)
    rim = 0.75 + 0.25 * np.clip(normals[:, 2], 0, 1) ** 0.5  # darker outlines separate what overlaps
    face_colors = np.clip(middle[:, 6:] * (shade * rim)[:, None], 0, 1)
    order = np.argsort(middle[:, 2], kind="stable")
    polygons = PolyCollection(
        list(corners[order, :, :2]), facecolors=face_colors[order], linewidths=0, antialiaseds=False
    )
    return _draw_axes(half_size, pixels, lambda axes: axes.add_collection(polygons))


def draw_points(points: FloatArray, color: tuple[float, ...], half_size: FloatArray, pixels: IntArray) -> ByteArray:
    """Dots, near ones darker and over far ones. *Shape:* ``(n, 3) -> (height, width, 3)``."""
    points = points[:: len(points) // 20_000 + 1]
    points = points[points[:, 2].argsort(kind="stable")]
    diameter = OVERSAMPLING * np.clip(120 / max(len(points), 1) ** 0.5, 3, 11)
    paint = 1 - np.linspace(0.4, 1, len(points))[:, None] * (1 - np.array(color))
    x, y = points[:, 0], points[:, 1]
    return _draw_axes(half_size, pixels, lambda axes: axes.scatter(x, y, diameter**2, paint, linewidths=0))


def _draw_axes(half_size: FloatArray, pixels: IntArray, add: Callable[[Any], object]) -> ByteArray:
    """Image of axes that fill it. *Shape:* ``(height, width, 3)``."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    (x, y), (width, height) = half_size, pixels.tolist()
    figure = Figure(figsize=(OVERSAMPLING * width / 72, OVERSAMPLING * height / 72), dpi=72)  # a point is a pixel
    canvas = FigureCanvasAgg(figure)
    axes = figure.add_axes((0, 0, 1, 1), xlim=(-x, x), ylim=(-y, y))
    axes.set_axis_off()
    add(axes)
    canvas.draw()
    image = np.asarray(canvas.buffer_rgba())[..., :3].astype(np.float64)
    blocks = image.reshape(height, OVERSAMPLING, width, OVERSAMPLING, 3)
    return blocks.mean(axis=(1, 3)).round().astype(np.uint8)
