"""Layers that are compiled, exported, mapped over times, and given nothing."""

from typing import Any

import pytest
import torch
from conftest import Shapes
from every_layer import CASES, Step, in_between
from torch import Tensor, nn
from torch._dynamo.testing import CompileCounterWithBackend
from torch.func import grad, vmap

import torch_modal as tm

DOUBLE = torch.float64
TIMES = torch.tensor([0.5, 1.5, 1.0, 0.0], dtype=DOUBLE)
THIRDS = torch.full((3,), 1 / 3, dtype=DOUBLE)


@pytest.mark.parametrize("name", ["Path", "Path, pairs", "ModalDecoder"])
def test_mapped_times(name: str, small_bars: Shapes) -> None:
    layer, x = CASES[name].make(small_bars), small_bars.keyframes
    if name == "ModalDecoder":
        x = torch.linspace(-1, 1, layer.n_modes, dtype=DOUBLE)

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
    for call in (vmap(lambda t: layer(x, t)), grad(lambda t: layer(x, t[0]).sum())):
        with pytest.raises(ValueError, match="t lies between the times"):
            call(TIMES + 9)


def test_steps_of_one_sample(small_bars: Shapes) -> None:
    made, x = Step(small_bars), small_bars.keyframes
    placement = made.step.energy.place(x[0], made.shell.against(x[1]))
    with pytest.raises(ValueError, match=r"amplitudes have the shape \(B, n\).* got \(3,\): .*pass a\[None\]"):
        made.step(torch.zeros(3, dtype=DOUBLE), placement)


# ------------------------------------------------------------------------------------------------------------ nothing


@pytest.mark.parametrize(
    ("name", "call"),
    [
        ("InBetween", lambda layer, x: layer(x[0], x[1], TIMES[:0])),
        ("Blend", lambda layer, x: layer(x, THIRDS.expand(0, 3))),
        ("Path", lambda layer, x: layer(x, TIMES[:0])),
        ("Path, pairs", lambda layer, x: layer(x, TIMES[:0])),
        ("Path, contact", lambda layer, x: layer(x, TIMES[:0])),
        ("ModalDecoder", lambda layer, x: layer(torch.zeros(0, 3, dtype=DOUBLE), 0.5)),
        ("ModalDecoder", lambda layer, x: layer(torch.zeros(3, dtype=DOUBLE), TIMES[:0])),
        *((name, lambda layer, x: layer(x[:0])) for name in CASES if name.startswith("Random")),
    ],
)
def test_no_times_and_no_shapes(name: str, call: Any, small_bars: Shapes) -> None:
    found = call(CASES[name].make(small_bars), small_bars.keyframes)
    assert found.shape[0] == 0 and found.shape[-1] == 3


def test_no_points_and_nobody_in_a_pool(bars: Shapes, small_bars: Shapes) -> None:
    x = small_bars.keyframes
    assert tm.Passengers(x[0], small_bars.faces, x[0, :0])(x).shape == (3, 0, 3)
    space, none = tm.ShapeSpace(bars.bases, bars.faces), bars.keyframes[:0]
    for kind in (tm.RandomBlend, tm.RandomExtrapolation, tm.RandomInBetween, tm.RandomModalDeformation):
        assert kind(p=1.0, space=space)(none, pool=tm.ShapeBatch.of_keyframes(space, none)).shape == none.shape
    fitted = space.fit(bars.keyframes[:0, :40], torch.arange(40))
    one = space.fit(bars.keyframes[0, :40], torch.arange(40))
    assert [part.shape[1:] for part in fitted] == [part.shape for part in one]


# ------------------------------------------------------------------------------------------------------------ compile


class Net(nn.Module):
    """A small network that predicts the second key-frame and the time of a layer, and a loss of the in-between."""

    def __init__(self, layer: nn.Module, x: Tensor) -> None:
        super().__init__()
        torch.manual_seed(0)
        self.layer, self.body = layer, nn.Linear(x[0].numel(), x[0].numel() + 1, dtype=DOUBLE)

    def forward(self, x: Tensor) -> tuple[Tensor, Tensor]:
        out = torch.tanh(self.body(x[0].flatten()))
        shape = self.layer(x[0], x[1] + 0.05 * out[:-1].view_as(x[1]), out[-1].sigmoid())
        return shape, torch.relu(shape).square().sum()


@pytest.mark.parametrize("backend", ["eager", pytest.param("inductor", marks=pytest.mark.slow)])
def test_compiled_network_around_a_layer(backend: str, small_bars: Shapes) -> None:
    """What surrounds the solve is compiled, in two graphs; the solve is not traced, which would take minutes."""
    if backend == "inductor":
        from torch._inductor import cpp_builder, exc

        try:
            cpp_builder.get_cpp_compiler()
        except exc.InvalidCxxCompiler:
            pytest.skip("there is no C++ compiler, which Inductor needs")
    torch.compiler.reset()
    net, x = Net(in_between(small_bars), small_bars.keyframes), small_bars.keyframes[:2].clone()
    counter = CompileCounterWithBackend(backend)
    compiled = torch.compile(net, backend=counter)
    found = []
    for call in (net, compiled):
        shape, loss = call(x)
        found.append([shape, *torch.autograd.grad(loss, list(net.body.parameters()))])
    torch.testing.assert_close(found[1], found[0], rtol=1e-10, atol=1e-12)
    assert counter.frame_count == 2
    compiled(x * 1.01)
    assert counter.frame_count == 2, "other numbers are compiled again"


# ------------------------------------------------------------------------------------------------------------- export


@pytest.mark.parametrize(
    "name", ["Passengers", "ShellEnergy", "ShellLoss", pytest.param("GaussNewtonStep", marks=pytest.mark.slow)]
)
def test_export_of_what_reads_no_numbers(name: str, small_bars: Shapes) -> None:
    layer, x = CASES[name].make(small_bars), small_bars.keyframes
    n = 1 if name == "Passengers" else 2
    batch = 2 if name == "GaussNewtonStep" else 3  # PyTorch bounds its batch by the layout of matrices
    given = (x[:2].clone(), x[1:].clone())[:n]
    sizes = ({0: torch.export.Dim("batch")},) * n if batch > 2 else None
    program = torch.export.export(layer, given, dynamic_shapes=sizes, strict=False).module()
    other = (1.01 * x[:batch], x.flip(0)[:batch])[:n]
    torch.testing.assert_close(program(*other), layer(*other), rtol=0, atol=1e-12)


@pytest.mark.slow
def test_export_of_fixed_steps(small_bars: Shapes) -> None:
    solver = tm.Solver(local_steps=0, gradient="unroll", max_steps=3)
    layer, (x_a, x_b) = in_between(small_bars, solver=solver), small_bars.keyframes[:2]
    exported = torch.export.export(layer, (x_a, x_b, TIMES[:1]), strict=False).module()
    others = (1.01 * x_a, x_b + 0.1 * x_a, TIMES[:1] + 0.1)
    torch.testing.assert_close(exported(*others), layer(*others), rtol=0, atol=1e-12)


@pytest.mark.parametrize(
    ("name", "given"),
    [
        ("InBetween", lambda x: (x[0], x[1], TIMES[:1])),
        ("InBetween, fast", lambda x: (x[0], x[1], TIMES[:1])),
        ("MidShape, paper", lambda x: (x[0], x[1])),
        ("Blend", lambda x: (x, THIRDS)),
        ("Path", lambda x: (x, TIMES[:1])),
        *((name, lambda x: (x,)) for name in CASES if name.startswith("Random")),
    ],
)
def test_what_cannot_be_exported_says_so_by_name(name: str, given: Any, small_bars: Shapes) -> None:
    layer = CASES[name].make(small_bars)
    own = "InBetween" if name.startswith("MidShape") else name.split(",")[0]
    with pytest.raises(RuntimeError, match=f"{own} takes steps that depend on the numbers"):
        torch.export.export(layer, given(small_bars.keyframes), strict=False)
