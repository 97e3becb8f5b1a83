"""Motion through many key-frames: its laws, its gradients, and how close it comes to known motions."""

import dataclasses
import math
from typing import Any

import numpy as np
import pytest
import torch
from conftest import Shapes
from helpers.shapes import diagonal, edge_error, largest
from helpers.sheets import cylinder, rectangle, rolled
from helpers.terms import Area
from scipy.interpolate import CubicSpline
from torch import Tensor, nn

import torch_modal as tm
from torch_modal.data.samples import load_sample
from torch_modal.geometry.rotations import exp
from torch_modal.motion import subdivide as sequence
from torch_modal.motion.cubics import Cubics, Squared, cubics
from torch_modal.motion.path import Path
from torch_modal.motion.subdivide import keyframe_places
from torch_modal.times import fill_linear

DOUBLE = torch.float64


def quarter_turns(k: float) -> Tensor:
    return exp(torch.tensor([0.0, 0.0, k * math.pi / 2], dtype=DOUBLE))


def times(*values: float) -> Tensor:
    return torch.tensor(values, dtype=DOUBLE)


@pytest.fixture(scope="module")
def motion(bars: Shapes) -> Shapes:
    """Five poses of a bar: straight, bent, twisted, bent, straight."""
    return bars.pick(0, 1, 2, 1, 0)


@pytest.fixture(scope="module")
def path(motion: Shapes) -> Path:
    return Path(motion.bases, motion.faces)


# --------------------------------------------------------------------------------------------------- cubic motion


@pytest.mark.parametrize("cyclic", [False, True])
def test_where_nothing_is_limited_it_is_the_spline_of_scipy(cyclic: bool, generator: torch.Generator) -> None:
    knots, u = times(0.0, 0.7, 1.9, 2.4, 3.6, 4.1), torch.linspace(0, 1, 9, dtype=DOUBLE)
    x = knots[:, None] + 0.1 * torch.randn(6, 50, dtype=DOUBLE, generator=generator)
    if cyclic:  # round a large circle
        angle = 2 * math.pi * knots / knots[-1]
        x = torch.stack([angle.cos(), angle.sin()], 1)
        x[-1] = x[0]
    found = cubics(x.diff(dim=0), knots.diff(), cyclic, lambda v: v.square().sum(-1, keepdim=True))
    truth = CubicSpline(knots.numpy(), x.numpy(), bc_type="periodic" if cyclic else "natural")
    for i in range(5):
        wanted = torch.from_numpy(truth(torch.lerp(knots[i], knots[i + 1], u).numpy()))
        way = Cubics(*(values[:, None] for values in found)).along(i, torch.zeros(9, dtype=torch.int64), u)
        torch.testing.assert_close(x[i] + way, wanted, rtol=0, atol=1e-12)


# ------------------------------------------------------------------------------------------------------------- laws


def test_keyframes_bit_for_bit(path: Path, motion: Shapes) -> None:
    for dtype in (DOUBLE, torch.float32):
        keyframes = motion.keyframes.to(dtype)
        assert torch.equal(path(keyframes, path.times), keyframes)


@pytest.mark.parametrize(
    ("lead", "t_shape", "expected"),
    [((), (), ()), ((), (3,), (3,)), ((2,), (2,), (2,)), ((2, 1), (3,), (2, 3)), ((2,), (), (2,)), ((0,), (), (0,))],
)
def test_leading_dimensions_broadcast(
    path: Path, motion: Shapes, lead: tuple[int, ...], t_shape: tuple[int, ...], expected: tuple[int, ...]
) -> None:
    keyframes = motion.keyframes.expand(*lead, -1, -1, -1)
    found = path(keyframes, torch.full(t_shape, 1.4, dtype=DOUBLE))
    assert found.shape == (*expected, *motion.keyframes.shape[1:])
    if found.numel():
        torch.testing.assert_close(found, path(motion.keyframes, 1.4).expand_as(found), rtol=0, atol=1e-9)


def test_pairs_alone_are_the_layers(motion: Shapes) -> None:
    path = Path(motion.bases, motion.faces, smooth=False)
    found = path(motion.keyframes, times(0.3, 2.6))
    for x, i, u in ((found[0], 0, 0.3), (found[1], 2, 0.6)):
        layer = tm.InBetween(motion.bases[i : i + 2], motion.faces)
        torch.testing.assert_close(x, layer(*motion.keyframes[i : i + 2], u), rtol=0, atol=1e-9)
    two = motion.pick(0, 1)
    smooth, straight = (Path(two.bases, two.faces, smooth=s)(two.keyframes, 0.4) for s in (True, False))
    assert torch.equal(smooth, straight), "two key-frames have no neighbours"


def test_a_rigid_motion_is_smooth_too(bars: Shapes) -> None:
    """Key-frames that only turn and travel: a uniform screw is followed exactly."""
    x = bars.keyframes[0]
    centre = x.mean(0)

    def posed(t: float) -> Tensor:
        c, s = math.cos(0.8 * t), math.sin(0.8 * t)
        return (x - centre) @ torch.tensor([[c, s, 0], [-s, c, 0], [0, 0, 1]], dtype=DOUBLE) + centre + t

    keyframes = torch.stack([posed(i) for i in range(4)])
    path = Path(keyframes, bars.faces)
    found = path(keyframes, times(0.25, 1.5, 2.9))
    for y, t in zip(found, (0.25, 1.5, 2.9), strict=True):
        wanted = posed(t)
        # The turn is about the area centroid, which travels: shapes are compared about their means.
        assert largest((y - y.mean(0)) - (wanted - wanted.mean(0))) < 1e-8


@pytest.mark.parametrize("back", [False, True])
def test_times_scale_and_run_backwards(motion: Shapes, back: bool) -> None:
    when, at = times(0.0, 0.5, 2.0, 2.5, 4.0), times(0.2, 1.1, 2.2, 3.3)
    own = Path(motion.keyframes, motion.faces, when)
    x, other, there = motion.keyframes, 10 * when - 3, 10 * at - 3
    if back:
        x, other, there = x.flip(0), -other.flip(0), -there
    torch.testing.assert_close(Path(x, motion.faces, other)(x, there), own(motion.keyframes, at), rtol=0, atol=1e-9)


def test_a_cycle_may_begin_anywhere(motion: Shapes) -> None:
    own = motion.pick(0, 1, 2, 3)
    cycle = Path(own.keyframes, own.faces, cyclic=True)
    rolled = Path(own.keyframes.roll(-1, 0), own.faces, cyclic=True)
    at = times(0.3, 1.6, 2.5, 3.9)
    found = cycle(own.keyframes, at)
    torch.testing.assert_close(rolled(own.keyframes.roll(-1, 0), at - 1), found, rtol=0, atol=1e-9)
    torch.testing.assert_close(cycle(own.keyframes, at + 8), found, rtol=0, atol=1e-9)


def second_derivatives(path: Path, keyframes: Tensor, h: float = 1e-3) -> Tensor:
    """Just before and just after the second of three key-frames. *Shape:* ``(2, V, 3)``."""
    x = path(keyframes, 1 + h * torch.arange(-3, 4, dtype=DOUBLE))
    return torch.stack([2 * x[3] - 5 * y[0] + 4 * y[1] - y[2] for y in (x[:3].flip(0), x[4:])]) / h**2


def test_accelerations_are_continuous(bars: Shapes) -> None:
    """But for the little by which the triangles' axes differ."""
    straight, half = bars.keyframes[0], Path(bars.keyframes[:2], bars.faces, [0, 1])(bars.keyframes[:2], 0.4)
    x = torch.stack([straight, half, bars.keyframes[1]])
    before, after = second_derivatives(Path(x, bars.faces), x)
    assert largest(before) > 0.1 and largest(after - before) < 1e-2 * largest(before)


def test_velocities_are_continuous_where_edges_change(bars: Shapes) -> None:
    """Both sides of a key-frame fit vertices to edges by the same weights."""
    x, key, h = bars.keyframes.clone(), times(1.0), 1e-5
    x[1] *= 1 + 0.5 * torch.sin(3 * x[1][:, :1])
    x[2] *= 1 + 0.5 * torch.sin(2 * x[2][:, 1:2])
    jumps = [
        largest((trajectory(x, key + h) + trajectory(x, key - h) - 2 * x[1]) / h)
        for trajectory in (Path(x, bars.faces, smooth=smooth) for smooth in (True, False))
    ]
    assert jumps[0] < 1e-4 * jumps[1]


def test_no_modes_are_needed(bars: Shapes, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sequence, "bases_of_checked", lambda *_, **__: pytest.fail("modes are extracted"))
    x, faces = bars.keyframes, bars.faces
    path, at = Path(x, faces), times(0.0, 0.3, 1.0, 1.6, 2.0)
    found = path(x, at)
    assert torch.equal(found[::2], x)
    torch.testing.assert_close(found, Path(bars.bases, faces)(x, at), rtol=0, atol=1e-12)
    for bases in (None, lambda *_: pytest.fail("modes are made")):
        frames = tm.subdivide(x, faces, 2, bases=bases, progress=False)
        torch.testing.assert_close(frames, path(x, torch.linspace(0, 2, 9, dtype=DOUBLE)), rtol=0, atol=1e-12)
    pairs = tm.subdivide(x, faces, 1, n_modes=0, smooth=False, progress=False)
    for i in (0, 1):
        truth = tm.MidShape(x[i : i + 2], faces, preset="accurate")(x[i], x[i + 1])
        torch.testing.assert_close(pairs[2 * i + 1], truth, rtol=0, atol=1e-12)
        torch.testing.assert_close(Path(x, faces, smooth=False)(x, i + 0.5), truth, rtol=0, atol=1e-9)


def unlimited(speeds: Tensor, durations: Tensor, cyclic: bool, squared: Squared) -> Tensor:
    """The path scheme without a limit, of scipy."""
    steps = speeds * durations.view(-1, *[1] * (speeds.dim() - 1))
    knots, x = (torch.cat([torch.zeros_like(own[:1]), own.cumsum(0)]).numpy() for own in (durations, steps))
    return torch.from_numpy(CubicSpline(knots, x, bc_type="natural")(knots, 1))


def test_what_rests_between_equal_keyframes_does_not_move(bars: Shapes) -> None:
    still = bars.pick(0, 1, 1, 2)
    path = Path(still.keyframes, still.faces)
    found = path(still.keyframes, torch.linspace(1, 2, 9, dtype=DOUBLE))
    assert largest(found - still.keyframes[1]) < 1e-9


def test_a_stop_is_not_passed(bars: Shapes) -> None:
    """A bar bends, stops, and goes back at uneven times; without the limit it would run on."""
    own = bars.pick(0, 2, 1, 1, 0)
    stop = own.keyframes[2]

    def overshoot(smooth: Any) -> float:
        path = Path(own.keyframes, own.faces, [0.0, 0.9, 1.2, 2.0, 2.3], smooth=smooth)
        worst = largest(path(own.keyframes, torch.linspace(1.2, 2.0, 17, dtype=DOUBLE)) - stop)
        for other, start, end in ((1, 0.9, 1.2), (4, 2.0, 2.3)):
            away = stop - own.keyframes[other]
            beyond = path(own.keyframes, torch.linspace(start, end, 17, dtype=DOUBLE)[1:-1]) - stop
            moving = away.norm(dim=-1) > 1e-3 * diagonal(stop)
            worst = max(worst, float(((beyond * away).sum(-1) / away.norm(dim=-1))[:, moving].amax()))
        return worst / diagonal(stop)

    assert overshoot(True) < 5e-3
    assert overshoot(unlimited) > 5e-3


def test_subdivide_is_the_path_at_even_times(motion: Shapes) -> None:
    when = [0.0, 1.0, 1.5, 3.0, 4.0]
    path = Path(motion.bases, motion.faces, when)
    for options in ({"levels": 2}, {"n_frames": 11}):
        frames = tm.subdivide(motion.keyframes, motion.faces, bases=motion.bases, times=when, progress=False, **options)
        places = keyframe_places(5, times=when, **options)
        at = fill_linear(torch.tensor(when, dtype=DOUBLE), places)
        assert len(at) == len(frames)
        torch.testing.assert_close(frames, path(motion.keyframes, at), rtol=0, atol=1e-9)
        assert at[places].tolist() == when
        assert torch.equal(frames[places], motion.keyframes)


# -------------------------------------------------------------------------------------------------------- gradients


@pytest.mark.parametrize("smooth", [True, False])
def test_a_spline_depends_on_all_key_frames_and_a_pair_on_its_own(motion: Shapes, smooth: bool) -> None:
    """The numbers of gradients: tests/layers/test_derivatives.py."""
    keyframes = motion.keyframes.clone().requires_grad_()
    shape = Path(motion.bases, motion.faces, smooth=smooth)(keyframes, 3.6)
    (own,) = torch.autograd.grad((shape * torch.cos(9 * motion.keyframes[0])).sum(), keyframes)
    felt = own.flatten(1).abs().amax(1) > 1e-9
    assert felt.tolist() == [smooth, smooth, smooth, True, True]


class Shrinking(Area):
    part = 0.9


def test_gradients_reach_a_term(motion: Shapes) -> None:
    """A course is at rest; what pulls at it is felt, and so is its stiffness."""

    def shapes(stiffness: Tensor) -> Tensor:
        objective = tm.Objective(terms=(Shrinking(stiffness),), coarse_faces=200)
        return Path(motion.bases, motion.faces, objective=objective)(motion.keyframes, 1.4)

    stiffness = nn.Parameter(torch.tensor(200.0, dtype=DOUBLE))
    (slope,) = torch.autograd.grad(shapes(stiffness).square().sum(), stiffness)
    h = 0.1
    with torch.enable_grad():
        ends = [
            float(shapes(torch.tensor(200.0 + s * h, dtype=DOUBLE, requires_grad=True)).square().sum()) for s in (-1, 1)
        ]
    assert float(slope) == pytest.approx((ends[1] - ends[0]) / (2 * h), rel=1e-4)
    bare = Path(motion.bases, motion.faces)(motion.keyframes, 1.4)
    assert largest(shapes(stiffness).detach() - bare) > 1e-3


# -------------------------------------------------------------------------------------------------------- exceptions


@pytest.mark.parametrize(
    ("call", "message"),
    [
        *((lambda path, x, at=at: path(x, at), "between the times of .*, 0 and 4") for at in (-0.1, 4.2, math.nan)),
        (lambda path, x: path(x[:4], 0.5), r"shape \(\.\.\., 5, 164, 3\); got \(4, 164, 3\)"),
        (lambda path, x: path(x.expand(2, -1, -1, -1), torch.rand(3)), r"keyframes \(2,\), t \(3,\); for"),
        (lambda path, x: path.insert(2.0), "already"),
    ],
)
def test_what_a_call_refuses(call: Any, message: str, path: Path, motion: Shapes) -> None:
    with pytest.raises(ValueError, match=message):
        call(path, motion.keyframes)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"times": [0.0, 1.0]}, "must be 5 ascending numbers, one for each key-frame"),
        ({"times": [0.0, 1.0, 2.0, 3.0, 4.0], "cyclic": True}, "must be 6 ascending numbers"),
        ({"times": [0.0, 1.0, 1.0, 3.0, 4.0]}, "got 1 at place 2, after 1"),
        ({"preset": "paper"}, "middle of a pair only"),
        ({"bases": slice(1)}, "two key-frames or more, got 1"),
    ],
)
def test_what_a_path_refuses(options: Any, message: str, motion: Shapes) -> None:
    with pytest.raises(ValueError, match=message):
        Path(motion.bases[options.pop("bases", slice(None))], motion.faces, **options)


# ----------------------------------------------------------------------------------------------------- known motions


def test_the_sample_creature() -> None:
    """Six key-frames of a gallop, the truth half-way between them."""
    sample = load_sample("creature")
    at = torch.tensor(sample.true_times, dtype=DOUBLE)
    smooth, pairs = (
        Path(sample.keyframes, sample.faces, cyclic=True, smooth=s)(sample.keyframes, at) for s in (True, False)
    )
    near, far = (float((x - sample.truth).norm(dim=-1).mean()) for x in (smooth, pairs))
    assert near < 0.4 * far
    edges, worse = (edge_error(x, sample.truth, sample.faces) for x in (smooth, pairs))
    assert edges < 0.5 * worse


# ----------------------------------------------------------------------------------------------------------- editing


def edited(shapes: Shapes, i: int, **options: Any) -> int:
    """How many intervals are computed again after a key-frame has changed."""
    path = Path(shapes.keyframes, shapes.faces, **options)
    editor = tm.PathEditor(path, shapes.keyframes, steps=3)
    before, other, computed = editor.shapes(), shapes.keyframes.clone(), []
    torch.testing.assert_close(before, path(shapes.keyframes, editor.times()), rtol=0, atol=1e-9)
    other[i] += 0.1
    path.register_forward_pre_hook(lambda *_: computed.append(1))
    editor.replace(i, other[i])
    after, n = editor.shapes(), len(computed)
    assert torch.equal(editor.shapes(), after) and len(computed) == n
    torch.testing.assert_close(after, path(other, editor.times()), rtol=0, atol=1e-5)
    assert torch.equal(shapes.keyframes[i] + 0.1, other[i]), "the caller's key-frames stay"
    return n


def test_a_change_of_a_pair_is_local(bars: Shapes) -> None:
    assert edited(bars.pick(0, 1, 2, 1, 0, 2), 1, smooth=False) == 2
    assert edited(bars.pick(0, 1, 2, 1, 0, 2), 0, smooth=False) == 1


@pytest.mark.parametrize("cyclic", [False, True])
def test_a_change_of_a_spline_fades(small_bars: Shapes, cyclic: bool) -> None:
    """It reaches all of it, a quarter as far at each key-frame; what nobody sees is not computed again."""
    assert 8 <= edited(small_bars.pick(*[0, 1, 2, 1] * 10), 1, cyclic=cyclic) <= 25


def test_a_pinned_in_between_becomes_a_keyframe(motion: Shapes, path: Path) -> None:
    editor = tm.PathEditor(path, motion.keyframes, steps=2)
    passing = path(motion.keyframes, 2.3)
    assert editor.insert(2.3) == 3
    assert editor.path.times.tolist() == [0, 1, 2, 2.3, 3, 4]
    assert editor.times()[4:9].tolist() == pytest.approx([2, 2.15, 2.3, 2.65, 3])
    torch.testing.assert_close(editor.shapes()[6], passing, rtol=0, atol=1e-12)
    moved = passing + 0.05
    editor.replace(3, moved)
    assert torch.equal(editor.path(editor.keyframes, 2.3), moved)
    editor.replace(-1, motion.keyframes[-1] + 0.1)  # counted from the end
    torch.testing.assert_close(editor.shapes(), editor.path(editor.keyframes, editor.times()), rtol=0, atol=1e-9)
    for number, shape, error, message in (
        (6, moved, IndexError, "out of bounds"),
        (0, moved * math.nan, ValueError, "not finite"),
    ):
        with pytest.raises(error, match=message):
            editor.replace(number, shape)
    assert path.insert(2.0 + 1e-9).times.tolist() == [0, 1, 2, 2.0 + 1e-9, 3, 4]


@pytest.mark.parametrize("turns", [-2, 1])
def test_a_key_frame_of_another_period_is_that_of_the_first(motion: Shapes, turns: int) -> None:
    """Times of a cycle are taken modulo the period: an inserted key-frame too."""
    own = motion.pick(0, 1, 2)
    path = Path(own.bases, own.faces, times(0.0, 1.0, 2.0, 4.0), cyclic=True)
    inside, outside = (tm.PathEditor(path, own.keyframes, steps=2) for _ in range(2))
    moved = own.keyframes[1] + 0.1
    assert inside.insert(2.5, moved) == outside.insert(2.5 + 4 * turns, moved) == 3
    assert outside.path.times.tolist() == [0.0, 1.0, 2.0, 2.5, 4.0]
    assert torch.equal(outside.path(outside.keyframes, 2.5 + 4 * turns), moved)
    assert torch.equal(outside.shapes(), inside.shapes())


@pytest.mark.parametrize("cyclic", [False, True])
def test_what_an_inserted_key_frame_changes_is_computed_again(bars: Shapes, cyclic: bool) -> None:
    """The intervals around it that shapes were known of already, too."""
    own = bars.pick(0, 1, 2, 1, 0)
    editor = tm.PathEditor(Path(own.bases, own.faces, cyclic=cyclic), own.keyframes, steps=3)
    before = editor.shapes()
    editor.insert(1.5, own.keyframes[0] + 0.1)
    whole = editor.path(editor.keyframes, editor.times())
    torch.testing.assert_close(editor.shapes(), whole, rtol=0, atol=1e-9)
    assert largest(whole[:6] - before[:6]) > 1e-3, "the intervals before it depend on it"


def test_a_path_scheme_outlasts_an_insert(motion: Shapes) -> None:
    """One in which every key-frame is a rest."""

    def still(speeds: Tensor, durations: Tensor, cyclic: bool, squared: Squared) -> Tensor:
        return torch.cat([torch.zeros_like(speeds), torch.zeros_like(speeds[:1])])

    path = Path(motion.bases, motion.faces, smooth=still)
    keyframes = torch.cat([motion.keyframes[:2], path(motion.keyframes, 1.5)[None], motion.keyframes[2:]])
    near = path.insert(1.5)(keyframes, times(1.5, 1.5 + 1e-3, 2.0, 2.0 + 1e-3))
    assert largest(near[1::2] - near[::2]) < 1e-4
    away = Path(motion.bases, motion.faces).insert(1.5)(keyframes, times(1.5, 1.5 + 1e-3))
    assert largest(away[1] - away[0]) > 3e-4, "without it, the motion goes on"


@pytest.mark.parametrize("cyclic", [False, True])
@pytest.mark.parametrize("t", [math.nan, -math.inf, 0.2 + 1e-16, 0.8, -0.4, 5.0])
def test_an_insert_that_fails_changes_nothing(bars: Shapes, cyclic: bool, t: float) -> None:
    own = bars.pick(0, 1, 2)
    path = Path(own.bases, own.faces, times(0.2, 0.6, 0.8, 1.4)[: 3 + cyclic], cyclic=cyclic)
    editor = tm.PathEditor(path, own.keyframes, steps=2)
    before, at = editor.shapes(), editor.times()
    if cyclic and t == 5.0:
        with pytest.raises(ValueError, match="not finite"):
            editor.insert(t, own.keyframes[0] * math.nan)
    else:
        with pytest.raises(ValueError, match=r"lies between|already"):
            editor.insert(t, own.keyframes[0])
    assert editor.path is path
    assert torch.equal(editor.keyframes, own.keyframes)
    assert torch.equal(editor.times(), at)
    assert torch.equal(editor.shapes(), before)
    moved = own.keyframes[0] + 0.1
    assert editor.insert(0.7, moved) == 2
    assert torch.equal(editor.path(editor.keyframes, 0.7), moved)


def test_solve_tells_how_it_went(motion: Shapes, path: Path) -> None:
    t = times(0.0, 3.5, 1.2, 0.4)
    with torch.no_grad():
        result = path.solve(motion.keyframes, t)
        assert torch.equal(result.shapes, path(motion.keyframes, t))
        alone = path.solve(motion.keyframes, 1.2)
        nothing = path.solve(motion.keyframes, t[:0])
    assert result.solution.status.shape == (4,)
    assert bool(result.solution.usable.all())
    torch.testing.assert_close(result.solution.energy[2], alone.solution.energy)
    assert nothing.shapes.shape == (0, *motion.keyframes.shape[1:]) and nothing.solution.status.shape == (0,)


def test_explain_tells_where_velocities_are_limited(bars: Shapes) -> None:
    """A bar bends, rests for an interval, and goes back: at a key-frame, and within intervals."""
    own = bars.pick(0, 1, 1, 0)
    why = Path(own.keyframes, own.faces).explain(own.keyframes, times(0.4, 1.0, 1.5, 2.5)[:, None])
    assert why.interval.tolist() == [[0], [1], [1], [2]]
    torch.testing.assert_close(why.fraction, times(0.4, 0.0, 0.5, 0.5)[:, None])
    assert torch.equal(why.limited > 0.99, torch.tensor([[[0, 1]], [[1, 1]], [[1, 1]], [[1, 0]]]).bool())
    assert not why.even.any() and not why.solution.start_weights.any() and largest(why.displacement) < 1e-9
    assert bool((why.turns[[0, 3], :, 1] > 0.5).all()) and largest(why.turns[1:3]) < 1e-6
    even = torch.stack([bars.keyframes[0] @ quarter_turns(k).mT for k in (0, 0.6, 1.2, 1.8)])
    steady = Path(even, bars.faces).explain(even, 1.5)
    assert not steady.limited.any()
    torch.testing.assert_close(steady.turns, times(0.6 * math.pi / 2, 0), rtol=0, atol=1e-6)
    pairs = Path(own.keyframes, own.faces, smooth=False).explain(own.keyframes, 1.0)
    assert pairs.even and not pairs.limited.any()


def test_explain_tells_what_is_blended(bars: Shapes, monkeypatch: pytest.MonkeyPatch) -> None:
    path, t = Path(bars.keyframes, bars.faces), times(0.3, 0.7)
    spline, knots = path.splines[0], path.knots(bars.keyframes[None])
    assert knots is not None
    which = torch.zeros(2, dtype=torch.int64)
    straight = spline.alignment.to_caller(spline.straight(knots[0], 0, which, t), spline.pose(knots[0], 0, which, t))
    smooth = path(bars.keyframes, t)
    monkeypatch.setattr(path.distortions[0], "forward", lambda *_: torch.tensor([[2.5e30, 1], [1e30, 1e30]]).double())
    why = path.explain(bars.keyframes, t)
    torch.testing.assert_close(why.solution.start_weights, times(0.5, 0)[:, None])
    torch.testing.assert_close(path(bars.keyframes, t), torch.stack([(smooth + straight)[0] / 2, smooth[1]]))


def test_explain_tells_of_more_than_a_full_turn() -> None:
    """A strip that rolls up, and goes on a little."""
    points, faces = rectangle(6.0, 1.0, 0.25)
    shapes = [cylinder(points, time, lambda s: rolled(s, 6.0, 3.0), math.radians(80)) for time in (0.0, 0.9, 1.0)]
    x = torch.from_numpy(np.stack(shapes))
    assert Path(x, torch.from_numpy(faces)).explain(x, times(0.5, 1.5)).even.tolist() == [True, False]


def test_explain_tells_what_a_term_moved(motion: Shapes) -> None:
    """Of two motions at two times each."""
    objective = tm.Objective(terms=(Shrinking(300.0),), coarse_faces=200)
    path = Path(motion.bases, motion.faces, objective=objective)
    keyframes, t = torch.stack([motion.keyframes, 1.1 * motion.keyframes])[:, None], times(1.0, 2.5)
    why = path.explain(keyframes, t)
    plain = Path(motion.keyframes, motion.faces)(keyframes, t)
    moved = (path(keyframes, t) - plain).norm(dim=-1).amax(-1)
    torch.testing.assert_close(why.displacement, moved, rtol=1e-6, atol=1e-9)
    assert largest(moved[:, 0]) < 1e-9 < 1e-4 * diagonal(motion.keyframes[0]) < float(moved[:, 1].min())
    assert why.limited.shape == (2, 2, 2) and why.solution.n_steps.shape == (2, 2)


def test_times_in_float32_reach_the_key_frames(motion: Shapes) -> None:
    at = [2.0, 2.3, 2.7, 3.1, 3.3]
    t = torch.tensor(at).requires_grad_()
    for cyclic in (False, True):
        layer = Path(motion.bases, motion.faces, times=[*at, 3.9] if cyclic else at, cyclic=cyclic)
        shapes = layer(motion.keyframes, t)
        assert torch.equal(shapes, motion.keyframes)
        assert torch.autograd.grad(shapes[1:4].square().sum(), t)[0][1:4].abs().min() > 0
        assert layer(motion.keyframes, torch.linspace(2.0, 3.3, 17)).isfinite().all()
    with pytest.raises(ValueError, match="lies between"):
        Path(motion.bases, motion.faces, times=at)(motion.keyframes, 3.3 + 1e-5)
    listed = Path(motion.bases[:3], motion.faces, [0.1, 0.3, 0.7])  # no numbers of float32
    assert torch.equal(listed(motion.keyframes[:3], times(0.1, 0.3, 0.7)), motion.keyframes[:3])


def test_an_inserted_key_frame_borrows_the_modes_around_it(motion: Shapes) -> None:
    """Those of the nearer one."""
    x, path = motion.keyframes, Path(motion.bases, motion.faces, smooth=False, preset="modal")
    for t, nearer in ((1.3, 1), (1.7, 2)):
        pinned = path(x, t) + 0.05
        found = path.insert(t)(torch.cat([x[:2], pinned[None], x[2:]]), times(0.5 + 0.5 * t, 0.5 * t + 1))
        borrowed = dataclasses.replace(motion.bases[nearer], reference=path(x, t))
        for shape, ends, other in zip(found, ((x[1], pinned), (pinned, x[2])), (1, 2), strict=True):
            bases = [motion.bases[1], borrowed] if other == 1 else [borrowed, motion.bases[2]]
            expected = tm.InBetween(bases, motion.faces, "modal")(*ends, 0.5)
            torch.testing.assert_close(shape, expected, rtol=0, atol=1e-9)
