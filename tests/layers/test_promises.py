"""What holds of every layer, random transform and function: one check for each promise, over one table.

Layers are also compiled, exported, mapped over times, and given nothing. ``docs/promises.md`` names the tests.
"""

import copy
import gc
import pickle
import re
import types
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import cache
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from conftest import Shapes, random_rotation
from helpers.every_layer import CASES, FUNCTIONS, LAYERS, TRANSFORMS, Step, in_between
from torch import Tensor, nn
from torch._dynamo.testing import CompileCounterWithBackend
from torch.func import functional_call, grad, jvp, vmap
from torch.multiprocessing import get_context

import torch_modal as tm
from torch_modal.data.shape_batch import ShapeBatch

DOUBLE = torch.float64
TIMES = torch.tensor([0.5, 1.5, 1.0, 0.0], dtype=DOUBLE)
THIRDS = torch.full((3,), 1 / 3, dtype=DOUBLE)
CONTACT = {"InBetween, contact", "Path, contact"}
OF_ONE_DTYPE = ("ModalDecoder", "Passengers", "GaussNewtonStep")
"""Layers that are cast to the dtype of what they are given."""
MADE_ON_THE_CPU = (*OF_ONE_DTYPE, "ShellEnergy", "ShellLoss", "LatentElasticity")
"""Layers that are on the CPU, whatever they are made of, until they are moved."""
BATCHED = [name for name, case in LAYERS.items() if case.batched]
NEEDS_NUMBERS = re.compile(r"InBetween|MidShape|Blend|Path\b|ModalDecoder|Random(?!RigidMotion)")
"""Layers that cannot run without numbers, on the meta device."""

every_layer = pytest.mark.parametrize("name", CASES)


class Made:
    """A layer, made once for all checks that leave it as it is."""

    def __init__(self, name: str, shapes: Shapes) -> None:
        self.case, self.shapes, self.x = {**CASES, **FUNCTIONS}[name], shapes, shapes.keyframes
        self.layer = self.case.make(shapes)
        self.truth = self.call(self.x)

    def call(self, x: Tensor, layer: Any = None) -> Tensor:
        return self.case.call(self.layer if layer is None else layer, x)


@pytest.fixture(scope="module")
def bar_space(bars: Shapes) -> tm.ShapeSpace:
    return tm.ShapeSpace(bars.bases, bars.faces)


@pytest.fixture(scope="module")
def known(small_bars: Shapes) -> Callable[[str], Made]:
    return cache(lambda name: Made(name, small_bars))


@pytest.fixture
def made(name: str, known: Callable[[str], Made]) -> Made:
    if name in {*CONTACT, "self_contacts"}:
        pytest.importorskip("igl")
    return known(name)


def assert_near(found: Tensor, truth: Tensor, part: float = 1e-12) -> None:
    """Within a part of the largest number."""
    assert found.shape == truth.shape and bool(truth.any())
    torch.testing.assert_close(found, truth, rtol=0, atol=part * float(truth.detach().abs().max()), check_dtype=False)


def loss(x: Tensor) -> Tensor:
    """Squares with weights: of unit quaternions, those without add up to a constant."""
    return (torch.linspace(1, 2, x.numel()).to(x).view_as(x) * x.square()).sum()


def gradient(call: Callable[[Tensor], Tensor], x: Tensor) -> Tensor:
    leaf = x.clone().requires_grad_()
    (found,) = torch.autograd.grad(loss(call(leaf)), leaf)
    return found


def tensors_of(value: Any, seen: set[int]) -> Iterator[Tensor]:
    """All tensors that an object of the package keeps, wherever they are, but for the settings of its caller."""
    if id(value) in seen or isinstance(value, tm.Objective):
        return
    seen.add(id(value))
    if isinstance(value, Tensor):
        yield value
    elif isinstance(value, dict | list | tuple):
        for part in list(value.values()) if isinstance(value, dict) else value:
            yield from tensors_of(part, seen)
    elif type(value).__module__.startswith(("torch_modal", "helpers.every_layer")) and hasattr(value, "__dict__"):
        yield from tensors_of(vars(value), seen)


# ------------------------------------------------------------------------------------------------------------ numbers


@pytest.mark.parametrize("name", [*CASES, *FUNCTIONS])
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
@pytest.mark.parametrize("name", [name for name in CASES if name != "GaussNewtonStep"])  # made of another module
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
@pytest.mark.parametrize("name", [name for name, case in CASES.items() if case.result != "other"])
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


@pytest.mark.parametrize("name", BATCHED)
def test_batch_is_a_loop(name: str, made: Made) -> None:
    both = torch.stack([made.x, 1.01 * made.x + 0.01 * made.x.sin()])
    truth = torch.stack([made.call(x) for x in both])
    assert_near(made.call(both[:, None]).reshape(truth.shape), truth, 1e-9)
    assert made.call(both[:0, None]).numel() == 0


@pytest.mark.parametrize("name", [name for name in BATCHED if name not in CONTACT])
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


@every_layer
def test_inference_mode_leaves_nothing_that_cannot_be_trained(name: str, made: Made) -> None:
    """Autograd refuses inference tensors for good."""
    made_there = not name.startswith(("Passengers", "GaussNewtonStep"))  # which are plain modules of tensors
    with torch.inference_mode(made_there):
        layer = made.case.make(made.shapes)
    with torch.inference_mode():
        made.call(made.x, layer)
    truth = gradient(made.call, made.x)
    kept = list(tensors_of(layer, set()))
    assert kept and not any(tensor.is_inference() for tensor in kept)
    assert_near(gradient(lambda x: made.call(x, layer), made.x), truth, 1e-9)
    with torch.inference_mode(made_there):
        layer.float().double()
    assert_near(gradient(lambda x: made.call(x, layer), made.x), truth, 1e-2)


def test_inference_mode_leaves_plain_bases_and_draws(small_bars: Shapes) -> None:
    own, motion = small_bars.bases[0], tm.RandomRigidMotion(p=1.0)
    with torch.inference_mode():
        basis = tm.ModalBasis(own.reference.clone(), own.eigenvalues * 1, own.modes * 1, own.rigid_eigenvalues * 1)
        motion(small_bars.keyframes)
    assert not any(getattr(basis, name).is_inference() for name in ("reference", "modes", "eigenvalues"))
    assert gradient(lambda x: motion(x, params=motion.params), small_bars.keyframes).any()


@every_layer
def test_nothing_is_left_of_a_gradient(name: str, made: Made) -> None:
    """References in circles count as kept, too: who collects them, and when, is not for a layer to choose."""

    def kept(run: Callable[[], Any]) -> int:
        run()
        gc.collect()
        before = sum(issubclass(type(one), Tensor) for one in gc.get_objects())
        run()
        return sum(issubclass(type(one), Tensor) for one in gc.get_objects()) - before

    def run() -> None:
        gradient(made.call, made.x)
        made.call(made.x.clone().requires_grad_())  # a gradient that nobody asks for

    gc.disable()
    try:
        assert kept(run) == 0
    finally:
        gc.enable()


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


# -------------------------------------------------------------------------------------------------- state and copies


@pytest.mark.parametrize("how", ["copied", "assigned", "functional_call"])
@every_layer
def test_loaded_state(name: str, how: str, made: Made) -> None:
    """All that a state has in it decides, whatever the layer was made of and used for before."""
    bases = [replace(b, reference=2.0 * b.reference, modes=b.modes.flip(0)) for b in made.shapes.bases[::-1]]
    other = made.case.make(Shapes(2.0 * made.x.flip(0), made.shapes.faces, bases))
    before = made.call(made.x, other)
    state = made.layer.state_dict()
    if how == "functional_call":
        if name in ("ModalDecoder", "Passengers, rotations", "Passengers, gradients", "InBetween, fast"):
            pytest.skip("more than its forward is called, or its coarse mesh is no buffer")
        whole = dict(made.layer.named_buffers())  # what follows from the state, too
        found = made.call(made.x, lambda *given: functional_call(other, whole, given, tie_weights=False))
        assert_near(made.call(made.x, other), before)
    else:
        other.load_state_dict(copy.deepcopy(state), assign=how == "assigned")
        found = made.call(made.x, other)
    if state:
        assert_near(found, made.truth)


@pytest.mark.slow
@every_layer
def test_a_compiled_call_gives_the_same(name: str, made: Made) -> None:
    """What a layer makes at its first use is made outside of the trace: SciPy cannot be traced."""
    torch.compiler.reset()  # what was compiled often is not compiled again
    new = made.case.make(made.shapes)
    assert_near(torch.compile(lambda x: made.call(x, new), backend="eager")(made.x), made.truth, 1e-9)


@every_layer
def test_copies_give_the_same(name: str, made: Made) -> None:
    for twin in (copy.deepcopy(made.layer), pickle.loads(pickle.dumps(made.layer))):
        assert torch.equal(made.call(made.x, twin), made.truth)
        twin.share_memory()
        assert_near(made.call(made.x, twin), made.truth)
        assert_near(made.call(made.x, copy.deepcopy(twin).to(DOUBLE)), made.truth)


def serve(connection: Connection) -> None:
    """Call what arrives, until nothing does."""
    torch.set_num_threads(1)
    while (given := connection.recv()) is not None:
        name, layer, x = given
        try:
            connection.send(CASES[name].call(layer, x).numpy())
        except Exception as error:
            connection.send(repr(error))


@pytest.fixture(scope="module", params=["spawn", "forkserver"])
def elsewhere(request: pytest.FixtureRequest) -> Iterator[Callable[..., Tensor]]:
    """A function that calls a layer in another process; one process for all layers."""
    context = get_context(request.param)
    here, there = context.Pipe()
    worker = context.Process(target=serve, args=(there,), daemon=True)
    worker.start()

    def call(*given: Any) -> Tensor:
        here.send(given)
        assert here.poll(120), "no answer"
        answer = here.recv()
        assert isinstance(answer, np.ndarray), answer
        return torch.from_numpy(answer)

    yield call
    here.send(None)
    worker.join(60)


@every_layer
def test_other_processes(name: str, made: Made, elsewhere: Callable[..., Tensor]) -> None:
    layer = copy.deepcopy(made.layer)
    made.call(made.x, layer)
    assert_near(elsewhere(name, layer, made.x), made.truth)
    assert_near(made.call(made.x, layer), made.truth)


def arrays_of(value: Any) -> Iterator[np.ndarray]:
    """All NumPy arrays that an object keeps."""
    seen: set[int] = set()
    left = [value]
    while left:
        one = left.pop()
        if id(one) in seen or isinstance(one, (type, types.ModuleType, types.FrameType)):
            continue
        seen.add(id(one))
        if isinstance(one, np.ndarray):
            yield one
        elif isinstance(one, types.FunctionType):  # not the modules that its globals are
            left += [cell.cell_contents for cell in one.__closure__ or ()]
        else:
            left += [*gc.get_referents(one), *(vars(one).values() if hasattr(one, "__dict__") else ())]


@every_layer
def test_no_array_is_a_view_of_a_tensor(name: str, made: Made) -> None:
    """Sharing a tensor frees the memory under its views."""
    for array in arrays_of(made.layer):
        base = array
        while isinstance(base, np.ndarray) and base.base is not None:
            base = base.base
        assert not isinstance(base, Tensor), (array.dtype, array.shape)


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


# -------------------------------------------------------------------------------------------- times, compile and export


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
    placement = made.step.energy.place(x[0], made.shell.reference_of(x[1]))
    with pytest.raises(ValueError, match=r"amplitudes have the shape \(B, n\).* got \(3,\): .*pass a\[None\]"):
        made.step(torch.zeros(3, dtype=DOUBLE), placement)


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


@pytest.mark.parametrize("name", ["Passengers", "ShellEnergy", "ShellLoss"])
def test_export_of_what_reads_no_numbers(name: str, small_bars: Shapes) -> None:
    layer, x = CASES[name].make(small_bars), small_bars.keyframes
    n = 1 if name == "Passengers" else 2
    given = (x[:2].clone(), x[1:].clone())[:n]
    sizes = ({0: torch.export.Dim("batch")},) * n
    program = torch.export.export(layer, given, dynamic_shapes=sizes, strict=False).module()
    other = (1.01 * x[:3], x.flip(0)[:3])[:n]
    torch.testing.assert_close(program(*other), layer(*other), rtol=0, atol=1e-12)
