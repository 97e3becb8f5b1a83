"""Layers and transforms without numbers, mapped over times, with nothing to do."""

import os
import re
import subprocess
import sys
from pathlib import Path

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
        # At a key-frame itself, steps of all vertices start from rounding.
        between = TIMES + torch.tensor([0, 0, 0.1, 0.1])
        slopes = torch.stack([slope(t) for t in between])
        torch.testing.assert_close(vmap(slope)(between), slopes, rtol=0, atol=1e-7)
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


def exported(layer: torch.nn.Module, given: tuple[Tensor, ...], dynamic: bool = True) -> torch.export.ExportedProgram:
    """With a batch of any size, in the first dimension of all."""
    batch = {0: torch.export.Dim("batch")}
    return torch.export.export(layer, given, dynamic_shapes=(batch,) * len(given) if dynamic else None, strict=False)


class TestExport:
    @pytest.mark.parametrize(
        "n, dtype", [(2, DOUBLE), (2, torch.float32), pytest.param(3, DOUBLE, marks=pytest.mark.slow)]
    )
    def test_a_decoder(self, n: int, dtype: torch.dtype, bars: Shapes) -> None:
        x, basis, times = bars.keyframes[:n], bars.bases[0], torch.arange(n).double() ** 2
        layer = tm.ModalDecoder(x, bars.faces, times, basis.reference, basis.modes).to(dtype)
        generator = torch.Generator().manual_seed(0)
        a = 3 * torch.randn(5, layer.n_modes, generator=generator, dtype=DOUBLE).to(dtype)
        t = torch.linspace(0, float(times[-1]), 5, dtype=dtype)
        motions = 0.1 * torch.randn(5, 6, generator=generator, dtype=DOUBLE).to(dtype)
        if n == 2:  # another program: with the tables of its intervals, which are made by a call
            layer(a, t)
        program = exported(layer, (a[:2], t[:2], motions[:2])).module()
        truth = layer(a, t, motions)
        torch.testing.assert_close(program(a, t, motions), truth, rtol=0, atol=1e-12 if dtype == DOUBLE else 1e-5)
        slopes = []
        for each in (program, layer):
            leaf = a.clone().requires_grad_()
            slopes += torch.autograd.grad(each(leaf, t, motions).square().sum(), leaf)
        torch.testing.assert_close(*slopes, rtol=1e-6 if dtype == DOUBLE else 1e-3, atol=1e-3)

    @pytest.mark.slow
    def test_a_decoder_of_loose_pieces_from_a_file(self, small_bars: Shapes, tmp_path: Path) -> None:
        x = torch.cat([small_bars.keyframes, small_bars.keyframes + 5], 1)
        faces = torch.cat([small_bars.faces, small_bars.faces + small_bars.keyframes.shape[1]])
        modes = small_bars.bases[0].modes.repeat(1, 2, 1)
        layer = tm.ModalDecoder(x, faces, [0.0, 1.0, 2.0, 3.0], x[0], modes)  # a cycle
        a, t = torch.linspace(-1, 1, 6, dtype=DOUBLE).view(2, 3), torch.tensor([2.5, 7.25], dtype=DOUBLE)
        layer(a[:1], torch.arange(3) + 0.5)
        torch.export.save(exported(layer, (a, t)), tmp_path / "decoder.pt2")
        torch.save((a, t), tmp_path / "given.pt")
        code = (
            "import torch; from torch_modal import ModalDecoder\n"
            "program = torch.export.load('decoder.pt2').module(); torch.save(program(*torch.load('given.pt')), 'x.pt')"
        )
        environment = {**os.environ, "PYTHONPATH": str(Path(tm.__file__).parents[1])}
        subprocess.run([sys.executable, "-c", code], cwd=tmp_path, env=environment, check=True, timeout=120)
        torch.testing.assert_close(torch.load(tmp_path / "x.pt"), layer(a, t), rtol=0, atol=1e-12)

    @pytest.mark.parametrize(
        "name",
        ["Passengers", "ShellEnergy", "ShellLoss", pytest.param("GaussNewtonStep", marks=pytest.mark.slow)],
    )
    def test_what_reads_no_numbers(self, name: str, small_bars: Shapes) -> None:
        layer, x = LAYERS[name].make(small_bars), small_bars.keyframes
        n = 1 if name == "Passengers" else 2
        batch = 2 if name == "GaussNewtonStep" else 3  # PyTorch bounds its batch by the layout of matrices
        program = exported(layer, (x[:2].clone(), x[1:].clone())[:n], dynamic=batch > 2).module()
        given = (1.01 * x[:batch], x.flip(0)[:batch])[:n]
        torch.testing.assert_close(program(*given), layer(*given), rtol=0, atol=1e-12)

    @pytest.mark.parametrize("name", sorted({*NEEDS_NUMBERS, "RandomRigidMotion"} - {"ModalDecoder"}))
    def test_what_cannot_be_says_so_by_name(self, name: str, small_bars: Shapes) -> None:
        layer, x = CASES[name].make(small_bars), small_bars.keyframes
        given = {
            "InBetween": (x[0], x[1], TIMES[:1]),
            "MidShape": (x[0], x[1]),
            "Blend": (x, torch.full((3,), 1 / 3, dtype=DOUBLE)),
            "Path": (x, TIMES[:1]),
        }.get(name.split(",")[0], (x,))
        own = "InBetween" if name.startswith("MidShape") else name.split(",")[0]
        with pytest.raises(RuntimeError, match=f"{own} takes steps that depend on the numbers"):
            exported(layer, given, dynamic=False)
