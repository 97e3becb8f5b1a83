"""Figure 5: where the modes fall short, the segments that they suggest, and local interpolation of the worst of them.

:mod:`torch_modal.inbetween.regions` says what each is; the preset ``"paper"`` does it.
"""

from collections.abc import Sequence
from pathlib import Path

import _paths  # noqa: F401
import matplotlib
import numpy as np
import torch
from errors import edge_error, lengths, percents, vertex_error
from numpy.typing import NDArray
from results import Table, wanted
from torch import Tensor

import torch_modal as tm
from torch_modal.data.samples import load_sample
from torch_modal.geometry.canonical import CANONICAL_SIZE
from torch_modal.geometry.connectivity import Connectivity
from torch_modal.inbetween.regions import fitting_error, segments
from torch_modal.view.drawing import draw_image, plain
from torch_modal.view.picture import BETWEEN_COLOR, ERROR_COLORS, KEYFRAME_COLOR, fit_into_cells, view_rotation

matplotlib.use("Agg")
from matplotlib import pyplot

FloatArray = NDArray[np.float64]

COLUMNS = ["half-way", "edge error", "in the regions", "vertex error"]
CHECK = "'Eq. 4' torch_modal"
PAIR = 2
"""The key-frame of the gallop before, at which the legs begin to be drawn in."""
REGION_COLOR = (0.78, 0.22, 0.20)


def main(table: Table, out: Path | None, only: Sequence[str]) -> None:
    """Draw what is found, and the mid-shape without and with."""
    sample = load_sample("creature")
    faces = sample.faces
    x_a, x_b = ends = sample.keyframes[PAIR : PAIR + 2]
    truth = sample.truth[PAIR]
    bases = tm.extract_bases(ends, faces, mesher="lattice", progress=False)
    layer = tm.MidShape(bases, faces, preset="paper")
    core, space = layer.in_between.core, layer.space
    clusters = space.first.coarse.clusters.numpy()
    # The bounding box of a shape in the frame of a layer is about this large.
    error = fitting_error(space, core.alignment.references)[clusters] / CANONICAL_SIZE
    segment = segments(space, core.alignment.references)[clusters]
    region = core.local.region.numpy()
    methods = {
        "Eq. 4": lambda: tm.MidShape(bases, faces, preset="paper", regions=0),
        "the paper": lambda: layer,
        "torch_modal": lambda: tm.MidShape(bases, faces),
    }
    with torch.no_grad():
        shapes = {name: method()(x_a, x_b) for name, method in methods.items() if wanted(name, only)}
    inside = torch.from_numpy(region)[faces].all(1)
    for name, x in shapes.items():
        parts = [edge_error(x, truth, some) for some in (faces, faces[inside])]
        table.add(name, *percents(*parts, vertex_error(x[None], truth[None])))
    if out:
        _draw(out / "paper-figure5.png", ends, faces, 100 * error, segment, region, {**shapes, "truth": truth})


def _draw(
    file: Path,
    ends: Tensor,
    faces: Tensor,
    error: FloatArray,
    segment: NDArray[np.int64],
    region: NDArray[np.bool_],
    shapes: dict[str, Tensor],
) -> None:
    """Three rows: what is found on the first key-frame, mid-shapes, and the errors of their edges from nearby."""
    off = np.stack([around_vertices(x, shapes["truth"], faces) for x in shapes.values()])
    scales = [_scale(error), _scale(off)]
    palette = pyplot.get_cmap("tab20")(np.arange(20) / 20)[:, :3] * 0.8 + 0.15
    key, plain = (np.tile(color, (len(error), 1)) for color in (KEYFRAME_COLOR, BETWEEN_COLOR))
    marked = np.where(region[:, None], REGION_COLOR, plain)
    cells = [
        ("first key-frame", ends[0], key),
        ("second key-frame", ends[1], key),
        ("local fitting error", ends[0], scales[0].to_rgba(error)[:, :3]),
        ("segments", ends[0], palette[segment % 20]),
        *((name, x, marked) for name, x in shapes.items()),
    ]
    rotation = view_rotation(ends[0].numpy(), None, None)
    placed, half = fit_into_cells(np.stack([x.numpy() @ rotation.T for _, x, _ in cells])[None])
    points = placed[0]
    images = _images(points, np.stack([color for *_, color in cells]), faces, half)
    low, high = (f(points[4:, region], axis=(0, 1)) for f in (np.min, np.max))
    close = 0.62 * (high - low)[:2].max() * half / half[1]
    nearby = _images(points[4:] - (low + high) / 2, scales[1].to_rgba(off)[..., :3], faces, close)

    figure, axes = pyplot.subplots(3, 4, figsize=(11, 6.2), dpi=110, layout="constrained")
    places = [*axes.flat[: len(images)], *axes[2]]
    for cell, image in zip(places, [*images, *nearby], strict=False):
        cell.imshow(image, interpolation="antialiased")
        cell.set(xticks=[], yticks=[])
        cell.spines[:].set(visible=cell in axes[2], color="#bbbbbb")
    for cell, (name, *_) in zip(axes.flat, cells, strict=False):
        cell.set_title(name, fontsize=10)
    for scale, row, label in zip(scales, (0, 2), ("distance, % of the diagonal", "edge error, %"), strict=True):
        bar = figure.colorbar(scale, ax=axes[row], shrink=0.95, pad=0.01, extend="max")
        bar.set_label(label, fontsize=8)
        bar.ax.tick_params(labelsize=8)
        bar.outline.set_visible(False)
    figure.savefig(file)
    pyplot.close(figure)


def around_vertices(x: Tensor, truth: Tensor, faces: Tensor) -> FloatArray:
    """Mean relative error of the edges of each vertex, in per cent. *Shape:* ``(V, 3), (V, 3) -> (V,)``."""
    wanted = lengths(truth, faces)
    error = 100 * ((lengths(x, faces) - wanted).abs() / wanted).numpy()
    ends = Connectivity(faces.numpy(), len(x)).edges.T.reshape(-1)
    return np.bincount(ends, np.tile(error, 2), len(x)) / np.maximum(np.bincount(ends, minlength=len(x)), 1)


def _scale(values: FloatArray) -> matplotlib.cm.ScalarMappable:
    """Colours from none to the 99.5th percentile."""
    return matplotlib.cm.ScalarMappable(
        matplotlib.colors.Normalize(0, np.percentile(values, 99.5)),
        matplotlib.colors.LinearSegmentedColormap.from_list("error", ERROR_COLORS),
    )


def _images(points: FloatArray, paint: FloatArray, faces: Tensor, half: FloatArray) -> NDArray[np.uint8]:
    """*Shape:* ``(S, V, 3)`` in view coordinates, and colours in [0, 1]."""
    pixels = np.maximum((420 * half / half.max()).round(), 1).astype(np.int64)
    each = zip(points, paint, strict=True)
    return np.stack([draw_image(x, plain(colors, faces.numpy()), half, pixels) for x, colors in each])


if __name__ == "__main__":
    print("\n".join(main(Path())))
