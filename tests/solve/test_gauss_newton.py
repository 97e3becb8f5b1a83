"""The solver against SciPy's on shells, and on problems whose solution is known."""

from typing import Any

import numpy as np
import pytest
import torch
from conftest import Shapes, modal, placement_of
from scipy.optimize import least_squares
from torch import Tensor
from torch.func import jacfwd
from torch_modal.solve.quasi_newton import descend

from torch_modal.energy.modal_energy import Derivatives, Placement
from torch_modal.energy.shell import ShellEnergy
from torch_modal.energy.term import periodic_square
from torch_modal.inbetween.results import ConvergenceError, report
from torch_modal.layers.mid_shape import MidShape
from torch_modal.solve.gauss_newton import GaussNewtonStep
from torch_modal.solve.minimise import Solution, Status, minimise


class LeastSquares:
    """Sum of squared residuals of a function, derivatives by autograd."""

    def residuals(self, a: Tensor) -> Tensor:
        raise NotImplementedError

    def value(self, a: Tensor, placement: Any) -> Tensor:
        return (self.residuals(a) ** 2).sum(-1)

    def derivatives(self, a: Tensor, placement: Any, second_order: bool = True) -> Derivatives:
        rows = []
        for sample in a:
            r, j = self.residuals(sample), torch.autograd.functional.jacobian(self.residuals, sample)
            hessian = torch.autograd.functional.hessian(lambda a: self.value(a, None), sample)
            rows.append((2 * j.mT @ r, 2 * j.mT @ j, hessian - 2 * j.mT @ j, torch.zeros_like(r[0])))
        gradient, gauss_newton, curved, resolution = map(torch.stack, zip(*rows, strict=True))
        return Derivatives(gradient, gauss_newton, curved if second_order else None, resolution)

    def value_and_gradient(self, a: Tensor, placement: Any) -> tuple[Tensor, Tensor]:
        return self.value(a, placement), self.derivatives(a, placement).gradient

    def second_order(self, a: Tensor, placement: Any) -> Tensor:
        curved = self.derivatives(a, placement).second_order
        assert curved is not None
        return curved


class Rosenbrock(LeastSquares):
    """Minimum 0 at (1, 1), behind a bent valley."""

    def residuals(self, a: Tensor) -> Tensor:
        return torch.stack([10 * (a[..., 1] - a[..., 0] ** 2), 1 - a[..., 0]], -1)


class Circle(LeastSquares):
    """Nearest point of a parabola to a far point on its hollow side: the residual stays, Gauss-Newton diverges."""

    def residuals(self, a: Tensor) -> Tensor:
        return torch.stack([a[..., 0], a[..., 0] ** 2 + 5.0], -1)


class Uphill(Circle):
    """Its derivatives are those of another function: no step goes downhill."""

    def derivatives(self, a: Tensor, placement: Any, second_order: bool = True) -> Derivatives:
        found = super().derivatives(a, placement, second_order)
        return found._replace(gradient=-found.gradient)


def start(*rows: list[float]) -> Tensor:
    return torch.tensor(rows, dtype=torch.float64)


both = pytest.mark.parametrize("method", [minimise, descend])

# ----------------------------------------------------------------------------------------------- known solutions


def test_quadratic_in_one_step() -> None:
    class Quadratic(LeastSquares):
        def residuals(self, a: Tensor) -> Tensor:
            return a * torch.tensor([1.0, 20.0, 0.5]) - torch.tensor([1.0, 2.0, 3.0])

    solution = minimise(GaussNewtonStep(Quadratic()), start([5.0, 5.0, 5.0]), None)
    torch.testing.assert_close(solution.amplitudes, start([1.0, 0.1, 6.0]), rtol=1e-9, atol=0)
    assert solution.n_steps.tolist() == [1]
    assert solution.converged.all()


@both
def test_rosenbrock(method: Any) -> None:
    solution = method(GaussNewtonStep(Rosenbrock()), start([-1.2, 1.0], [3.0, -2.0], [1.0, 1.0]), None)
    torch.testing.assert_close(solution.amplitudes, torch.ones(3, 2, dtype=torch.float64), atol=1e-6, rtol=0)
    assert solution.converged.all()
    assert solution.n_steps[2] == 0, "it started at the solution"
    assert (solution.gradient_norm[:2] <= 1e-8).all()


def test_large_residual_needs_the_full_hessian() -> None:
    # Hessian at 0: 2 + 20; Gauss-Newton's: 2, so its whole step overshoots by ten.
    solution = minimise(GaussNewtonStep(Circle()), start([0.3], [-1.0]), None, max_steps=8)
    assert solution.converged.all()
    assert solution.amplitudes.abs().max() < 1e-8
    torch.testing.assert_close(solution.energy, start([25.0, 25.0])[0])


def test_directions_are_newtons_where_they_exist() -> None:
    step = GaussNewtonStep(Rosenbrock(), damping=0.0)
    gradient = start([1.0, -2.0], [3.0, 4.0])
    definite = torch.tensor([[3.0, 1.0], [1.0, 2.0]], dtype=torch.float64).expand(2, 2, 2)
    beyond = torch.stack([torch.eye(2, dtype=torch.float64), -5 * torch.eye(2, dtype=torch.float64)])
    directions = step.directions(Derivatives(gradient, definite, beyond, gradient[:, 0]))
    assert directions.shape == (2, 2, 2)
    for i in range(2):
        torch.testing.assert_close(directions[0, i], -torch.linalg.solve(definite[i], gradient[i]))
    torch.testing.assert_close(directions[1, 0], -torch.linalg.solve(definite[0] + beyond[0], gradient[0]))
    assert directions[1, 1].isnan().all(), "the full Hessian of the second sample is indefinite"
    assert step.directions(Derivatives(gradient, definite, None, gradient[:, 0])).shape == (1, 2, 2)


# --------------------------------------------------------------------------------------------------- on shells


@pytest.fixture(scope="module")
def layer(bars: Shapes) -> MidShape:
    """Between the bent and the twisted bar: 17 amplitudes."""
    return MidShape(bars.bases[1:], bars.faces, **modal(coarse_faces=200, backend="torch"))


def problem(layer: MidShape, bars: Shapes, bends: list[float]) -> tuple[Placement, Tensor]:
    """In-betweens of the bent bar, and of the twisted one pulled away from the straight one."""
    straight, bent, twisted = bars.keyframes
    x_a = torch.stack([straight + b * (bent - straight) for b in bends])
    x_b = torch.stack([straight + b * (twisted - straight) for b in bends])
    t = torch.full((len(bends),), 0.5, dtype=torch.float64)
    return placement_of(layer, layer.space.frame.place(x_a, x_b), t), t.new_zeros(len(bends), layer.space.n_unknowns)


def solve(layer: MidShape, bars: Shapes, bends: list[float]) -> Solution:
    placed, a = problem(layer, bars, bends)
    return minimise(layer.step, a, placed)


def test_a_last_newton_step_that_went_wrong_is_not_the_last() -> None:
    """All that there is to gain drowns in the rounding of a large constant, and the first Newton step overshoots."""

    class Drowned(LeastSquares):
        def residuals(self, a: Tensor) -> Tensor:
            return torch.cat([1.2429636856062651 + a.sin(), 0.1285222588569714 * a**2, torch.full_like(a, 1e9)], -1)

    solution = minimise(GaussNewtonStep(Drowned()), start([1.5465700486790057]), None, tolerance=1e-9)
    assert float(solution.gradient_norm) < 100, "one Newton step has 202 times the gradient of the start"


@pytest.mark.parametrize("ends", [(0, 1), (1, 2)])
def test_agrees_with_scipy(ends: tuple[int, int], small_bars: Shapes) -> None:
    bars = small_bars.pick(*ends)
    layer = MidShape(bars.bases, bars.faces, **modal())
    frame, energy = layer.space.frame, layer.space.energy
    pair = frame.place(*bars.keyframes[:, None])
    placement = placement_of(layer, pair, torch.tensor([0.5], dtype=torch.float64))
    a = torch.zeros(1, layer.space.n_unknowns, dtype=torch.float64)
    rests = [frame.coarsen(x) for x in pair[:2]]
    shell = ShellEnergy(frame.coarse.faces)

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
    solution = minimise(layer.step, a, placement)
    assert solution.converged.all()
    assert float(solution.energy) == pytest.approx(2 * truth.cost, rel=1e-9)
    assert float(solution.energy) < 0.95 * float(energy.value(a, placement)), "nothing was to be gained"
    np.testing.assert_allclose(solution.amplitudes[0].numpy(), truth.x, atol=1e-5 * np.abs(truth.x).max())


@both
def test_what_cannot_go_on_says_why(method: Any) -> None:
    """Neither what stalls nor what runs out of steps counts as converged; what is at its optimum does."""
    stalled = method(GaussNewtonStep(Uphill()), start([0.5], [2.0]), None)
    assert (stalled.status == Status.STALLED).all() and not stalled.usable.any()
    assert stalled.amplitudes.tolist() == [[0.5], [2.0]]
    short = method(GaussNewtonStep(Rosenbrock()), start([-1.2, 1.0], [1.0, 1.0]), None, max_steps=2)
    assert short.status.tolist() == [Status.OUT_OF_STEPS, Status.CONVERGED]
    assert short.n_steps[0] <= 2 and short.n_steps[1] == 0
    invalid = method(GaussNewtonStep(Rosenbrock()), start([float("nan"), 1.0], [0.0, 0.0]), None)
    assert invalid.status.tolist() == [Status.INVALID, Status.CONVERGED]
    with pytest.raises(ConvergenceError, match="did not converge"):
        report(stalled, max_steps=40, forbid=True)


def test_converges_and_says_so(layer: MidShape, bars: Shapes) -> None:
    placed, a = problem(layer, bars, [0.3, 1.0, 1.6])
    solution = minimise(layer.step, a, placed)
    assert solution.converged.all()
    assert solution.n_steps.max() <= 10
    # What it reports is what is there.
    there, first = (layer.space.energy.derivatives(x, placed).gradient for x in (solution.amplitudes, a))
    torch.testing.assert_close(solution.gradient_norm, there.norm(dim=1) / first.norm(dim=1))
    assert solution.gradient_norm.max() <= 1e-8
    torch.testing.assert_close(solution.energy, layer.space.energy.value(solution.amplitudes, placed))


def test_energy_never_increases(layer: MidShape, bars: Shapes, generator: torch.Generator) -> None:
    """Also from a start far away, where shapes pass through themselves."""
    placed, a = problem(layer, bars, [1.0] * 8)
    a = a + 100 * torch.randn(a.shape, dtype=torch.float64, generator=generator) * torch.arange(8)[:, None] / 8
    energies = [layer.space.energy.value(a, placed)]
    for _ in range(15):
        taken = layer.step(a, placed)
        a = taken.amplitudes
        energies.append(layer.space.energy.value(a, placed))
        torch.testing.assert_close(taken.energy, energies[-1], rtol=1e-12, atol=0)
    change = torch.stack(energies).diff(dim=0) / energies[-1]
    assert change.max() <= 1e-14
    assert (energies[-1][1:] < 0.9 * energies[0][1:]).all()


def test_one_bad_sample_spoils_no_other(layer: MidShape, bars: Shapes) -> None:
    bends = [0.5, 1.0, 1.5]
    alone = solve(layer, bars, bends)
    placed, a = problem(layer, bars, bends)
    (coarse,) = placed
    base = coarse.base.clone()
    base[1, :, 7] = torch.nan
    solution = minimise(layer.step, a, (coarse._replace(base=base),))
    assert solution.converged.tolist() == [True, False, True]
    assert solution.gradient_norm[1].isnan()
    for i in (0, 2):
        torch.testing.assert_close(solution.amplitudes[i], alone.amplitudes[i], rtol=0, atol=1e-7)
        assert solution.n_steps[i] == alone.n_steps[i]


@pytest.mark.parametrize("tolerance", [1e-8, 1e-13])
def test_batch_is_a_loop(tolerance: float, layer: MidShape, bars: Shapes) -> None:
    bends = [0.0, 0.4, 1.0, 1.6]

    def solve_all(bends: list[float]) -> Solution:
        placed, a = problem(layer, bars, bends)
        return minimise(layer.step, a, placed, tolerance=tolerance)

    together = solve_all(bends)
    assert together.converged.all()
    for i, bend in enumerate(bends):
        alone = solve_all([bend])
        assert alone.converged.all()
        torch.testing.assert_close(together.energy[i], alone.energy[0], rtol=1e-10, atol=1e-10)
        if tolerance == 1e-8:
            assert together.n_steps[i] == alone.n_steps[0]
        else:  # At the last digit the number of steps is chance, but the solution is one.
            torch.testing.assert_close(together.amplitudes[i], alone.amplitudes[0], rtol=1e-10, atol=1e-10)


def test_gives_up_and_says_so(layer: MidShape, bars: Shapes) -> None:
    placed, a = problem(layer, bars, [1.0, 0.0])
    none = minimise(layer.step, a, placed, max_steps=0)
    assert none.n_steps.tolist() == [0, 0]
    assert none.gradient_norm[0] == 1
    one = minimise(layer.step, a, placed, max_steps=1)
    assert one.n_steps[0] == 1
    assert one.converged.tolist() == [False, True], "between equal shapes there is nothing to do"
    assert 1e-8 < float(one.gradient_norm[0]) < 1


def test_damping_takes_directions_that_do_nothing(layer: MidShape, bars: Shapes) -> None:
    """Equal key-frames leave the column of their difference empty, and the Hessian singular."""
    solution = solve(layer, bars, [0.0])
    assert solution.amplitudes.isfinite().all()
    assert solution.amplitudes.abs().max() < 1e-9
    assert solution.converged.all()
