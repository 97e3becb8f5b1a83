"""In-betweens that give way to their starts as far as they are worse."""

import pytest
import torch
from torch import Tensor
from torch.autograd import gradcheck

from torch_modal.inbetween.comparison import blended

INF, NAN = torch.inf, torch.nan


@pytest.mark.parametrize(
    "own, part", [(0.9, 0.0), (1.1, 0.0), (1.15, 0.5), (1.2, 1.0), (2.0, 1.0), (INF, 1.0), (NAN, 1.0)]
)
def test_a_shape_gives_way_from_a_tenth_more_distortion_to_a_fifth(own: float, part: float) -> None:
    x, start = torch.zeros(1, 4, 3).double(), torch.ones(1, 4, 3).double()
    found, replaced, weights = blended(x, [start], torch.tensor([[own], [1.0]]).double(), torch.zeros(1).double())
    assert float(found[0, 0, 0]) == pytest.approx(part, abs=1e-6) and replaced.tolist() == [part == 1]
    assert float(weights[0, 0]) == pytest.approx(part, abs=1e-6)


def test_the_best_of_the_starts_is_taken() -> None:
    x, starts = torch.zeros(3, 4, 3), [torch.full((3, 4, 3), value) for value in (1.0, 2.0)]
    distortion = torch.tensor([[9.0, 9.0, 1.0], [1.0, 3.0, 1.0], [2.0, 2.0, 1.0]])
    found, worse, weights = blended(x, starts, distortion, torch.zeros(3))
    assert worse.tolist() == [True, True, False] and found[:, 0, 0].tolist() == [1.0, 2.0, 0.0]
    assert weights.tolist() == [[1, 0], [0, 1], [0, 0]]


def test_a_shape_may_have_parts_of_both_starts() -> None:
    x, starts = torch.zeros(1, 4, 3).double(), [torch.full((1, 4, 3), value).double() for value in (1.0, 100.0)]
    found, _, weights = blended(x, starts, torch.tensor([[1.15], [1.0], [0.95]]).double(), torch.zeros(1).double())
    first, second = weights[0].tolist()
    assert 0 < first < 0.5 and 0 < second < 0.5 and float(found[0, 0, 0]) == pytest.approx(first + 100 * second)


def test_gradient_of_the_blend(generator: torch.Generator) -> None:
    def given_way(x: Tensor) -> Tensor:
        own = 1 + 0.2 * torch.sigmoid(x.sum((1, 2)))
        distortion = torch.stack([own, torch.ones_like(own)])
        return blended(x, [torch.ones_like(x)], distortion, torch.zeros_like(own))[0]

    assert gradcheck(given_way, torch.randn(2, 4, 3, dtype=torch.float64, generator=generator).requires_grad_())
