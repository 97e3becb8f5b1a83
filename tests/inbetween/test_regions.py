"""Local interpolation of the regions that the modes reach worst, and the preset "paper" as a whole."""

from typing import Any

import pytest
import torch
from conftest import Shapes
from shapes import edge_error, largest
from torch import Tensor

from torch_modal.energy.bend import NEEDLE, SquaredBend, fullness
from torch_modal.energy.energy import Energy, RestShapes
from torch_modal.energy.shell import ShellEnergy
from torch_modal.energy.stretch import Stretch
from torch_modal.energy.term import Mesh
from torch_modal.energy.volume import Volume
from torch_modal.inbetween.regions import LocalInterpolation, fitting_error, segments, worst_regions
from torch_modal.inbetween.settings import Objective, Solver
from torch_modal.layers.mid_shape import MidShape
from torch_modal.solve.minimise import Status


@pytest.fixture(scope="module")
def layer(bars: Shapes) -> MidShape:
    return MidShape(bars.bases[1:], bars.faces, preset="paper", regions=3)


def inner(layer: MidShape) -> Tensor:
    """Vertices of the regions. *Shape:* ``(V,)``, bool."""
    return layer.in_between.core.local.region  # type: ignore[union-attr, no-any-return]


def test_segments_are_connected_and_regions_are_the_worst_of_them(layer: MidShape) -> None:
    space, references = layer.space, layer.in_between.core.alignment.references
    coarse, segment = space.first.coarse, torch.from_numpy(segments(space, references, 6))
    assert segment.unique().tolist() == list(range(6))
    edges = coarse.mesh.edges
    within = edges[segment[edges[:, 0]] == segment[edges[:, 1]]]
    assert len(set(Mesh.of(torch.cat([within, within[:, :1]], 1), coarse.n_vertices).connectivity.vertex_pieces)) == 6
    error = torch.from_numpy(fitting_error(space, references))[coarse.clusters]
    regions = [worst_regions(space, references, n) for n in (0, 1, 3)]
    assert not regions[0].any() and bool((regions[2] | ~regions[1]).all()) and regions[1].sum() < regions[2].sum()
    assert error[regions[1]].mean() > error[regions[2]].mean() > 2 * error[~regions[2]].mean()
    faces = layer.in_between.core.mesh.faces
    grown = regions[2].index_fill(0, faces[regions[2][faces].any(1)].flatten(), True)
    assert torch.equal(inner(layer), grown) and grown.sum() > regions[2].sum()


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
    rests = [energy.rest_of(y[None]) for y in (x, other)]

    x_full, y_full = (fullness(energy.parts[1].edge_vectors(z.mT[:, None]), NEEDLE) for z in (x, other))

    def gradient(y: Tensor) -> Tensor:
        y = y.clone().requires_grad_()
        now, total = energy.rest_of(y[None]), torch.zeros((), dtype=torch.float64)
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


def test_result_has_both_shapes_and_energies(layer: MidShape, bars: Shapes) -> None:
    x_a, x_b = bars.keyframes[1:]
    without = MidShape(bars.bases[1:], bars.faces, preset="paper", regions=0)
    found, plain = (each.solve(torch.stack([x_a, x_b]), torch.stack([x_b, x_a])) for each in (layer, without))
    assert found.first is not None and found.second is not None and found.shell_energy is not None
    assert found.first.shape == found.shapes.shape and found.shell_energy.shape == (2,)
    torch.testing.assert_close(found.shapes, (found.first + found.second) / 2, rtol=0, atol=1e-12)
    region = inner(layer)
    for end in ("first", "second"):
        moved = (getattr(found, end) - getattr(plain, end)).norm(dim=-1)
        assert largest(moved[:, ~region]) < 1e-12 and moved[0, region].mean() > 1e-3
    scale, shell = layer.in_between.core.alignment.scale, ShellEnergy(bars.faces)
    by_hand = [sum(shell(scale * found.shapes[0], scale * x) for x in (x_a, x_b)) / 2]
    torch.testing.assert_close(found.shell_energy[:1], torch.stack(by_hand))
    assert found.shell_energy[0] < found.linear_energy[0]  # type: ignore[index]


def test_nothing_takes_the_place_of_a_bad_shape(bars: Shapes) -> None:
    """A large mu distorts: the shape is worse than linear interpolation, and is returned."""
    options: dict[str, Any] = {"objective": Objective(space="paired", mu=1e6), "solver": Solver(local_steps=0)}
    found = MidShape(bars.bases[:2], bars.faces, **options).solve(*bars.keyframes[:2])
    assert found.shell_energy > 1.5 * found.linear_energy  # type: ignore[operator]
    assert found.solution.status != Status.FELL_BACK


def test_bases_of_one_reference_have_no_regions(bars: Shapes) -> None:
    assert MidShape(bars.bases[0], bars.faces, preset="paper").in_between.core.local is None


def test_gradients_pass_through_the_regions(layer: MidShape, bars: Shapes, generator: torch.Generator) -> None:
    x_a, x_b = bars.keyframes[1:]
    pull, way = (torch.randn(x_a.shape, dtype=torch.float64, generator=generator) for _ in range(2))
    x = x_a.clone().requires_grad_()
    (slope,) = torch.autograd.grad((pull * layer(x, x_b))[inner(layer)].sum(), x)
    ahead, behind = ((pull * layer(x_a + step * way, x_b))[inner(layer)].sum() for step in (1e-5, -1e-5))
    torch.testing.assert_close((slope * way).sum(), (ahead - behind) / 2e-5, rtol=1e-5, atol=0)


def test_hand_is_one_function_with_its_gradient(hands: Shapes, generator: torch.Generator) -> None:
    """Truncated steps amplify rounding by 1e11, and have another gradient: regions are minimised to convergence."""
    pair = hands.pick(0, 2)
    layer = MidShape(pair.bases, pair.faces, preset="paper")
    (x_a, x_b), size = pair.keyframes, (pair.keyframes[0].amax(0) - pair.keyframes[0].amin(0)).norm()
    pull, way = (torch.randn(x_a.shape, dtype=torch.float64, generator=generator) for _ in range(2))
    way = size * (way - way.mean(0))
    x = x_a.clone().requires_grad_()
    shape = layer(x, x_b)
    (slope,) = torch.autograd.grad((pull * shape).sum(), x)
    moved = layer(torch.stack([x_a + step * way for step in (1e-7, -1e-7, 1e-12)]), x_b)
    torch.testing.assert_close((slope * way).sum(), ((moved[0] - moved[1]) * pull).sum() / 2e-7, rtol=1e-5, atol=0)
    assert largest(moved[2] - shape.detach()) < 1e-9 * size
    assert largest(layer(torch.stack([x_b, x_a]), torch.stack([x_a, x_b]))[1] - shape.detach()) < 1e-10 * size


def test_mu_and_regions_are_of_the_paired_space(bars: Shapes) -> None:
    given: Any = bars.bases[:2], bars.faces
    with pytest.raises(ValueError, match=r"mu weighs the similarity of the two shapes of Eq\. 4"):
        MidShape(*given, mu=2.0)
    with pytest.raises(ValueError, match=r"regions=3 are interpolated.*preset='paper' has two"):
        MidShape(*given, regions=3)
    with pytest.raises(ValueError, match="regions is a whole number, 0 or more; got -1"):
        MidShape(*given, preset="paper", regions=-1)
    assert MidShape(*given, preset="paper", mu=2.0).in_between.objective.mu == 2.0


@pytest.mark.parametrize(("ends", "truth"), [((0, 2), 1), ((0, 4), 2)], ids=["0-4", "0-8"])
def test_hand(ends: tuple[int, int], truth: int, hands: Shapes) -> None:
    """Measured with 30 modes: 0.16 and 0.38 of linear's edge error; in the regions, 0.30 and 0.48 of that without."""
    pair, wanted = hands.pick(*ends), hands.keyframes[truth]
    whole, plain = (MidShape(pair.bases, pair.faces, preset="paper", **more) for more in ({}, {"regions": 0}))
    result = whole.solve(*pair.keyframes)
    assert result.solution.converged and result.solution.n_steps <= 8
    core, half = whole.in_between.core, torch.full((1, 2), 0.5, dtype=torch.float64)
    placed, pose, _ = core.alignment(pair.keyframes[None], half)
    linear = core.alignment.restore(placed.mean(1), pose)[0]
    errors = [edge_error(x, wanted, pair.faces) for x in (result.shapes, linear)]
    assert errors[0] < 0.5 * errors[1]
    inside = pair.faces[inner(whole)[pair.faces].all(1)]
    errors = [edge_error(x, wanted, inside) for x in (result.shapes, plain(*pair.keyframes))]
    assert errors[0] < 0.6 * errors[1]
