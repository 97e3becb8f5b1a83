"""Figure 2: between two poses of a person, linearly and in the modal space, beside the truth.

The paper's women are not public; this person is sculpted and posed here, and every joint turns evenly. ``--meshes``
takes two poses of the lion. The truth between them is not known: edges are compared with interpolated lengths.
"""

from collections.abc import Sequence
from pathlib import Path

import _paths  # noqa: F401
import torch
from _meshes import poses
from errors import edge_error, lengths, percents
from results import Table, wanted
from samples.bipeds import biped

import torch_modal as tm
from torch_modal.times import fill_linear

COLUMNS = ["", "edge error"]
CHECK = "linear torch_modal"
VIEW = (72.0, 6.0)


def main(table: Table, out: Path | None, only: Sequence[str], meshes: Path | None = None) -> None:
    """Draw the rows."""
    truth = None
    if meshes:
        shapes, faces = poses(meshes, "lion")
        keyframes = shapes[:2]
    else:
        body = biped("person", None)
        faces = torch.from_numpy(body.faces)
        truth = torch.stack([torch.from_numpy(body.pose(n / 4)) for n in range(5)])
        keyframes = truth[[0, 4]]
    methods = {
        "linear": lambda: fill_linear(keyframes, [0, 4]),
        "the paper": lambda: tm.interpolate(keyframes, faces, levels=2, preset="paper", progress=False),
        "torch_modal": lambda: tm.interpolate(keyframes, faces, levels=2, progress=False),
    }
    rows = {name: method() for name, method in methods.items() if wanted(name, only)}
    for name, x in rows.items():
        if truth is None:
            wanted_lengths = torch.lerp(*lengths(keyframes, faces), torch.tensor([[0.25], [0.5], [0.75]]).double())
            error = 100 * float(((lengths(x[1:-1], faces) - wanted_lengths).abs() / wanted_lengths).mean())
        else:
            error = edge_error(x[1:-1], truth[1:-1], faces)
        table.add(name, *percents(error))
    if out:
        rows |= {} if truth is None else {"truth": truth}
        tm.render_sequence(rows, faces, out / "paper-figure2.png", keyframe_indices=[0, 4], view=VIEW)
