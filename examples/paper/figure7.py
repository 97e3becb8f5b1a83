"""Figure 7: a wading bird folds a slender leg; the example-driven method of Froehlich and Botsch (2011) beside others.

The bird is sculpted and posed here. Their method interpolates edge lengths, dihedral angles and volume, and seeks the
shape on a decimated mesh; it is in ``tests/benchmarks``. Printed are errors of edge lengths and vertices, by what angle
the leg that moves is off, and how thin the thinnest place of the legs gets, over its thickness in truth; and the errors
half-way to a leg that is folded three quarters as far.
"""

from collections.abc import Sequence
from pathlib import Path

import _paths  # noqa: F401
import numpy as np
import torch
from _bipeds import Biped, biped
from errors import edge_error, percents, vertex_error, wanted
from reduced import ReducedPair, froehlich_botsch
from results import Table
from torch import Tensor

import torch_modal as tm
from torch_modal.geometry.rigid import best_fit

COLUMNS = ["fold", "method", "edge error", "vertex error", "leg off", "thinnest"]
LABELS = 2
CHECK = "torch_modal"
THEIRS = "Fröhlich and Botsch 2011"
LEG = ("tibia", "tarsus")
SLICES = 8
FOLDS = {"whole": 1.0, "three quarters": 0.75}
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


def main(table: Table, out: Path | None, only: Sequence[str]) -> None:
    """Draw the rows of the whole fold."""
    body = biped("wader", None)
    faces = torch.from_numpy(body.faces)
    for fold, most in FOLDS.items():
        truth = torch.stack([torch.from_numpy(body.pose(most * n / 4)) for n in range(5)])
        x_a, x_b = ends = truth[[0, 4]]
        rows = {}
        if wanted(THEIRS, only):
            reduced = ReducedPair(x_a, x_b, faces, 1000)
            rows[THEIRS] = torch.stack([x_a, *(froehlich_botsch(reduced, n / 4) for n in (1, 2, 3)), x_b])
        if wanted("the paper", only):
            rows["the paper"] = tm.subdivide(ends, faces, levels=2, preset="paper", progress=False)
        if wanted("torch_modal", only):
            rows["torch_modal"] = tm.subdivide(ends, faces, levels=2, progress=False)
        for name, x in rows.items():
            between, known = x[1:-1], truth[1:-1]
            errors = percents(edge_error(between, known, faces), vertex_error(between, known))
            legs = f"{turned(body, between, known):.0f}°", f"{thinnest(body, between, known):.2f}"
            table.add(fold, name, *errors, *legs)
        if out and most == 1:
            drawn = {name.replace(" and ", " and\n"): x for name, x in (rows | {"truth": truth}).items()}
            tm.render_sequence(drawn, faces, out / "paper-figure7.png", keyframe_indices=[0, 4], overwrite=True)
