"""A picture that compares rows of shapes: one row a method, one column a time.

All shapes are turned into view coordinates (x right, y up, z to the viewer), and drawing.py draws each into a cell.
"""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from torch_modal.arrays import Array, FloatArray, IntArray
from torch_modal.io.files import write_files
from torch_modal.io.formats import PICTURES
from torch_modal.io.write import check_frames, check_indices, check_suffix, refuse_existing, to_numpy
from torch_modal.view.drawing import DPI, draw_points, draw_shape, make_cells, plain

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.cm import ScalarMappable
    from matplotlib.figure import Figure

KEYFRAME_COLOR = (0.91, 0.60, 0.36)  # warm: given
BETWEEN_COLOR = (0.62, 0.71, 0.82)  # cool: computed
DOT_COLOR = (0.71, 0.35, 0.10)
ERROR_COLORS = ["#e4e4e2", "#f6c9a0", "#e8804f", "#b2182b", "#5c0a20"]
CELL_PIXELS = 420  # the longer side of a cell
CELL_MARGIN = 1.06  # of a cell against the largest shape in it


def check_view(view: tuple[float, float] | None, up: str | None) -> None:
    """Raise a ValueError unless ``view`` and ``up`` are valid."""
    if view is not None and not (len(view) == 2 and np.isfinite(view).all()):
        raise ValueError(f"view must be two numbers of degrees, azimuth and elevation, got {view}")
    if up not in (None, "y", "z"):
        raise ValueError(f"up must be 'y' or 'z', got {up!r}")


def check_sequences(sequences: Mapping[str, Array], faces: Array, name: str) -> tuple[dict[str, FloatArray], IntArray]:
    """Check sequences of shapes that are shown together, and their faces; ``name`` is for messages."""
    if not sequences:
        raise ValueError(f"{name} is empty; it needs at least one sequence of shapes")
    checked: dict[str, FloatArray] = {}
    for key, frames in sequences.items():
        checked[key], triangles = check_frames(frames, faces, f"{name}[{key!r}]")
    if len({frames.shape for frames in checked.values()}) > 1:
        sizes = ", ".join(f"{key!r} {frames.shape}" for key, frames in checked.items())
        raise ValueError(f"all {name} must have the same shape (N, V, 3), got {sizes}")
    return checked, triangles


def up_axis(shape: FloatArray, up: Literal["y", "z"] | None = None) -> Literal["y", "z"]:
    """The up axis; by default Y, unless the shape is flat in Y (less than half of both other extents), then Z."""
    extent = np.ptp(shape, axis=0)
    return up or ("z" if extent[1] < 0.5 * min(extent[0], extent[2]) else "y")


def view_rotation(shape: FloatArray, view: tuple[float, float] | None, up: Literal["y", "z"] | None) -> FloatArray:
    """Rows are the directions right, up and to the viewer. *Shape:* ``(3, 3)``.

    Without a ``view`` the viewer stands where the least principal direction points, and so sees the widest side, a
    little from the side and from above so that depth shows.
    """
    up = up_axis(shape, up)
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


def fit_into_cells(points: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Move shapes ``(R, C, V, 3)`` into their cells; returns them, and the half width and height that hold them all.

    One centre serves all cells, so that static parts stay in place and rows can be compared. Where shapes are
    separated by more than their own size, each column gets a centre, or if necessary each shape.
    """
    extent = np.ptp(points, axis=2).max(axis=(0, 1))
    for together in ((0, 1, 2), (0, 2), (2,)):
        low, high = points.min(axis=together, keepdims=True), points.max(axis=together, keepdims=True)
        size = (high - low).max(axis=(0, 1, 2))
        if (size[:2] <= 1.4 * extent[:2]).all():
            break
    half = 0.5 * size[:2] * CELL_MARGIN
    # Neither needles nor points: labels need some width.
    half = np.maximum(half, max(0.4 * float(half.max()), np.finfo(np.float64).tiny))
    return points - 0.5 * (low + high), half


def render_sequence(
    frames_by_row: Mapping[str, Array],
    faces: Array,
    out: str | Path,
    columns: int | Sequence[int] | None = None,
    titles: Sequence[str] | None = None,
    keyframe_indices: Sequence[int] | None = None,
    view: tuple[float, float] | None = None,
    up: Literal["y", "z"] | None = None,
    colors: Mapping[str, Array] | None = None,
    color_label: str = "",
    points: Mapping[str, Sequence[Array]] | None = None,
) -> Path:
    """Draw rows of shapes side by side, all seen by the same camera at the same scale.

    Args:
        frames_by_row: For each row its label and its shapes, for example ``{"torch_modal": x, "linear": y}``.
            *Shape of each:* ``(N, V, 3)``, the same for all.
        faces: Vertex indices. *Shape:* ``(F, 3)``.
        out: File to write, ``*.png`` or ``*.pdf``; replaced if it exists.
        columns: How many frames to show, evenly chosen with the first and the last, or their numbers. Default: up to
            seven, in equal steps, or half-way between key-frames where most of these were key-frames.
        titles: Text above the columns. Default: their times, from 0 to 1.
        keyframe_indices: Frames that are key-frames, drawn in the other colour. Default: the first and the last.
        view: Azimuth and elevation of the camera in degrees; ``(0, 0)`` looks from the front (+Z where Y is up, -Y
            where Z is), a positive azimuth moves the camera to the right. By default chosen from the shape.
        up: ``"y"`` or ``"z"``; by default Y, unless the first shape is flat in Y.
        colors: A number for each vertex, for any of the rows, shown as colour with a bar. The bar ends at the 99.5th
            percentile of what is shown, with an arrow if there is more. *Shape of each:* ``(N, V)``.
        color_label: Name of the numbers in ``colors``, with their unit.
        points: Rows of clouds, drawn above the shapes as dots: a cloud for each frame. *Shape of each:* ``(n, 3)``.

    Returns:
        The file.

    Raises:
        ValueError: An argument cannot be used; the message says why.
        IsADirectoryError: ``out`` is a folder.
    """
    path = Path(out)
    fmt = check_suffix(path, PICTURES)[1:]
    check_view(view, up)
    refuse_existing(path)

    checked, triangles = check_sequences(frames_by_row, faces, "frames_by_row")
    rows, shapes = list(checked), list(checked.values())
    n_frames = len(shapes[0])
    ends = [0, n_frames - 1]
    keyframes = check_indices(ends if keyframe_indices is None else keyframe_indices, n_frames, "keyframe_indices")
    chosen = choose_columns(columns, n_frames, keyframes)
    titles = [f"t = {n / max(n_frames - 1, 1):.3g}" for n in chosen] if titles is None else titles
    if len(titles) != len(chosen):
        raise ValueError(f"titles stand above {len(chosen)} columns, got {len(titles)}")
    clouds = _check_points(points or {}, n_frames)
    values = _check_colors(colors or {}, checked)
    scale = _color_scale(np.stack([numbers[chosen] for numbers in values.values()])) if values else None
    rotation = view_rotation(shapes[0][0], view, up)
    turned = np.stack([frames[chosen] for frames in shapes]) @ rotation.T  # (R, C, V, 3)
    placed, half = fit_into_cells(turned)
    moves = (placed - turned)[0, :, 0]  # of the first row, into the cells
    pixels = np.maximum((CELL_PIXELS * half / half.max()).round(), 1).astype(np.int64)
    cells = make_cells(len(clouds) + len(rows), len(chosen), half, pixels)
    points_of_text = min(17.0, 0.13 * pixels[0] * 72 / DPI)  # the longest title has about twelve letters
    _label_rows(cells[:, 0], [*clouds, *rows], 1.1 * points_of_text)
    for column, (n, title) in enumerate(zip(chosen, titles, strict=True)):
        color = "#b4581a" if n in keyframes else "#333333"
        cells[0, column].set_title(title, fontsize=points_of_text, color=color)
        usual = np.broadcast_to(KEYFRAME_COLOR if n in keyframes else BETWEEN_COLOR, shapes[0][0].shape)
        for cell, cloud in zip(cells[:, column], clouds.values(), strict=False):
            draw_points(cell, cloud[n] @ rotation.T + moves[column], DOT_COLOR)
        for cell, label, shape in zip(cells[len(clouds) :, column], rows, placed[:, column], strict=True):
            paint = scale.to_rgba(values[label][n])[:, :3] if scale and label in values else usual
            draw_shape(cell, shape, plain(paint, triangles))
    figure = cells[0, 0].figure
    if scale:
        _draw_bar(figure, scale, pixels, color_label, points_of_text)
    stream = io.BytesIO()
    figure.savefig(stream, format=fmt, dpi=DPI, bbox_inches="tight", pad_inches=0.2)
    write_files([(path, stream.getvalue())])
    return path


def _check_points(points: Mapping[str, Sequence[Array]], n_frames: int) -> dict[str, list[FloatArray]]:
    """Check rows of clouds, one cloud for each frame."""
    clouds = {label: [to_numpy(cloud) for cloud in row] for label, row in points.items()}
    for label, row in clouds.items():
        if len(row) != n_frames or any(cloud.shape != (len(cloud), 3) for cloud in row):
            raise ValueError(f"points[{label!r}] must be {n_frames} clouds (n, 3), got {[c.shape for c in row]}")
    return clouds


def _check_colors(colors: Mapping[str, Array], shapes: Mapping[str, FloatArray]) -> dict[str, FloatArray]:
    """Check the numbers of vertices that are shown as colours, for any of the rows of shapes."""
    values = {row: to_numpy(numbers).astype(np.float64) for row, numbers in colors.items()}
    for label, numbers in values.items():
        size = shapes[label].shape[:2] if label in shapes else f"of a row {', '.join(shapes)}"
        if numbers.shape != size or not np.isfinite(numbers).all():
            raise ValueError(f"colors[{label!r}] must be finite numbers of shape {size}, got shape {numbers.shape}")
    return values


def _label_rows(cells: Sequence[Axes], labels: Sequence[str], font: float) -> None:
    """Write labels to the left of the first cell of each row."""
    for cell, label in zip(cells, labels, strict=True):
        cell.text(-0.05, 0.5, label, fontsize=font, va="center", ha="right", transform=cell.transAxes)


def _draw_bar(figure: Figure, scale: ScalarMappable, pixels: IntArray, label: str, font: float) -> None:
    """Draw the bar of a colour scale to the right of a figure, as tall as two cells of this width and height."""
    width, height = (pixels / DPI / figure.get_size_inches()).tolist()
    tall = min(1.0, 2 * height)
    box = (1 + 0.1 * width, (1 - tall) / 2, 0.06 * width, tall)
    bar = figure.colorbar(scale, cax=figure.add_axes(box), extendfrac=0.03)
    bar.ax.tick_params(labelsize=0.8 * font)
    bar.set_label(label, fontsize=0.9 * font)
    bar.outline.set_visible(False)


def choose_columns(columns: int | Sequence[int] | None, n_frames: int, keyframes: Sequence[int]) -> list[int]:
    """Numbers of the frames that are drawn; by default at least half of them are between the key-frames."""
    by_default = columns is None
    if columns is None:
        # Equal steps if at all possible: 5 of 9 or 17 frames, 7 of 25.
        columns = next((c for c in (7, 6, 5, 4) if n_frames > c and (n_frames - 1) % (c - 1) == 0), 7)
    if not isinstance(columns, (int, np.integer)):
        if not (chosen := check_indices(columns, n_frames, "columns")):
            raise ValueError("columns are the frames to show, one or more; got none")
        return chosen
    if columns < 1:
        raise ValueError(f"columns must be at least 1, got {columns}")
    chosen = np.unique(np.linspace(0, n_frames - 1, min(columns, n_frames)).round().astype(int)).tolist()
    middles = [(a + b) // 2 for a, b in pairwise([*keyframes, n_frames]) if b - a > 1]
    if by_default and middles and 2 * len(set(chosen) & set(keyframes)) > len(chosen):
        picked = np.linspace(0, len(middles) - 1, min(5, len(middles))).round().astype(int)
        return sorted({chosen[0], *(middles[i] for i in picked), chosen[-1]})
    return chosen


def _color_scale(numbers: FloatArray) -> ScalarMappable:
    """Colours of numbers; a few extreme ones do not hide the rest."""
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import LinearSegmentedColormap, Normalize

    low, high = numbers.min(), np.percentile(numbers, 99.5)
    palette: Any = LinearSegmentedColormap.from_list("error", ERROR_COLORS)
    palette.colorbar_extend = "max" if numbers.max() > high else "neither"
    return ScalarMappable(Normalize(low, high if high > low else low + 1.0), palette)
