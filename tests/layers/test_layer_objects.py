"""Promises about layers as objects: kept, copied, loaded, shared, compiled and exported.

Promises about their results are in test_promises.py.
"""

import copy
import gc
import pickle
import types
from collections.abc import Callable, Iterator
from dataclasses import replace
from multiprocessing.connection import Connection
from typing import Any

import numpy as np
import pytest
import torch
from conftest import Shapes
from helpers.every_layer import (
    CASES,
    TIMES,
    Made,
    Step,
    assert_near,
    each,
    every_layer,
    gradient,
    in_between,
)
from torch import Tensor, nn
from torch._dynamo.testing import CompileCounterWithBackend
from torch.func import functional_call, grad, vmap
from torch.multiprocessing import get_context

import torch_modal as tm

DOUBLE = torch.float64


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


# ------------------------------------------------------------------------------------------------------------ after use


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
        gc.freeze()  # what was there before is not listed below
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
        gc.unfreeze()
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


@pytest.fixture(scope="module", params=["spawn", pytest.param("forkserver", marks=pytest.mark.slow)])
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


# -------------------------------------------------------------------------------------------- times, compile and export


@each(["Path", "Path, pairs", "ModalDecoder"])
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


@each(["Passengers", "ShellEnergy", "ShellLoss"])
def test_export_of_what_reads_no_numbers(name: str, small_bars: Shapes) -> None:
    layer, x = CASES[name].make(small_bars), small_bars.keyframes
    n = 1 if name == "Passengers" else 2
    given = (x[:2].clone(), x[1:].clone())[:n]
    sizes = ({0: torch.export.Dim("batch")},) * n
    program = torch.export.export(layer, given, dynamic_shapes=sizes, strict=False).module()
    other = (1.01 * x[:3], x.flip(0)[:3])[:n]
    torch.testing.assert_close(program(*other), layer(*other), rtol=0, atol=1e-12)
