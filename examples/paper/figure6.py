"""Figures 2 and 6: between two hands, linearly and in the modal space, beside the truth.

The paper's hands and women are not to be had; this is the sample hand. Printed are errors of edge lengths.
"""

from pathlib import Path

import torch

import torch_modal as tm
from torch_modal.data.samples import load_sample
from torch_modal.geometry.connectivity import Connectivity


def main(out: Path, overwrite: bool = True) -> list[str]:
    """Draw the rows."""
    hand = load_sample("hand")
    first, last = hand.keyframes
    own = tm.subdivide(hand.keyframes, hand.faces, levels=2, progress=False)
    paper = tm.subdivide(hand.keyframes, hand.faces, levels=2, preset="paper", progress=False)
    linear = tm.linear_sequence(hand.keyframes, [0, 4])
    truth = torch.stack([first, *hand.truth, last])
    i, j = torch.tensor(Connectivity(hand.faces.numpy()).edges).T
    lengths = (truth[:, i] - truth[:, j]).norm(dim=-1)
    lines = []
    for name, x in (("linear", linear), ("paper, Eq. 4", paper), ("torch_modal", own)):
        error = ((x[:, i] - x[:, j]).norm(dim=-1) - lengths).abs() / lengths
        lines.append(f"{name:12s} edge error, quarters and half-way: {100 * float(error[1:4].mean()):.2f} %")
    rows = {"linear": linear, "paper, Eq. 4": paper, "torch_modal": own, "truth": truth}
    tm.render_sequence(rows, hand.faces, out / "paper-figure6.png", keyframe_indices=[0, 4], overwrite=overwrite)
    return lines


if __name__ == "__main__":
    print("\n".join(main(Path())))
