"""Figure 6: between two hands, linearly, in the modal space and by a geodesic (Kilian et al. 2007), beside the truth.

The paper's hands are not to be had; this is the sample hand. The geodesic is in ``tests/benchmarks``. Printed are
errors of edge lengths.
"""

from collections.abc import Sequence
from pathlib import Path

import _paths  # noqa: F401
import torch
from errors import edge_error, percents
from geodesic import geodesic
from results import Table, wanted

import torch_modal as tm
from torch_modal.data.samples import load_sample
from torch_modal.times import fill_linear

COLUMNS = ["", "edge error"]
CHECK = "linear torch_modal"


def main(table: Table, out: Path | None, only: Sequence[str]) -> None:
    """Draw the rows."""
    hand = load_sample("hand")
    faces, ends = hand.faces, hand.keyframes
    truth = torch.stack([ends[0], *hand.truth, ends[1]])
    methods = {
        "linear": lambda: fill_linear(ends, [0, 4]),
        "the paper": lambda: tm.interpolate(ends, faces, levels=2, preset="paper", progress=False),
        "torch_modal": lambda: tm.interpolate(ends, faces, levels=2, progress=False),
        "geodesic (Kilian et al. 2007)": lambda: geodesic(*ends, faces).frames[::2],
    }
    rows = {name: method() for name, method in methods.items() if wanted(name, only)}
    for name, x in rows.items():
        table.add(name, *percents(edge_error(x[1:4], truth[1:4], faces)))
    if out:
        drawn = {name.replace(" (", "\n("): x for name, x in (rows | {"truth": truth}).items()}
        tm.render_sequence(drawn, faces, out / "paper-figure6.png", keyframe_indices=[0, 4])
