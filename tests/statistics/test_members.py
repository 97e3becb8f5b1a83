"""New members of a shape space, and the transform that draws them."""

from collections.abc import Sequence

import pytest
import torch
from conftest import Shapes, seeded
from helpers.shapes import edge_error, edge_lengths
from test_coordinates import far

import torch_modal as tm
from torch_modal.elastic import backend
from torch_modal.elastic.backend import TorchBackend
from torch_modal.elastic.steps import FineEnergy
from torch_modal.elastic.term import Mesh, Term
from torch_modal.geometry.connectivity import Connectivity
from torch_modal.geometry.rigid import best_fit


def test_the_same_seed_has_the_same_members(space: tm.ShapeSpace) -> None:
    one, other = (space.sample(3, seeded()) for _ in range(2))
    assert torch.equal(one, other) and one.shape == (3, space.n_vertices, 3) and one.dtype == torch.float64
    assert float((space.sample(3, seeded(1)) - one).abs().max()) > 0.01
    assert len(space.sample(0)) == 0


def test_members_are_computed_by_the_backend_of_the_solver(bars: Shapes, monkeypatch: pytest.MonkeyPatch) -> None:
    made = []

    class Counted(TorchBackend):
        def fine_energy(self, mesh: Mesh, terms: Sequence[Term]) -> FineEnergy:
            made.append(len(terms))
            return super().fine_energy(mesh, terms)

    monkeypatch.setitem(backend.BACKENDS, "counted", Counted)
    space = tm.ShapeSpace(bars.bases, bars.faces, solver=tm.Solver(backend="counted"))
    made.clear()  # of the layers of the space
    assert len(space.sample(1, seeded())) == 1
    assert made == [3]


def test_edges_keep_the_lengths_of_the_keyframes(space: tm.ShapeSpace, bars: Shapes) -> None:
    members = space.sample(20, seeded())
    lengths, found = (edge_lengths(x, bars.faces) for x in (bars.keyframes, members))
    beyond = torch.relu(found - lengths.amax(0)) + torch.relu(lengths.amin(0) - found)
    assert float((beyond / lengths.mean(0)).mean()) < 0.01
    variation = space.variation()
    most = max(variation.folds(x) for x in bars.keyframes)
    assert max(variation.folds(x) for x in members) <= most


def test_members_stand_where_the_keyframes_stand(space: tm.ShapeSpace, bars: Shapes) -> None:
    """On average over draws; those on the mean shape are 2 % of the diagonal away."""
    x, areas = bars.keyframes, space.reconstruction().areas
    blend = tm.RandomBlend(p=1.0, space=space, generator=seeded())
    for members in (space.sample(60, seeded()), blend(x.repeat(20, 1, 1) + 5)):
        motion = best_fit(members.mean(0), x.mean(0), areas)
        shift = (motion.target - motion.source).norm() / (x[0].amax(0) - x[0].amin(0)).norm()
        cosine = 0.5 * (motion.rotation.trace() - 1)
        assert float(shift) < 3e-3 and float(torch.rad2deg(cosine.clamp(max=1).acos())) < 1


def test_members_on_the_mean_shape(space: tm.ShapeSpace) -> None:
    placed, others = space.sample(2, seeded()), space.sample(2, seeded(), on_keyframes=False)
    assert float((placed - others).abs().max()) > 1e-3
    assert max(far(one, other) for one, other in zip(placed, others, strict=True)) < 1e-9
    variation = space.variation()
    torch.testing.assert_close(others - variation.origin, variation.coordinates.align(others - variation.origin))


def test_folds_are_counted(space: tm.ShapeSpace, bars: Shapes) -> None:
    """A corner of a triangle that is laid on the opposite corner of its neighbour."""
    x, variation = bars.keyframes[0].clone(), space.variation()
    assert variation.folds(x) == 0
    first, second, own, other = Connectivity(bars.faces.numpy()).hinges[100]
    middle = 0.5 * (x[first] + x[second])
    x[own] = middle + 0.9 * (x[other] - middle)
    assert variation.folds(x) > 0


def test_a_draw_that_folds_is_made_less_local(space: tm.ShapeSpace, monkeypatch: pytest.MonkeyPatch) -> None:
    variation = space.variation()
    weights, factors, _ = (one[0] for one in variation.draw(1, 1.0, 3.0, (0, 0), seeded()))
    smoother = variation.member(weights, 0.25 * factors, 0.0)[0]
    counts = iter([1, 1, 0])
    monkeypatch.setattr(variation, "folds", lambda _: next(counts))
    assert torch.equal(variation.member(weights, factors, 0.0)[0], smoother)


def test_a_draw_that_always_folds_is_a_key_frame(space: tm.ShapeSpace, monkeypatch: pytest.MonkeyPatch) -> None:
    variation = space.variation()
    weights, factors, _ = (one[0] for one in variation.draw(1, 1.0, 3.0, (0, 0), seeded()))
    shapes = variation.shapes.unbind()
    monkeypatch.setattr(variation, "folds", lambda x: int(not any(torch.equal(x, shape) for shape in shapes)))
    x, own = variation.member(weights, factors, 0.0)
    assert torch.equal(x, shapes[int(weights.argmax())])
    assert torch.equal(own.argmax(0), weights.argmax().expand(own.shape[1])) and torch.equal(own.sum(0), own.amax(0))


def test_concentration_and_locality(space: tm.ShapeSpace) -> None:
    variation = space.variation()
    few, many = (variation.draw(50, c, 0.0, (0, 0), seeded())[0] for c in (0.1, 100.0))
    assert float(few.amax(1).mean()) > 0.85 and float(many.amax(1).mean()) < 0.45
    weights, factors, _ = (one[0] for one in variation.draw(1, 1.0, 0.0, (0, 0), seeded()))
    assert not bool(factors.any())
    local = variation.member(weights, factors, 0.0)[1]
    torch.testing.assert_close(local, weights[:, None].expand_as(local))


@pytest.mark.parametrize("options", [{"concentration": 0.0}, {"locality": -1.0}, {"concentration": float("nan")}])
def test_densities_that_do_not_exist(space: tm.ShapeSpace, options: dict[str, float]) -> None:
    with pytest.raises(ValueError, match="concentration is above 0"):
        space.sample(1, **options)
    with pytest.raises(ValueError, match="concentration is above 0"):
        tm.RandomBlend(**options)


def test_shapes_beyond_the_key_frames(space: tm.ShapeSpace, bars: Shapes) -> None:
    """Of little locality and one key-frame each: bent farther than the key-frames, and as large as they are."""
    options = {"concentration": 0.01, "locality": 0.0}
    within, beyond = (space.sample(20, seeded(), beyond=(b, b), **options) for b in (0.0, 0.3))
    mean = space.mean()
    far = [(tm.align(x, mean) - mean).norm(dim=-1).mean(-1) for x in (within.double(), beyond.double())]
    assert bool((far[1] > 1.1 * far[0]).all())
    assert edge_error(beyond[0].double(), bars.keyframes[0], bars.faces) < 0.05
    with pytest.raises(ValueError, match="beyond is a range"):
        space.sample(1, beyond=(0.5, 0.1))


def drawn(space: tm.ShapeSpace, n: int) -> dict[str, torch.Tensor]:
    """Parameters of the members of :meth:`tm.ShapeSpace.sample`."""
    weights, factors, beyond = space.variation().draw(n, 0.2, 3.0, (0, 0), seeded())
    chosen = torch.ones(n, dtype=torch.bool)
    return {"batch_prob": chosen, "weights": weights, "factors": factors, "beyond": beyond}


class TestRandomBlend:
    def test_draws_as_the_space_does(self, space: tm.ShapeSpace, bars: Shapes) -> None:
        found = tm.RandomBlend(p=1.0, space=space)(bars.keyframes + 10, params=drawn(space, 3))
        torch.testing.assert_close(found, space.sample(3, seeded()), rtol=0, atol=1e-9)

    def test_replaces_shapes_in_their_pose_if_asked(self, space: tm.ShapeSpace, bars: Shapes) -> None:
        transform = tm.RandomBlend(p=1.0, generator=seeded(), space=space, on_keyframes=False)
        given = bars.keyframes[[0, 1]].float() + 10
        found = transform(given)
        assert found.shape == given.shape and found.dtype == torch.float32
        torch.testing.assert_close(found.mean(1), given.mean(1), rtol=0, atol=0.2)
        assert torch.equal(transform(given, params=transform.params), found)
        assert min(far(found[0].double(), x) for x in bars.keyframes) > 1e-3

    def test_draws_from_a_table(self, space: tm.ShapeSpace, bars: Shapes) -> None:
        transform = tm.RandomBlend(p=1.0, members=3, generator=seeded(), space=space)
        found = transform(bars.keyframes[:1].expand(40, -1, -1))
        members = space.sample(3, torch.Generator().manual_seed(0))
        distances = torch.tensor([[far(x, y) for y in members.double()] for x in found])
        assert float(distances.amin(1).max()) < 1e-5
        assert sorted(set(distances.argmin(1).tolist())) == [0, 1, 2]
        with pytest.raises(ValueError, match="members must be 1 or more"):
            tm.RandomBlend(members=0)
