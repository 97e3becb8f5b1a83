"""A sequence as a video, by imageio and its ffmpeg (``pip install torch_modal[video]``), or as a GIF, by Pillow."""

from pathlib import Path
from typing import Any

import numpy as np

from torch_modal.io.formats import Animation, resample
from torch_modal.progress import ProgressReport
from torch_modal.view.drawing import ByteArray, Scene, draw
from torch_modal.view.picture import BETWEEN_COLOR, centred, view_rotation

PIXELS = 640
"""The longer side of a picture."""

PICTURES_AT_ONCE = 24
"""Drawn by one process of the renderer."""


def write_mp4(animation: Animation, path: Path) -> None:
    """H.264."""
    import imageio.v2 as imageio

    options: dict[str, Any] = {"codec": "libx264", "macro_block_size": 1, "ffmpeg_log_level": "error"}
    pictures = _pictures(animation)
    writer: Any = imageio.get_writer(path, format="FFMPEG", mode="I", fps=animation.timing.fps, **options)
    with writer:
        for picture in pictures:
            writer.append_data(picture)


def write_gif(animation: Animation, path: Path) -> None:
    """A GIF that repeats for ever."""
    from PIL import Image

    # GIF counts in hundredths of a second, and players slow down below two of them.
    milliseconds = max(20, 10 * round(100 / animation.timing.fps))
    first, *others = map(Image.fromarray, _pictures(animation))
    first.save(path, save_all=True, append_images=others, duration=milliseconds, loop=0)


def _pictures(animation: Animation) -> list[ByteArray]:
    """The sequence drawn from one place, at the rate of its timing."""
    shapes, faces = animation.shapes, animation.faces
    places = animation.timing.samples()
    # A frame that is shown twice, as on the way back, is drawn once.
    unique, which = np.unique(places, return_inverse=True)
    points = resample(shapes, unique) @ view_rotation(shapes[0], None, None).T
    points, half = centred(points[None])
    # H.264 stores colour for blocks of two by two.
    size = np.maximum((PIXELS * half / half.max() / 2).round() * 2, 2).astype(np.int64)
    paint = np.broadcast_to((np.array(BETWEEN_COLOR) * 255).round().astype(np.uint8), points[0].shape)
    images: list[ByteArray] = []
    with ProgressReport(len(unique), "pictures", animation.progress, unit="picture") as report:
        for start in range(0, len(unique), PICTURES_AT_ONCE):
            part = slice(start, start + PICTURES_AT_ONCE)
            images += list(draw(Scene(points[0, part], paint[part].copy(), faces, half, size), "auto"))
            report.update(len(images) - start)
    return [images[number] for number in which.reshape(-1)]
