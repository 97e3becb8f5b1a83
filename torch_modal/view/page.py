"""Pages that play sequences of shapes, or on which landmarks are picked, packed by page_data.py into one HTML file."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np

from torch_modal.arrays import Array, FloatArray, IntArray
from torch_modal.io.write import check_frames, check_indices, to_numpy
from torch_modal.view.document import Page, checked_path, document
from torch_modal.view.page_data import grid_of, pack_faces, pack_frames, quantise
from torch_modal.view.picture import check_sequences, check_view, up_axis, view_rotation

COMMON_SCRIPTS = ("dom.js", "decode.js", "measure.js", "stage.js")
SCRIPTS = (*COMMON_SCRIPTS, "timeline.js", "page.js")
LANDMARK_SCRIPTS = (*COMMON_SCRIPTS, "landmarks.js")


def show(
    sequences: Mapping[str, Array] | Array,
    faces: Array,
    *,
    keyframe_indices: Sequence[int] | None = None,
    times: Sequence[float] | None = None,
    fps: float = 24.0,
    cyclic: bool = False,
    view: tuple[float, float] | None = None,
    up: Literal["y", "z"] | None = None,
    title: str = "torch_modal",
    height: int = 600,
) -> Page:
    """A page that shows sequences of shapes, in a notebook or saved: play, orbit, compare, measure, pick vertices.

    In the page, shapes between two neighbouring frames are blended linearly. Positions are stored in 65,535 steps along
    the longest side of all shapes together, so they are off by at most 8e-6 of it.

    Args:
        sequences: Shapes, or several sequences under their names, for example ``{"torch_modal": x, "linear": y}``,
            shown side by side or overlaid. *Shape of each:* ``(N, V, 3)``, the same for all.
        faces: Vertex indices. *Shape:* ``(F, 3)``.
        keyframe_indices: Frames that are key-frames: drawn in the other colour and marked on the time line; an empty
            list means none. By default the first and the last.
        times: The time of each frame, rising; shown beside its number, and the time line keeps their distances. Evenly
            spaced by default. *Shape:* ``(N,)``.
        fps: Frames a second, on average if ``times`` are given.
        cyclic: Add the step from the last frame back to the first, unless the two are equal already.
        view: Azimuth and elevation of the first view in degrees, as for :func:`torch_modal.render_sequence`.
        up: ``"y"`` or ``"z"``; by default Y, unless the first shape is flat in Y.
        title: Of the page.
        height: In pixels, in a notebook.

    Returns:
        The page. Notebooks show it; ``save(path)`` writes it.

    Raises:
        ValueError: An argument cannot be used; the message says why.
    """
    check_view(view, up)
    given = sequences if isinstance(sequences, Mapping) else {"shapes": sequences}
    if not (np.isfinite(fps) and fps > 0):
        raise ValueError(f"fps must be a positive number, got {fps}.")
    checked, triangles = check_sequences({str(name): frames for name, frames in given.items()}, faces, "sequences")
    shapes = list(checked.values())
    n_frames = len(shapes[0])
    ends = [0, n_frames - 1]
    keyframes = check_indices(ends if keyframe_indices is None else keyframe_indices, n_frames, "keyframe_indices")
    stamps = np.arange(n_frames, dtype=np.float64) if times is None else _checked_times(times, n_frames)
    closed = cyclic and n_frames > 1 and not all(np.array_equal(frames[0], frames[-1]) for frames in shapes)
    data = {
        "times": stamps.tolist(),
        "has_times": times is not None,
        "fps": float(fps),
        "closed": closed,
        "keyframes": keyframes,
        **_packed(checked, triangles, view, up),
    }
    return Page(document("page.html", SCRIPTS, title, data), height)


def write_page(
    sequences: Mapping[str, Array] | Array,
    faces: Array,
    out: str | Path,
    *,
    title: str | None = None,
    overwrite: bool = False,
    **options: Any,
) -> Path:
    """Write a page that shows sequences of shapes, as one HTML file that works without a network.

    Args:
        sequences: As for :func:`show`.
        faces: Vertex indices. *Shape:* ``(F, 3)``.
        out: File to write, ``*.html``.
        title: Of the page; by default the file's name.
        overwrite: Replace the file if it exists.
        options: Further arguments of :func:`show`, such as ``keyframe_indices``.

    Returns:
        The file.

    Raises:
        ValueError: An argument cannot be used; the message says why.
        FileExistsError: The file exists and ``overwrite`` is off.
    """
    path = checked_path(out, overwrite)
    return show(sequences, faces, title=path.stem if title is None else title, **options).save(path, overwrite)


def show_landmarks(
    meshes: Mapping[str, tuple[Array, Array]],
    landmarks: Array | None = None,
    *,
    title: str = "landmarks",
    height: int = 600,
) -> Page:
    """A page to pick landmarks for :func:`torch_modal.register`: vertices of several meshes that belong together.

    Each mesh has its own camera. The first click on each gives the first landmark, and so on. The page copies or saves
    the text file for ``landmarks=`` of :func:`torch_modal.load_keyframes` and for ``--landmarks``.

    Args:
        meshes: Name, vertices ``(V, 3)`` and faces ``(F, 3)`` of two or more meshes of any connectivity.
        landmarks: Landmarks to start from: vertex indices, a column for each mesh. *Shape:* ``(n, K)``.
        title: Of the page.
        height: In pixels, in a notebook.

    Returns:
        The page. Notebooks show it; ``save(path)`` writes it.

    Raises:
        ValueError: An argument cannot be used; the message says why.
    """
    if len(meshes) < 2:
        raise ValueError(f"landmarks belong to two meshes or more, got {len(meshes)}.")
    checked = [
        (str(name), *check_frames(to_numpy(vertices)[None], faces, f"meshes[{name!r}][0][None]"))
        for name, (vertices, faces) in meshes.items()
    ]
    rows = np.zeros((0, len(checked)), dtype=np.int64) if landmarks is None else to_numpy(landmarks)
    if rows.ndim != 2 or rows.shape[1] != len(checked) or rows.dtype.kind not in "iu":
        raise ValueError(
            f"landmarks must be vertex indices, a column for each of the {len(checked)} meshes, got shape {rows.shape} "
            f"and dtype {rows.dtype}."
        )
    counts = np.array([shape.shape[1] for _, shape, _ in checked])
    if ((rows < 0) | (rows >= counts)).any():
        raise ValueError(f"landmarks must index the {counts.tolist()} vertices of the meshes from 0.")
    data: dict[str, Any] = {
        "meshes": [_packed({name: shape}, faces) for name, shape, faces in checked],
        "landmarks": rows.tolist(),
    }
    return Page(document("landmarks.html", LANDMARK_SCRIPTS, title, data), height)


def _checked_times(times: Sequence[float], n_frames: int) -> FloatArray:
    stamps: FloatArray = np.asarray(to_numpy(times), dtype=np.float64)  # type: ignore[arg-type]
    if stamps.shape != (n_frames,) or not np.isfinite(stamps).all() or (np.diff(stamps) <= 0).any():
        raise ValueError(
            f"times must be {n_frames} finite numbers, one a frame, each larger than the one before; got "
            f"{np.array2string(stamps, threshold=8)} of shape {stamps.shape}."
        )
    return stamps


def _packed(
    sequences: dict[str, FloatArray],
    faces: IntArray,
    view: tuple[float, float] | None = None,
    up: Literal["y", "z"] | None = None,
) -> dict[str, Any]:
    """Shapes, faces and the first view of a page; lengths in steps of the grid."""
    first = next(iter(sequences.values()))[0]
    rotation = view_rotation(first, view, up)
    grid = grid_of(list(sequences.values()))
    numbers = {name: quantise(frames, grid) for name, frames in sequences.items()}
    # The box around everything along right, up and front; the camera orbits its middle.
    low = np.min([_extreme(frames, rotation, np.min) for frames in numbers.values()], axis=0)
    high = np.max([_extreme(frames, rotation, np.max) for frames in numbers.values()], axis=0)
    return {
        "origin": grid.origin.tolist(),
        "step": grid.step,
        "n_vertices": len(first),
        "n_faces": len(faces),
        "faces": pack_faces(faces),
        "sequences": [{"name": name, "frames": pack_frames(frames)} for name, frames in numbers.items()],
        "diagonal": max(float(np.linalg.norm(np.ptp(first, axis=0))) / grid.step, 1.0),
        "view": {
            "front": rotation[2].tolist(),
            "centre": (0.5 * (low + high) @ rotation).tolist(),
            "half": (0.5 * (high - low)).tolist(),
            "world_up": [0, 1, 0] if up_axis(first, up) == "y" else [0, 0, 1],
        },
    }


def _extreme(numbers: Any, rotation: FloatArray, which: Any) -> FloatArray:
    """Least or largest coordinates of shapes ``(N, V, 3)`` in view directions, a frame at a time to save memory."""
    found: FloatArray = which([which(shape @ rotation.T, axis=0) for shape in numbers], axis=0)
    return found
