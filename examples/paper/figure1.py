"""Figure 1, and its claim of compression: a gallop from six key-frames by several methods, beside the true frames.

Printed are the errors half-way between the key-frames: of edges, of edges in the regions that the preset ``"paper"``
interpolates locally, of vertices; and the processor time of all in-betweens.
"""

import time
from collections.abc import Callable
from pathlib import Path

import _paths  # noqa: F401
import numpy as np
import torch
from errors import edge_error, vertex_error
from figure5 import around_vertices
from spacetime import spacetime
from torch import Tensor

import torch_modal as tm
from torch_modal.data.samples import load_sample
from torch_modal.modes.basis import ModalBasis

LEVELS = 2
"""Of the recursion: three shapes between two key-frames."""

METHODS: dict[str, Callable[[Tensor, Tensor, list[ModalBasis]], Tensor]] = {
    "linear": lambda keys, faces, bases: _every(tm.linear_sequence(keys, range(0, 25, 4))),
    "paper": lambda keys, faces, bases: _every(
        tm.subdivide(keys, faces, LEVELS, cyclic=True, bases=bases, preset="paper", progress=False)
    ),
    "torch_modal": lambda keys, faces, bases: _every(tm.subdivide(keys, faces, LEVELS, cyclic=True, progress=False)),
    "Hildebrandt 2012": lambda keys, faces, bases: spacetime(keys, faces, torch.arange(12.0) / 2, cyclic=True),
}


def _every(sequence: Tensor) -> Tensor:
    """Key-frames and shapes half-way. *Shape:* ``(24, V, 3) -> (12, V, 3)``."""
    return sequence[:: 2 ** (LEVELS - 1)]


def main(out: Path, overwrite: bool = True) -> list[str]:
    """Draw a part of the cycle, and encode its true frames."""
    sample = load_sample("creature")
    keys, faces, truth = sample.keyframes, sample.faces, sample.truth
    frames = torch.stack([keys, truth], 1).flatten(0, 1)  # a true frame half-way
    bases = tm.extract_bases(keys, faces, progress=False)
    layers = [tm.MidShape([bases[i - 1], bases[i]], faces, preset="paper") for i in (1, 2, 3, 4, 5, 0)]
    inside = [faces[layer.in_between.core.local.region[faces].all(1)] for layer in layers]
    rows, lines = {}, ["method: edges, edges in the regions, vertices, seconds"]
    for name, method in METHODS.items():
        start = time.process_time()
        with torch.no_grad():
            rows[name] = x = method(keys, faces, bases)
        seconds, middles = time.process_time() - start, x[1::2]
        local = np.mean([edge_error(y, t, some) for y, t, some in zip(middles, truth, inside, strict=True)])
        errors = edge_error(middles, truth, faces), local, vertex_error(middles, truth)
        lines.append(f"{name:16s} {' '.join(f'{value:6.2f} %' for value in errors)} {seconds:6.1f} s")
    motion = tm.encode(frames, faces, list(range(0, 12, 2)), 60, cyclic=True, progress=False)
    apart = (motion.decode() - frames)[1::2].norm(dim=-1).mean() / motion.decoder.size
    lines.append(f"vertices, the spline with 60 amplitudes a frame: {100 * float(apart):.3f} % of the diagonal")
    rows = {name: x[4:9] for name, x in (rows | {"truth": frames}).items()}
    off = {
        name: np.stack([around_vertices(y, t, faces) for y, t in zip(x, frames[4:9], strict=True)])
        for name, x in rows.items()
    }
    file, label = out / "paper-figure1.png", "edge error, %"
    tm.render_sequence(rows, faces, file, range(5), None, [0, 2, 4], colors=off, color_label=label, overwrite=overwrite)
    return lines


if __name__ == "__main__":
    print("\n".join(main(Path())))
