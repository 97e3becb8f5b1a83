"""A picture that compares rows of shapes: one row a method, one column a time.

The parent turns all shapes into view coordinates (x right, y up, z to the viewer), a renderer draws each into
an image of its own, the parent sets the sheet. pyvista renders in a child process, because it takes its
process down (a segmentation fault, nothing to catch) where neither EGL nor OSMesa exists; then matplotlib
draws.
"""

from __future__ import annotations

import io
import subprocess
import sys
import tempfile
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from torch_modal.export import (
    FloatArray,
    IntArray,
    check_frames,
    check_indices,
    refuse_existing,
    to_numpy,
    vertex_normals,
    write_file,
)

if TYPE_CHECKING:
    from torch_modal.export import Array

__all__ = ["render_sequence"]

ByteArray = NDArray[np.uint8]

KEYFRAME_COLOR = (0.91, 0.60, 0.36)  # warm: given
BETWEEN_COLOR = (0.62, 0.71, 0.82)  # cool: computed
ERROR_COLORS = ["#e4e4e2", "#f6c9a0", "#e8804f", "#b2182b", "#5c0a20"]
CHILD_SECONDS = 300.0
CELL_PIXELS = 420  # the longer side of a cell
SMOOTH_FACES = 30_000  # matplotlib draws at least so many
LIGHTS = (
    ((-2, 3, 4), 0.82),
    ((4, 1, 3), 0.30),
    ((0, -3, 2), 0.14),
)  # from where, as the viewer sees it; how bright
MARGIN = 1.06  # of a cell against the largest shape in it


class Scene(NamedTuple):
    """What a renderer gets: all shapes in view coordinates, the cell centred at the origin."""

    points: FloatArray  # (S, V, 3)
    colors: ByteArray  # (S, V, 3) RGB
    faces: IntArray  # (F, 3)
    half_size: FloatArray  # (2,) half width and half height of the cell
    pixels: IntArray  # (2,) width and height of the image


def _view_rotation(shape: FloatArray, view: tuple[float, float] | None, up: Literal["y", "z"] | None) -> FloatArray:
    """Rows are the directions right, up and to the viewer. *Shape:* ``(3, 3)``.

    Y is up unless the shape is flat in Y (less than half of both other extents): then Z. Without a ``view``
    the viewer stands where the least principal direction points, and so sees the widest side, a little from
    the side and from above so that depth shows.
    """
    extent = np.ptp(shape, axis=0)
    if up is None:
        up = "z" if extent[1] < 0.5 * min(extent[0], extent[2]) else "y"
    # Columns: the directions of azimuth 0 and 90 degrees, and up. Front is +Z where Y is up, -Y where Z is.
    world = np.array([[0, 0, 1], [1, 0, 0], [0, 1, 0]] if up == "y" else [[0, -1, 0], [1, 0, 0], [0, 0, 1]]).T
    if view is None:
        least = np.linalg.eigh(np.cov(shape.T, bias=True))[1][:, 0] @ world
        least *= 1.0 if least[0] >= 0 else -1.0
        azimuth = np.degrees(np.arctan2(least[1], least[0])) + 20.0
        elevation = np.clip(np.degrees(np.arcsin(np.clip(least[2], -1, 1))), -35.0, 35.0) + 10.0
    else:
        azimuth, elevation = view
    a, e = np.radians([azimuth, elevation])
    front = world @ [np.cos(a) * np.cos(e), np.sin(a) * np.cos(e), np.sin(e)]
    right = world @ [-np.sin(a), np.cos(a), 0.0]
    return np.stack([right, np.cross(front, right), front])


def _centred(points: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Move shapes ``(R, C, V, 3)`` into their cells; also the half width and height that hold them all.

    One centre serves all cells, so that what rests stays at its place and rows can be compared. Where the
    shapes lie further apart than their own size, each column gets a centre, and if need be each shape.
    """
    own = np.ptp(points, axis=2).max(axis=(0, 1))
    for together in ((0, 1, 2), (0, 2), (2,)):
        low, high = points.min(axis=together, keepdims=True), points.max(axis=together, keepdims=True)
        size = (high - low).max(axis=(0, 1, 2))
        if (size[:2] <= 1.4 * own[:2]).all():
            break
    half = 0.5 * size[:2] * MARGIN
    # Neither needles nor points: labels need some width.
    half = np.maximum(half, max(0.4 * float(half.max()), np.finfo(np.float64).tiny))
    return points - 0.5 * (low + high), half


def _draw_pyvista(scene: Scene) -> ByteArray:
    """Images ``(S, height, width, 3)``. Runs in the child only."""
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
    plotter.camera.position, plotter.camera.focal_point, plotter.camera.up = (
        (0, 0, 2 * depth),
        (0, 0, 0),
        (0, 1, 0),
    )
    plotter.camera.parallel_scale = 1.0
    plotter.camera.clipping_range = (0.5 * depth, 3.5 * depth)
    images: list[ByteArray] = []
    for points, colors in zip(scene.points, scene.colors, strict=True):
        mesh = pv.PolyData(points * scale, corners.reshape(-1))
        mesh["rgb"] = colors
        mesh.point_data.active_normals = vertex_normals(points, scene.faces)
        actor = plotter.add_mesh(
            mesh,
            scalars="rgb",
            rgb=True,
            smooth_shading=True,
            ambient=0.25,
            diffuse=0.85,
            specular=0.08,
            specular_power=12,
            reset_camera=False,
        )
        plotter.camera.clipping_range = (0.5 * depth, 3.5 * depth)
        images.append(plotter.screenshot(None, return_img=True))
        plotter.remove_actor(actor, reset_camera=False)
    plotter.close()
    return np.stack(images)[..., :3]


def _quartered(corners: FloatArray) -> FloatArray:
    """Each face ``(F, 3, D)`` as four, cut at the middles of its sides. *Shape:* ``(4F, 3, D)``."""
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    ab, bc, ca = (a + b) / 2, (b + c) / 2, (c + a) / 2
    parts = [(a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)]
    return np.concatenate([np.stack(part, axis=1) for part in parts])


def _draw_matplotlib(scene: Scene) -> ByteArray:
    """Images ``(S, height, width, 3)``: faces from back to front, each in one shade."""
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
        while len(corners) < SMOOTH_FACES:
            corners = _quartered(corners)
        middle = corners.mean(axis=1)
        normals = middle[:, 3:6] / np.maximum(np.linalg.norm(middle[:, 3:6], axis=1, keepdims=True), 1e-12)
        normals *= np.where(normals[:, 2:] < 0, -1.0, 1.0)  # open meshes show their inside too
        shade = 0.25 + 0.85 * np.clip(normals @ lights.T, 0, None).sum(axis=1)
        rim = 0.75 + 0.25 * np.clip(normals[:, 2], 0, 1) ** 0.5  # darker outlines part what overlaps
        face_colors = middle[:, 6:] * (shade * rim)[:, None]
        order = np.argsort(middle[:, 2], kind="stable")
        figure = Figure(figsize=(width * over / 100, height * over / 100), dpi=100)
        canvas = FigureCanvasAgg(figure)
        axes = figure.add_axes((0, 0, 1, 1))
        axes.set_axis_off()
        axes.set_xlim(-scene.half_size[0], scene.half_size[0])
        axes.set_ylim(-scene.half_size[1], scene.half_size[1])
        axes.add_collection(
            PolyCollection(
                list(corners[order, :, :2]),
                facecolors=np.clip(face_colors[order], 0, 1),
                linewidths=0,
                antialiaseds=False,
            )
        )
        canvas.draw()
        pixels = np.asarray(canvas.buffer_rgba())[..., :3].astype(np.float64)
        images.append(pixels.reshape(height, over, width, over, 3).mean(axis=(1, 3)).round().astype(np.uint8))
    return np.stack(images)


# The package is set up as an empty shell around its folder: its __init__ would import torch, which drawing a
# picture does not need and which costs seconds.
_CHILD = """
import sys, types
package = types.ModuleType("torch_modal"); package.__path__ = [sys.argv[1]]
sys.modules["torch_modal"] = package
from torch_modal.picture import _child_main
_child_main(sys.argv[2])
"""


def _child_command(folder: str) -> list[str]:
    return [sys.executable, "-c", _CHILD, str(Path(__file__).parent), folder]


def _child_main(folder: str) -> None:
    with np.load(Path(folder, "scene.npz")) as stored:
        scene = Scene(**{name: stored[name] for name in Scene._fields})
    np.save(Path(folder, "images.npy"), _draw_pyvista(scene))


def _draw_in_child(scene: Scene) -> ByteArray:
    """Images from pyvista in a process of its own; RuntimeError with the reason if that fails."""
    with tempfile.TemporaryDirectory(prefix="torch_modal-") as folder:
        np.savez(Path(folder, "scene.npz"), **scene._asdict())
        try:
            # The folder is the working directory so that a core file goes with it.
            done = subprocess.run(
                _child_command(folder), cwd=folder, capture_output=True, timeout=CHILD_SECONDS, check=False
            )
        except subprocess.TimeoutExpired:
            raise RuntimeError(f"it did not finish within {CHILD_SECONDS:g} s") from None
        if done.returncode != 0:
            said = done.stderr.decode(errors="replace").strip().splitlines()
            ending = f"signal {-done.returncode}" if done.returncode < 0 else f"status {done.returncode}"
            raise RuntimeError(f"its process ended with {ending}" + (f": {said[-1]}" if said else ""))
        stored = Path(folder, "images.npy")
        if not stored.is_file():
            raise RuntimeError("it left no images")
        images: ByteArray = np.load(stored)
    if images.shape != (len(scene.points), scene.pixels[1], scene.pixels[0], 3) or (images == 255).all():
        raise RuntimeError(f"its images are empty, shape {images.shape}")
    return images


def _draw(scene: Scene, renderer: str) -> ByteArray:
    if renderer == "matplotlib":
        return _draw_matplotlib(scene)
    try:
        return _draw_in_child(scene)
    except RuntimeError as error:
        if renderer == "pyvista":
            raise RuntimeError(f"pyvista could not render: {error}. renderer='matplotlib' needs no GL.") from None
        warnings.warn(f"pyvista could not render ({error}); matplotlib draws the picture.", stacklevel=3)
        return _draw_matplotlib(scene)


def _sheet(
    images: ByteArray,  # (R, C, height, width, 3)
    rows: list[str],
    column_labels: list[tuple[str, str]],  # text and colour
    color_bar: tuple[Any, str] | None,  # ScalarMappable and label
    fmt: str,
) -> bytes:
    """The images on white paper with their labels. Measures are in pixels of the result."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.font_manager import FontProperties
    from matplotlib.textpath import TextPath

    n_rows, n_columns, height, width = images.shape[:4]
    dpi, gap = 200, 12
    text = min(11.0, 0.13 * width * 72 / dpi)  # points; the longest column label has about twelve letters
    line = text * dpi / 72
    font = FontProperties(size=text + 1)
    parts = [part for row in rows for part in row.split("\n") if part.strip()]  # TextPath fails on blanks
    widest = max((TextPath((0, 0), part, prop=font).get_extents().width for part in parts), default=0.0)
    left = widest * dpi / 72 + 2 * line
    right = 7 * line if color_bar else line
    top, bottom = 2.6 * line, line
    total = np.array([left + n_columns * (width + gap) + right, top + n_rows * (height + gap) + bottom])
    figure = Figure(figsize=tuple(total / dpi), dpi=dpi, facecolor="white")
    FigureCanvasAgg(figure)

    def cell(x: float, y: float, w: float, h: float) -> tuple[float, float, float, float]:
        """From pixels, y down, to the fractions of the figure."""
        return x / total[0], 1 - (y + h) / total[1], w / total[0], h / total[1]

    for r, row in enumerate(rows):
        y = top + r * (height + gap)
        figure.text(*cell(line, y + height / 2, 0, 0)[:2], row, fontproperties=font, va="center", ha="left")
        for c in range(n_columns):
            axes = figure.add_axes(cell(left + c * (width + gap), y, width, height))
            axes.imshow(images[r, c], aspect="auto", interpolation="none")
            axes.set_axis_off()
    for c, (label, color) in enumerate(column_labels):
        x, y = cell(left + c * (width + gap) + width / 2, 1.6 * line, 0, 0)[:2]
        figure.text(x, y, label, fontsize=text, color=color, ha="center", va="center")
    if color_bar:
        mappable, label = color_bar
        tall = min(n_rows * (height + gap) - gap, 2 * height)
        x, y = left + n_columns * (width + gap) + line, top + (n_rows * (height + gap) - gap - tall) / 2
        beyond = "max" if mappable.get_array().max() > mappable.norm.vmax else "neither"
        cax = figure.add_axes(cell(x, y, 0.8 * line, tall))
        bar = figure.colorbar(mappable, cax=cax, extend=beyond, extendfrac=0.03)
        bar.ax.tick_params(labelsize=0.8 * text)
        bar.set_label(label, fontsize=0.9 * text)
        bar.outline.set_visible(False)
    stream = io.BytesIO()
    figure.savefig(stream, format=fmt, dpi=dpi)
    return stream.getvalue()


def render_sequence(
    frames_by_row: Mapping[str, Array],
    faces: Array,
    out: str | Path,
    columns: int | Sequence[int] | None = None,
    keyframe_indices: Sequence[int] | None = None,
    view: tuple[float, float] | None = None,
    up: Literal["y", "z"] | None = None,
    colors: Mapping[str, Array] | None = None,
    color_label: str = "",
    renderer: Literal["auto", "pyvista", "matplotlib"] = "auto",
    overwrite: bool = False,
) -> Path:
    """Draw rows of shapes side by side, all seen by the same camera at the same scale.

    Args:
        frames_by_row: For each row its label and its shapes, for example ``{"torch_modal": x, "linear": y}``.
            *Shape of each:* ``(N, V, 3)``, the same for all.
        faces: Vertex indices. *Shape:* ``(F, 3)``.
        out: File to write, ``*.png`` or ``*.pdf``.
        columns: How many frames to show, evenly chosen with the first and the last, or their numbers. By
            default all up to seven, and of more a number from four to seven that gives equal steps.
        keyframe_indices: Frames that are key-frames, drawn in the other colour. The first and the last by
            default.
        view: Azimuth and elevation of the camera in degrees; ``(0, 0)`` looks from the front (+Z where Y is
            up, -Y where Z is), a positive azimuth moves the camera to the right. By default chosen from the
            shape.
        up: ``"y"`` or ``"z"``; by default Y, unless the first shape is flat in Y.
        colors: A number for each vertex, for any of the rows, shown as colour with a bar. The bar ends at the
            99.5th percentile of what is shown, with an arrow if there is more.
            *Shape of each:* ``(N, V)``.
        color_label: What those numbers are, with their unit.
        renderer: ``"auto"`` is pyvista, and matplotlib (with a warning) where pyvista cannot render.
        overwrite: Replace the file if it exists.

    Returns:
        The file.

    Raises:
        ValueError: An argument cannot be used; the message says why.
        FileExistsError: The file exists and ``overwrite`` is off.
        RuntimeError: ``renderer="pyvista"`` and pyvista cannot render here.
    """
    if not frames_by_row:
        raise ValueError("frames_by_row is empty; it needs at least one row of shapes.")
    path = Path(out)
    fmt = path.suffix.lower().lstrip(".")
    if fmt not in ("png", "pdf"):
        raise ValueError(f"out must end in .png or .pdf, got {path.name!r}.")
    if renderer not in ("auto", "pyvista", "matplotlib"):
        raise ValueError(f"renderer must be auto, pyvista or matplotlib, got {renderer!r}.")
    if view is not None and not (len(view) == 2 and np.isfinite(view).all()):
        raise ValueError(f"view must be two numbers of degrees, azimuth and elevation, got {view}.")
    if up not in (None, "y", "z"):
        raise ValueError(f"up must be 'y' or 'z', got {up!r}.")
    refuse_existing(path, overwrite)

    rows = list(frames_by_row)
    checked = [check_frames(frames_by_row[row], faces, f"frames_by_row[{row!r}]") for row in rows]
    shapes = [frames for frames, _ in checked]
    if len({frames.shape for frames in shapes}) > 1:
        sizes = ", ".join(f"{row!r} {frames.shape}" for row, frames in zip(rows, shapes, strict=True))
        raise ValueError(f"all rows must have the same shape (N, V, 3), got {sizes}.")
    n_frames = len(shapes[0])
    if columns is None:
        # Equal steps if at all possible: 5 of 9 or 17 frames, 7 of 25.
        columns = next((c for c in (7, 6, 5, 4) if n_frames > c and (n_frames - 1) % (c - 1) == 0), 7)
    if isinstance(columns, (int, np.integer)):
        count = min(columns, n_frames)
        if count < 1:
            raise ValueError(f"columns must be at least 1, got {columns}.")
        chosen = np.unique(np.linspace(0, n_frames - 1, count).round().astype(int)).tolist()
    else:
        chosen = check_indices(columns, n_frames, "columns")
    given = [0, n_frames - 1] if keyframe_indices is None else keyframe_indices
    keyframes = check_indices(given, n_frames, "keyframe_indices")

    shown = np.stack([frames[chosen] for frames in shapes])  # (R, C, V, 3)
    rotation = _view_rotation(shapes[0][0], view, up)
    points, half = _centred(shown @ rotation.T)
    paint = np.empty(shown.shape)
    paint[:] = np.array([KEYFRAME_COLOR if n in keyframes else BETWEEN_COLOR for n in chosen])[:, None]
    color_bar = None
    if colors:
        mappable, painted = _colored(colors, rows, shapes[0].shape[:2], chosen)
        for r, rgb in painted.items():
            paint[r] = rgb
        color_bar = (mappable, color_label)
    scene = Scene(
        points.reshape(-1, *shown.shape[2:]),
        (paint * 255).round().astype(np.uint8).reshape(-1, *shown.shape[2:]),
        checked[0][1],
        half,
        np.maximum((CELL_PIXELS * half / half.max()).round(), 1).astype(np.int64),
    )
    images = _draw(scene, renderer)
    last = max(n_frames - 1, 1)
    labels = [(f"t = {n / last:.3g}", "#b4581a" if n in keyframes else "#333333") for n in chosen]
    write_file(path, _sheet(images.reshape(*shown.shape[:2], *images.shape[1:]), rows, labels, color_bar, fmt))
    return path


def _colored(
    colors: Mapping[str, Array], rows: list[str], size: tuple[int, ...], chosen: list[int]
) -> tuple[Any, dict[int, FloatArray]]:
    """The colour scale, shared by all rows, and for each coloured row its RGB ``(C, V, 3)`` in [0, 1]."""
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import LinearSegmentedColormap, Normalize

    values = {}
    for row, numbers in colors.items():
        array = to_numpy(numbers)
        if row not in rows:
            raise ValueError(f"colors has a row {row!r} that frames_by_row does not have ({', '.join(rows)}).")
        if array.shape != size or not np.isfinite(array).all():
            raise ValueError(
                f"colors[{row!r}] must hold finite numbers, one a vertex, shape {size}, got shape {array.shape}."
            )
        values[rows.index(row)] = array[chosen].astype(np.float64)
    everything = np.concatenate([v.reshape(-1) for v in values.values()])
    low, high = (
        everything.min(),
        np.percentile(everything, 99.5),
    )  # a few extreme vertices must not hide the rest
    mappable = ScalarMappable(
        Normalize(low, high if high > low else low + 1.0),
        LinearSegmentedColormap.from_list("error", ERROR_COLORS),
    )
    mappable.set_array(everything)
    return mappable, {r: mappable.to_rgba(v)[..., :3] for r, v in values.items()}
