"""Eq. 5 with all vertices free: derivatives against autograd, and what a few steps gain."""

from collections.abc import Iterable
from itertools import pairwise

import pytest
import torch
from conftest import Shapes
from torch import Tensor
from torch.func import hessian, jacfwd

from torch_modal.elastic import formulas
from torch_modal.elastic.energy import Energy, EnergyAt, Reference, RestShapes
from torch_modal.elastic.shell import ShellEnergy
from torch_modal.elastic.steps import (
    SumOfEnergies,
    TermsTowards,
    descend,
    inverse_of_symmetric,
    step_length,
)
from torch_modal.geometry.vectors import norm

BATCH = 2


def relax(core: Energy, x: Tensor, reference: Reference, n_steps: int, n_products: int) -> Tensor:
    return descend(SumOfEnergies([TermsTowards(core, reference)]), x, n_steps * [n_products])


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
        self.core = self.shell.energy
        self.rows = self.core.extend(self.x.movedim(-1, 0).contiguous())
        self.reference = self.reference_of(range(BATCH))

    def reference_of(self, samples: Iterable[int]) -> Reference:
        """Both rest shapes in one, for some of the samples."""
        rows, shapes = list(samples), torch.stack([rest.expand_as(self.x) for rest in self.rests], 1)
        rests = RestShapes(shapes[rows], torch.stack(self.pulls, -1)[rows], self.shell.stiffness)
        return rests.reference(self.core)

    def at(self, x: Tensor) -> EnergyAt:
        return EnergyAt(self.core, self.core.extend(x.movedim(-1, 0).contiguous()), self.reference)

    def energy(self, x: Tensor, sample: int) -> Tensor:
        parts = zip(self.rests, self.pulls, strict=True)
        return sum(p[sample] * self.shell(x, r.expand_as(self.x)[sample]) for r, p in parts)  # type: ignore[return-value]


@pytest.fixture(params=["closed", "open"])
def case(request: pytest.FixtureRequest, small_bars: Shapes) -> Case:
    return Case(small_bars, small_bars.faces if request.param == "closed" else small_bars.faces[6:])


def test_convex_hessian_is_gauss_newton_and_the_stretched_edges(case: Case) -> None:
    core, at = case.core, case.at(case.x)
    n, edges, volume = case.x[0].numel(), at.terms[0], at.terms[2]
    to_volume = core.fold(volume.gradients)
    for sample in range(BATCH):
        unit = torch.eye(n, dtype=torch.float64).reshape(n, *case.x[0].shape).movedim(-1, 0)
        alone = EnergyAt(core, case.rows[:, [sample]].expand(-1, n, -1).contiguous(), case.reference_of([sample]))
        got = core.fold(alone.product(core.extend(unit))).movedim(0, -1).flatten(1)

        def residuals(x: Tensor, sample: int = sample) -> Tensor:
            parts = zip(case.rests, case.pulls, strict=True)
            return torch.cat(
                [p[sample].sqrt() * case.shell.residuals(x, r.expand_as(case.x)[sample]) for r, p in parts]
            )

        jacobian = jacfwd(residuals)(case.x[sample]).flatten(1)
        stretched = at.tensions[0][sample] * norm(edges.edge_vectors[0])[sample]

        def lengths(x: Tensor, stretched: Tensor = stretched) -> Tensor:
            return (stretched * case.shell.measure(x).length).sum()

        truth = 2 * jacobian.T @ jacobian + hessian(lengths)(case.x[sample]).reshape(n, n)
        assert float((got - truth).norm() / truth.norm()) < 1e-11
        assert float(torch.linalg.eigvalsh(got).amin()) > -1e-9 * float(torch.linalg.eigvalsh(got).amax())

        blocks = inverse_of_symmetric(at.diagonal())[:, :, sample, : n // 3].permute(2, 0, 1)
        own = truth.reshape(n // 3, 3, n // 3, 3)
        # The volume couples all vertices and is left out of the blocks.
        own_volume = to_volume[:, sample].T
        at_volume = volume.curvature[sample] * own_volume[:, :, None] * own_volume[:, None]
        diagonal = torch.stack([own[v, :, v] for v in range(n // 3)]) - at_volume
        ridge = formulas.RIDGE * torch.eye(3) * diagonal.diagonal(dim1=1, dim2=2).sum(1)[:, None, None]
        product = (blocks @ (diagonal + ridge))[core.used]
        torch.testing.assert_close(product, torch.eye(3).double().expand_as(product), atol=1e-8, rtol=0)


def test_steps_go_downhill_and_many_end_at_a_minimum(small_bars: Shapes) -> None:
    case = Case(small_bars, roughness=0.05)

    def energies(x: Tensor) -> Tensor:
        return torch.stack([case.energy(x[sample], sample) for sample in range(BATCH)])

    values = [energies(relax(case.core, case.x, case.reference, n, 5)) for n in (0, 1, 2, 4)]
    assert all(bool((after < before).all()) for before, after in pairwise(values))
    end = relax(case.core, case.x, case.reference, 60, 100)
    start_norm, end_norm = (case.core.fold(case.at(x).gradient()).norm() for x in (case.x, end))
    assert float(end_norm / start_norm) < 1e-5


def test_a_step_that_goes_uphill_ends_where_the_parabola_is_least(case: Case) -> None:
    core, at = case.core, case.at(case.x)
    before, gradient = at.value, core.fold(at.gradient())
    move = -gradient * torch.tensor([1.0, 1e-5])[:, None]
    slope, after = (gradient * move).sum((0, -1)), core.value(case.rows + core.extend(move), case.reference)
    length = step_length(before, slope, after, torch.ones_like(before))
    assert float(length[0]) < 0.1 and float(length[1]) == 1
    shorter = case.rows + length[:, None] * core.extend(move)
    assert bool((core.value(shorter, case.reference) < before).all())
    torch.testing.assert_close(length[0], -0.5 * slope[0] / (after - before - slope)[0])
