"""A sequence as one file that plays, in the format of its suffix. The formats that are drawn, MP4 and GIF, are here."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from torch_modal.arrays import Array, FloatArray, IntArray
from torch_modal.geometry.skin import Skin
from torch_modal.io.asset import Asset
from torch_modal.io.files import atomic_write
from torch_modal.io.formats import ANIMATION_FORMATS, PIXELS, Animation, Timing, check_forms, resample
from torch_modal.io.write import check_frames, check_indices, check_suffix, refuse_existing
from torch_modal.motion.skin import bake
from torch_modal.progress import Progress, ProgressReport
from torch_modal.view.drawing import ByteArray, draw_image, plain, textured
from torch_modal.view.picture import BETWEEN_COLOR, fit_into_cells, view_rotation

PIECE_PIXELS = 4  # sides of the pieces of a textured face
MOST_PIECES = 60_000  # of all faces of a picture; 80,000 take a second of processor time


def save_animation(
    frames: Array,
    faces: Array,
    out: str | Path,
    fps: float | None = None,
    keyframe_indices: Sequence[int] | None = None,
    cyclic: bool = False,
    *,
    duration: float | None = None,
    ping_pong: bool = False,
    ease: bool = False,
    times: Sequence[float] | None = None,
    asset: Asset | None = None,
    bones: int | Skin | None = None,
    targets: int | None = None,
    size: int = PIXELS,
    progress: Progress = None,
) -> Path:
    """Write the sequence as one file that plays.

    ``.glb`` is glTF 2.0 with a morph target for each frame after the first, between which viewers interpolate linearly.
    glTF calls Y up and metres the unit; the caller's coordinates are written as they are (float32), so a Z-up sequence
    lies on its back there. Normals move with the shape. ``.usd``, ``.usda`` and ``.usdc`` (extra ``usd``) hold the
    points over time, ``.abc`` (extra ``alembic``) at a fixed rate. A GLB with ``bones`` holds a skin
    (:func:`torch_modal.bake`), a tenth of the size, that every engine plays; with ``targets``, the mean and a few
    principal shapes.

    ``.mp4`` (extra ``video``) and ``.gif`` are drawn, with the materials and textures of the asset. ``.mdd`` and
    ``.pc2`` are point caches, for a mesh that is already in Blender, Maya or Houdini. ``.npz`` holds ``frames``,
    ``faces``, ``times`` and ``keyframes`` as arrays.

    Args:
        frames: Vertex positions, in the caller's coordinates; one shape stands still. *Shape:* ``(N, V, 3)``.
        faces: Vertex indices. *Shape:* ``(F, 3)``.
        out: File to write; replaced if it exists.
        fps: Frames a second; with a ``duration``, pictures or samples a second of videos and point caches
            (default: 24), while GLB and USD show every frame.
        keyframe_indices: Which frames are key-frames. They are kept when frames are left out (unless they are
            too many themselves), named in the GLB's ``extras``, and their number gives the default duration.
        cyclic: Add the step from the last frame back to the first, unless the two are equal already.
        duration: Of the sequence once, in seconds. Default: from ``fps`` where that is given; otherwise 1 s for a
            cycle, 2 s for two key-frames, and 1 s for each interval of more.
        ping_pong: Play forwards and then backwards, which takes twice the duration.
        ease: Slow at both ends, by half a period of a cosine.
        times: Times of the frames, in any unit; of a cycle, also the time when it begins again. Default: evenly
            spaced. The duration does not change.
        asset: The mesh file that the frames come from (:func:`torch_modal.open_asset`). GLB gets its materials,
            textures, texture coordinates, colours and normals, USD its polygons, texture coordinates and colours.
        bones: Most bones of a skin, or a skin of these frames. GLB alone.
        targets: Principal shapes, as the only morph targets; they give the frames approximately. GLB alone.
        size: The longer side of pictures of MP4 and GIF, in pixels.
        progress: A bar while a video is drawn: see :data:`torch_modal.progress.Progress`.

    Returns:
        The file.

    Raises:
        ValueError: An argument cannot be used; the message says why.
        IsADirectoryError: ``out`` is a folder.
        MissingPackageError: The format needs a package that is not installed; the message says which.

    Warns:
        MeshWarning: The format cannot hold what the asset carries.
    """
    shapes, triangles = check_frames(frames, faces)
    path, suffix = _check_file(out, shapes, asset, bones, targets, size)
    keyframes = [] if keyframe_indices is None else check_indices(keyframe_indices, len(shapes), "keyframe_indices")
    if cyclic and len(shapes) > 1 and np.array_equal(shapes[0], shapes[-1]):
        shapes = shapes[:-1]
        keyframes = [number for number in keyframes if number < len(shapes)]
    if times is None and isinstance(bones, Skin) and bones.times is not None:
        times = bones.times.tolist()
    repeats = {"cyclic": cyclic and len(shapes) > 1, "ping_pong": ping_pong, "ease": ease}
    timing = Timing(len(shapes), len(keyframes), duration=duration, fps=fps, times=times, **repeats)
    skin = None if bones is None else _make_skin(bones, shapes, triangles, cyclic)
    path.parent.mkdir(parents=True, exist_ok=True)
    animation = Animation(shapes, triangles, timing, path.name, keyframes, asset, progress, skin, targets, size)
    with atomic_write(path, suffix) as temporary:
        ANIMATION_FORMATS[suffix].write(animation, temporary)
    return path


def _check_file(
    out: str | Path, shapes: FloatArray, asset: Asset | None, bones: int | Skin | None, targets: int | None, size: int
) -> tuple[Path, str]:
    """Check that a file can be written, in a format that holds the frames as requested; returns it and its suffix."""
    path = Path(out)
    check_forms(path, bones, targets)
    if targets is not None and not (isinstance(targets, int) and 1 <= targets < len(shapes)):
        raise ValueError(f"targets must be a whole number, 1 to {len(shapes) - 1} of these frames; got {targets!r}")
    if size < 2:
        raise ValueError(f"size must be a number of pixels, 2 or more; got {size}")
    suffix = check_suffix(path, ANIMATION_FORMATS)
    if asset is not None:
        asset.check(shapes, path, ANIMATION_FORMATS[suffix].holds)
    ANIMATION_FORMATS[suffix].check_installed(path.name)
    refuse_existing(path)
    return path, suffix


def _make_skin(bones: int | Skin, shapes: FloatArray, faces: IntArray, cyclic: bool) -> Skin:
    """Bake a skin of at most this many bones, or check a given one, whose repeated frame of a cycle is dropped."""
    skin = bones if isinstance(bones, Skin) else bake(shapes, faces, bones)
    n = len(skin.transforms)
    if skin.rest.shape != shapes.shape[1:] or not 0 <= n - len(shapes) <= cyclic:
        raise ValueError(f"bones is a skin of {n} other frames than these {len(shapes)}; bake these")
    return replace(skin, transforms=skin.transforms[: len(shapes)])


def write_mp4(animation: Animation, path: Path) -> None:
    """Draw and write an MP4 file, H.264."""
    import imageio.v2 as imageio

    options: dict[str, Any] = {"codec": "libx264", "macro_block_size": 1, "ffmpeg_log_level": "error"}
    pictures = _pictures(animation)
    writer: Any = imageio.get_writer(path, format="FFMPEG", mode="I", fps=animation.timing.fps, **options)
    with writer:
        for picture in pictures:
            writer.append_data(picture)


def write_gif(animation: Animation, path: Path) -> None:
    """Draw and write a GIF that repeats for ever."""
    from PIL import Image

    # GIF counts in hundredths of a second, and players slow down below two of them.
    milliseconds = max(20, 10 * round(100 / animation.timing.fps))
    first, *others = map(Image.fromarray, _pictures(animation))
    first.save(path, save_all=True, append_images=others, duration=milliseconds, loop=0)


def _pictures(animation: Animation) -> list[ByteArray]:
    """Draw the sequence from one viewpoint, at the rate of its timing."""
    shapes, faces = animation.shapes, animation.faces
    places = animation.timing.samples()
    # A frame that is shown twice, as on the way back, is drawn once.
    unique, which = np.unique(places, return_inverse=True)
    points = resample(shapes, unique) @ view_rotation(shapes[0], None, None).T
    points, half = fit_into_cells(points[None])
    # H.264 stores colour for blocks of two by two.
    size = np.maximum((animation.size * half / half.max() / 2).round() * 2, 2).astype(np.int64)
    surface, asset = plain(np.broadcast_to(BETWEEN_COLOR, points[0, 0].shape), faces), animation.asset
    if asset is not None and asset.is_painted:
        corners = points[0, 0][faces] * float(size.max() / half.max() / 2)
        side = float(np.quantile(np.linalg.norm(corners - np.roll(corners, 1, 1), axis=-1), 0.9))
        most = (MOST_PIECES / len(faces)) ** 0.5
        surface = textured(asset, max(1, int(min(np.ceil(side / PIECE_PIXELS), most))))
    images: list[ByteArray] = []
    with ProgressReport(len(unique), "pictures", animation.progress, unit="picture") as report:
        for shape in points[0]:
            images.append(draw_image(shape, surface, half, size))
            report.update()
    return [images[number] for number in which.reshape(-1)]
