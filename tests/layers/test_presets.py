"""The named settings: each at its first use inside a transform, on nothing, and with derivatives by ``torch.func``."""

import pytest
import torch
from conftest import Shapes
from presets import Derived
from torch.func import jacrev

import torch_modal as tm

F64 = torch.float64
each_preset = pytest.mark.parametrize("preset", tm.PRESETS)


@each_preset
@pytest.mark.parametrize("dtype", [torch.float32, F64])
def test_a_transform_may_be_the_first_to_use_a_layer(small_bars: Shapes, preset: str, dtype: torch.dtype) -> None:
    x_a, x_b = small_bars.keyframes[:2].to(dtype)

    def made() -> tm.InBetween:
        return tm.InBetween(small_bars.bases[:2], small_bars.faces, preset).to(dtype)

    def first_coordinates(layer: tm.InBetween, x: torch.Tensor) -> torch.Tensor:
        return layer(x, x_b, 0.5)[:2]

    cold, warm = made(), made()
    warm(x_a, x_b, 0.5)
    found = jacrev(lambda x: first_coordinates(cold, x))(x_a)
    rows = [
        torch.autograd.grad(first_coordinates(warm, x := x_a.clone().requires_grad_()).flatten()[i], x)[0]
        for i in range(6)
    ]
    torch.testing.assert_close(found.flatten(0, 1), torch.stack(rows), rtol=0, atol=1e-3 if dtype != F64 else 1e-8)


@each_preset
def test_of_nothing_nothing(small_bars: Shapes, preset: str) -> None:
    layer = tm.InBetween(small_bars.bases, small_bars.faces, preset)
    nothing = small_bars.keyframes[:0]
    assert layer(nothing, nothing, 0.5).shape == nothing.shape
    assert layer(nothing, nothing, 0.5, torch.zeros(0, dtype=torch.int64)).shape == nothing.shape


def test_derivatives_by_torch_func_give_the_same(small_bars: Shapes) -> None:
    """As ``tests/benchmarks/presets.py --terms`` has it: only the derivatives differ."""
    solver = tm.Solver()
    x_a, x_b = small_bars.keyframes[:2]
    weights = torch.sin(torch.arange(x_a.numel(), dtype=F64)).view_as(x_a)
    found = []
    for objective in (tm.Objective(), Derived()):
        layer = tm.InBetween(small_bars.bases[:2], small_bars.faces, objective=objective, solver=solver)
        x = x_a.clone().requires_grad_()
        shape = layer(x, x_b, 0.3)
        found.append((shape, torch.autograd.grad((shape * weights).sum(), x)[0]))
    torch.testing.assert_close(*(shape for shape, _ in found), rtol=0, atol=1e-10)
    torch.testing.assert_close(*(gradient for _, gradient in found), rtol=0, atol=1e-10)
