"""Key-frames that are a motion: who follows whom, and what random in-betweens of them are."""

from pathlib import Path
from typing import Any

import pytest
import torch
from conftest import Shapes

import torch_modal as tm
from torch_modal.data.shape_batch import ShapeBatch

F64 = torch.float64
TIMES = (0.0, 0.5, 2.0, 3.0, 4.5)


@pytest.fixture(scope="module")
def bar_motion(bars: Shapes) -> Shapes:
    """Five poses of a bar: straight, bent, twisted, bent, straight."""
    return bars.pick(0, 1, 2, 1, 0)


def space_of(shapes: Shapes, **options: Any) -> tm.ShapeSpace:
    return tm.ShapeSpace(shapes.bases, shapes.faces, **{"dtype": F64, "keyframe_times": TIMES, **options})


def between(space: tm.ShapeSpace, i: int, j: int, t: torch.Tensor) -> torch.Tensor:
    """Shapes between two key-frames. *Shape:* ``(B,) -> (B, V, 3)``."""
    x = space.keyframes()
    ends = (x[k].expand(len(t), -1, -1) for k in (i, j))
    return space.in_betweens(*ends, t, *(torch.full((len(t),), k) for k in (i, j)))


def largest(x: torch.Tensor) -> float:
    return float(x.abs().max())


# ------------------------------------------------------------------------------------------------------------ times
@pytest.mark.parametrize(
    ("places", "cyclic", "wanted"),
    [
        ((0, 1, 2, 0), False, [[1, 1], [0, 2], [1, 3], [2, 2]]),
        ((0, 1, 2, 0), True, [[3, 1], [0, 2], [1, 3], [2, 0]]),
        ((0, 1), False, [[1, 1], [0, 0]]),
    ],
)
def test_neighbours_in_time(bars: Shapes, places: tuple[int, ...], cyclic: bool, wanted: list[list[int]]) -> None:
    n = len(places)
    space = space_of(bars.pick(*places), keyframe_times=range(n + cyclic), cyclic=cyclic)
    pool, draw = ShapeBatch.of_keyframes(space), torch.tensor([0.2, 0.8]).repeat(n)
    partners = pool.partners(torch.arange(n).repeat_interleave(2), draw, space, pool)
    assert partners is not None and partners.nearest is not None
    assert partners.nearest.view(n, 2).tolist() == wanted


# ----------------------------------------------------------------------------------------------------------- shapes
@pytest.mark.parametrize("cyclic", [False, True])
def test_neighbours_are_joined_by_the_path_and_others_by_the_pair(bar_motion: Shapes, cyclic: bool) -> None:
    when = (*TIMES, 6.0) if cyclic else TIMES
    shapes = bar_motion if not cyclic else bar_motion.pick(0, 1, 2, 1, 2)  # the last is not the first
    space = space_of(shapes, keyframe_times=when, cyclic=cyclic)
    pairs = space_of(shapes, keyframe_times=None)
    path = tm.Path(shapes.bases, shapes.faces, when, cyclic, preset="fast")
    u = torch.tensor([0.0, 0.2, 0.5, 0.9, 1.0], dtype=F64)
    for i in range(len(when) - 1):
        j = (i + 1) % 5
        with torch.no_grad():
            expected = path(shapes.keyframes, torch.lerp(*torch.tensor(when[i : i + 2], dtype=F64), u))
        found = between(space, i, j, u)
        assert largest(found - expected) < 1e-12
        assert largest(between(pairs, i, j, u) - expected) > 2e-2
        assert torch.equal(found[[0, -1]], shapes.keyframes[[i, j]])
        torch.testing.assert_close(between(space, j, i, 1 - u), found, rtol=0, atol=1e-6)
    assert torch.equal(between(space, 0, 2, u), between(pairs, 0, 2, u))
    x = shapes.keyframes[:2] + 0.01 * torch.sin(shapes.keyframes[:2])
    given = x[:1], x[1:], u[2:3], *torch.tensor([[0], [1]])
    assert torch.equal(space.in_betweens(*given), pairs.in_betweens(*given))


# ------------------------------------------------------------------------------------------------------ transforms
def test_partners_of_key_frames_are_their_neighbours(bar_motion: Shapes) -> None:
    space = space_of(bar_motion)
    pool = ShapeBatch.of_keyframes(space, bar_motion.keyframes, shape_labels=torch.arange(5))
    augment = tm.RandomInBetween(t=(0.6, 0.9), p=1.0, space=space)
    start = torch.arange(5).repeat(40)
    params = augment.forward_parameters(200, generator=torch.Generator().manual_seed(0))
    out = augment.transform(pool.rows(start), params, None, pool)
    partner = out.shape_labels  # these are nearer to it
    assert partner is not None
    assert bool(((partner - start).abs() == 1).all())
    inner = (start > 0) & (start < 4)
    assert 0.35 < float((partner > start)[inner].double().mean()) < 0.65
    for row in range(10):
        i, j = int(start[row]), int(partner[row])
        expected = between(space, i, j, params["t"][row : row + 1])[0]
        torch.testing.assert_close(out.shapes[row], expected, rtol=0, atol=1e-12)


def test_other_shapes_are_solved_with_their_partner_alone(bar_motion: Shapes) -> None:
    space, pairs = space_of(bar_motion), space_of(bar_motion, keyframe_times=None)
    x = bar_motion.keyframes[1:3] + 0.02 * torch.sin(bar_motion.keyframes[1:3])
    params = {name: torch.tensor([value] * 2) for name, value in (("batch_prob", True), ("partner", 0.7), ("t", 0.4))}
    augment = tm.RandomInBetween(p=1.0)
    # Of a batch: as without times.
    assert torch.equal(augment(x, params=params, space=space), augment(x, params=params, space=pairs))
    # Of the key-frames: the one after the nearest.
    pool = ShapeBatch.of_keyframes(space, x)
    found = augment(x, params=params, space=space, pool=pool)
    nearest = space.nearest(x)
    for row, i in enumerate(nearest.tolist()):
        ends = x[row : row + 1], bar_motion.keyframes[i + 1 : i + 2]
        expected = pairs.in_betweens(*ends, params["t"][:1], *torch.tensor([[i], [i + 1]]))
        torch.testing.assert_close(found[row : row + 1], expected, rtol=0, atol=1e-6)


def test_a_dataset_draws_from_the_path_of_a_stored_motion(bar_motion: Shapes, tmp_path: Path) -> None:
    tm.write_set(tmp_path / "set", *bar_motion, [*"01234"], times=TIMES)
    half = tm.RandomInBetween(t=(0.5, 0.5), p=1.0)
    path = tm.Path(bar_motion.bases, bar_motion.faces, TIMES, preset="fast")
    with torch.no_grad():
        middles = path(bar_motion.keyframes, torch.tensor(TIMES, dtype=F64).unfold(0, 2, 1).mean(1))

    def distances(**options: Any) -> torch.Tensor:
        data = tm.ShapeDataset(tmp_path, half, samples_per_set=20, dtype=F64, **options)
        samples = torch.stack([data[i]["vertices"] for i in range(20)])
        return (samples[:, None] - middles).flatten(2).abs().amax(2)

    found = distances()
    assert largest(found.amin(1)) < 1e-12
    assert set(found.argmin(1).tolist()) == {0, 1, 2, 3}
    assert float(distances(keyframe_times=None).amin(1).min()) > 1e-2
