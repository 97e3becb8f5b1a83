"""What must hold of every layer and random transform: one check for each promise, over one table."""

import copy
import gc
import pickle
import re
import types
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import cache
from multiprocessing.connection import Connection
from typing import Any

import numpy as np
import pytest
import torch
from conftest import Shapes, random_rotation
from every_layer import CASES, LAYERS
from torch import Tensor
from torch.func import functional_call, grad, jvp, vmap
from torch.multiprocessing import get_context

import torch_modal as tm

DOUBLE = torch.float64
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
        self.case, self.shapes, self.x = CASES[name], shapes, shapes.keyframes
        self.layer = self.case.make(shapes)
        self.truth = self.call(self.x)

    def call(self, x: Tensor, layer: Any = None) -> Tensor:
        return self.case.call(self.layer if layer is None else layer, x)


@pytest.fixture(scope="module")
def known(small_bars: Shapes) -> Callable[[str], Made]:
    return cache(lambda name: Made(name, small_bars))


@pytest.fixture
def made(name: str, known: Callable[[str], Made]) -> Made:
    if name in CONTACT:
        pytest.importorskip("ipctk")
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
    elif type(value).__module__.startswith(("torch_modal", "every_layer")) and hasattr(value, "__dict__"):
        yield from tensors_of(vars(value), seen)


# ------------------------------------------------------------------------------------------------------------ numbers


@every_layer
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


@every_layer
def test_meta_device(name: str, made: Made) -> None:
    layer, x = copy.deepcopy(made.layer), made.x.to("meta")
    if NEEDS_NUMBERS.match(name):
        own = "InBetween" if name.startswith("MidShape") else name.split(",")[0]
        with pytest.raises(RuntimeError, match=f"{own} takes steps that depend on"):
            made.call(x, layer.to("meta"))
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
