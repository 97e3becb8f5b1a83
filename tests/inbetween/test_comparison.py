"""In-betweens that give way to their starts as far as they are worse, by their distortion; the status says so."""

from dataclasses import replace
from typing import Any

import pytest
import torch
from conftest import Shapes, modal
from torch import Tensor
from torch.autograd import gradcheck

import torch_modal as tm
from torch_modal.elastic.bend import Bend
from torch_modal.elastic.distortion import Distortion
from torch_modal.elastic.energy import RestShapes
from torch_modal.elastic.formulas import LARGEST_WEIGHT
from torch_modal.elastic.implicit import ConvergenceWarning
from torch_modal.elastic.minimise import Status
from torch_modal.elastic.term import Mesh
from torch_modal.inbetween.comparison import blend_by_distortion

INF, NAN = torch.inf, torch.nan


@pytest.mark.parametrize(
    "own, part", [(0.9, 0.0), (1.1, 0.0), (1.15, 0.5), (1.2, 1.0), (2.0, 1.0), (INF, 1.0), (NAN, 1.0)]
)
def test_a_shape_gives_way_from_a_tenth_more_distortion_to_a_fifth(own: float, part: float) -> None:
    x, start = torch.zeros(1, 4, 3).double(), torch.ones(1, 4, 3).double()
    found, replaced, weights = blend_by_distortion(
        x, [start], torch.tensor([[own], [1.0]]).double(), torch.zeros(1).double()
    )
    assert float(found[0, 0, 0]) == pytest.approx(part, abs=1e-6) and replaced.tolist() == [part == 1]
    assert float(weights[0, 0]) == pytest.approx(part, abs=1e-6)


def test_the_best_of_the_starts_is_taken() -> None:
    x, starts = torch.zeros(3, 4, 3), [torch.full((3, 4, 3), value) for value in (1.0, 2.0)]
    distortion = torch.tensor([[9.0, 9.0, 1.0], [1.0, 3.0, 1.0], [2.0, 2.0, 1.0]])
    found, worse, weights = blend_by_distortion(x, starts, distortion, torch.zeros(3))
    assert worse.tolist() == [True, True, False] and found[:, 0, 0].tolist() == [1.0, 2.0, 0.0]
    assert weights.tolist() == [[1, 0], [0, 1], [0, 0]]


def test_a_shape_may_have_parts_of_both_starts() -> None:
    x, starts = torch.zeros(1, 4, 3).double(), [torch.full((1, 4, 3), value).double() for value in (1.0, 100.0)]
    found, _, weights = blend_by_distortion(
        x, starts, torch.tensor([[1.15], [1.0], [0.95]]).double(), torch.zeros(1).double()
    )
    first, second = weights[0].tolist()
    assert 0 < first < 0.5 and 0 < second < 0.5 and float(found[0, 0, 0]) == pytest.approx(first + 100 * second)


def test_gradient_of_the_blend(generator: torch.Generator) -> None:
    def given_way(x: Tensor) -> Tensor:
        own = 1 + 0.2 * torch.sigmoid(x.sum((1, 2)))
        distortion = torch.stack([own, torch.ones_like(own)])
        return blend_by_distortion(x, [torch.ones_like(x)], distortion, torch.zeros_like(own))[0]

    assert gradcheck(given_way, torch.randn(2, 4, 3, dtype=torch.float64, generator=generator).requires_grad_())


class TestFallBack:
    """A result that is worse than its start."""

    def test_the_start_is_returned_and_the_status_says_so(self, bars: Shapes, backend: str, monkeypatch: Any) -> None:
        layer = tm.InBetween(bars.bases[1:], bars.faces, **modal(coarse_faces=200, backend=backend))
        space, x_a, x_b = layer.core.space, *bars.keyframes[1:]
        spoiled = type(space).lift

        def lift(self: Any, a: Tensor, base: Tensor) -> Tensor:
            x = spoiled(self, a, base)
            return torch.cat([x[:1] + 10 * torch.sin(37 * x[:1]), x[1:]])

        good = layer.solve(x_a, x_b, torch.tensor([0.5, 0.5]))
        assert good.solution.status.tolist() == [Status.CONVERGED] * 2
        assert not good.solution.start_weights.any()
        monkeypatch.setattr(type(space), "lift", lift)
        result = layer.solve(x_a, x_b, torch.tensor([0.5, 0.5]))
        assert result.solution.status.tolist() == [Status.FELL_BACK, Status.CONVERGED]
        assert result.solution.start_weights.tolist() == [[1, 0], [0, 0]]
        assert result.solution.usable.all() and result.solution.converged.tolist() == [False, True]
        torch.testing.assert_close(result.shapes[1], good.shapes[1], rtol=0, atol=1e-10)
        # Without a step the shape is the blend by local rotations.
        solver = replace(layer.solver, max_steps=0)
        blend = tm.InBetween(bars.bases[1:], bars.faces, objective=layer.objective, solver=solver)
        monkeypatch.setattr(type(space), "lift", spoiled)
        torch.testing.assert_close(result.shapes[0], blend.solve(x_a, x_b, 0.5).shapes, rtol=0, atol=1e-10)
        assert (good.shapes[0] - result.shapes[0]).abs().max() > 1e-6
        monkeypatch.setattr(type(space), "lift", lift)
        with pytest.warns(ConvergenceWarning, match="1 of 2 in-betweens had up to .* times the distortion.*FELL_BACK"):
            layer(x_a, x_b, torch.tensor([0.5, 0.5]))

    def test_not_where_nobody_sees_a_difference(self, bars: Shapes, monkeypatch: Any) -> None:
        """Key-frames that are the same, and a minimiser with strains of some thousandths."""
        layer = tm.InBetween(bars.bases[1:], bars.faces, **modal(coarse_faces=200))
        space, x = layer.core.space, bars.keyframes[1]
        spoiled = type(space).lift
        monkeypatch.setattr(type(space), "lift", lambda *given: spoiled(*given) * (1 + 3e-3))
        found = layer.solve(x, x, 0.5)
        assert found.solution.status == Status.CONVERGED and 0 < float(found.solution.distortion_ratio) < 0.5

    def test_gradients_are_those_of_what_is_returned(self, small_bars: Shapes, backend: str, monkeypatch: Any) -> None:
        layer = tm.InBetween(small_bars.bases[1:], small_bars.faces, **modal(coarse_faces=200, backend=backend))
        space, (x_a, x_b) = layer.core.space, small_bars.keyframes[1:]
        spoiled = type(space).lift
        monkeypatch.setattr(type(space), "lift", lambda *given: 10 * torch.sin(37 * spoiled(*given)))
        leaf = x_a.clone().requires_grad_()
        result = layer.solve(leaf, x_b, 0.4)
        assert result.solution.status == Status.FELL_BACK
        weights = torch.randn(x_a.shape, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
        (gradient,) = torch.autograd.grad((result.shapes * weights).sum(), leaf)
        step = 1e-6 * torch.randn(x_a.shape, dtype=torch.float64, generator=torch.Generator().manual_seed(2))
        with torch.no_grad():
            there, back = ((layer.solve(x_a + s * step, x_b, 0.4).shapes * weights).sum() for s in (1, -1))
        assert float((gradient * step).sum()) == pytest.approx(float(there - back) / 2, rel=1e-5)


def test_nothing_falls_back_at_a_key_frame(bars: Shapes) -> None:
    """There, all shapes are the same, and their distortions are rounding."""
    path = tm.Path(bars.bases, bars.faces)
    layer = tm.InBetween(bars.bases[1:], bars.faces)
    t = torch.tensor([0.0, 1e-9, 1.0, 2.0], dtype=torch.float64)
    for dtype in (torch.float64, torch.float32):
        keyframes = bars.keyframes.to(dtype)
        found = path.to(dtype).solve(keyframes, t.to(dtype)), layer.to(dtype).solve(*keyframes[1:], t[:3].to(dtype))
        assert all((result.solution.status != Status.FELL_BACK).all() for result in found)


class TestDistortion:
    """What results are judged by."""

    def given(self, bars: Shapes) -> tuple[list[Tensor], Tensor, Tensor, list[Tensor]]:
        straight, bent, twisted = bars.keyframes[:, None] * 20
        shapes = [torch.lerp(bent, twisted, 0.5), straight, bent + 0.2 * torch.sin(straight), 3.0 * bent]
        stiffness = [torch.tensor([[value]], dtype=torch.float64) for value in (500.0, 10.0, 1000.0)]
        return shapes, torch.stack([bent, twisted], 1), torch.tensor([[0.7, 0.3]], dtype=torch.float64), stiffness

    def test_is_eq_5_without_volume_where_strains_are_small(self, bars: Shapes) -> None:
        _, ends, _, stiffness = self.given(bars)
        bent = ends[:, 0]
        x = bent + 1e-3 * torch.sin(3 * bent)
        mesh = Mesh.of(bars.faces, bent.shape[1])
        rests = RestShapes(bent[:, None], torch.ones(1, 1, dtype=torch.float64), stiffness)
        distortion = Distortion(mesh, None)([x], rests)
        shell = tm.ShellEnergy(bars.faces, alpha=500.0, beta=10.0, gamma=0.0)
        # Beside that, Eq. 5 counts a relative strain squared, and the distortion the same.
        assert float(distortion) == pytest.approx(float(shell(x, bent)), rel=1e-9)

    def test_a_degenerate_face_does_not_dominate(self, bars: Shapes) -> None:
        """A vertex laid onto its neighbour in both key-frames: Eq. 5 divides by the length of that edge."""
        shapes, ends, weights, stiffness = self.given(bars)
        mesh = Mesh.of(bars.faces, ends.shape[2])
        distortion = Distortion(mesh, None)
        before = distortion(shapes, RestShapes(ends, weights, stiffness))
        i, j = mesh.edges[50].tolist()
        collapsed = ends.clone()
        collapsed[:, :, i] = collapsed[:, :, j] + 1e-3
        after = distortion(shapes, RestShapes(collapsed, weights, stiffness))
        assert (after < 4 * before).all(), "the faces around it were pulled out of shape, too"
        shell = tm.ShellEnergy(bars.faces)
        assert shell(shapes[0], collapsed[:, 0]) > 100 * shell(shapes[0], ends[:, 0])

    def test_needles_have_a_bounded_weight(self) -> None:
        e, b = torch.tensor([1.0, 0, 0]), torch.tensor([0.5, -1e-3, 0])
        edge_vectors = torch.stack([torch.stack([e, torch.tensor([0.5, h, 0]), b]) for h in (0.866, 1e-3, 0.0)], -1)
        hinges = edge_vectors.double()
        weights = Bend().weights(hinges, Bend().measures(hinges)).clamp_max(LARGEST_WEIGHT)
        assert weights[0] == pytest.approx(2 / 0.867, rel=1e-3) and weights[1:].tolist() == [8.0, 0.0]
