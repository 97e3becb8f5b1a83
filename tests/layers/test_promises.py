"""Promises about the results of every layer, random transform and function: one check for each, over one table.

Promises about the objects themselves are in test_layer_objects.py. ``docs/promises.md`` names the tests.
"""

import copy
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from conftest import Shapes, random_rotation
from helpers.every_layer import (
    CASES,
    CONTACT,
    FUNCTIONS,
    LAYERS,
    TIMES,
    TRANSFORMS,
    Made,
    assert_near,
    each,
    every_layer,
    gradient,
    loss,
)
from torch import Tensor, nn
from torch.func import grad, jvp, vmap

import torch_modal as tm
from torch_modal.data.shape_batch import ShapeBatch

DOUBLE = torch.float64
THIRDS = torch.full((3,), 1 / 3, dtype=DOUBLE)
OF_ONE_DTYPE = ("ModalDecoder", "Passengers", "GaussNewtonStep")
"""Layers that are cast to the dtype of what they are given."""
MADE_ON_THE_CPU = (*OF_ONE_DTYPE, "ShellEnergy", "ShellLoss", "LatentElasticity")
"""Layers that are on the CPU, whatever they are made of, until they are moved."""
BATCHED = [name for name, case in LAYERS.items() if case.batched]
NEEDS_NUMBERS = re.compile(r"InBetween|MidShape|Blend|Path\b|ModalDecoder|Random(?!RigidMotion)")
"""Layers that cannot run without numbers, on the meta device."""


@pytest.fixture(scope="module")
def bar_space(bars: Shapes) -> tm.ShapeSpace:
    return tm.ShapeSpace(bars.bases, bars.faces)


# ------------------------------------------------------------------------------------------------------------ numbers


@each([*CASES, *FUNCTIONS])
def test_result_is_the_same_each_time_and_nothing_given_changes(name: str, made: Made) -> None:
    before, state = made.x.clone(), torch.get_rng_state()
    assert torch.equal(made.call(made.x), made.truth)
    assert torch.equal(made.x, before)
    assert torch.equal(torch.get_rng_state(), state), "PyTorch's own random numbers were drawn"


@every_layer
def test_float32_is_near_float64(name: str, made: Made) -> None:
    single = copy.deepcopy(made.layer).float()
    for layer in [single] if name.startswith(OF_ONE_DTYPE) else [single, made.layer]:
        found = made.call(made.x.float(), layer)
        assert found.dtype == torch.float32
        assert_near(found, made.truth, 2e-3)
    assert_near(made.call(made.x, single.double()), made.truth, 2e-3)


@every_layer
def test_autocast_computes_in_float32(name: str, made: Made) -> None:
    layer, x = copy.deepcopy(made.layer).float(), made.x.float()
    truth = made.call(x, layer)
    with torch.autocast("cpu", torch.bfloat16):
        found = made.call(x.requires_grad_(), layer)
    assert found.dtype == torch.float32
    assert_near(found, truth, 1e-5)
    if found.requires_grad:  # backward outside, as PyTorch asks for
        (slope,) = torch.autograd.grad(loss(found), x)
        assert_near(slope, gradient(lambda x: made.call(x, layer), x.detach()), 1e-4)


class Called(nn.Module):
    """The call of a layer as a module, to export it."""

    def __init__(self, made: Made) -> None:
        super().__init__()
        self.layer, self.run = made.layer, made.case.call

    def forward(self, x: Tensor) -> Tensor:
        return self.run(self.layer, x)


@every_layer
def test_layers_that_need_numbers_say_so_by_name(name: str, made: Made) -> None:
    """On the meta device and in exports; others run there."""
    layer, x = copy.deepcopy(made.layer), made.x.to("meta")
    if NEEDS_NUMBERS.match(name):
        said = f"{'InBetween' if name.startswith('MidShape') else name.split(',')[0]} takes steps that depend on"
        with pytest.raises(RuntimeError, match=said):
            made.call(x, layer.to("meta"))
        if name != "ModalDecoder":  # its times decide, which an export keeps
            with pytest.raises(RuntimeError, match=said):
                torch.export.export(Called(made), (made.x,), strict=False)
    else:
        found = made.call(x, layer.to("meta"))
        assert found.is_meta and found.shape == made.truth.shape


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU")
@every_layer
def test_a_gpu_gives_the_same(name: str, made: Made) -> None:
    found = made.call(made.x.cuda(), copy.deepcopy(made.layer).cuda())
    assert found.is_cuda
    assert_near(found.cpu(), made.truth, 1e-8)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU")
@each(name for name in CASES if name != "GaussNewtonStep")  # made of another module
def test_gpu_made_there(name: str, made: Made) -> None:
    """Of key-frames, faces and bases that are on the GPU, and differentiated there."""
    x, faces, bases = made.shapes
    layer = made.case.make(Shapes(x.cuda(), faces.cuda(), [basis.to("cuda") for basis in bases]))
    if name.startswith(MADE_ON_THE_CPU):
        layer = layer.cuda()
    found = made.call(x.cuda(), layer)
    assert found.is_cuda
    assert_near(found.cpu(), made.truth, 1e-8)
    slope = gradient(lambda x: made.call(x, layer), x.cuda())
    assert_near(slope.cpu(), gradient(made.call, x), 1e-6)


@pytest.mark.parametrize("factor", [1e-6, 1.0, 1e3])
@each(name for name, case in CASES.items() if case.result != "other")
def test_units_and_rigid_motions(name: str, factor: float, made: Made, generator: torch.Generator) -> None:
    """Micrometres and kilometres, turned and moved away: everything moves along, bases too."""
    turn, move = random_rotation(generator), torch.tensor([50.0, -60.0, 70.0], dtype=DOUBLE)
    if name == "RandomRigidMotion":  # its axes are the world's
        turn = torch.eye(3, dtype=DOUBLE)

    def moved(x: Tensor) -> Tensor:
        return factor * (x @ turn.mT + move)

    bases = [
        replace(b, reference=moved(b.reference), modes=b.modes @ turn.mT / factor**1.5, eigenvalues=b.eigenvalues)
        for b in made.shapes.bases
    ]
    x = moved(made.x)
    found = made.call(x, made.case.make(Shapes(x, made.shapes.faces, bases)))
    truth = moved(made.truth) if made.case.result == "shapes" else made.truth
    assert_near(found, truth, 1e-7)


# ------------------------------------------------------------------------------------------------------------ batches


@each(BATCHED)
def test_batch_is_a_loop(name: str, made: Made) -> None:
    both = torch.stack([made.x, 1.01 * made.x + 0.01 * made.x.sin()])
    truth = torch.stack([made.call(x) for x in both])
    assert_near(made.call(both[:, None]).reshape(truth.shape), truth, 1e-9)
    assert made.call(both[:0, None]).numel() == 0


@each(name for name in BATCHED if name not in CONTACT)
def test_vmap_is_a_loop(name: str, made: Made) -> None:
    """A transform may be the first that uses a layer."""
    both, new = torch.stack([made.x, 1.01 * made.x + 0.01 * made.x.sin()]), made.case.make(made.shapes)
    slopes = torch.stack([gradient(made.call, x) for x in both])
    assert_near(vmap(grad(lambda x: loss(made.call(x, new))))(both), slopes, 1e-6)
    assert_near(vmap(made.call)(both), torch.stack([made.call(x) for x in both]), 1e-9)


# -------------------------------------------------------------------------------------------------------- derivatives


@every_layer
def test_gradient_recorded_or_not(name: str, made: Made) -> None:
    assert not any(tensor.requires_grad for tensor in made.layer.buffers())
    with torch.no_grad():
        assert_near(made.call(made.x), made.truth, 1e-11)
    with torch.inference_mode():
        assert_near(made.call(made.x).clone(), made.truth, 1e-11)
    assert_near(made.call(made.x.clone().requires_grad_()).detach(), made.truth, 1e-11)


@every_layer
def test_derivatives_are_those_of_differences(name: str, made: Made, generator: torch.Generator) -> None:
    """Backward is the limit of differences, and forward mode is its transpose."""
    along, weights = (torch.randn(x.shape, dtype=DOUBLE, generator=generator) for x in (made.x, made.truth))
    leaf, step = made.x.clone().requires_grad_(), 1e-5
    (slope,) = torch.autograd.grad((weights * made.call(leaf)).sum(), leaf)
    there, back = (made.call(made.x + sign * step * along) for sign in (1, -1))
    found = float((slope * along).sum())
    if name != "LatentElasticity":  # whose Hessian is a constant
        assert found == pytest.approx(float((weights * (there - back)).sum()) / (2 * step), rel=1e-4)
    if name in CONTACT:
        with pytest.raises(RuntimeError, match="no forward mode"):
            jvp(made.call, (made.x,), (along,))
        return
    value, tangent = jvp(made.call, (made.x,), (along,))
    assert_near(value, made.truth, 1e-11)
    assert float((weights * tangent).sum()) == pytest.approx(found, rel=1e-7)


# ------------------------------------------------------------------------------------------------- random transforms


@pytest.mark.parametrize("name", TRANSFORMS)
def test_one_generator_decides_everything(name: str, bars: Shapes, bar_space: tm.ShapeSpace) -> None:
    def drawn(seed: int) -> Tensor:
        transform = getattr(tm, name)(p=1.0, space=bar_space, generator=torch.Generator().manual_seed(seed))
        return transform(bars.keyframes)  # type: ignore[no-any-return]

    torch.manual_seed(1)
    first = drawn(0)
    torch.manual_seed(2)
    assert torch.equal(drawn(0), first) and not torch.equal(drawn(1), first)
    assert torch.equal(*(bar_space.sample(2, torch.Generator().manual_seed(3)) for _ in range(2)))


@pytest.mark.parametrize("name", TRANSFORMS)
def test_sequences_are_batches(name: str, bars: Shapes, bar_space: tm.ShapeSpace) -> None:
    transform = getattr(tm, name)(p=1.0, space=bar_space, generator=torch.Generator().manual_seed(0))
    frames = torch.lerp(bars.keyframes[0], bars.keyframes[1], torch.linspace(0, 1, 5)[:, None, None].double())
    assert transform(frames).shape == frames.shape
    labels = torch.arange(frames.shape[1]).expand(5, -1)
    both = tm.AugmentationSequential(transform, data_keys=["shapes", "vertex_labels"], space=bar_space)
    moved, kept = both(frames, labels)
    assert moved.shape == frames.shape and torch.equal(kept, labels)


# ------------------------------------------------------------------------------------------------------------- the page


def test_the_order_of_vertices_stays(bars: Shapes) -> None:
    """Vertices and faces in any order, and vertices that no face names."""
    generator = torch.Generator().manual_seed(0)
    order, faces_order = (torch.randperm(n, generator=generator) for n in (bars.keyframes.shape[1], len(bars.faces)))
    rank = torch.empty_like(order).scatter_(0, order, torch.arange(len(order)))
    shuffled = torch.cat([bars.keyframes[:, order], torch.full((3, 2, 3), 7.0, dtype=torch.float64)], 1)
    faces = rank[bars.faces][faces_order]
    frames = tm.subdivide(shuffled, faces, 1, n_modes=6, preset="fast", progress=False)
    assert torch.equal(frames[::2], shuffled)
    plain = tm.subdivide(bars.keyframes, bars.faces, 1, n_modes=6, preset="fast", progress=False)
    torch.testing.assert_close(frames[1, rank], plain[1], rtol=0, atol=0.02)


def test_each_promise_is_kept_by_a_test() -> None:
    """The page names the tests."""
    root = Path(__file__).parents[2]
    page = (root / "docs" / "promises.md").read_text()
    named = re.findall(r"`(tests/\S+?::\w+)`", page)
    assert len(named) >= 8
    for name in named:
        file, _, test = name.partition("::")
        assert f"def {test}" in (root / file).read_text(), name


# -------------------------------------------------------------------------------------------------------------- nothing


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
    for kind in (tm.RandomBlend, tm.RandomInBetween, tm.RandomModalDeformation):
        assert kind(p=1.0, space=space)(none, pool=ShapeBatch.of_keyframes(space, none)).shape == none.shape
    fitted = space.fit(bars.keyframes[:0, :40], torch.arange(40))
    one = space.fit(bars.keyframes[0, :40], torch.arange(40))
    assert [part.shape[1:] for part in fitted] == [part.shape for part in one]
