"""Figure 6: between two hands, linearly and in the modal space, beside the truth.

The paper's hands are not to be had; this is the sample hand. Printed are errors of edge lengths.
"""

from pathlib import Path

import torch
from errors import edge_error

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
    lines = []
    for name, x in (("linear", linear), ("paper, Eq. 4", paper), ("torch_modal", own)):
        error = edge_error(x[1:4], truth[1:4], hand.faces)
        lines.append(f"{name:12s} edge error, quarters and half-way: {error:.2f} %")
    rows = {"linear": linear, "paper, Eq. 4": paper, "torch_modal": own, "truth": truth}
    tm.render_sequence(rows, hand.faces, out / "paper-figure6.png", keyframe_indices=[0, 4], overwrite=overwrite)
    return lines


if __name__ == "__main__":
    print("\n".join(main(Path())))
