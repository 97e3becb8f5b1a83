"""A page that plays sequences of shapes, or on which landmarks are picked: one HTML file that needs no other.

It joins the files in page_assets with the shapes of page_data.py. Its content security policy allows its own scripts by
their hashes and forbids everything else, so that text in file names or titles cannot run.
"""

from __future__ import annotations

import base64
import hashlib
import html
import json
import re
from collections.abc import Mapping, Sequence
from importlib.resources import files
from pathlib import Path
from typing import Any, Literal

import numpy as np

from torch_modal.arrays import Array
from torch_modal.io.asset import FEATURES, Asset
from torch_modal.io.files import write_files
from torch_modal.io.formats import PAGES
from torch_modal.io.write import check_frames, check_indices, check_suffix, refuse_existing, to_numpy
from torch_modal.times import check_times
from torch_modal.version import __version__
from torch_modal.view.page_data import pack_group
from torch_modal.view.picture import check_sequences, check_view

POLICY = "default-src 'none'; img-src data: blob:; base-uri 'none'; form-action 'none'"
SCRIPTS = ("meshes.js", "stage.js", "page.js")


class Page:
    """A page of shapes as HTML, which notebooks display, with a height in pixels, and :meth:`save` writes.

    Raises:
        ValueError: A height below 1.
    """

    def __init__(self, html: str, height: int = 600) -> None:
        if height < 1:
            raise ValueError(f"height is a number of pixels, at least 1; got {height}")
        self.html = html
        self.height = height

    def __repr__(self) -> str:
        return f"<torch_modal.Page of {len(self.html) / 1e6:.1f} MB; its save(path) writes it>"

    def _repr_html_(self) -> str:
        # The sandbox isolates the page's scripts from the notebook's.
        return (
            '<iframe sandbox="allow-scripts allow-downloads" allow="clipboard-write" loading="lazy" '
            f'style="width: 100%; height: {self.height}px; border: 1px solid #dde3e9; border-radius: 8px" '
            f'srcdoc="{html.escape(self.html)}"></iframe>'
        )

    def save(self, out: str | Path) -> Path:
        """Write the page as one HTML file, ``*.html``, which is replaced if it exists; returns its path.

        Raises:
            ValueError: ``out`` does not end in .html.
            IsADirectoryError: ``out`` is a folder.
        """
        path = Path(out)
        check_suffix(path, PAGES)
        refuse_existing(path)
        write_files([(path, self.html.encode("utf-8"))])
        return path


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
    asset: Asset | None = None,
    title: str = "torch_modal",
    height: int = 600,
) -> Page:
    """A page that shows sequences of shapes, in a notebook or saved: play, orbit, compare, pick and follow vertices.

    In the page, shapes between two neighbouring frames are blended linearly. Positions are stored in 65,535 steps along
    the longest side of all shapes together, so they are off by at most 8e-6 of it.

    Args:
        sequences: Shapes, or several sequences under their names, for example ``{"torch_modal": x, "linear": y}``,
            shown side by side or overlaid. *Shape of each:* ``(N, V, 3)``, the same for all.
        faces: Vertex indices. *Shape:* ``(F, 3)``.
        keyframe_indices: Frames that are key-frames: drawn in the other colour and marked on the time line; an empty
            list means none. By default the first and the last.
        times: The time of each frame, ascending; shown next to its number, and the time line keeps their distances.
            Evenly spaced by default. *Shape:* ``(N,)``.
        fps: Frames a second, on average if ``times`` are given.
        cyclic: Add the step from the last frame back to the first, unless the two are equal already.
        view: Azimuth and elevation of the first view in degrees, as for :func:`torch_modal.render_sequence`.
        up: ``"y"`` or ``"z"``; by default Y, unless the first shape is flat in Y.
        asset: The mesh file that the shapes come from (:func:`torch_modal.open_asset`), with whose materials, textures
            and vertex colours all sequences are shown. Textures are at most 2,048 pixels wide and high.
        title: Of the page.
        height: In pixels, in a notebook.

    Returns:
        The page. Notebooks show it; ``save(path)`` writes it.

    Raises:
        ValueError: An argument cannot be used; the message says why.

    Warns:
        MeshWarning: A texture cannot be read, and is white.
    """
    check_view(view, up)
    by_name = sequences if isinstance(sequences, Mapping) else {"shapes": sequences}
    if not (np.isfinite(fps) and fps > 0):
        raise ValueError(f"fps must be a positive number, got {fps}")
    checked, triangles = check_sequences({str(name): frames for name, frames in by_name.items()}, faces, "sequences")
    shapes = list(checked.values())
    n = len(shapes[0])
    if asset is not None:
        asset.check(shapes[0], Path("page.html"), FEATURES)
    keyframes = check_indices([0, n - 1] if keyframe_indices is None else keyframe_indices, n, "keyframe_indices")
    stamps = check_times(times, n, of="frame").numpy()
    if cyclic and n > 1 and not all(np.array_equal(frames[0], frames[-1]) for frames in shapes):
        stamps = np.append(stamps, stamps[-1] + (stamps[-1] - stamps[0]) / (n - 1))  # when the first comes again
    data = {"n_frames": n, "times": stamps.tolist(), "has_times": times is not None, "fps": float(fps)}
    return _page([pack_group(checked, triangles, view, up, asset)], title, height, **data, keyframes=keyframes)


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
        raise ValueError(f"landmarks belong to two meshes or more, got {len(meshes)}")
    checked = {
        str(name): check_frames(to_numpy(vertices)[None], faces, f"meshes[{name!r}][0][None]")
        for name, (vertices, faces) in meshes.items()
    }
    rows = np.zeros((0, len(checked)), dtype=np.int64) if landmarks is None else to_numpy(landmarks)
    counts = [shape.shape[1] for shape, _ in checked.values()]
    fits = rows.ndim == 2 and rows.shape[1] == len(checked) and rows.dtype.kind in "iu"
    if not fits or ((rows < 0) | (rows >= counts)).any():
        raise ValueError(f"landmarks must be indices, a column for each of the meshes, of their {counts} vertices")
    groups = [pack_group({name: shape}, faces) for name, (shape, faces) in checked.items()]
    return _page(groups, title, height, landmarks=rows.tolist())


def _page(groups: list[dict[str, Any]], title: str, height: int, **data: Any) -> Page:
    """Page of groups of shapes, with the data that page.js reads. Titles and names are escaped."""
    still = {"n_frames": 1, "times": [0.0], "has_times": False, "fps": 24.0, "keyframes": [], "landmarks": None}
    data = {"groups": groups, **still, **data}
    assets = files("torch_modal.view") / "page_assets"

    def asset(name: str) -> str:
        return (assets / name).read_text(encoding="utf-8")

    style, library = asset("page.css"), asset("three.min.js")
    # In a function scope, strict.
    program = '(() => {\n"use strict";\n' + "\n".join(map(asset, SCRIPTS)) + "})();\n"
    parts = {
        "@POLICY@": f"{POLICY}; style-src {_hash(style)}; script-src {_hash(library)} {_hash(program)}",
        "@GENERATOR@": f"torch_modal {__version__}",
        "@TITLE@": html.escape(title),
        "@STYLE@": style,
        "@DATA@": json.dumps(data, allow_nan=False).replace("<", "\\u003c"),
        "@LIBRARY@": library,
        "@PROGRAM@": program,
    }
    # In one pass: markers inside inserted text stay.
    return Page(re.sub("|".join(parts), lambda marker: parts[marker.group()], asset("page.html")), height)


def _hash(text: str) -> str:
    """The source expression of an inline script or style in a content security policy."""
    return f"'sha256-{base64.b64encode(hashlib.sha256(text.encode('utf-8')).digest()).decode('ascii')}'"
