"""Layers and transforms that are sent to other processes, shared, copied and moved."""

import copy
import gc
import types
from collections.abc import Callable, Iterator
from multiprocessing.connection import Connection
from typing import Any

import numpy as np
import pytest
import torch
from conftest import Shapes
from every_layer import CASES
from torch import Tensor
from torch.multiprocessing import get_context


def serve(connection: Connection) -> None:
    """Call what arrives, until nothing does."""
    torch.set_num_threads(1)
    while (given := connection.recv()) is not None:
        name, made, x = given
        try:
            connection.send(CASES[name].call(made, x).numpy())
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


def assert_same(found: Tensor, truth: Tensor) -> None:
    torch.testing.assert_close(found, truth, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("name", CASES)
def test_used_sent_used_there_and_again_here(name: str, bars: Shapes, elsewhere: Callable[..., Tensor]) -> None:
    made, x = CASES[name].make(bars), bars.keyframes
    truth = CASES[name].call(made, x)
    assert_same(elsewhere(name, made, x), truth)
    assert_same(CASES[name].call(made, x), truth)


@pytest.mark.parametrize("name", CASES)
def test_used_shared_copied_and_cast(name: str, bars: Shapes) -> None:
    made, call, x = CASES[name].make(bars), CASES[name].call, bars.keyframes.clone()
    truth = call(made, x)
    twin = copy.deepcopy(made)
    if isinstance(made, torch.nn.Module):
        made.share_memory()
    assert_same(call(made, x), truth)
    assert_same(call(twin, x), truth)
    twin.share_memory()
    assert_same(call(copy.deepcopy(twin), x), truth)
    assert_same(call(made.to(torch.float64), x), truth)


def kept_arrays(value: Any) -> Iterator[np.ndarray]:
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
            left += [*gc.get_referents(one), *vars(one).values()] if hasattr(one, "__dict__") else gc.get_referents(one)


@pytest.mark.parametrize("name", CASES)
def test_no_array_is_a_view_of_a_tensor(name: str, small_bars: Shapes) -> None:
    """Sharing a tensor frees the memory under its views."""
    made = CASES[name].make(small_bars)
    CASES[name].call(made, small_bars.keyframes)
    for array in kept_arrays(made):
        base = array
        while isinstance(base, np.ndarray) and base.base is not None:
            base = base.base
        assert not isinstance(base, Tensor), (array.dtype, array.shape, [type(r) for r in gc.get_referrers(array)])
