"""Minimisation against SciPy's on shells, and on problems whose solution is known."""

from typing import Any

import numpy as np
import pytest
import torch
from conftest import Shapes, modal, placement_of
from scipy.optimize import least_squares
from test_gauss_newton import LeastSquares, Rosenbrock, Uphill, start
from torch import Tensor
from torch.func import jacfwd

from torch_modal.elastic.bend import Bend
from torch_modal.elastic.formulas import periodic_square
from torch_modal.elastic.minimise import Solution, Status, minimise
from torch_modal.elastic.shell import ShellEnergy
from torch_modal.elastic.term import Term
from torch_modal.errors import ConvergenceError
from torch_modal.inbetween.results import report
from torch_modal.inbetween.settings import Solver
from torch_modal.layers.mid_shape import MidShape

# ----------------------------------------------------------------------------------------------- known solutions


class Waves(LeastSquares):
    """Concave between its minima."""

    def residuals(self, a: Tensor) -> Tensor:
        return torch.stack([1 - a[..., 0].cos(), 0.3 * (a[..., 1] - 0.1 * a[..., 0])], -1)


def test_across_negative_curvature() -> None:
    first = start([2.5, 3.0], [-2.8, -1.0], [2.9, 0.5], [2.8559, -0.84165])
    solution = minimise(Waves(), first, None, tolerance=1e-6)
    assert solution.converged.all()
    assert (solution.energy < 1e-6).all()


def test_a_hessian_serves_until_the_gradient_shrinks_no_more() -> None:
    """Gauss-Newton's is exact at the end of the bent valley; the start is no place for it to serve long."""
    energy, hessians = Rosenbrock(), []
    whole = energy.derivatives
    energy.derivatives = lambda *given, **k: hessians.append(k) or whole(*given, **k)  # type: ignore[method-assign]
    solution = minimise(energy, start([-1.2, 1.0], [1.0, 1.0]), None, tolerance=1e-12)
    assert solution.converged.all()
    torch.testing.assert_close(solution.amplitudes, torch.ones(2, 2, dtype=torch.float64), atol=1e-9, rtol=0)
    assert solution.n_steps[1] == 0, "it started at the solution"
    assert hessians[0] == {"second_order": False} and len([k for k in hessians if k != {}]) == 1


def test_what_drowns_in_rounding_has_converged() -> None:
    """All that there is to gain is less than the rounding of a large constant."""

    class Drowned(LeastSquares):
        def residuals(self, a: Tensor) -> Tensor:
            return torch.cat([1.2429636856062651 + a.sin(), 0.1285222588569714 * a**2, torch.full_like(a, 1e9)], -1)

    solution = minimise(Drowned(), start([1.5465700486790057]), None, tolerance=1e-9)
    assert float(solution.gradient_norm) < 100, "one Newton step has 202 times the gradient of the start"


def test_what_cannot_go_on_says_why() -> None:
    """Neither what stalls nor what runs out of steps counts as converged; what is at its optimum does."""
    stalled = minimise(Uphill(), start([0.5], [2.0]), None)
    assert (stalled.status == Status.STALLED).all() and not stalled.usable.any()
    assert stalled.amplitudes.tolist() == [[0.5], [2.0]]
    short = minimise(Rosenbrock(), start([-1.2, 1.0], [1.0, 1.0]), None, max_steps=1)
    assert short.status.tolist() == [Status.OUT_OF_STEPS, Status.CONVERGED]
    assert short.n_steps.tolist() == [1, 0]
    invalid = minimise(Rosenbrock(), start([float("nan"), 1.0], [0.0, 0.0]), None)
    assert invalid.status.tolist() == [Status.INVALID, Status.CONVERGED]
    with pytest.raises(ConvergenceError, match="did not converge"):
        report(stalled, Solver(unconverged="raise"))


# --------------------------------------------------------------------------------------------------- on shells


@pytest.fixture(scope="module")
def layer(bars: Shapes) -> MidShape:
    """Between the bent and the twisted bar: 16 amplitudes."""
    return MidShape(bars.bases[1:], bars.faces, **modal(coarse_faces=200, backend="torch"))


def problem(layer: MidShape, bars: Shapes, bends: list[float]) -> tuple[Any, Tensor, Any]:
    """Energy, zeros and placement between the bent and the twisted bar, both pulled away from the straight one."""
    straight, ends = bars.keyframes[0], bars.keyframes[1:]
    keyframes = torch.stack([straight + b * (ends - straight) for b in bends])
    energy = layer.space
    placement = placement_of(layer.in_between.core, keyframes, torch.full((len(bends), 2), 0.5, dtype=torch.float64))
    return energy, keyframes.new_zeros(len(bends), energy.n_amplitudes), placement


def solve(layer: MidShape, bars: Shapes, bends: list[float], tolerance: float = 1e-8) -> Solution:
    return minimise(*problem(layer, bars, bends), tolerance=tolerance)


@pytest.mark.parametrize("ends", [(0, 1), (1, 2)])
def test_agrees_with_scipy(ends: tuple[int, int], small_bars: Shapes, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Bend, "softening", Term.softening)
    bars = small_bars.pick(*ends)
    layer = MidShape(bars.bases, bars.faces, **modal(anchor=0.0, backend="torch"))
    core, energy, half = layer.in_between.core, layer.space, torch.full((1, 2), 0.5, dtype=torch.float64)
    placement = placement_of(core, bars.keyframes[None], half, linear=True)
    a, coarse = torch.zeros(1, energy.n_amplitudes, dtype=torch.float64), layer.space.coarse
    rests = [coarse.restrict(x) for x in core.alignment(bars.keyframes[None], half)[0].unbind(1)]
    shell = ShellEnergy(coarse.mesh.faces)

    def towards(x: Tensor, rest: Tensor) -> Tensor:
        """Residuals of Eq. 5, with the periodic function of angles in the place of the square."""
        found, turn = shell.residuals(x, rest)[0], (shell.measure(x).angle - shell.measure(rest).angle)[0]
        n = len(shell.measure(x).length[0])
        bend = found[n:-1] * (periodic_square(turn) / turn**2).sqrt()
        return torch.cat([found[:n], bend, found[-1:]])

    def residuals(a: Tensor) -> Tensor:
        x = energy.parts[0].rows(a[None], placement[0]).movedim(0, -1)
        return 0.5**0.5 * torch.cat([towards(x, rest) for rest in rests])

    truth = least_squares(
        lambda a: residuals(torch.from_numpy(a)).numpy(),
        a[0].numpy(),
        jac=lambda a: jacfwd(residuals)(torch.from_numpy(a)).numpy(),
        xtol=1e-15,
        ftol=1e-15,
        gtol=1e-12,
        max_nfev=1000,
    )
    solution = minimise(energy, a, placement, tolerance=1e-9)
    assert solution.converged.all()
    assert float(solution.energy) == pytest.approx(2 * truth.cost, rel=1e-9)
    assert float(solution.energy) < 0.95 * float(energy.value(a, placement)), "nothing was to be gained"
    np.testing.assert_allclose(solution.amplitudes[0].numpy(), truth.x, atol=1e-5 * np.abs(truth.x).max())


def test_converges_and_says_so(layer: MidShape, bars: Shapes) -> None:
    energy, a, placement = problem(layer, bars, [0.3, 1.0, 1.6])
    solution = minimise(energy, a, placement, tolerance=1e-10)
    assert solution.converged.all()
    assert (solution.gradient_norm <= 1e-10).all()
    last, first = (energy.derivatives(x, placement).gradient.norm(dim=1) for x in (solution.amplitudes, a))
    assert (last / first < 0.5 * solution.gradient_norm).all(), "the last step is not counted"
    torch.testing.assert_close(solution.energy, energy.value(solution.amplitudes, placement))


def test_one_hessian_is_enough(layer: MidShape, bars: Shapes, monkeypatch: pytest.MonkeyPatch) -> None:
    energy, a, placement = problem(layer, bars, [0.3, 1.0, 1.6])
    derivatives, calls = energy.derivatives, []
    monkeypatch.setattr(energy, "derivatives", lambda *given, **k: calls.append(k) or derivatives(*given, **k))
    assert minimise(energy, a, placement).converged.all()
    assert calls == [{"second_order": False}]


@pytest.mark.parametrize("tolerance", [1e-8, 1e-13])
def test_a_sample_does_not_depend_on_its_batch(tolerance: float, layer: MidShape, bars: Shapes) -> None:
    bends = [0.0, 0.3, 1.0, 1.6]
    together = solve(layer, bars, bends, tolerance)
    assert together.converged.all()
    for i, bend in enumerate(bends):
        alone = solve(layer, bars, [bend], tolerance)
        torch.testing.assert_close(alone.amplitudes[0], together.amplitudes[i], rtol=0, atol=1e-10)
        assert tolerance < 1e-8 or alone.n_steps[0] == together.n_steps[i]
    assert len(set(together.n_steps.tolist())) > 1, "they end at different times"
