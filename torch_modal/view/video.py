"""A sequence as a video or GIF. Needs ``imageio`` (``pip install torch_modal[video]``)."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from torch_modal.io.files import temporary_beside
from torch_modal.io.timing import Timing, resample
from torch_modal.view.drawing import Scene, draw
from torch_modal.view.picture import BETWEEN_COLOR, centred, view_rotation

PIXELS = 640
"""The longer side of a picture."""


def save_video(
    shapes: np.ndarray,
    faces: np.ndarray,
    path: Path,
    timing: Timing,
    view: tuple[float, float] | None = None,
    renderer: str = "auto",
) -> Path:
    """Draw the sequence from one place and write it as H.264 in MP4, or as a GIF that goes on for ever.

    Args:
        shapes: *Shape:* ``(N, V, 3)``.
        faces: *Shape:* ``(F, 3)``.
        path: The file, ``.mp4`` or ``.gif``, which is replaced.
        timing: Pictures are taken at its rate.
        view: Azimuth and elevation of the camera, as for :func:`torch_modal.render_sequence`.
        renderer: ``"auto"``, ``"pyvista"`` or ``"matplotlib"``.
    """
    writer_of = _writer(path)
    places = timing.samples(len(shapes))
    # A frame that is shown twice, as on the way back, is drawn once.
    unique, which = np.unique(places, return_inverse=True)
    points = resample(shapes, unique) @ view_rotation(shapes[0], view, None).T
    points, half = centred(points[None])
    # H.264 stores colour for blocks of two by two.
    size = np.maximum((PIXELS * half / half.max() / 2).round() * 2, 2).astype(np.int64)
    paint = np.broadcast_to((np.array(BETWEEN_COLOR) * 255).round().astype(np.uint8), points[0].shape)
    images = draw(Scene(points[0], paint.copy(), faces, half, size), renderer)
    path.parent.mkdir(parents=True, exist_ok=True)
    with temporary_beside(path, path.suffix.lower()) as temporary, writer_of(temporary, timing.fps) as writer:
        for number in which.reshape(-1):
            writer.append_data(images[number])
    return path


def _writer(path: Path) -> Any:
    """Opens a writer of the suffix, given a path and the pictures a second."""
    import imageio.v2 as imageio

    if path.suffix.lower() == ".gif":
        # GIF counts in hundredths of a second, and players slow down below two of them.
        return lambda file, fps: imageio.get_writer(
            file, format="GIF-PIL", mode="I", duration=max(20, 10 * round(100 / fps)), loop=0
        )
    return lambda file, fps: imageio.get_writer(
        file, format="FFMPEG", mode="I", fps=fps, codec="libx264", macro_block_size=1, ffmpeg_log_level="error"
    )
