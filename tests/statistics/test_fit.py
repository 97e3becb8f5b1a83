"""Shapes that meet observed points: distance, gradients, outliers, errors."""

from typing import Any

import pytest
import torch
from conftest import Shapes
from helpers.shapes import coarsened
from test_coordinates import far, with_second_piece
from torch import Tensor

import torch_modal as tm
from torch_modal.data.samples import load_sample
from torch_modal.geometry.rotations import exp
from torch_modal.statistics.fit import fit
from torch_modal.statistics.local_weights import LocalWeights, Observations
from torch_modal.statistics.variation import LARGEST_EXTRAPOLATION, LocalMixtures, Variation, bound_weights

DOUBLE = torch.float64


def markers(x: Tensor, n: int = 20) -> Tensor:
    """Vertices that are far from each other."""
    found, distances = [0], (x - x[0]).norm(dim=-1)
    while len(found) < n:
        found.append(int(distances.argmax()))
        distances = torch.minimum(distances, (x - x[found[-1]]).norm(dim=-1))
    return torch.tensor(found)


def mean_distance(x: Tensor, y: Tensor) -> float:
    return float((x - y).norm(dim=-1).mean())


@pytest.fixture(scope="module")
def creature() -> tuple[tm.ShapeSpace, Tensor]:
    """All poses but one, and that one, of 1,200 vertices."""
    x, faces, *_ = load_sample("creature")
    x, faces = coarsened(x, faces, 2400)
    bases = tm.extract_bases(x, faces, 8, progress=False)
    return tm.ShapeSpace([basis for k, basis in enumerate(bases) if k != 2], faces), x[2]


def test_a_pose_that_is_not_among_the_keyframes(creature: tuple[tm.ShapeSpace, Tensor]) -> None:
    space, truth = creature
    picked = markers(truth)
    turn = exp(torch.tensor([0.2, 2.0, -0.4], dtype=DOUBLE))
    moved = truth @ turn.mT + 5
    found = space.fit(moved[picked], picked)
    shapes = space.keyframes(truth)
    nearest = min(mean_distance(x, moved) for x in tm.align(shapes, moved.expand_as(shapes)))
    assert mean_distance(found.shape, moved) < 0.5 * mean_distance(_linear(shapes, moved, picked), moved)
    assert mean_distance(found.shape, moved) < 0.35 * nearest
    assert float(found.misses.max()) < 0.01 * float((truth.amax(0) - truth.amin(0)).norm())
    torch.testing.assert_close(found.weights.sum(0), torch.ones(len(truth), dtype=DOUBLE))


def test_inference_mode_and_arrays(space: tm.ShapeSpace, bars: Shapes) -> None:
    points, picked = bars.keyframes[0][::9] + 0.02, torch.arange(0, 164, 9)
    near = torch.tensor([0.4, 0.3, 0.3], dtype=DOUBLE)
    wanted = space.fit(points, picked, near=near)
    with torch.inference_mode():
        found = space.fit(points + 0, picked + 0, near=near + 0)
        torch.testing.assert_close(found.shape, wanted.shape)
    assert torch.equal(space.fit(points.numpy(), picked.numpy(), near=near.numpy()).shape, wanted.shape)


def _linear(shapes: Tensor, moved: Tensor, picked: Tensor) -> Tensor:
    """The nearest shape of the linear span, seen at the picked vertices."""
    aligned = tm.align(shapes, moved.expand_as(shapes))
    off = (aligned[1:] - aligned[0])[:, picked].flatten(1)
    ridge = 1e-4 * float(off.square().sum(1).mean()) * torch.eye(len(off), dtype=DOUBLE)
    right = off @ (moved[picked] - aligned[0, picked]).flatten()
    weights = torch.linalg.solve(off @ off.mT + ridge, right)
    return aligned[0] + torch.einsum("k,kvc->vc", weights, aligned[1:] - aligned[0])


def test_a_rigid_motion_of_the_points_moves_the_shape(space: tm.ShapeSpace, bars: Shapes) -> None:
    truth = tm.Blend(bars.bases, bars.faces)(bars.keyframes, torch.tensor([0.3, 0.4, 0.3], dtype=DOUBLE))
    picked = markers(truth, 12)
    turn = exp(torch.tensor([1.0, -2.0, 0.5], dtype=DOUBLE))
    one, other = space.fit(truth[picked], picked), space.fit(truth[picked] @ turn.mT - 7, picked)
    torch.testing.assert_close(one.shape @ turn.mT - 7, other.shape, rtol=0, atol=1e-6)
    batch = space.fit(torch.stack([truth[picked], truth[picked] @ turn.mT - 7]).float(), picked)
    assert batch.shape.shape == (2, space.n_vertices, 3) and batch.shape.dtype == torch.float32
    torch.testing.assert_close(batch.shape[0].double(), one.shape, rtol=0, atol=1e-4)


@pytest.mark.parametrize("weighted", [pytest.param(False, marks=pytest.mark.slow), True])
def test_gradients_are_those_of_weights_and_pose(
    space: tm.ShapeSpace, bars: Shapes, generator: torch.Generator, weighted: bool
) -> None:
    variation, n, noise = space.variation(), 14, 0.02 * space.variation().size if weighted else 0.0
    picked = markers(bars.keyframes[1], n)
    points = 0.5 * (bars.keyframes[1] + bars.keyframes[2])[picked]
    weights = torch.ones(n, dtype=DOUBLE)
    if weighted:
        weights = torch.rand(n, generator=generator, dtype=DOUBLE) + 0.5
        weights[[2, 9]], points[2] = 0, torch.nan
    seen = weights > 0
    about = torch.full((3,), 1 / 3, dtype=DOUBLE)
    taken = torch.randn(space.n_vertices, 3, generator=generator, dtype=DOUBLE)
    move = torch.randn(points.shape, generator=generator, dtype=DOUBLE)

    def assembled(points: Tensor) -> Tensor:
        to = Observations.at_vertices(points[seen], picked[seen], weights[seen])
        given = LocalWeights(variation, to, about, noise)
        x = given.shape(given.solve(False)[0])
        return (to.pose(x).apply(x) * taken).sum()

    ends = [assembled(points + s * 1e-5 * move) for s in (1, -1)]
    expected = float(ends[0] - ends[1]) / 2e-5
    leaf = points.clone().requires_grad_()
    found = space.fit(leaf, picked, weights=weights, noise=noise)
    assert torch.equal(found.shape.detach(), space.fit(points, picked, weights=weights, noise=noise).shape)
    # The elastic steps are carried along by the pose; without them the gradient is exact.
    assembled(leaf).backward()
    assert leaf.grad is not None
    assert float((leaf.grad * move).sum()) == pytest.approx(expected, rel=1e-5)
    leaf.grad = None
    ((found.shape * taken).sum() + found.misses.nansum()).backward()
    assert torch.equal((leaf.grad == 0).all(-1), ~seen)  # not even of a point that is NaN
    leaf.grad = None
    (space.fit(leaf, picked, weights=weights, noise=noise).shape * taken).sum().backward()
    assert float((leaf.grad * move).sum()) == pytest.approx(expected, rel=0.2)


def test_points_of_no_weight_are_never_read(space: tm.ShapeSpace, bars: Shapes) -> None:
    picked = markers(bars.keyframes[1], 16)
    points = (0.5 * (bars.keyframes[1] + bars.keyframes[2]))[picked]
    seen = torch.ones(2, 16, dtype=torch.bool)
    seen[0, 3], seen[1, [0, 8]] = False, False
    both = points.repeat(2, 1, 1)
    both[0, 3], both[1, 0] = torch.nan, torch.inf
    found = space.fit(both, picked, weights=seen)
    for i, own in enumerate(seen):
        wanted = space.fit(points[own], picked[own])
        assert all(torch.equal(one[i], other) for one, other in zip(found[:2], wanted[:2], strict=True))
        assert torch.equal(found.misses[i, own], wanted.misses) and torch.equal(found.trust[i], own.double())
    assert bool(found.misses[0, 3].isnan()) and bool(found.misses[1, 0].isinf())
    torch.testing.assert_close(found.misses[1, 8], (found.shape[1, picked[8]] - points[8]).norm())
    with torch.inference_mode():  # one set of points with two sets of weights
        again = space.fit(points + 0, picked, weights=seen.double() + 0)
    torch.testing.assert_close(again.shape, found.shape)
    assert torch.equal(space.fit(points[None], picked, weights=seen[0].numpy()).shape, found.shape[:1])


def test_a_weight_of_two_counts_as_two_points(space: tm.ShapeSpace, bars: Shapes) -> None:
    variation = space.variation()
    picked = markers(bars.keyframes[1], 10)
    points = (0.5 * (bars.keyframes[1] + bars.keyframes[2]))[picked] - variation.origin
    weights, about = torch.ones(10, dtype=DOUBLE), torch.full((3,), 1 / 3, dtype=DOUBLE)
    weights[4] = 2
    twice = torch.cat([torch.arange(10), torch.tensor([4])])
    one = LocalWeights(variation, Observations.at_vertices(points, picked, weights), about).solve(False)[0]
    doubled = Observations.at_vertices(points[twice], picked[twice], torch.ones(11, dtype=DOUBLE))
    torch.testing.assert_close(one, LocalWeights(variation, doubled, about).solve(False)[0], rtol=0, atol=1e-6)


def test_points_of_little_weight_are_not_taken_for_outliers(space: tm.ShapeSpace, bars: Shapes) -> None:
    picked = markers(bars.keyframes[1], 16)
    points, weights = bars.keyframes[1][picked].clone(), torch.ones(16, dtype=DOUBLE)
    points[5, 1] += 0.05 * space.variation().size
    weights[5] = 0.01  # so that its standard deviation is a tenth of the size
    found = space.fit(points, picked, weights=weights, robust=True)
    assert 0.003 < float(found.trust[5]) < 0.01
    assert float(space.fit(points, picked, robust=True).trust[5]) < 0.2


def test_noise_that_is_known(space: tm.ShapeSpace, bars: Shapes, generator: torch.Generator) -> None:
    truth = tm.Blend(bars.bases, bars.faces)(bars.keyframes, torch.tensor([0.3, 0.4, 0.3], dtype=DOUBLE))
    picked, noise = markers(truth), 0.03 * float((truth.amax(0) - truth.amin(0)).norm())
    points = truth[picked] + noise * torch.randn(20, 3, generator=generator, dtype=DOUBLE)
    plain, exact, known = (space.fit(points, picked, noise=own) for own in (None, 0, noise))
    assert torch.equal(plain.shape, exact.shape)
    assert mean_distance(known.shape, truth) < 0.85 * mean_distance(plain.shape, truth)


def test_outliers_are_ignored_if_asked(creature: tuple[tm.ShapeSpace, Tensor]) -> None:
    space, truth = creature
    picked = markers(truth, 30)
    points = truth[picked].clone()
    size = float((truth.amax(0) - truth.amin(0)).norm())
    points[[3, 17]] += torch.tensor([0.0, 0.4 * size, 0.0], dtype=DOUBLE)
    plain, robust = (space.fit(points, picked, robust=robust) for robust in (False, True))
    assert mean_distance(robust.shape, truth) < 0.3 * mean_distance(plain.shape, truth)
    assert float(robust.trust[[3, 17]].max()) < 0.05 and float(robust.trust.median()) > 0.5


def test_second_pieces_are_met(bars: Shapes) -> None:
    shapes, faces = with_second_piece(bars.keyframes, bars.faces)
    variation, n = Variation(shapes, faces), bars.keyframes.shape[1]
    picked = torch.cat([markers(bars.keyframes[0], 20), torch.arange(n, n + 4)])
    found = fit(variation, shapes[2, picked] - variation.origin, picked)
    off = (found.shape - shapes[2] + variation.origin)[: n + 4].norm(dim=-1) / variation.size
    assert float(off.max()) < 0.01


def test_far_from_the_origin(bars: Shapes) -> None:
    bases = [tm.ModalBasis(b.reference + 1e6, b.eigenvalues, b.modes, b.rigid_eigenvalues) for b in bars.bases]
    space, near = (tm.ShapeSpace(some, bars.faces, dtype=DOUBLE) for some in (bases, bars.bases))
    picked = markers(bars.keyframes[1])
    points = bars.keyframes[1][picked]
    torch.testing.assert_close(space.fit(points, picked).shape, near.fit(points, picked).shape, rtol=0, atol=1e-4)
    one, other = (each.sample(2, torch.Generator().manual_seed(0)) for each in (space, near))
    torch.testing.assert_close(one - 1e6, other, rtol=0, atol=1e-4)


def test_second_derivatives_are_refused(space: tm.ShapeSpace, bars: Shapes) -> None:
    picked = markers(bars.keyframes[1], 12)
    leaf = (0.5 * (bars.keyframes[1] + bars.keyframes[2])[picked]).requires_grad_()
    with pytest.raises(RuntimeError, match="first derivatives only"):
        (slope,) = torch.autograd.grad(space.fit(leaf, picked).shape.square().sum(), leaf, create_graph=True)
        slope.sum().backward()


def test_a_keyframe_comes_back(space: tm.ShapeSpace, bars: Shapes) -> None:
    picked = markers(bars.keyframes[1])
    for near in (None, torch.tensor([0.0, 1.0, 0.0])):
        assert far(space.fit(bars.keyframes[1][picked], picked, near=near).shape, bars.keyframes[1]) < 0.01


@pytest.mark.parametrize("near", [0, 2, -2])
def test_what_points_leave_open_is_as_in_the_likely_key_frame(space: tm.ShapeSpace, bars: Shapes, near: int) -> None:
    """Three corners of one triangle say where the shape is and nothing of its pose."""
    picked = bars.faces[0]
    found = space.fit(bars.keyframes[near][picked], picked, near=near)
    assert far(found.shape, bars.keyframes[near]) < 0.02


def test_weights_far_below_zero_come_nearer_to_even_ones() -> None:
    weights = torch.tensor([[5.0, 1.5, 0.2], [-3.0, -0.5, 0.3], [-1.0, 0.0, 0.5]], dtype=DOUBLE)
    found = bound_weights(weights)
    torch.testing.assert_close(found.sum(0), torch.ones(3, dtype=DOUBLE))
    assert float(found[:, 0].clamp_max(0).sum()) >= -LARGEST_EXTRAPOLATION
    torch.testing.assert_close(found[:, 1:], weights[:, 1:])  # within the bound


@pytest.mark.parametrize("factor", [3, 1.01])
def test_what_no_mixture_meets_falls_back_to_a_keyframe(
    space: tm.ShapeSpace, bars: Shapes, monkeypatch: pytest.MonkeyPatch, factor: float
) -> None:
    variation = space.variation()
    monkeypatch.setattr(variation, "relax", lambda x, *_: factor * x)
    picked = markers(bars.keyframes[1])
    found = space.fit(bars.keyframes[1][picked], picked)
    assert far(found.shape, bars.keyframes[1]) < 1e-9
    assert torch.equal(found.weights[1], torch.ones(space.n_vertices, dtype=DOUBLE))


@pytest.mark.parametrize(
    "points, vertices, near, words",
    [
        (torch.zeros(2, 3), torch.tensor([0, 1]), None, "three vertices or more"),
        (torch.full((3, 3), torch.nan), torch.tensor([0, 1, 2]), None, "a weight of zero"),
        (torch.zeros(3, 3), torch.tensor([0, 1]), None, "an index from 0 to 163 for each of 3 points"),
        (torch.zeros(3, 3), torch.tensor([0, 1, 10**6]), None, "an index from 0 to 163"),
        (torch.zeros(3, 3), torch.tensor([0, 1, 1]), None, "three vertices"),
        (torch.zeros(3, 3), torch.tensor([0, 1, 2]), 3, "one of 3 key-frames"),
        (torch.zeros(3, 3), torch.tensor([0, 1, 2]), torch.tensor([0.5, 0.5, 0.5]), "add up to one"),
    ],
)
def test_arguments_that_do_not_fit(
    space: tm.ShapeSpace, points: Tensor, vertices: Tensor, near: object, words: str
) -> None:
    with pytest.raises(ValueError, match=words):
        space.fit(points, vertices, near=near)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    "given, words",
    [
        ({"weights": torch.ones(4)}, r"weights must be .* \(\.\.\., 5\); got \(4,\)"),
        ({"weights": torch.ones(3, 5)}, r"do not broadcast: points \(2,\), weights \(3,\)"),
        ({"weights": torch.tensor([1.0, 1.0, 1.0, 1.0, -1.0])}, "none below zero; got -1.0 to 1.0"),
        ({"weights": torch.tensor([1.0, 1.0, 1.0, 1.0, torch.nan])}, "finite"),
        ({"weights": [[1, 1, 1, 1, 1], [1, 1, 0, 0, 0]]}, "a set has 2"),
        ({"weights": [0, 0, 0, 1, 0]}, "a set has 1"),
        ({"noise": -1.0}, "noise is a standard deviation"),
        ({"noise": torch.nan}, "noise is a standard deviation"),
    ],
)
def test_weights_and_noise_that_do_not_fit(space: tm.ShapeSpace, given: dict[str, Any], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        space.fit(torch.zeros(2, 5, 3), torch.arange(5), **given)


def test_a_mesh_of_few_vertices_is_fitted(small_bars: Shapes) -> None:
    """With as many patches as vertices, each patch would be a single vertex, whose moments are zero."""
    x = small_bars.keyframes[1]
    found = tm.ShapeSpace(small_bars.bases, small_bars.faces, dtype=DOUBLE).fit(x[::3], torch.arange(len(x))[::3])
    assert far(found.shape, x) < 0.02


@pytest.mark.parametrize("scale", [1e3, 1e-3])
def test_points_in_other_units(space: tm.ShapeSpace, bars: Shapes, scale: float) -> None:
    picked = markers(bars.keyframes[1], 12)
    with pytest.raises(ValueError, match="in other units"):
        space.fit(scale * bars.keyframes[1][picked], picked)


def test_equal_shapes_share_a_patch(space: tm.ShapeSpace) -> None:
    variation = space.variation()
    twice = variation.shapes[[0, 0]]
    weights = LocalMixtures(variation.coordinates, twice).weights(twice[0])
    torch.testing.assert_close(weights, torch.full_like(weights, 0.5))
