"""The paper's space (Eq. 4) against its formula, written out from Eq. 5, and against its limits."""

import pytest
import torch
from conftest import Shapes, modal, placement_of
from helpers.shapes import rigid_blend
from torch import Tensor
from torch.func import hessian, jacrev

from torch_modal.elastic.shell import ShellEnergy
from torch_modal.geometry import connectivity
from torch_modal.layers.in_between import InBetween
from torch_modal.layers.mid_shape import MidShape

MU = 0.3


class Setting:
    """The space of two bars, a batch of two pairs, and amplitudes away from zero."""

    def __init__(self, bars: Shapes, coarse_faces: int) -> None:
        layer = MidShape(bars.bases[:2], bars.faces, **modal(space="paired", coarse_faces=coarse_faces))
        core = layer.in_between.core
        self.energy, self.ends = core.space, (core.space.first, core.space.second)
        self.coarse = core.space.first.coarse
        self.shell = ShellEnergy(self.coarse.mesh.faces)
        pairs, half = torch.stack([bars.keyframes[:2], bars.keyframes[1:3]]), torch.full((2, 2), 0.5).double()
        self.shapes = core.alignment(pairs, half)[0].unbind(1)
        self.placement = placement_of(core, pairs, half)._replace(mu=torch.full((2,), MU, dtype=torch.float64))
        generator = torch.Generator().manual_seed(3)
        self.a = torch.randn(2, self.energy.n_amplitudes, dtype=torch.float64, generator=generator)

    def energy_by_hand(self, a: Tensor) -> Tensor:
        """Eq. 4, d(x_a, x1) + mu |x1 - x2|^2 + d(x_b, x2), on the coarse mesh."""
        parts = a.split([end.n_amplitudes for end in self.ends], -1)
        x1, x2 = (end.lift(part, x) for end, x, part in zip(self.ends, self.shapes, parts, strict=True))
        restrict, (x_a, x_b) = self.coarse.restrict, self.shapes
        similarity = (restrict(x1 - x2) ** 2).sum((-1, -2))
        return self.shell(restrict(x1), restrict(x_a)) + MU * similarity + self.shell(restrict(x2), restrict(x_b))


@pytest.fixture(scope="module", params=[200, 1000], ids=["coarse", "fine"])
def setting(request: pytest.FixtureRequest, bars: Shapes) -> Setting:
    return Setting(bars, request.param)


def test_energy_is_eq_4(setting: Setting) -> None:
    value = setting.energy.value(setting.a, setting.placement)
    torch.testing.assert_close(value, setting.energy_by_hand(setting.a), rtol=1e-10, atol=0)
    zero = torch.zeros_like(setting.a)
    # At rest only the similarity of the key-frames is left.
    apart = MU * (setting.coarse.restrict(setting.shapes[0] - setting.shapes[1]) ** 2).sum((-1, -2))
    torch.testing.assert_close(setting.energy.value(zero, setting.placement), apart, rtol=1e-10, atol=0)


def test_derivatives_agree_with_autograd(setting: Setting) -> None:
    got = setting.energy.derivatives(setting.a, setting.placement)
    gradient = jacrev(lambda a: setting.energy_by_hand(a).sum())(setting.a)
    torch.testing.assert_close(got.gradient, gradient, rtol=1e-9, atol=1e-9 * float(gradient.abs().max()))
    torch.testing.assert_close(got.value, setting.energy.value(setting.a, setting.placement))
    whole = hessian(lambda a: setting.energy_by_hand(a).sum())(setting.a)
    truth = torch.stack([whole[i, :, i] for i in range(2)])
    assert float((got.hessian - truth).norm()) < 1e-10 * float(truth.norm())
    assert float((got.gauss_newton - truth).norm()) > 1e-3 * float(truth.norm())
    assert torch.linalg.eigvalsh(got.gauss_newton).amin() > 0
    assert setting.energy.derivatives(setting.a, setting.placement, False).second_order is None


def test_the_anchor_of_the_joint_space_is_part_of_its_energy(bars: Shapes) -> None:
    pairs, half = bars.keyframes[None, 1:], torch.full((1, 2), 0.5, dtype=torch.float64)
    free, held = (
        MidShape(bars.bases[1:], bars.faces, **modal(anchor=anchor, backend="torch")).in_between.core
        for anchor in (0.0, 7.0)
    )
    placement, a = placement_of(free, pairs, half), 0.1 * torch.ones(1, free.space.n_amplitudes, dtype=torch.float64)
    gain = 3.5 * a.square().sum(-1)
    torch.testing.assert_close(held.space.value(a, placement), free.space.value(a, placement) + gain)
    without, found = (core.space.derivatives(a, placement) for core in (free, held))
    torch.testing.assert_close(found.gradient, without.gradient + 7 * a)
    torch.testing.assert_close(found.gauss_newton, without.gauss_newton + 7 * torch.eye(a.shape[1]).to(a))
    value, gradient = held.space.value_and_gradient(a, placement)
    torch.testing.assert_close((value, gradient), (held.space.value(a, placement), found.gradient))


def test_small_mu_is_linear_interpolation(bars: Shapes) -> None:
    x_a, x_b = bars.keyframes[1:]
    areas = torch.stack(
        [torch.from_numpy(connectivity.vertex_areas(x.numpy(), bars.faces.numpy())) for x in (x_a, x_b)]
    )
    weights = (areas / areas.sum(1, keepdim=True)).sum(0)
    mean = rigid_blend(x_a, x_b, torch.tensor(0.5, dtype=torch.float64), weights)
    distances = []
    for mu in (1e-3, 1e-6, 1e-9):
        found = MidShape(bars.bases[1:], bars.faces, "paired", mu, **modal(coarse_faces=200))(x_a, x_b)
        distances.append(float((found - mean).abs().max()))
    assert distances[0] > 100 * distances[1] > 1e4 * distances[2], distances
    assert distances[2] < 1e-7


def test_knows_the_middle_only(bars: Shapes) -> None:
    with pytest.raises(ValueError, match="t = 1/2 only; other presets have all times"):
        x_a, x_b = bars.keyframes[:2]
        InBetween(bars.bases[:2], bars.faces, **modal(space="paired", coarse_faces=200))(
            x_a, x_b, torch.tensor([0.5, 0.25])
        )
