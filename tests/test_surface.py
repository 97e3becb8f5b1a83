"""Eq. 5 with all vertices free: derivatives against autograd, and what a few steps gain."""

from itertools import pairwise

import pytest
import torch
from conftest import Shapes
from torch import Tensor
from torch.func import hessian, jacfwd

from torch_modal.energy.linearised import Reference, energy_of, gradient, linearise
from torch_modal.energy.shell import ShellEnergy
from torch_modal.nn.relax import RIDGE, ConvexHessian, relax

BATCH = 2


class Case:
    """Shapes between two references of different pull, the second squeezed so that much residual is left."""

    def __init__(self, shapes: Shapes, faces: Tensor | None = None, roughness: float = 0.3) -> None:
        generator = torch.Generator().manual_seed(3)
        self.shell = ShellEnergy(shapes.faces if faces is None else faces, gamma=1e5)
        x = shapes.keyframes * 20
        noise = torch.randn(BATCH, *x.shape[1:], dtype=x.dtype, generator=generator)
        self.x = x[1] + roughness * noise
        self.rests = [x[1].expand_as(self.x), x[2] * torch.tensor([1.2, 0.8, 1.0])]
        self.pulls = [torch.tensor([0.5, 0.9]).double(), torch.tensor([0.5, 0.2]).double()]
        self.references = [Reference(self.shell.rest(r), p) for r, p in zip(self.rests, self.pulls, strict=True)]
        self.rows = self.x.movedim(-1, 0).contiguous()

    def energy(self, x: Tensor, sample: int) -> Tensor:
        parts = zip(self.rests, self.pulls, strict=True)
        return sum(p[sample] * self.shell(x, r.expand_as(self.x)[sample]) for r, p in parts)  # type: ignore[return-value]


@pytest.fixture(params=["closed", "open"])
def case(request: pytest.FixtureRequest, small_bars: Shapes) -> Case:
    return Case(small_bars, small_bars.faces if request.param == "closed" else small_bars.faces[6:])


def test_gradient(case: Case) -> None:
    got = gradient(case.shell, linearise(case.shell, case.rows, case.references))
    for sample in range(BATCH):
        x = case.x[sample].clone().requires_grad_()
        (truth,) = torch.autograd.grad(case.energy(x, sample), x)
        torch.testing.assert_close(got[:, sample].T, truth, rtol=1e-11, atol=1e-9)


def test_convex_hessian_is_gauss_newton_and_the_stretched_edges(case: Case) -> None:
    at = linearise(case.shell, case.rows, case.references)
    convex = ConvexHessian(case.shell, at)
    n = case.x[0].numel()
    for sample in range(BATCH):
        unit = torch.eye(n, dtype=torch.float64).reshape(n, *case.x[0].shape).movedim(-1, 0)
        only = linearise(
            case.shell,
            case.rows[:, [sample]].expand(-1, n, -1).contiguous(),
            [
                Reference(case.shell.rest(r.expand_as(case.x)[[sample]]), p[[sample]])
                for r, p in zip(case.rests, case.pulls, strict=True)
            ],
        )
        got = ConvexHessian(case.shell, only)(unit).movedim(0, -1).flatten(1)

        def residuals(x: Tensor, sample: int = sample) -> Tensor:
            parts = zip(case.rests, case.pulls, strict=True)
            return torch.cat(
                [p[sample].sqrt() * case.shell.residuals(x, r.expand_as(case.x)[sample]) for r, p in parts]
            )

        jacobian = jacfwd(residuals)(case.x[sample]).flatten(1)
        stretched = at.slope.length[sample].clamp_min(0)

        def lengths(x: Tensor, stretched: Tensor = stretched) -> Tensor:
            return (stretched * case.shell.measure(x).length).sum()

        truth = 2 * jacobian.T @ jacobian + hessian(lengths)(case.x[sample]).reshape(n, n)
        assert float((got - truth).norm() / truth.norm()) < 1e-11
        assert float(torch.linalg.eigvalsh(got).amin()) > -1e-9 * float(torch.linalg.eigvalsh(got).amax())

        blocks = convex.inverse_diagonal()[:, :, sample].permute(2, 0, 1)
        own = truth.reshape(n // 3, 3, n // 3, 3)
        # The volume couples all vertices and is left out of the blocks.
        at_volume = (
            at.curvature.volume[sample] * at.to_volume[:, sample].T[:, :, None] * at.to_volume[:, sample].T[:, None]
        )
        diagonal = torch.stack([own[v, :, v] for v in range(n // 3)]) - at_volume
        ridge = RIDGE * torch.eye(3) * diagonal.diagonal(dim1=1, dim2=2).sum(1)[:, None, None]
        product = (blocks @ (diagonal + ridge))[case.shell.used]
        torch.testing.assert_close(product, torch.eye(3).double().expand_as(product), atol=1e-8, rtol=0)


def test_steps_go_downhill_and_many_end_at_a_minimum(small_bars: Shapes) -> None:
    case = Case(small_bars, roughness=0.05)

    def energies(x: Tensor) -> Tensor:
        return energy_of(case.shell, case.shell.measure(x), case.references)

    values = [energies(relax(case.shell, case.x, case.references, n, 5)) for n in (0, 1, 2, 4)]
    assert all(bool((after < before).all()) for before, after in pairwise(values))
    end = relax(case.shell, case.x, case.references, 60, 100)
    start_norm, end_norm = (
        gradient(case.shell, linearise(case.shell, x.movedim(-1, 0).contiguous(), case.references)).norm()
        for x in (case.x, end)
    )
    assert float(end_norm / start_norm) < 1e-5


def test_a_minimum_stays(small_bars: Shapes) -> None:
    case = Case(small_bars)
    rest = case.rests[0]
    references = [Reference(case.shell.rest(rest), torch.ones(BATCH, dtype=torch.float64))]
    assert torch.equal(relax(case.shell, rest, references, 2, 5), rest)
