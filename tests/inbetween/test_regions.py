"""Local interpolation of the regions that the modes reach worst, and the preset "paper" as a whole."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from conftest import Shapes
from helpers.shapes import edge_error, largest
from torch import Tensor

from torch_modal.elastic.bend import NEEDLE, SquaredBend
from torch_modal.elastic.energy import Energy, Rest, RestShapes
from torch_modal.elastic.formulas import hinge_fullness
from torch_modal.elastic.minimise import Status
from torch_modal.elastic.shell import ShellEnergy
from torch_modal.elastic.stretch import Stretch
from torch_modal.elastic.term import Mesh
from torch_modal.elastic.volume import Volume
from torch_modal.inbetween import regions as regions_module
from torch_modal.inbetween.regions import NO_ERROR, LocalInterpolation, fitting_error, segments, worst_regions
from torch_modal.inbetween.settings import Objective, Solver
from torch_modal.layers.mid_shape import MidShape


@pytest.fixture(scope="module")
def layer(bars: Shapes) -> MidShape:
    return MidShape(bars.bases[1:], bars.faces, preset="paper", regions=3)


def inner(layer: MidShape) -> Tensor:
    """Vertices of the regions. *Shape:* ``(V,)``, bool."""
    return layer.in_between.core.local.region  # type: ignore[union-attr, no-any-return]


def test_regions_are_the_worst_segments_and_a_ring_of_faces(layer: MidShape) -> None:
    space, references = layer.space, layer.in_between.core.alignment.references
    region, faces = worst_regions(space, references, 3), layer.in_between.core.mesh.faces
    error = torch.from_numpy(fitting_error(space, references))[space.first.coarse.clusters]
    assert error[region].mean() > 2 * error[~region].mean()
    grown = region.index_fill(0, faces[region[faces].any(1)].flatten(), True)
    assert torch.equal(inner(layer), grown) and grown.sum() > region.sum()


@pytest.fixture
def strip(generator: torch.Generator) -> tuple[Any, Tensor]:
    """Two shapes of a strip of 24 vertices with unequal areas, and a random mode of each; the shapes."""
    i = torch.arange(18).view(3, 6)[:, :5].flatten()
    faces = torch.cat([torch.stack([i, i + 6, i + 1], 1), torch.stack([i + 1, i + 6, i + 7], 1)])
    grid = torch.cartesian_prod(torch.arange(4), torch.arange(6)).double()
    x = torch.stack([torch.nn.functional.pad(grid, (0, 1)), torch.nn.functional.pad(1.3 * grid, (1, 0))])
    x = x + 0.2 * torch.randn(x.shape, dtype=x.dtype, generator=generator)
    areas = torch.rand(24, dtype=x.dtype, generator=generator) ** 3
    coarse = SimpleNamespace(weights=areas / areas.sum(), mesh=Mesh.of(faces, 24), restrict=lambda shapes: shapes)
    ends = []
    for _ in range(2):
        mode = torch.randn(1, 24, 3, dtype=x.dtype, generator=generator)
        mode = mode / (coarse.weights * mode.square().sum(-1)).sum().sqrt()
        ends.append(SimpleNamespace(coarse=coarse, coarse_basis=mode))
    return SimpleNamespace(first=ends[0], second=ends[1]), x


def test_segments_are_those_of_a_slow_search(strip: tuple[Any, Tensor]) -> None:
    """Of all neighbours the pair whose union adds least to the distances from rigid motions, by least squares."""
    space, shapes = strip
    mesh, areas = space.first.coarse.mesh, space.first.coarse.weights
    ends = []
    for end, x in zip((space.first, space.second), shapes, strict=True):
        (mode,) = end.coarse_basis
        side, rate = (y[mesh.edges[:, 1]] - y[mesh.edges[:, 0]] for y in (x, mode))
        stiffness = ((rate * side).sum(1) ** 2 / side.norm(dim=1) ** 3).sum()  # of the energy, but for a factor
        turns = torch.linalg.cross(torch.eye(3).to(x)[None], x[:, None]).mT
        rigid = torch.cat([torch.eye(3).to(x).expand_as(turns), turns], 2)
        ends.append((rigid * areas.sqrt()[:, None, None], mode * (areas / stiffness).sqrt()[:, None]))

    def cost(part: frozenset[int]) -> float:
        some = sorted(part)
        each = ((rigid[some].flatten(0, 1).numpy(), mode[some].flatten().numpy()) for rigid, mode in ends)
        return sum(float(((a @ np.linalg.lstsq(a, b, rcond=None)[0] - b) ** 2).sum()) for a, b in each)

    parts = [frozenset([i]) for i in range(24)]
    while len(parts) > 4:
        joined = {
            a | b: (a, b) for i, j in mesh.edges.tolist() for a in parts for b in parts if i in a and j in b and a != b
        }
        a, b = joined[min(joined, key=lambda whole: cost(whole) - cost(joined[whole][0]) - cost(joined[whole][1]))]
        parts = [part for part in parts if part not in (a, b)] + [a | b]
    found = segments(space, shapes, 4)
    assert {frozenset(np.flatnonzero(found == i).tolist()) for i in range(4)} == set(parts)


def test_fitting_error_is_that_of_weighted_least_squares(strip: tuple[Any, Tensor]) -> None:
    space, shapes = strip
    way, root = shapes[1] - shapes[0], space.first.coarse.weights.sqrt()[:, None]
    squares = torch.zeros(24, dtype=way.dtype)
    for end in (space.first, space.second):
        (mode,) = end.coarse_basis
        amplitude = torch.linalg.lstsq((root * mode).view(-1, 1), (root * way).view(-1, 1)).solution
        squares += (way - amplitude * mode).square().sum(1)
    torch.testing.assert_close(torch.from_numpy(fitting_error(space, shapes)), squares.sqrt())


def test_the_worst_region_is_that_of_the_largest_mean_over_its_area(monkeypatch: pytest.MonkeyPatch) -> None:
    """Means of 1.3, 2 and nearly nothing, by hand; without areas the first would be 2.5."""
    error = NO_ERROR * 100 * np.array([1e6, 4e6, 2e6, 2e6, 0.99, 0.99])
    monkeypatch.setattr(regions_module, "segments", lambda *given: np.array([0, 0, 1, 1, 2, 2]))
    monkeypatch.setattr(regions_module, "fitting_error", lambda *given: error)
    weights, clusters = torch.tensor([9.0, 1, 1, 1, 1, 1]).double(), torch.tensor([5, 4, 3, 3, 1, 0])
    space: Any = SimpleNamespace(first=SimpleNamespace(coarse=SimpleNamespace(weights=weights, clusters=clusters)))
    found = [worst_regions(space, torch.zeros(2, 6, 3), n).nonzero().flatten().tolist() for n in (1, 2, 3)]
    assert found == [[2, 3], [2, 3, 4, 5], [2, 3, 4, 5]]
    error[4:] *= 1.02
    assert bool(worst_regions(space, torch.zeros(2, 6, 3), 3).all())


def test_minimises_eq_5_against_measures_half_way_and_moves_nothing_else(
    bars: Shapes, generator: torch.Generator
) -> None:
    """Each edge and hinge has a stiffness of its own; the gradient is that of the whole mesh, by autograd."""
    x, other = (12 * bars.keyframes[1:]).unbind()  # the bars are 4 long
    mesh, region = Mesh.of(bars.faces, len(x)), x[:, 0] > 12
    free = region.index_fill(0, bars.faces[region[bars.faces].any(1)].flatten(), True)
    sizes = len(mesh.edges), len(mesh.hinges)
    alpha, beta = (1 + 99 * torch.rand(1, n, dtype=torch.float64, generator=generator) for n in sizes)
    energy = Energy(mesh, [Stretch(), SquaredBend(), Volume()])
    starts = [
        y + 0.3 * free[:, None] * torch.randn(x.shape, dtype=torch.float64, generator=generator) for y in (x, other)
    ]
    none, half = torch.zeros(1, 1, dtype=torch.float64), torch.full((1, 2), 0.5, dtype=torch.float64)
    given = RestShapes(torch.stack([x, other])[None], half, [alpha, beta, none])
    usable = torch.ones(1, dtype=torch.bool)
    found, status = LocalInterpolation(mesh, energy, region)([y[None] for y in starts], given, usable)
    assert status.tolist() == [Status.CONVERGED]

    def rest_of(y: Tensor) -> Rest:
        return energy.rest(energy.extend(y[None].movedim(-1, 0)))

    rests = [rest_of(y) for y in (x, other)]

    x_full, y_full = (hinge_fullness(energy.parts[1].edge_vectors(z.mT[:, None]), NEEDLE) for z in (x, other))

    def gradient(y: Tensor) -> Tensor:
        y = y.clone().requires_grad_()
        now, total = rest_of(y), torch.zeros((), dtype=torch.float64)
        for i, stiffness in enumerate((alpha, beta * x_full * y_full)):
            a, b = (rest.measures[i] for rest in rests)
            off = now.measures[i] - (a + energy.parts[i].term.difference(b, a) / 2)
            square = off**2 if i == 0 else 2 * (1 - off.cos()) + (1 - off.cos()) ** 2 / 3
            total = total + (stiffness * (rests[0].weights[i] + rests[1].weights[i]) / 2 * square).sum()
        return torch.autograd.grad(total, y)[0][free]

    for (end,), start in zip(found, starts, strict=True):
        assert torch.equal(end[~free], start[~free])
        # But for the ridge.
        assert largest(gradient(end)) < 1e-5 * largest(gradient(start))


def test_result_has_both_shapes(layer: MidShape, bars: Shapes) -> None:
    x_a, x_b = bars.keyframes[1:]
    without = MidShape(bars.bases[1:], bars.faces, preset="paper", regions=0)
    found, plain = (each.solve(torch.stack([x_a, x_b]), torch.stack([x_b, x_a])) for each in (layer, without))
    assert found.first is not None and found.second is not None
    torch.testing.assert_close(found.shapes, (found.first + found.second) / 2, rtol=0, atol=1e-12)
    region = inner(layer)
    for end in ("first", "second"):
        moved = (getattr(found, end) - getattr(plain, end)).norm(dim=-1)
        assert largest(moved[:, ~region]) < 1e-12 and moved[0, region].mean() > 1e-3


def test_nothing_takes_the_place_of_a_bad_shape(bars: Shapes) -> None:
    """A large mu distorts: the shape is worse than linear interpolation, and is returned."""
    options: dict[str, Any] = {"objective": Objective(space="paired", mu=1e6), "solver": Solver(local_steps=0)}
    layer, (x_a, x_b) = MidShape(bars.bases[:2], bars.faces, **options), bars.keyframes[:2]
    found, scale, shell = layer.solve(x_a, x_b), layer.in_between.core.alignment.scale, ShellEnergy(bars.faces)
    energy, linear = (sum(shell(scale * y, scale * x) for x in (x_a, x_b)) for y in (found.shapes, (x_a + x_b) / 2))
    assert energy > 1.5 * linear
    assert found.solution.status != Status.FELL_BACK


def test_bases_of_one_reference_have_no_regions(bars: Shapes) -> None:
    assert MidShape(bars.bases[0], bars.faces, preset="paper").in_between.core.local is None


def test_gradients_are_differentiated(layer: MidShape, bars: Shapes, generator: torch.Generator) -> None:
    x_a, x_b = bars.keyframes[1:]
    pull, way, further = (torch.randn(x_a.shape, dtype=torch.float64, generator=generator) for _ in range(3))

    def slope(x: Tensor, create_graph: bool = False) -> Tensor:
        x = x if x.requires_grad else x.clone().requires_grad_()
        return torch.autograd.grad((pull * layer(x, x_b)).sum(), x, create_graph=create_graph)[0]

    x = x_a.clone().requires_grad_()
    (second,) = torch.autograd.grad((slope(x, True) * way).sum(), x)
    ahead, behind = ((slope(x_a + step * further) * way).sum() for step in (1e-5, -1e-5))
    torch.testing.assert_close((second * further).sum(), (ahead - behind) / 2e-5, rtol=1e-5, atol=0)


def test_mu_and_regions_are_of_the_paired_space(bars: Shapes) -> None:
    given: Any = bars.bases[:2], bars.faces
    with pytest.raises(ValueError, match=r"mu weighs the similarity of the two shapes of Eq\. 4"):
        MidShape(*given, mu=2.0)
    with pytest.raises(ValueError, match=r"regions=3 are interpolated.*which only preset='paper' has"):
        MidShape(*given, regions=3)
    with pytest.raises(ValueError, match="regions is a whole number, 0 or more; got -1"):
        MidShape(*given, preset="paper", regions=-1)
    assert MidShape(*given, preset="paper", mu=2.0).in_between.objective.mu == 2.0


@pytest.mark.parametrize(
    ("ends", "truth"),
    [pytest.param((0, 2), 1, id="0-4"), pytest.param((0, 4), 2, id="0-8", marks=pytest.mark.slow)],
)
def test_local_interpolation_comes_closer_to_a_known_hand(ends: tuple[int, int], truth: int, hands: Shapes) -> None:
    """Measured with 30 modes: 0.16 and 0.30 of linear's edge error; in the regions, 0.30 and 0.33 of that without."""
    pair, wanted = hands.pick(*ends), hands.keyframes[truth]
    whole, plain = (MidShape(pair.bases, pair.faces, preset="paper", **more) for more in ({}, {"regions": 0}))
    result = whole.solve(*pair.keyframes)
    assert result.solution.converged and result.solution.n_steps <= 8
    core, half = whole.in_between.core, torch.full((1, 2), 0.5, dtype=torch.float64)
    placed, pose, _ = core.alignment(pair.keyframes[None], half)
    linear = core.alignment.to_caller(placed.mean(1), pose)[0]
    errors = [edge_error(x, wanted, pair.faces) for x in (result.shapes, linear)]
    assert errors[0] < 0.5 * errors[1]
    inside = pair.faces[inner(whole)[pair.faces].all(1)]
    errors = [edge_error(x, wanted, inside) for x in (result.shapes, plain(*pair.keyframes))]
    assert errors[0] < 0.6 * errors[1]
