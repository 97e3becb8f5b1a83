"""Figure 2: between two poses of a person, linearly and in the modal space, beside the truth.

The paper's women are not to be had; this person is sculpted and posed here, and every joint turns evenly.
"""

from pathlib import Path

import _paths  # noqa: F401
import torch
from _bipeds import biped
from errors import edge_error

import torch_modal as tm

VIEW = (72.0, 6.0)


def main(out: Path, overwrite: bool = True, cell: float | None = None, levels: int = 2) -> list[str]:
    """Draw the rows; ``cell`` is the length of the edges."""
    last = 2**levels
    times = [n / last for n in range(last + 1)]
    body = biped("person", cell)
    faces = torch.from_numpy(body.faces)
    truth = torch.stack([torch.from_numpy(body.pose(t)) for t in times])
    keyframes = truth[[0, last]]
    rows = {
        "linear": tm.linear_sequence(keyframes, [0, last]),
        "the paper": tm.subdivide(keyframes, faces, levels=levels, preset="paper", progress=False),
        "torch_modal": tm.subdivide(keyframes, faces, levels=levels, progress=False),
        "truth": truth,
    }
    tm.render_sequence(
        rows, faces, out / "paper-figure2.png", keyframe_indices=[0, last], view=VIEW, overwrite=overwrite
    )
    found = [f"{n:12s} {edge_error(x[1:-1], truth[1:-1], faces):.2f} %" for n, x in rows.items() if n != "truth"]
    return [f"{len(body.rest)} vertices; edge error, quarters and half-way:", *found]


if __name__ == "__main__":
    print("\n".join(main(Path())))
