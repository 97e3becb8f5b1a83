"""Figure 7: a wading bird folds a slender leg; the example-driven method of Froehlich and Botsch (2011) beside others.

The bird is sculpted and posed here. Their method interpolates edge lengths, dihedral angles and volume, and seeks the
shape on a decimated mesh; it is in ``tests/benchmarks``. Printed are errors of edge lengths and vertices, by what angle
the leg that moves is off, and how thin the thinnest place of the legs gets, over its thickness in truth; and the errors
half-way to a leg that is folded three quarters as far.
"""

from pathlib import Path

import _paths  # noqa: F401
import numpy as np
import torch
from _bipeds import Biped, biped
from errors import edge_error, vertex_error
from reduced import ReducedPair, froehlich_botsch
from torch import Tensor

import torch_modal as tm
from torch_modal.geometry.rigid import best_fit

THEIRS = "Froehlich and\nBotsch 2011"
LEG = ("tibia", "tarsus")
SLICES = 8
LESS = 0.75
"""Of the way from pose to pose."""


def thinnest(body: Biped, x: Tensor, truth: Tensor) -> float:
    """The least thickness of a slice of a leg bone over its thickness in truth. *Shape:* ``(T, V, 3)``."""
    found = []
    for number, (name, bone) in enumerate(body.bones.items()):
        members = np.flatnonzero(body.bone == number)
        if not name.startswith(LEG) or len(members) < 8 * SLICES:
            continue
        along = (body.rest[members] - bone.head) @ np.subtract(bone.tail, bone.head)
        for part in np.array_split(members[np.argsort(along)], SLICES)[1:-1]:
            # Around the slice and along it; the least of the three is across.
            spread = [torch.linalg.svdvals(y[:, part] - y[:, part].mean(1, keepdim=True))[:, 2] for y in (x, truth)]
            found.append((spread[0] / spread[1]).amin())
    return float(torch.stack(found).amin())


def turned(body: Biped, x: Tensor, truth: Tensor) -> float:
    """By how many degrees the lower part of the left leg is off, at the most. *Shape:* ``(T, V, 3)``."""
    bone = body.bones["tarsus-left"]
    members = np.flatnonzero(body.bone == list(body.bones).index("tarsus-left"))
    along = (body.rest[members] - bone.head) @ np.subtract(bone.tail, bone.head)
    parts = np.array_split(members[np.argsort(along)], 4)
    laid = best_fit(x, truth, torch.ones(x.shape[1], dtype=x.dtype)).apply(x)
    here, there = (y[:, parts[-1]].mean(1) - y[:, parts[0]].mean(1) for y in (laid, truth))
    return float(torch.rad2deg(torch.acos(torch.cosine_similarity(here, there, dim=-1))).amax())


def main(out: Path, overwrite: bool = True, cell: float | None = None, levels: int = 2) -> list[str]:
    """Draw the rows; ``cell`` is the length of the edges."""
    last = 2**levels
    times = [n / last for n in range(last + 1)]
    body = biped("wader", cell)
    faces = torch.from_numpy(body.faces)
    truth = torch.stack([torch.from_numpy(body.pose(t)) for t in times])
    x_a, x_b = keyframes = truth[[0, last]]
    reduced = ReducedPair(x_a, x_b, faces, 1000)
    rows = {
        THEIRS: torch.stack([x_a, *(froehlich_botsch(reduced, t) for t in times[1:-1]), x_b]),
        "the paper": tm.subdivide(keyframes, faces, levels=levels, preset="paper", progress=False),
        "torch_modal": tm.subdivide(keyframes, faces, levels=levels, progress=False),
        "truth": truth,
    }
    tm.render_sequence(rows, faces, out / "paper-figure7.png", keyframe_indices=[0, last], overwrite=overwrite)
    lines = [
        f"{len(body.rest)} vertices; quarters and half-way: edge and vertex error, leg off, thinnest place of legs"
    ]
    for name, x in rows.items():
        if name != "truth":
            between, known = x[1:-1], truth[1:-1]
            numbers = f"{edge_error(between, known, faces):.2f} %  {vertex_error(between, known):.2f} %"
            legs = f"{turned(body, between, known):.0f} degrees  {thinnest(body, between, known):.2f}"
            lines.append(f"{' '.join(name.split()):26s} {numbers}  {legs}")
    half, end = (torch.from_numpy(body.pose(t)) for t in (0.5 * LESS, LESS))
    less = {
        " ".join(THEIRS.split()): froehlich_botsch(ReducedPair(x_a, end, faces, 1000), 0.5),
        "torch_modal": tm.subdivide(torch.stack([x_a, end]), faces, levels=1, progress=False)[1],
    }
    for name, x in less.items():
        numbers = f"{edge_error(x, half, faces):.2f} %  {vertex_error(x[None], half[None]):.2f} %"
        lines.append(f"{name:26s} {numbers}  {turned(body, x[None], half[None]):.0f} degrees, folded less")
    return lines


if __name__ == "__main__":
    print("\n".join(main(Path())))
