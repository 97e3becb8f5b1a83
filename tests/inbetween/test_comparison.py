"""In-betweens that give way to their starts as far as they are worse."""

import pytest
import torch

from torch_modal.inbetween.comparison import no_worse


@pytest.mark.parametrize("own, part", [(0.9, 0.0), (1.1, 0.0), (1.15, 0.5), (1.2, 1.0), (2.0, 1.0), (torch.inf, 1.0)])
def test_a_shape_gives_way_from_a_tenth_more_distortion_to_a_fifth(own: float, part: float) -> None:
    x, start = torch.zeros(1, 4, 3).double(), torch.ones(1, 4, 3).double()
    found, replaced = no_worse(x, [start], torch.tensor([[own], [1.0]]).double(), torch.zeros(1).double())
    assert float(found[0, 0, 0]) == pytest.approx(part, abs=1e-6) and replaced.tolist() == [part == 1]
