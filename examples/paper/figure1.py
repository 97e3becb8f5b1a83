"""Figure 1, and its claim of compression: a gallop from six key-frames by several methods, beside the true frames.

Errors are those half-way between the key-frames: of edges, of edges in the regions that the preset ``"paper"``
interpolates locally, and of vertices; times are of the processor, for all in-betweens.
"""

import time
from collections.abc import Callable, Sequence
from pathlib import Path

import _paths  # noqa: F401
import numpy as np
import torch
from _meshes import gallop
from errors import edge_error, percents, vertex_error
from figure5 import around_vertices
from hildebrandt import spacetime
from results import Table, wanted
from torch import Tensor

import torch_modal as tm
from torch_modal.data.samples import load_sample
from torch_modal.times import fill_linear

COLUMNS = ["", "edge error", "in the regions", "vertex error", "time, s"]
CHECK = "linear Hildebrandt"
DRAWN = ("linear", "Hildebrandt et al. 2012", "the paper", "torch_modal", "truth")
LEVELS = 2
"""Of the recursion: three shapes between two key-frames."""


def main(table: Table, out: Path | None, only: Sequence[str], meshes: Path | None = None) -> None:
    """Draw a part of the cycle, and encode its true frames."""
    sample = load_sample("creature")
    keys, faces, truth = gallop(meshes) if meshes else (sample.keyframes, sample.faces, sample.truth)
    frames = torch.stack([keys, truth], 1).flatten(0, 1)  # a true frame half-way
    bases = tm.extract_bases(keys, faces, progress=False)
    times, half = torch.arange(12.0) / 2, 2 ** (LEVELS - 1)
    methods: dict[str, Callable[[], Tensor]] = {
        "linear": lambda: fill_linear(keys, range(0, 25, 4))[::half],
        "Hildebrandt et al. 2012": lambda: spacetime(keys, faces, times, cyclic=True),
        "Hildebrandt et al. 2012, faster": lambda: spacetime(keys, faces, times, cyclic=True, pitch=0.1),
        "the paper": lambda: tm.interpolate(
            keys, faces, LEVELS, cyclic=True, bases=bases, preset="paper", progress=False
        )[::half],
        "torch_modal": lambda: tm.interpolate(keys, faces, LEVELS, cyclic=True, progress=False)[::half],
        "torch_modal, encoded": lambda: tm.encode(
            frames, faces, list(range(0, 12, 2)), 60, cyclic=True, progress=False
        ).decode(),
    }
    layers = [tm.MidShape([bases[i - 1], bases[i]], faces, preset="paper") for i in (1, 2, 3, 4, 5, 0)]
    inside = [faces[layer.in_between.core.local.region[faces].all(1)] for layer in layers]
    rows = {"truth": frames}
    for name, method in methods.items():
        if wanted(name, only):
            start = time.process_time()
            with torch.no_grad():
                rows[name] = x = method()
            seconds, middles = time.process_time() - start, x[1::2]
            local = np.mean([edge_error(y, t, some) for y, t, some in zip(middles, truth, inside, strict=True)])
            errors = edge_error(middles, truth, faces), float(local), vertex_error(middles, truth)
            table.add(name, *percents(*errors), f"{seconds:.1f}")
    if out:
        rows = {name: rows[name][4:9] for name in DRAWN if name in rows}
        off = {
            name: np.stack([around_vertices(*pair, faces) for pair in zip(x, frames[4:9], strict=True)])
            for name, x in rows.items()
        }
        file, label = out / "paper-figure1.png", "edge error, %"
        tm.render_sequence(rows, faces, file, range(5), None, [0, 2, 4], colors=off, color_label=label)
