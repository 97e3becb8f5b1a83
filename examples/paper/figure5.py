"""Figure 5: where the modes fall short, the segments that they suggest, and local interpolation of the worst of them.

The paper finds regions by the method of Huang et al. 2009 and interpolates them once more by that of Froehlich and
Botsch 2011, the rest held. Here:

- the *local fitting error* of a vertex is what is left of the way from one key-frame to the other, when the modes of
  the first are fitted to it;
- *segments* are parts that move nearly rigidly in all modes, each mode as large as it is at a given energy: pairs of
  neighbours are joined, from the cheapest on, until so many are left;
- the *regions* are the segments of the largest mean error, up to a part of the surface;
- of the two shapes that Eq. 4 gives, ``x1`` near the first key-frame and ``x2`` near the second, the regions are put
  half-way between ``x1`` and the second key-frame, and between ``x2`` and the first. The mid-shape is the mean of both.
"""

import heapq
from pathlib import Path
from typing import NamedTuple

import _paths  # noqa: F401
import matplotlib
import numpy as np
import torch
from errors import edge_error, lengths, vertex_error
from full_space import full_space
from numpy.typing import NDArray
from torch import Tensor

import torch_modal as tm
from torch_modal.data.samples import load_sample
from torch_modal.geometry.connectivity import Connectivity, vertex_areas
from torch_modal.geometry.rigid import best_fit
from torch_modal.modes.coarsening import coarsen
from torch_modal.view.drawing import Scene, draw
from torch_modal.view.picture import BETWEEN_COLOR, ERROR_COLORS, KEYFRAME_COLOR, centred, view_rotation

matplotlib.use("Agg")
from matplotlib import pyplot

FloatArray = NDArray[np.float64]

PAIR = 2
"""The key-frame of the gallop before, at which the legs begin to be drawn in."""
N_MODES = 50
N_SEGMENTS = 24
WORST = 0.06
"""The part of the surface that the regions may be."""
REGION_COLOR = (0.78, 0.22, 0.20)


class Halves(NamedTuple):
    """What Eq. 4 gives, before the mean is taken."""

    first: Tensor
    """``x1``, near the first key-frame. *Shape:* ``(V, 3)``."""
    second: Tensor
    """``x2``. *Shape:* ``(V, 3)``."""


def fitting_error(basis: tm.ModalBasis, x: Tensor, weights: Tensor) -> FloatArray:
    """Distance of a shape from the nearest one that the modes reach. *Shape:* ``(V, 3), (V,) -> (V,)``."""
    way = best_fit(x, basis.reference, weights).apply(x) - basis.reference
    root = weights.sqrt()[None, :, None]
    columns = (basis.modes * root).flatten(1).T
    amplitudes = torch.linalg.lstsq(columns, (way * root[0]).reshape(-1, 1)).solution[:, 0]
    return (way - torch.tensordot(amplitudes, basis.modes, 1)).norm(dim=1).numpy()


def segments(basis: tm.ModalBasis, faces: Tensor, n_segments: int, n_faces: int = 1200) -> NDArray[np.int64]:
    """Parts that are nearly rigid in all modes (Huang et al. 2009): the segment of each vertex. *Shape:* ``(V,)``."""
    rest, triangles = basis.reference.numpy(), faces.numpy()
    coarsening = coarsen(rest[None], triangles, n_faces)
    x = coarsening.restrict(rest)
    modes = coarsening.restrict(basis.modes.numpy() / basis.eigenvalues.numpy()[:, None, None] ** 0.5)
    area = np.bincount(coarsening.clusters, vertex_areas(rest, triangles), len(x))
    skew = np.zeros((len(x), 3, 3))
    skew[:, [0, 1, 2], [1, 2, 0]], skew[:, [1, 2, 0], [0, 1, 2]] = x[:, [2, 0, 1]], -x[:, [2, 0, 1]]
    rigid = np.concatenate([np.broadcast_to(np.eye(3), skew.shape), skew], axis=2)  # of a turn: w x p
    normal = np.einsum("v,vci,vcj->vij", area, rigid, rigid)
    right = np.einsum("v,vci,kvc->vik", area, rigid, modes)
    whole = np.einsum("v,kvc,kvc->v", area, modes, modes)

    def left(a: FloatArray, b: FloatArray, c: float) -> float:
        """What no rigid motion explains."""
        return c - float(np.einsum("ik,ik->", b, np.linalg.pinv(a, hermitian=True) @ b))

    parts = {i: (normal[i], right[i], whole[i], 0.0) for i in range(len(x))}
    near: dict[int, set[int]] = {i: set() for i in parts}
    for i, j in Connectivity(coarsening.faces).edges.tolist():
        near[i].add(j)
        near[j].add(i)
    owner = np.arange(len(x))
    queue: list[tuple[float, int, int]] = []

    def offer(i: int, j: int) -> None:
        together = [p + q for p, q in zip(parts[i][:3], parts[j][:3], strict=True)]
        heapq.heappush(queue, (left(*together) - parts[i][3] - parts[j][3], i, j))

    for i, others in near.items():
        for j in others:
            if i < j:
                offer(i, j)
    new = len(x)
    while len(parts) > n_segments and queue:
        _, i, j = heapq.heappop(queue)
        if i not in parts or j not in parts:
            continue
        a, b, c = (p + q for p, q in zip(parts.pop(i)[:3], parts.pop(j)[:3], strict=True))
        parts[new] = a, b, c, left(a, b, c)
        near[new] = (near.pop(i) | near.pop(j)) - {i, j}
        owner[(owner == i) | (owner == j)] = new
        for other in near[new]:
            near[other] = (near[other] - {i, j}) | {new}
            offer(other, new)
        new += 1
    return np.unique(owner, return_inverse=True)[1][coarsening.clusters]


def regions(error: FloatArray, segment: NDArray[np.int64], areas: FloatArray) -> NDArray[np.bool_]:
    """The segments of the largest mean error, up to a part of the surface. *Shape:* ``(V,)`` each."""
    size = np.bincount(segment, areas) / areas.sum()
    mean = np.bincount(segment, areas * error) / np.bincount(segment, areas)
    chosen, sum_of_sizes = [], 0.0
    for number in np.argsort(-mean):
        if sum_of_sizes + size[number] <= WORST:
            chosen.append(number)
            sum_of_sizes += size[number]
    return np.isin(segment, chosen)


def halves(layer: tm.MidShape, x_a: Tensor, x_b: Tensor) -> Halves:
    """The two shapes of Eq. 4, in the caller's coordinates."""
    with torch.no_grad():
        amplitudes = layer.solve(x_a, x_b).solution.amplitudes[None]
        space, alignment = layer.space, layer.in_between.core.alignment
        placed, pose, _ = alignment(torch.stack([x_a, x_b])[None], torch.full((1, 2), 0.5, dtype=x_a.dtype))
        ends = zip((space.first, space.second), space.split(amplitudes), placed.unbind(1), strict=True)
        return Halves(*(alignment.restore(end.lift(a, x), pose)[0] for end, a, x in ends))


def interpolated(x: Tensor, other: Tensor, faces: Tensor, region: NDArray[np.bool_], rings: int = 2) -> Tensor:
    """A shape whose regions are half-way to another's, the rest held. *Shape:* ``(V, 3), (V, 3) -> (V, 3)``."""
    inner = torch.from_numpy(region)
    around = inner.clone()
    for _ in range(rings):
        around[faces[around[faces].any(1)]] = True
    some = faces[around[faces].all(1)]
    used, numbered = some.unique(return_inverse=True)
    size = float((x.amax(0) - x.amin(0)).norm())
    fixed = ~inner[used]
    found = full_space(
        x[used], other[used], numbered, start=x[used], example_based=True, fixed=fixed, size=size, max_steps=30
    )
    return x.index_copy(0, used, torch.where(fixed[:, None], x[used], found.shape))


def main(out: Path, overwrite: bool = True) -> list[str]:
    """Draw what is found, and the mid-shape without and with."""
    sample = load_sample("creature")
    faces = sample.faces
    x_a, x_b = ends = sample.keyframes[PAIR : PAIR + 2]
    truth = sample.truth[PAIR]
    bases = tm.extract_bases(ends, faces, N_MODES, mesher="lattice", progress=False)
    areas = vertex_areas(x_a.numpy(), faces.numpy())
    error = fitting_error(bases[0], x_b, torch.from_numpy(areas)) / float((x_a.amax(0) - x_a.amin(0)).norm())
    segment = segments(bases[0], faces, N_SEGMENTS)
    region = regions(error, segment, areas)
    near = halves(tm.MidShape(bases, faces, preset="paper"), x_a, x_b)
    local = Halves(*(interpolated(x, end, faces, region) for x, end in zip(near, (x_b, x_a), strict=True)))
    with torch.no_grad():
        own = tm.MidShape(bases, faces)(x_a, x_b)
    shapes = {
        "Eq. 4": (near.first + near.second) / 2,
        "Eq. 4, local interpolation": (local.first + local.second) / 2,
        "torch_modal": own,
        "truth": truth,
    }
    _draw(out / "paper-figure5.png", ends, faces, 100 * error, segment, region, shapes, overwrite)
    inside = torch.from_numpy(region)[faces].all(1)
    lines = [
        f"regions: {100 * float(areas[region].sum() / areas.sum()):.0f} % of the surface; edge error, in the regions"
    ]
    lines[0] += ", vertex error:"
    for name, x in shapes.items():
        if name != "truth":
            parts = [edge_error(x, truth, f) for f in (faces, faces[inside])]
            vertices = vertex_error(x[None], truth[None])
            lines.append(f"{name:26s} {parts[0]:.2f} %  {parts[1]:.2f} %  {vertices:.2f} %")
    return lines


def _draw(
    file: Path,
    ends: Tensor,
    faces: Tensor,
    error: FloatArray,
    segment: NDArray[np.int64],
    region: NDArray[np.bool_],
    shapes: dict[str, Tensor],
    overwrite: bool,
) -> None:
    """Three rows: what is found on the first key-frame, mid-shapes, and the errors of their edges from nearby."""
    if file.exists() and not overwrite:
        raise FileExistsError(file)
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
    placed, half = centred(np.stack([x.numpy() @ rotation.T for _, x, _ in cells])[None])
    points = placed[0]
    images = _images(points, np.stack([color for *_, color in cells]), faces, half)
    low, high = (f(points[4:, region], axis=(0, 1)) for f in (np.min, np.max))
    close = 0.62 * (high - low)[:2].max() * half / half[1]
    nearby = _images(points[4:] - (low + high) / 2, scales[1].to_rgba(off)[..., :3], faces, close)

    figure, axes = pyplot.subplots(3, 4, figsize=(11, 6.2), dpi=110, layout="constrained")
    for cell, image in zip(axes.flat, [*images, *nearby], strict=True):
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
    return draw(Scene(points, (255 * paint).round().astype(np.uint8), faces.numpy(), half, pixels), "auto")


if __name__ == "__main__":
    print("\n".join(main(Path())))
