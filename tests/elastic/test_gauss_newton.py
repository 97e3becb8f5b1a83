"""One damped step on problems whose solution is known."""

from typing import Any

import pytest
import torch
from torch import Tensor

from torch_modal.elastic.gauss_newton import GaussNewtonStep
from torch_modal.elastic.modal import Derivatives


class LeastSquares:
    """Sum of squared residuals of a function, derivatives by autograd."""

    n_amplitudes = 2

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
        return Derivatives(
            self.value(a, placement), gradient, gauss_newton, curved if second_order else None, resolution
        )

    def value_and_gradient(self, a: Tensor, placement: Any) -> tuple[Tensor, Tensor]:
        return self.value(a, placement), self.derivatives(a, placement).gradient


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


def stepped(energy: Any, a: Tensor, n: int) -> Tensor:
    """Amplitudes after so many steps."""
    step = GaussNewtonStep(energy)
    for _ in range(n):
        a = step(a, None).amplitudes
    return a


def test_quadratic_in_one_step() -> None:
    class Quadratic(LeastSquares):
        def residuals(self, a: Tensor) -> Tensor:
            return a * torch.tensor([1.0, 20.0, 0.5]) - torch.tensor([1.0, 2.0, 3.0])

    found = stepped(Quadratic(), start([5.0, 5.0, 5.0]), 1)
    torch.testing.assert_close(found, start([1.0, 0.1, 6.0]), rtol=1e-9, atol=0)


def test_large_residual_needs_the_full_hessian() -> None:
    # Hessian at 0: 2 + 20; Gauss-Newton's: 2, so its whole step overshoots by ten.
    assert stepped(Circle(), start([0.3], [-1.0]), 8).abs().max() < 1e-8


def test_newtons_step_where_it_exists_and_gauss_newtons_elsewhere() -> None:
    gradient = start([1.0, -2.0], [3.0, 4.0])
    definite = torch.tensor([[3.0, 1.0], [1.0, 2.0]], dtype=torch.float64).expand(2, 2, 2)
    beyond = torch.stack([torch.eye(2, dtype=torch.float64), -5 * torch.eye(2, dtype=torch.float64)])
    hessians = torch.stack([definite[0] + beyond[0], definite[1]])
    wanted = -torch.linalg.solve(hessians, gradient)

    class Distance(LeastSquares):
        """Least at those steps; the derivatives are others, the full Hessian of the second sample is indefinite."""

        def value(self, a: Tensor, placement: Any) -> Tensor:
            return (a - wanted).square().sum(-1)

        def derivatives(self, a: Tensor, placement: Any, second_order: bool = True) -> Derivatives:
            return Derivatives(self.value(a, placement), gradient, definite, beyond, gradient[:, 0])

    found = GaussNewtonStep(Distance())(torch.zeros_like(gradient), None)
    torch.testing.assert_close(found.amplitudes, wanted)
    torch.testing.assert_close(found.gradient_norm, gradient.norm(dim=-1))


@pytest.mark.parametrize(
    ("rise", "part", "moves"), [(5e-4, 0.5, False), (1e-13, 0.5, False), (2e-16, 0.5, True), (0, 2, False)]
)
def test_no_step_goes_uphill_beyond_rounding(rise: float, part: float, moves: bool) -> None:
    """Within the rounding of the energy, the gradient decides."""

    class Slope(Circle):
        """Every step rises by a part of the energy, which may be below zero, and leaves a part of the gradient."""

        def value(self, a: Tensor, placement: Any) -> Tensor:
            return level + 100 * rise * (a != origin).any(-1)

        def derivatives(self, a: Tensor, placement: Any, second_order: bool = True) -> Derivatives:
            square = torch.eye(2, dtype=a.dtype).expand(2, 2, 2)
            gradient = torch.where(a == origin, 1.0, part).to(a)
            return Derivatives(self.value(a, placement), gradient, square, 0 * square, 0 * a[:, 0])

    origin, level = start([0.3, -1.0], [2.0, 0.5]), start([100.0, -100.0])[0]
    found = GaussNewtonStep(Slope())(origin, None)
    assert found.moved.tolist() == [moves] * 2
    assert torch.equal(found.amplitudes, origin) != moves
    torch.testing.assert_close(found.energy, level, rtol=4e-16, atol=0)
