"""Quasi-Newton steps: the same minimum as Newton's method, sample by sample, with a status that is true."""

from typing import Any

import pytest
import torch
from conftest import Shapes
from test_gauss_newton import Circle, LeastSquares, Rosenbrock, problem, start
from test_gauss_newton import layer as layer  # a fixture
from torch import Tensor
from torch_modal.solve.quasi_newton import descend

from torch_modal.layers.mid_shape import MidShape
from torch_modal.solve import quasi_newton
from torch_modal.solve.gauss_newton import GaussNewtonStep
from torch_modal.solve.minimise import Status, minimise


def test_same_minimum_as_newtons_method(layer: MidShape, bars: Shapes) -> None:
    placed, a = problem(layer, bars, [0.3, 1.0, 1.6])
    found, wanted = (method(layer.step, a, placed, tolerance=1e-10) for method in (descend, minimise))
    assert found.converged.all() and wanted.converged.all()
    torch.testing.assert_close(found.amplitudes, wanted.amplitudes, atol=1e-8, rtol=0)
    torch.testing.assert_close(found.energy, wanted.energy, atol=0, rtol=1e-12)
    first, last = (layer.space.energy.derivatives(x, placed).gradient.norm(dim=1) for x in (a, found.amplitudes))
    assert (found.gradient_norm <= 1e-10).all()
    assert (last / first < 0.5 * found.gradient_norm).all(), "the last step is not counted"


def test_one_hessian_is_enough(layer: MidShape, bars: Shapes, monkeypatch: pytest.MonkeyPatch) -> None:
    placed, a = problem(layer, bars, [0.3, 1.0, 1.6])
    energy, calls = layer.step.energy, []
    derivatives = energy.derivatives
    monkeypatch.setattr(energy, "derivatives", lambda *given, **k: calls.append(1) or derivatives(*given, **k))
    monkeypatch.setattr(energy, "second_order", lambda *_: pytest.fail("no second-order term is needed"))
    assert descend(layer.step, a, placed).converged.all()
    assert len(calls) == 1


def test_a_sample_does_not_depend_on_its_batch(layer: MidShape, bars: Shapes) -> None:
    bends = [0.0, 0.3, 1.0, 1.6]
    together = descend(layer.step, *problem(layer, bars, bends)[::-1])
    for i, bend in enumerate(bends):
        alone = descend(layer.step, *problem(layer, bars, [bend])[::-1])
        assert alone.n_steps[0] == together.n_steps[i]
        torch.testing.assert_close(alone.amplitudes[0], together.amplitudes[i], rtol=0, atol=1e-11)
    assert len(set(together.n_steps.tolist())) > 1, "they end at different times"


class Waves(LeastSquares):
    """Concave between its minima."""

    def residuals(self, a: Tensor) -> Tensor:
        return torch.stack([1 - a[..., 0].cos(), 0.3 * (a[..., 1] - 0.1 * a[..., 0])], -1)


def alone(monkeypatch: pytest.MonkeyPatch) -> None:
    """No Newton steps help."""
    monkeypatch.setattr(quasi_newton, "minimise", lambda *_: pytest.fail("quasi-Newton steps should do"))


def test_across_negative_curvature(monkeypatch: pytest.MonkeyPatch) -> None:
    alone(monkeypatch)
    first = start([2.5, 3.0], [-2.8, -1.0], [2.9, 0.5], [2.8559, -0.84165])
    solution = descend(GaussNewtonStep(Waves()), first, None, tolerance=1e-6)
    assert solution.converged.all()
    assert (solution.energy < 1e-6).all()


def test_never_uphill_from_a_bent_valley(monkeypatch: pytest.MonkeyPatch) -> None:
    """A hard start: steps are shortened, and the energy never rises."""
    alone(monkeypatch)

    class Recorded(Rosenbrock):
        def value_and_gradient(self, a: Tensor, placement: Any) -> tuple[Tensor, Tensor]:
            tried.append(float(self.value(a, placement)))
            return super().value_and_gradient(a, placement)

    tried: list[float] = []
    first = start([-1.2, 1.0])
    solution = descend(GaussNewtonStep(Recorded()), first, None)
    assert solution.converged.all()
    torch.testing.assert_close(solution.amplitudes, torch.ones_like(first), rtol=0, atol=1e-6)
    assert max(tried) > float(Rosenbrock().value(first, None)), "no step was too long: the test is too easy"


def test_newton_steps_take_over(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(quasi_newton, "MOST_EVALUATIONS", 2)
    solution = descend(GaussNewtonStep(Circle()), start([0.3], [-1.0], [0.0]), None)
    assert solution.status.tolist() == [Status.CONVERGED] * 3
    assert solution.amplitudes.abs().max() < 1e-6
    energy, first = Circle(), start([0.3], [-1.0])
    norms = [energy.value_and_gradient(a, None)[1].norm(dim=1) for a in (first, solution.amplitudes[:2])]
    torch.testing.assert_close(solution.gradient_norm[:2], norms[1] / norms[0], rtol=1e-6, atol=1e-14)
    assert solution.n_steps[2] == 0, "it started at the solution"
