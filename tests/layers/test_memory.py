"""Nothing of a solve, forward or back, outlives its results."""

import gc
from collections.abc import Callable, Iterator
from typing import Any

import pytest
import torch
from conftest import Shapes
from torch import Tensor

import torch_modal as tm


@pytest.fixture(autouse=True)
def uncollected() -> Iterator[None]:
    """References in circles count as kept, too: who collects them, and when, is not for a layer to choose."""
    gc.collect()
    gc.disable()
    yield
    gc.enable()


def tensors() -> int:
    return sum(issubclass(type(one), Tensor) for one in gc.get_objects())


def kept_by(run: Callable[[], Any]) -> int:
    """How many tensors are left of three runs, after some that make what is made at first use."""
    for _ in range(2):
        run()
    gc.collect()
    before = tensors()
    for _ in range(3):
        run()
    return tensors() - before


def gradient_of(layer: Callable[..., Tensor], shapes: Shapes, t: float | Tensor, again: bool = False) -> None:
    leaves = [x.clone().requires_grad_() for x in shapes.keyframes[:2]]
    time = torch.as_tensor(t, dtype=torch.float64).requires_grad_()
    gradients = torch.autograd.grad(layer(*leaves, time).square().sum(), [*leaves, time], create_graph=again)
    if again:
        torch.autograd.grad(sum(one.square().sum() for one in gradients), [*leaves, time])


@pytest.mark.parametrize("backend", ["auto", "torch"])
@pytest.mark.parametrize("preset", ["accurate", "fast", "paper"])
def test_nothing_is_left_of_a_layer(small_bars: Shapes, preset: Any, backend: Any) -> None:
    layer = tm.InBetween(small_bars.bases[:2], small_bars.faces, preset, solver=tm.Solver(backend=backend))
    assert kept_by(lambda: gradient_of(layer, small_bars, 0.5)) == 0
    assert kept_by(lambda: layer(*small_bars.keyframes[:2], 0.5)) == 0


@pytest.mark.parametrize("backend", ["auto", "torch"])
def test_nothing_is_left_of_gradients_of_gradients(small_bars: Shapes, backend: Any) -> None:
    layer = tm.InBetween(small_bars.bases[:2], small_bars.faces, solver=tm.Solver(backend=backend))
    assert kept_by(lambda: gradient_of(layer, small_bars, 0.5, again=True)) == 0


def test_nothing_is_left_of_unrolled_steps(small_bars: Shapes) -> None:
    layer = tm.InBetween(small_bars.bases[:2], small_bars.faces, solver=tm.Solver(gradient="unroll", max_steps=2))
    layer.train()
    assert kept_by(lambda: gradient_of(layer, small_bars, 0.5)) == 0


def test_nothing_is_left_of_a_gradient_that_nobody_asks_for(small_bars: Shapes) -> None:
    layer = tm.InBetween(small_bars.bases[:2], small_bars.faces)
    leaf = small_bars.keyframes[0].clone().requires_grad_()
    assert kept_by(lambda: layer(leaf, small_bars.keyframes[1], 0.5)) == 0


def test_nothing_is_left_of_a_path(small_bars: Shapes) -> None:
    path = tm.Path(small_bars.bases, small_bars.faces)

    def run() -> None:
        leaf = small_bars.keyframes.clone().requires_grad_()
        path(leaf, torch.tensor([0.2, 1.7], dtype=torch.float64)).square().sum().backward()

    assert kept_by(run) == 0
