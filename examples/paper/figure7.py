"""Figure 7: a wading bird folds a slender leg; the example-driven method of Froehlich and Botsch (2011) beside others.

The bird is sculpted and posed here. Their method interpolates edge lengths, dihedral angles and volume, and seeks the
shape on a decimated mesh; it is in ``tests/benchmarks``. Printed are errors of edge lengths and vertices, by what angle
the leg that moves is off, and how thin the thinnest place of the legs gets, over its thickness in truth.
"""

from collections.abc import Sequence
from pathlib import Path

import _paths  # noqa: F401
import numpy as np
import torch
from decimated_pair import ReducedPair, froehlich_botsch
from errors import edge_error, percents, vertex_error
from results import Table, wanted
from samples.bipeds import Biped, biped
from torch import Tensor

import torch_modal as tm

COLUMNS = ["", "edge error", "vertex error", "leg off", "thinnest"]
CHECK = "torch_modal"
LEG = ("tibia", "tarsus")
SLICES = 8


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
    laid = tm.align(x, truth)
    here, there = (y[:, parts[-1]].mean(1) - y[:, parts[0]].mean(1) for y in (laid, truth))
    return float(torch.rad2deg(torch.acos(torch.cosine_similarity(here, there, dim=-1))).amax())


def main(table: Table, out: Path | None, only: Sequence[str]) -> None:
    """Draw the rows."""
    body = biped("wader", None)
    faces = torch.from_numpy(body.faces)
    truth = torch.stack([torch.from_numpy(body.pose(n / 4)) for n in range(5)])
    x_a, x_b = ends = truth[[0, 4]]
    reduced = ReducedPair(x_a, x_b, faces, 1000)
    methods = {
        "Fröhlich and Botsch 2011": lambda: torch.stack(
            [x_a, *(froehlich_botsch(reduced, n / 4) for n in (1, 2, 3)), x_b]
        ),
        "the paper": lambda: tm.interpolate(ends, faces, levels=2, preset="paper", progress=False),
        "torch_modal": lambda: tm.interpolate(ends, faces, levels=2, progress=False),
    }
    rows = {name: method() for name, method in methods.items() if wanted(name, only)}
    for name, x in rows.items():
        between, known = x[1:-1], truth[1:-1]
        errors = percents(edge_error(between, known, faces), vertex_error(between, known))
        table.add(name, *errors, f"{turned(body, between, known):.0f}°", f"{thinnest(body, between, known):.2f}")
    if out:
        drawn = {name.replace(" and ", " and\n"): x for name, x in (rows | {"truth": truth}).items()}
        tm.render_sequence(drawn, faces, out / "paper-figure7.png", keyframe_indices=[0, 4])
