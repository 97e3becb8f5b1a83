"""A sequence as a video, by imageio and its ffmpeg (``pip install torch_modal[video]``), or as a GIF, by Pillow."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from torch_modal.io.files import temporary_beside
from torch_modal.io.timing import Timing, resample
from torch_modal.progress import Progress, ProgressReport
from torch_modal.view.drawing import ByteArray, Scene, draw
from torch_modal.view.picture import BETWEEN_COLOR, centred, view_rotation

PIXELS = 640
"""The longer side of a picture."""

PICTURES_AT_ONCE = 24
"""That a process of the renderer draws."""


def save_video(
    shapes: np.ndarray,
    faces: np.ndarray,
    path: Path,
    timing: Timing,
    view: tuple[float, float] | None = None,
    renderer: str = "auto",
    progress: Progress = None,
) -> Path:
    """Draw the sequence from one place and write it as H.264 in MP4, or as a GIF that goes on for ever.

    Args:
        shapes: *Shape:* ``(N, V, 3)``.
        faces: *Shape:* ``(F, 3)``.
        path: The file, ``.mp4`` or ``.gif``, which is replaced.
        timing: Pictures are taken at its rate.
        view: Azimuth and elevation of the camera, as for :func:`torch_modal.render_sequence`.
        renderer: ``"auto"``, ``"pyvista"`` or ``"matplotlib"``.
        progress: How the drawing shows its progress.
    """
    places = timing.samples(len(shapes))
    # A frame that is shown twice, as on the way back, is drawn once.
    unique, which = np.unique(places, return_inverse=True)
    points = resample(shapes, unique) @ view_rotation(shapes[0], view, None).T
    points, half = centred(points[None])
    # H.264 stores colour for blocks of two by two.
    size = np.maximum((PIXELS * half / half.max() / 2).round() * 2, 2).astype(np.int64)
    paint = np.broadcast_to((np.array(BETWEEN_COLOR) * 255).round().astype(np.uint8), points[0].shape)
    images: list[ByteArray] = []
    with ProgressReport(len(unique), "pictures", progress, unit="picture") as report:
        for start in range(0, len(unique), PICTURES_AT_ONCE):
            part = slice(start, start + PICTURES_AT_ONCE)
            images += list(draw(Scene(points[0, part], paint[part].copy(), faces, half, size), renderer))
            report.update(len(images) - start)
    path.parent.mkdir(parents=True, exist_ok=True)
    with temporary_beside(path, path.suffix.lower()) as temporary:
        write = _write_gif if path.suffix.lower() == ".gif" else _write_mp4
        write(temporary, [images[number] for number in which.reshape(-1)], timing.fps)
    return path


def _write_gif(path: Path, pictures: list[ByteArray], fps: float) -> None:
    from PIL import Image

    # GIF counts in hundredths of a second, and players slow down below two of them.
    milliseconds = max(20, 10 * round(100 / fps))
    first, *others = (Image.fromarray(picture) for picture in pictures)
    first.save(path, save_all=True, append_images=others, duration=milliseconds, loop=0)


def _write_mp4(path: Path, pictures: list[ByteArray], fps: float) -> None:
    import imageio.v2 as imageio

    options: dict[str, Any] = {"codec": "libx264", "macro_block_size": 1, "ffmpeg_log_level": "error"}
    writer: Any = imageio.get_writer(path, format="FFMPEG", mode="I", fps=fps, **options)
    with writer:
        for picture in pictures:
            writer.append_data(picture)
