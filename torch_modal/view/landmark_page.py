"""A page to pick landmarks on meshes of any connectivity, side by side."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from torch_modal.arrays import Array
from torch_modal.io.write import check_frames, to_numpy
from torch_modal.view.document import Page, document
from torch_modal.view.page import packed

__all__ = ["show_landmarks"]

SCRIPTS = ("dom.js", "decode.js", "measure.js", "stage.js", "landmarks.js")


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
        "meshes": [packed({name: shape}, faces) for name, shape, faces in checked],
        "landmarks": rows.tolist(),
    }
    return Page(document("landmarks.html", SCRIPTS, title, data), height)
