"""Layers and transforms without numbers, mapped over times, with nothing to do."""

import re

import pytest
import torch
from conftest import Shapes
from every_layer import CASES, LAYERS, Linear, Step
from torch import Tensor
from torch.func import grad, vmap

import torch_modal as tm

DOUBLE = torch.float64
TIMES = torch.tensor([0.5, 1.5, 1.0, 0.0], dtype=DOUBLE)
NEEDS_NUMBERS = [
    name for name in CASES if name.startswith(("InBetween", "MidShape", "Blend", "Path", "ModalD", "Random"))
]
NEEDS_NUMBERS.remove("PathEnergy")
NEEDS_NUMBERS.remove("RandomRigidMotion")


@pytest.mark.parametrize("name", CASES)
def test_on_the_meta_device(name: str, small_bars: Shapes) -> None:
    made, x = CASES[name].make(small_bars), small_bars.keyframes
    truth = CASES[name].call(made, x)
    if name in NEEDS_NUMBERS:
        own = "InBetween" if name.startswith("MidShape") else re.match(r"\w+", name)
        with pytest.raises(RuntimeError, match=f"{own if isinstance(own, str) else own[0]} takes steps that depend on"):
            CASES[name].call(made.to("meta"), x.to("meta"))
    else:
        found = CASES[name].call(made.to("meta"), x.to("meta"))
        assert found.is_meta and found.shape == truth.shape


class TestMappedTimes:
    @pytest.mark.parametrize("name", ["Path", "Path, pairs"])
    def test_of_a_path(self, name: str, small_bars: Shapes) -> None:
        layer, x = CASES[name].make(small_bars), small_bars.keyframes

        def slope(t: Tensor) -> Tensor:
            return grad(lambda u: layer(x, u).square().sum())(t)

        torch.testing.assert_close(vmap(lambda t: layer(x, t))(TIMES), layer(x, TIMES), rtol=0, atol=1e-12)
        torch.testing.assert_close(vmap(slope)(TIMES), torch.stack([slope(t) for t in TIMES]), rtol=0, atol=1e-9)
        both = torch.stack([x, 1.1 * x])
        found = vmap(lambda y, t: layer(y, t))(both, TIMES[:2])
        torch.testing.assert_close(found, layer(both, TIMES[:2]), rtol=0, atol=1e-12)

    def test_of_a_decoder(self, small_bars: Shapes) -> None:
        layer = CASES["ModalDecoder"].make(small_bars)
        a = torch.linspace(-1, 1, 4 * layer.n_modes, dtype=DOUBLE).view(4, -1)

        def slope(a: Tensor, t: Tensor) -> Tensor:
            return grad(lambda u: layer(a, u).square().sum())(t)

        truth = torch.stack([slope(*own) for own in zip(a, TIMES, strict=True)])
        torch.testing.assert_close(vmap(layer)(a, TIMES), layer(a, TIMES), rtol=0, atol=1e-12)
        torch.testing.assert_close(vmap(slope)(a, TIMES), truth, rtol=0, atol=1e-9)

    @pytest.mark.parametrize("name", ["Path", "ModalDecoder"])
    def test_outside(self, name: str, small_bars: Shapes) -> None:
        layer = CASES[name].make(small_bars)
        first = small_bars.keyframes if name == "Path" else torch.ones(layer.n_modes, dtype=DOUBLE)
        for call in (vmap(lambda t: layer(first, t)), grad(lambda t: layer(first, t[0]).sum())):
            with pytest.raises(ValueError, match="t lies between the times"):
                call(TIMES + 9)


def test_steps_of_one_sample(small_bars: Shapes) -> None:
    made, x = Step(small_bars), small_bars.keyframes
    placement = made.step.energy.place(x[0], made.shell.against(x[1]))
    with pytest.raises(ValueError, match=r"amplitudes have the shape \(B, n\).* got \(3,\): .*pass a\[None\]"):
        made.step(torch.zeros(3, dtype=DOUBLE), placement)


class TestNothing:
    """Batches of no shapes, no times, no points."""

    @pytest.mark.parametrize("name", LAYERS)
    def test_layers(self, name: str, small_bars: Shapes) -> None:
        layer, x = LAYERS[name].make(small_bars), small_bars.keyframes
        none, no_numbers = x[:0], torch.zeros(0, dtype=DOUBLE)
        if name.startswith("InBetween"):
            found = [layer(none, none, 0.5), layer(none, none, no_numbers), layer(x[0], x[1], no_numbers)]
        elif name == "Blend":
            weights = torch.full((3,), 1 / 3, dtype=DOUBLE)
            found = [layer(x, weights.expand(0, 3)), layer(x[None][:0], weights)]
        elif name in ("Path", "Path, pairs", "Path, contact"):
            found = [layer(x, no_numbers), layer(x[None][:0], 0.5)]
        elif name == "ModalDecoder":
            amplitudes = torch.zeros(0, layer.n_modes, dtype=DOUBLE)
            found = [layer(amplitudes, 0.5), layer(torch.zeros(layer.n_modes, dtype=DOUBLE), no_numbers)]
        elif name.startswith("Passengers"):
            nobody = tm.Passengers(x[0], small_bars.faces, x[0, :0])
            found = [layer(none), layer.rotations(none), layer.gradients(none)]
            assert nobody(x).shape == (3, 0, 3)
        elif name in ("LatentElasticity", "PathEnergy"):
            found = [layer(Linear(x), torch.zeros(0, 2, 2, dtype=DOUBLE))]
        else:
            found = [layer(none, none)]
        assert all(len(one) == 0 for one in found)

    @pytest.mark.parametrize("pool", [False, True])
    def test_transforms(self, pool: bool, small_bars: Shapes) -> None:
        space, none = tm.ShapeSpace(small_bars.bases, small_bars.faces), small_bars.keyframes[:0]
        kinds = tm.RandomBlend, tm.RandomExtrapolation, tm.RandomInBetween, tm.RandomModalDeformation
        for kind in (*kinds, tm.RandomRigidMotion):
            others = tm.ShapeBatch.of_keyframes(space, none) if pool else None
            assert kind(p=1.0, space=space)(none, pool=others).shape == none.shape

    def test_fits(self, bars: Shapes) -> None:
        space = tm.ShapeSpace(bars.bases, bars.faces)
        fitted = space.fit(bars.keyframes[:0, :40], torch.arange(40))
        one = space.fit(bars.keyframes[0, :40], torch.arange(40))
        assert [part.shape[1:] for part in fitted] == [part.shape for part in one]
