"""Batches on several threads: the same bits, gradients, errors and warnings as on one."""

import _thread
import threading
import time
import warnings
from collections.abc import Callable, Iterator
from typing import Any

import pytest
import torch
from conftest import Shapes
from helpers.terms import Edges
from torch import Tensor

import torch_modal as tm
from torch_modal import threads
from torch_modal.errors import ConvergenceError, MeshWarning
from torch_modal.inbetween.results import ConvergenceWarning

DOUBLE = torch.float64


@pytest.fixture(autouse=True)
def small_chunks(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Chunks of one or two of the small shapes of the tests; the number of threads as it was afterwards."""
    monkeypatch.setattr(threads, "LEAST_VERTICES", 1)
    monkeypatch.setattr(threads, "MOST_VERTICES", 300)
    before = torch.get_num_threads()
    yield
    torch.set_num_threads(before)


@pytest.fixture(scope="module")
def layer(bars: Shapes) -> tm.InBetween:
    return tm.InBetween(bars.bases[:2], bars.faces)


def each_number(compute: Callable[[], Any]) -> Iterator[Any]:
    for n in (1, 2, 3, 8):
        torch.set_num_threads(n)
        yield compute()
        assert torch.get_num_threads() == n


def same(given: Iterator[Any]) -> bool:
    first, *others = given
    return all(torch.equal(x, y) for other in others for x, y in zip(first, other, strict=True))


def leaves(bars: Shapes, n: int = 7) -> list[Tensor]:
    """Two key-frames and times of samples, which differ."""
    scales = torch.linspace(0.9, 1.1, n, dtype=DOUBLE)[:, None, None]
    given = [bars.keyframes[0] * scales, bars.keyframes[1] / scales, torch.linspace(0.1, 0.9, n, dtype=DOUBLE)]
    return [x.clone().requires_grad_() for x in given]


def test_chunks_depend_on_the_batch_alone() -> None:
    assert threads.chunk_sizes(7, 1000) == [1] * 7
    assert threads.chunk_sizes(7, 164) == [2, 2, 2, 1]
    assert threads.chunk_sizes(7, 20) == [4, 3]
    assert threads.chunk_sizes(1, 1000) == [1]
    assert threads.chunk_sizes(0, 20) == [0]


def test_results_and_gradients_are_the_same_bit_for_bit(layer: tm.InBetween, bars: Shapes) -> None:
    def compute() -> list[Tensor]:
        given = leaves(bars)
        found = layer.solve(*given)
        (found.shapes.square().sum() + found.solution.amplitudes.sum()).backward()
        return [found.shapes.detach(), *(x for x in found.solution if x is not None), *(x.grad for x in given)]  # type: ignore[list-item]

    assert same(each_number(compute))
    with torch.no_grad():
        assert same(each_number(lambda: [layer(*leaves(bars))]))
    with torch.inference_mode():
        assert same(each_number(lambda: [layer(*leaves(bars))]))
        assert layer(*leaves(bars)).is_inference()


def test_threads_have_the_modes_of_their_caller() -> None:
    torch.set_num_threads(2)
    modes = 2 * [lambda: (torch.is_inference_mode_enabled(), torch.is_grad_enabled())]
    assert threads.run(modes) == 2 * [(False, True)]
    with torch.no_grad():
        assert threads.run(modes) == 2 * [(False, False)]
    with torch.inference_mode():
        assert threads.run(modes) == 2 * [(True, False)]


def test_only_the_last_pools_of_threads_stay() -> None:
    def n_started() -> int:
        return sum(each.name.startswith("torch_modal") for each in threading.enumerate())

    for n in range(2, 14):
        torch.set_num_threads(n)
        threads.run(4 * n * [threading.get_ident])
    deadline = time.monotonic() + 10  # threads of pools that are given up end by themselves
    while n_started() > 13 * threads.N_POOLS and time.monotonic() < deadline:
        time.sleep(0.01)
    assert n_started() <= 10 + 11 + 12 + 13


def test_all_layers_and_subdivide(bars: Shapes) -> None:
    x, bases, faces = bars.keyframes, bars.bases, bars.faces
    weights = torch.rand(6, 3, dtype=DOUBLE).softmax(1)
    blend, mid, paper = tm.Blend(bases, faces), tm.MidShape(bases[:2], faces), tm.MidShape(bases[:2], faces, "paired")
    path = tm.Path(bases, faces, smooth=False)
    scales = torch.linspace(0.9, 1.1, 5, dtype=DOUBLE)[:, None, None]

    def compute() -> list[Tensor]:
        ends = x[0] * scales, x[1] * scales
        each = [blend(x, weights), mid(*ends), paper(*ends), path(x, torch.linspace(0.1, 1.9, 8, dtype=DOUBLE))]
        return [*each, *(tm.subdivide(x[:n], faces, 3, bases=bases[:n], progress=False) for n in (2, 3))]

    assert same(each_number(compute))


def test_the_graph_is_freed_and_kept_as_torch_does(layer: tm.InBetween, bars: Shapes) -> None:
    torch.set_num_threads(2)
    given = leaves(bars)
    loss = layer(*given).square().sum()
    (once,) = torch.autograd.grad(loss, given[0], retain_graph=True)
    (again,) = torch.autograd.grad(loss, given[0])
    assert torch.equal(once, again)
    with pytest.raises(RuntimeError, match="second time"):
        loss.backward()
    with torch.autograd.graph.save_on_cpu():  # it replaces what is saved
        loss = layer(*given).square().sum()
    assert torch.equal(torch.autograd.grad(loss, given[0])[0], once)


def test_gradients_of_some_inputs_and_of_parameters(bars: Shapes) -> None:
    def compute(n: int) -> list[Tensor]:
        torch.set_num_threads(n)
        alpha, beta = (torch.nn.Parameter(torch.tensor(value, dtype=DOUBLE)) for value in (500.0, 10.0))
        layer = tm.InBetween(bars.bases[:2], bars.faces, objective=tm.Objective(alpha=alpha, beta=beta))
        a, b, t = (x.detach() for x in leaves(bars))
        seen = []
        b.requires_grad_().register_hook(lambda x: seen.append(x) or 2 * x)  # type: ignore[func-returns-value]
        x = layer(a, b, t)
        x[:, 5].square().sum().backward()
        assert len(seen) == 1 and torch.equal(b.grad, 2 * seen[0])  # type: ignore[arg-type]
        assert a.grad is None
        return [alpha.grad, beta.grad, b.grad]  # type: ignore[list-item]

    one, several = compute(1), compute(4)
    assert all(torch.equal(x, y) for x, y in zip(one, several, strict=True))
    assert float(one[0].abs()) > 0 < float(one[1].abs())


class Scaled(Edges):
    """A term with a parameter of its own in the measure."""

    def __init__(self) -> None:
        super().__init__(30.0)
        self.power = torch.nn.Parameter(torch.tensor(1.5, dtype=DOUBLE))

    def measure(self, edge_vectors: Tensor) -> Tensor:
        return super().measure(edge_vectors) ** self.power


def test_parameters_of_terms_have_the_gradients_of_plain_calls(bars: Shapes, monkeypatch: pytest.MonkeyPatch) -> None:
    def compute() -> list[Tensor]:
        term = Scaled()
        layer = tm.InBetween(bars.bases[:2], bars.faces, objective=tm.Objective(terms=(term,)))
        a, b, t = leaves(bars, 3)
        layer(a, b, t).square().sum().backward()
        return [term.power.grad, a.grad]  # type: ignore[list-item]

    torch.set_num_threads(3)
    found = compute()
    monkeypatch.setattr("torch_modal.layers.base.by_chunks", lambda compute, samples, *_, **__: compute(samples))
    for x, y in zip(found, compute(), strict=True):
        torch.testing.assert_close(x, y, rtol=1e-8, atol=1e-10)
    assert float(found[0].abs()) > 0


def test_second_derivatives(layer: tm.InBetween, bars: Shapes) -> None:
    def twice(given: list[Tensor]) -> list[Tensor]:
        first = torch.autograd.grad(layer(*given).square().sum(), given, create_graph=True)
        torch.autograd.backward(sum(x.square().sum() for x in first))  # type: ignore[arg-type]
        return [*(x.detach() for x in first), *(x.grad for x in given)]  # type: ignore[list-item]

    torch.set_num_threads(3)
    found = twice(leaves(bars, 3))
    samples = zip(*leaves(bars, 3), strict=True)
    alone = [twice([x.detach()[None].requires_grad_() for x in sample]) for sample in samples]
    for x, *parts in zip(found, *alone, strict=True):
        torch.testing.assert_close(x, torch.cat(parts), rtol=1e-6, atol=1e-8)


class InLoader(torch.utils.data.Dataset):  # type: ignore[type-arg]
    """One batch of in-betweens, computed in a process of a loader."""

    def __init__(self, layer: tm.InBetween, given: list[Tensor]) -> None:
        self.layer, self.given = layer, given

    def __len__(self) -> int:
        return 2

    def __getitem__(self, index: int) -> Tensor:
        assert torch.get_num_threads() == 1
        with torch.no_grad():
            return self.layer(*self.given)  # type: ignore[no-any-return]


@pytest.mark.skipif(not hasattr(__import__("os"), "fork"), reason="this system cannot fork")
def test_workers_of_a_loader_find_the_same(layer: tm.InBetween, bars: Shapes) -> None:
    torch.set_num_threads(3)
    given = [x.detach() for x in leaves(bars)]
    with torch.no_grad():
        wanted = layer(*given)
    loader = torch.utils.data.DataLoader(
        InLoader(layer, given), batch_size=None, num_workers=1, multiprocessing_context="fork"
    )
    assert all(torch.equal(x, wanted) for x in loader)


def test_errors_and_warnings_reach_the_caller(bars: Shapes) -> None:
    torch.set_num_threads(3)
    layer = tm.InBetween(bars.bases[:2], bars.faces, "modal", solver=tm.Solver(max_steps=0, unconverged="raise"))
    with pytest.warns(ConvergenceWarning) as told, torch.no_grad():
        layer(*leaves(bars))
    assert len(told) == 1 and "7 of 7" in str(told[0].message)
    with pytest.raises(ConvergenceError):
        layer(*leaves(bars))
    with pytest.warns(MeshWarning, match="as large as") as told, torch.no_grad():
        other = tm.InBetween(bars.bases[:2], bars.faces)
        other(*(100 * x for x in leaves(bars)[:2]), 0.5)
    assert len(told) == 1


def test_work_in_threads() -> None:
    def failing() -> None:
        raise ZeroDivisionError("of a thread")

    running, names = [], set()

    def slow() -> None:
        running.append(1)
        names.add(threading.current_thread().name)
        threads.warn("{} of them", 2, ConvergenceWarning)
        assert torch.get_num_threads() == 1
        threads.run([lambda: names.add(threading.current_thread().name)] * 2)  # in the same thread
        running.pop()

    torch.set_num_threads(2)
    with pytest.raises(ZeroDivisionError, match="of a thread"):
        threads.run([slow, failing, slow])
    assert not running
    names.clear()
    with pytest.warns(ConvergenceWarning) as told:
        threads.run([slow] * 4)
    assert [str(x.message) for x in told] == ["8 of them"]
    assert threading.current_thread().name not in names and len(names) <= 2
    with threads.alone():  # as many threads as without, and one for torch
        assert torch.get_num_threads() == 1 and threads.n_threads() == 2
        names.clear()
        with pytest.warns(ConvergenceWarning):
            threads.run([slow] * 4)
        assert threading.current_thread().name not in names
    assert torch.get_num_threads() == 2
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with pytest.raises(ConvergenceWarning):
            threads.run([slow] * 2)


def test_an_interrupt_ends_the_call_when_no_thread_runs() -> None:
    torch.set_num_threads(2)
    begun, ended = [], []

    def slow() -> None:
        begun.append(1)
        time.sleep(0.3)
        ended.append(1)

    threading.Timer(0.1, _thread.interrupt_main).start()
    with pytest.raises(KeyboardInterrupt):
        threads.run([slow] * 20)
    assert len(begun) == len(ended) < 20


def test_threads_that_begin_together_make_tables_once(bars: Shapes) -> None:
    torch.set_num_threads(8)
    given = [x.detach() for x in leaves(bars, 16)]
    wanted = None
    for _ in range(3):
        with torch.no_grad():
            found = tm.InBetween(bars.bases[:2], bars.faces)(*given)  # its factors are made by all
        wanted = found if wanted is None else wanted
        assert torch.equal(found, wanted)
