"""Layers and transforms inside models that are autocast."""

import pytest
import torch
from conftest import Shapes
from every_layer import CASES
from torch import Tensor

import torch_modal as tm

BF16 = torch.bfloat16


@pytest.mark.parametrize("name", CASES)
def test_shapes_and_gradients_are_those_without(name: str, bars: Shapes) -> None:
    made, x = CASES[name].make(bars).float(), bars.keyframes.float().requires_grad_()

    def gradient(found: Tensor) -> Tensor:
        """Outside of autocast, as PyTorch asks for."""
        return torch.autograd.grad(found.square().sum(), x, allow_unused=True, materialize_grads=True)[0]

    truth = CASES[name].call(made, x)
    with torch.autocast("cpu", BF16):
        found = CASES[name].call(made, x)
    pairs = [(found, truth)]
    if truth.requires_grad:
        pairs.append((gradient(found), gradient(truth)))
    for one, other in pairs:
        assert one.dtype == torch.float32
        torch.testing.assert_close(one, other, rtol=1e-5, atol=1e-5 * float(other.detach().abs().max()))


def test_weights_of_low_precision_add_up_to_one(bars: Shapes) -> None:
    layer, x = tm.Blend(bars.bases, bars.faces).float(), bars.keyframes.float()
    weights = torch.tensor([0.2, 0.3, 0.5], dtype=BF16)
    assert float(weights.double().sum()) != 1
    found, truth = layer(x, weights), layer(x, weights.float() / weights.float().sum())
    torch.testing.assert_close(found, truth, rtol=0, atol=1e-5)
    with pytest.raises(ValueError, match="weights add up to 1"):
        layer(x, weights + torch.tensor([0.1, 0, 0], dtype=BF16))


def test_energies_of_low_precision_are_computed_in_float32(bars: Shapes) -> None:
    x, rest = bars.keyframes[:2].to(BF16)
    for loss in (tm.ShellEnergy(bars.faces), tm.losses.ShellLoss(bars.faces)):
        torch.testing.assert_close(loss(x, rest), loss(x.float(), rest.float()), rtol=0.02, atol=0)
