"""Figure 6: between two hands, linearly, in the modal space and by a geodesic (Kilian et al. 2007), beside the truth.

The paper's hands are not to be had; this is the sample hand. The geodesic is in ``tests/benchmarks``. Printed are
errors of edge lengths.
"""

from pathlib import Path

import _paths  # noqa: F401
import torch
from errors import edge_error
from geodesic import geodesic

import torch_modal as tm
from torch_modal.data.samples import load_sample


def main(out: Path, overwrite: bool = True) -> list[str]:
    """Draw the rows."""
    hand = load_sample("hand")
    first, last = hand.keyframes
    own = tm.subdivide(hand.keyframes, hand.faces, levels=2, progress=False)
    paper = tm.subdivide(hand.keyframes, hand.faces, levels=2, preset="paper", progress=False)
    linear = tm.linear_sequence(hand.keyframes, [0, 4])
    truth = torch.stack([first, *hand.truth, last])
    rows = {
        "linear": linear,
        "the paper": paper,
        "torch_modal": own,
        "geodesic\n(Kilian et al. 2007)": geodesic(first, last, hand.faces).frames[::2],
        "truth": truth,
    }
    lines = []
    for name, x in rows.items():
        if name != "truth":
            error = edge_error(x[1:4], truth[1:4], hand.faces)
            lines.append(f"{' '.join(name.split()):30s} edge error, quarters and half-way: {error:.2f} %")
    tm.render_sequence(rows, hand.faces, out / "paper-figure6.png", keyframe_indices=[0, 4], overwrite=overwrite)
    return lines


if __name__ == "__main__":
    print("\n".join(main(Path())))
