"""Shapes drawn into images, by pyvista or by matplotlib.

pyvista renders in a child process, because it takes its process down (a segmentation fault, nothing to catch) where
neither EGL nor OSMesa exists; then matplotlib draws.
"""

import importlib.util
import logging
import tempfile
import warnings
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from torch_modal.arrays import FloatArray, IntArray
from torch_modal.geometry.vectors import vertex_normals
from torch_modal.modes.processes import package_command, run_child

logger = logging.getLogger("torch_modal")

ByteArray = NDArray[np.uint8]

CHILD_SECONDS = 300.0
DRAW_SCENE = "torch_modal.view.drawing:_draw_scene"  # runs in the child process
SMOOTH_FACES = 30_000  # matplotlib draws at least so many
LIGHTS = (((-2, 3, 4), 0.82), ((4, 1, 3), 0.30), ((0, -3, 2), 0.14))  # directions as the viewer sees them; brightness
SURFACE = {"ambient": 0.25, "diffuse": 0.85, "specular": 0.08, "specular_power": 12}


class Scene(NamedTuple):
    """Input of a renderer: all shapes in view coordinates, the cell centred at the origin."""

    points: FloatArray  # (S, V, 3)
    colors: ByteArray  # (S, V, 3) RGB
    faces: IntArray  # (F, 3)
    half_size: FloatArray  # (2,) half width and half height of the cell
    pixels: IntArray  # (2,) width and height of the image


def _draw_pyvista(scene: Scene) -> ByteArray:
    """Images by pyvista, ``(S, height, width, 3)``; runs in the child process only."""
    import pyvista as pv

    scale = 1.0 / float(scene.half_size[1])  # to half height 1: radii below are absolute
    corners = np.insert(scene.faces, 0, 3, axis=1)
    plotter: Any = pv.Plotter(off_screen=True, window_size=scene.pixels.tolist(), lighting="none")
    plotter.set_background("white")
    for position, intensity in LIGHTS:
        plotter.add_light(pv.Light(position=position, intensity=intensity, light_type="camera light"))
    plotter.enable_anti_aliasing("ssaa")
    plotter.enable_ssao(radius=0.25, bias=0.01, kernel_size=128, blur=True)
    plotter.enable_parallel_projection()
    depth = float(np.abs(scene.points[..., 2]).max()) * scale + 1.0
    camera = plotter.camera
    camera.position, camera.focal_point, camera.up = (0, 0, 2 * depth), (0, 0, 0), (0, 1, 0)
    camera.parallel_scale = 1.0
    images: list[ByteArray] = []
    for points, colors in zip(scene.points, scene.colors, strict=True):
        mesh = pv.PolyData(points * scale, corners.reshape(-1))
        mesh["rgb"] = colors
        mesh.point_data.active_normals = vertex_normals(points, scene.faces)
        actor = plotter.add_mesh(mesh, scalars="rgb", rgb=True, smooth_shading=True, reset_camera=False, **SURFACE)
        camera.clipping_range = (0.5 * depth, 3.5 * depth)
        images.append(plotter.screenshot(None, return_img=True))
        plotter.remove_actor(actor, reset_camera=False)
    plotter.close()
    return np.stack(images)[..., :3]


def _draw_matplotlib(scene: Scene) -> ByteArray:
    """Images by matplotlib, ``(S, height, width, 3)``: faces from back to front, each in one shade."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.collections import PolyCollection
    from matplotlib.figure import Figure

    over = 2  # drawn larger without antialiasing (which would show every seam), then averaged
    width, height = scene.pixels.tolist()
    lights = np.array([brightness / np.linalg.norm(place) * np.array(place) for place, brightness in LIGHTS])
    images = []
    for points, colors in zip(scene.points, scene.colors, strict=True):
        # Position, normal and colour of each corner of each face, in small enough faces to look smooth.
        corners = np.concatenate([points, vertex_normals(points, scene.faces), colors / 255], axis=1)[scene.faces]
        while len(corners) < SMOOTH_FACES:  # each as four, cut at the middles of its sides
            a, b, c = corners.swapaxes(0, 1)
            ab, bc, ca = (a + b) / 2, (b + c) / 2, (c + a) / 2
            quarters = [(a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)]
            corners = np.concatenate([np.stack(quarter, axis=1) for quarter in quarters])
        middle = corners.mean(axis=1)
        normals = middle[:, 3:6] / np.maximum(np.linalg.norm(middle[:, 3:6], axis=1, keepdims=True), 1e-12)
        normals *= np.where(normals[:, 2:] < 0, -1.0, 1.0)  # open meshes show their inside too
        shade = 0.25 + 0.85 * np.clip(normals @ lights.T, 0, None).sum(axis=1)
        rim = 0.75 + 0.25 * np.clip(normals[:, 2], 0, 1) ** 0.5  # darker outlines part what overlaps
        face_colors = middle[:, 6:] * (shade * rim)[:, None]
        order = np.argsort(middle[:, 2], kind="stable")
        figure = Figure(figsize=(width * over / 100, height * over / 100), dpi=100)
        canvas = FigureCanvasAgg(figure)
        x, y = scene.half_size
        axes = figure.add_axes((0, 0, 1, 1), xlim=(-x, x), ylim=(-y, y))
        axes.set_axis_off()
        polygons, paint = list(corners[order, :, :2]), np.clip(face_colors[order], 0, 1)
        axes.add_collection(PolyCollection(polygons, facecolors=paint, linewidths=0, antialiaseds=False))
        canvas.draw()
        pixels = np.asarray(canvas.buffer_rgba())[..., :3].astype(np.float64)
        images.append(pixels.reshape(height, over, width, over, 3).mean(axis=(1, 3)).round().astype(np.uint8))
    return np.stack(images)


def draw_points(points: FloatArray, color: tuple[float, ...], half_size: FloatArray, pixels: IntArray) -> ByteArray:
    """Dots in view coordinates, near ones darker and over far ones. *Shape:* ``(n, 3) -> (height, width, 3)``."""
    over, radius = 3, int(np.clip(180 / max(len(points), 1) ** 0.5, 4, 16))  # drawn larger, then averaged
    disc = np.argwhere(np.hypot(*np.mgrid[-radius : radius + 1, -radius : radius + 1]) <= radius) - radius
    points = points[:: len(points) // 20_000 + 1]
    points = points[points[:, 2].argsort(kind="stable")]
    centres = (points[:, :2] * [1, -1] / half_size + 1) / 2 * over * pixels
    places = (centres[:, None] + disc).reshape(-1, 2).round()
    inside = ((places >= 0) & (places < over * pixels)).all(axis=1)
    x, y = places[inside].astype(np.int64).T
    paint = 1 - np.linspace(0.4, 1, len(points))[:, None] * (1 - np.array(color))
    image = np.ones((over * pixels[1], over * pixels[0], 3))
    image[y, x] = np.repeat(paint, len(disc), axis=0)[inside]
    return (255 * image.reshape(pixels[1], over, pixels[0], over, 3).mean(axis=(1, 3))).round().astype(np.uint8)


def _draw_scene() -> None:
    """Draw the scene in the current folder, and write the images there; runs in the child process."""
    with np.load("scene.npz") as stored:
        scene = Scene(**{name: stored[name] for name in Scene._fields})
    np.save("images.npy", _draw_pyvista(scene))


def _draw_in_child(scene: Scene) -> ByteArray:
    """Images from pyvista in a child process; raises RuntimeError with the reason if it fails."""
    with tempfile.TemporaryDirectory(prefix="torch_modal-") as folder:
        np.savez(Path(folder, "scene.npz"), **scene._asdict())
        # The folder is the working directory so that a core file goes with it.
        run_child(package_command(DRAW_SCENE), Path(folder), CHILD_SECONDS)
        stored = Path(folder, "images.npy")
        if not stored.is_file():
            raise RuntimeError("it left no images")
        images: ByteArray = np.load(stored)
    if images.shape != (len(scene.points), scene.pixels[1], scene.pixels[0], 3) or (images == 255).all():
        raise RuntimeError(f"its images are empty, shape {images.shape}")
    return images


def draw(scene: Scene, renderer: str) -> ByteArray:
    """Images of all shapes, by ``"pyvista"``, ``"matplotlib"``, or ``"auto"``. *Shape:* ``(S, height, width, 3)``.

    Automatic is pyvista, and matplotlib where that is not installed or fails.
    """
    if renderer == "matplotlib":
        return _draw_matplotlib(scene)
    if importlib.util.find_spec("pyvista") is None:
        if renderer == "pyvista":
            raise RuntimeError(
                "pyvista is not installed: pip install torch_modal[pictures]; matplotlib draws without it"
            )
        logger.debug("matplotlib draws; pyvista draws better: pip install torch_modal[pictures]")
        return _draw_matplotlib(scene)
    try:
        return _draw_in_child(scene)
    except RuntimeError as error:
        if renderer == "pyvista":
            raise RuntimeError(f"pyvista could not render: {error}. renderer='matplotlib' needs no GL") from None
        warnings.warn(f"pyvista could not render ({error}); matplotlib draws the picture", stacklevel=3)
        return _draw_matplotlib(scene)
