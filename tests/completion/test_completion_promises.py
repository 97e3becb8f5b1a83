"""Promises of completion about unusual observations: weights, outliers, noise, exact times, reversed time, borders."""

import itertools
import warnings
from dataclasses import replace

import numpy as np
import pytest
import test_completion
import torch
from test_completion import VIEWS, error, scanned

import torch_modal as tm
from torch_modal.completion import poses
from torch_modal.completion.confidence import OF_MODES, OF_NOISE, compare, expected_errors
from torch_modal.completion.frames import CompletionProblem
from torch_modal.completion.pairs import ObservedPoints, SampledSurface
from torch_modal.completion.poses import N_KNOWN, FramePoses, ModalFit, times_between
from torch_modal.progress import ProgressReport

tube = test_completion.tube
TIMES = [0.0, 4.0]


def marked(x, diagonal, time=1.0, step=7, noise=0.005, seed=0, **options):
    """Every so many-th vertex, with noise."""
    vertices = torch.arange(0, len(x), step)
    generator = torch.Generator().manual_seed(seed)
    off = noise * diagonal * torch.randn(len(vertices), 3, generator=generator, dtype=x.dtype)
    return tm.Observation(time, x[vertices] + off, vertices=vertices, noise=noise * diagonal, **options)


# ----------------------------------------------------------------------------------------------------- exact key-frames
@pytest.mark.parametrize("estimate_times", [False, True])
def test_an_observation_at_the_time_of_a_keyframe_beside_others(tube, estimate_times):
    x, faces, diagonal = tube
    seen = [marked(x[i], diagonal, float(i)) for i in (0, 1, 3)]
    found = tm.complete(x[[0, 4]], faces, seen, times=TIMES, estimate_times=estimate_times)
    assert found.times[0] == 0 and len(found.times) == 3
    assert torch.equal(found.shapes[0], x[0])
    assert found.knots.shape[0] == 4
    assert error(found.shapes[1:], x[[1, 3]], diagonal) < 0.5


def test_misses_trust_and_confidence_at_the_time_of_a_keyframe_belong_to_it(tube):
    x, faces, diagonal = tube
    seen = marked(x[0], diagonal, 0.0)
    away = replace(seen, points=x[0, seen.vertices] + torch.tensor([0.0, 0.0, 0.05 * diagonal]))
    with pytest.warns(tm.MeshWarning, match="the shapes at 0"):
        found = tm.complete(x[[0, 4]], faces, [away], times=TIMES)
    torch.testing.assert_close(found.misses[0], torch.full_like(found.misses[0], 0.05 * diagonal))
    assert float(found.trust[0].max()) < 0.3
    assert torch.equal(found.shapes[0], x[0]) and bool((found.confidence == 1).all())
    assert float(tm.complete(x[[0, 4]], faces, [seen], times=TIMES).trust[0].mean()) > 0.7


# -------------------------------------------------------------------------------------------------------------- weights
@pytest.mark.parametrize("kind", ["markers", "cloud"])
def test_weights_are_absolute_across_observations(tube, kind):
    """Of two that contradict each other, the one of more weight wins, wherever the weights are."""
    x, faces, diagonal = tube
    one = marked(x[2], diagonal) if kind == "markers" else scanned(x[2], faces, 1.0, VIEWS[2], noise=0.003 * diagonal)
    shift = torch.tensor([0.0, 0.0, 0.02 * diagonal], dtype=x.dtype)
    other = replace(one, points=one.points + shift)
    found = []
    for first, second in ((30.0, 1.0), (1.0, 30.0)):
        pair = [replace(o, weights=o.points.new_full((len(o.points),), w)) for o, w in ((one, first), (other, second))]
        found.append(tm.complete(x[2], faces, pair).shapes[0])
    assert float((found[1] - found[0] - shift).norm(dim=-1).mean()) < 0.35 * 0.02 * diagonal


def test_points_of_more_weight_are_met_more_exactly(tube):
    x, faces, diagonal = tube
    one = scanned(x[2], faces, 1.0, VIEWS[2], noise=0.01 * diagonal)
    heavy = replace(one, weights=one.points.new_full((400,), 100.0))
    plain, weighted = (float(tm.complete(x[[0, 4]], faces, [o], times=TIMES).misses[0].mean()) for o in (one, heavy))
    assert weighted < 0.85 * plain


@pytest.mark.parametrize("kind", ["markers", "cloud"])
def test_points_of_weight_zero_have_no_effect(tube, kind):
    x, faces, diagonal = tube
    if kind == "markers":
        some = marked(x[1], diagonal)
        vertices = torch.cat([some.vertices, some.vertices[:9] + 1])
        every = replace(some, points=torch.cat([some.points, some.points[:9] + 50 * diagonal]), vertices=vertices)
    else:
        some = scanned(x[1], faces, 1.0, VIEWS[1], noise=0.003 * diagonal)
        points = torch.cat([some.points, some.points[:300] + 50 * diagonal])
        every = replace(some, points=points, normals=torch.cat([some.normals, some.normals[:300]]))
    n = len(some.points)
    every = replace(every, weights=(torch.arange(len(every.points)) < n).double())
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        one, other = (tm.complete(x[[0, 4]], faces, [o], times=TIMES) for o in (some, every))
    for given, found in (
        (one.shapes, other.shapes),
        (one.confidence, other.confidence),
        (one.misses[0], other.misses[0][:n]),
        (one.trust[0], other.trust[0][:n]),
    ):
        torch.testing.assert_close(found, given, rtol=0, atol=1e-6)
    assert float(other.misses[0][n:].min()) > 10 * diagonal and not other.trust[0][n:].any()


# ------------------------------------------------------------------------------------------------------------- outliers
def test_outliers_do_little_against_none(tube):
    x, faces, diagonal = tube
    clean = marked(x[1], diagonal, step=5)
    points = clean.points.clone()
    points[::8] += 0.15 * diagonal
    plain, found = (tm.complete(x[[0, 4]], faces, [o], times=TIMES) for o in (clean, replace(clean, points=points)))
    assert error(found.shapes, x[1:2], diagonal) < 2 * error(plain.shapes, x[1:2], diagonal)
    assert float(found.trust[0][::8].max()) < 0.1 < 0.5 < float(found.trust[0].median())


@pytest.mark.parametrize(("kind", "part", "away"), [("keyframes", 0.05, 0.3), ("template", 0.48, 0.6)])
def test_stray_clusters_pull_no_limb_and_are_named(tube, kind, part, away):
    x, faces, diagonal = tube
    plain = scanned(x[1], faces, 1.0, VIEWS[1], n=1000, noise=0.003 * diagonal)
    n = round(1000 * part / (1 - part))
    end = x[1, -1] + away * diagonal * torch.nn.functional.normalize(x[1, -1] - x[1, -13], dim=0)
    cluster = end + 0.02 * diagonal * torch.randn(n, 3, generator=torch.Generator().manual_seed(0), dtype=x.dtype)
    normals = torch.cat([plain.normals, torch.nn.functional.normalize(cluster - end)])
    seen = replace(plain, points=torch.cat([plain.points, cluster]), normals=normals)
    rest, times = (x[[0, 4]], TIMES) if kind == "keyframes" else (x[2], None)
    with pytest.warns(tm.MeshWarning, match="no shape explains") as warned:
        found = tm.complete(rest, faces, [seen], times=times)
    assert error(found.shapes, x[1:2], diagonal) < 2.5
    (message,) = [str(one.message) for one in warned if "no shape explains" in str(one.message)]
    where = torch.tensor([float(number) for number in message.split("around (")[1].split(")")[0].split(",")])
    assert float((where - end).norm()) < 0.02 * diagonal


def test_many_points_at_one_place_need_little_memory(tube):
    """Depth cameras give invalid pixels as zeros: 24,000 of them make 288 million pairs."""
    x, faces, diagonal = tube
    cloud = scanned(x[2], faces, 0.0, VIEWS[2], n=2000, noise=0.001 * diagonal).points.numpy() * 100 / diagonal
    for spread in (0, 1e-9):
        same = np.array([90.0, 0, 0]) + spread * np.random.default_rng(0).standard_normal((24000, 3))
        points = np.concatenate([cloud, same])
        seen = ObservedPoints(points, None, np.ones(len(points)), np.arange(len(points)), 1.0)
        first, *others = seen.find_unexplained(SampledSurface(100 / diagonal * x[2].numpy(), faces.numpy()), 2.0, 4)
        assert not others and set(first) == set(range(2000, 26000))


# --------------------------------------------------------------------------------------------------------------- search
def test_the_former_pairs_of_a_limb_that_is_tried_are_released(tube, monkeypatch):
    x, faces, _ = tube
    points = torch.cat([scanned(x[2], faces, 0.0, VIEWS[2], n=600).points, x[4, 12 * 16 : 12 * 24]])
    problem = CompletionProblem(x[2:3].numpy(), faces, np.zeros(0), [tm.Observation(0.0, points, noise=0.002)])
    poses, (seen,) = FramePoses(problem), problem.frames[0].seen
    search, base, group = poses.poses, poses.template, seen.points[600:]
    tip = int(np.linalg.norm(base.numpy()[search.tips] - group.mean(0), axis=1).argmin())
    pairs, touched = ObservedPoints.pairs, []

    def watched(self, surface, released=None):
        found = pairs(self, surface, released)
        if self.places is None:
            touched.append(float(sum(abs(one.places[:, search.tips[tip]]).T @ one.weights for one in found)[0]))
        return found

    monkeypatch.setattr(ObservedPoints, "pairs", watched)
    search._try_limb(base, search.bending.still(), problem.frames[0], group, np.full(len(group), 0.01), tip)
    assert not any(touched[: len(touched) // 2])
    assert any(touched[len(touched) // 2 :])


def test_a_pose_that_comes_again_is_found_from_the_shape_of_another_time(tube, monkeypatch):
    """Motions repeat: without any steps of the modes, only such a start is near."""
    x, faces, _ = tube
    every, turn = torch.arange(x.shape[1]), torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]], dtype=x.dtype)
    shapes = [x[0], x[4], x[0] @ turn.mT]
    seen = [tm.Observation(float(t), one, vertices=every, noise=0.002) for t, one in enumerate(shapes)]
    problem = CompletionProblem(x[2:3].numpy(), faces, np.zeros(0), seen)
    poses = FramePoses(problem)
    monkeypatch.setattr(poses.poses, "descend", lambda *args, **_: args[1])
    still = poses.bending.still()
    known = [torch.from_numpy(problem.to_canonical(one)) for one in shapes]
    fits = {i: ModalFit(known[i], known[i], still, 0.0) for i in (0, 1)}
    poses._outward(fits, {2: ModalFit(known[1], known[1], still, 9.0)}, ProgressReport(1, "", False))
    assert float((fits[2].x - known[2]).norm(dim=1).mean()) < 8.0


def test_starts_of_a_long_motion_are_made_from_few_shapes(tube, monkeypatch):
    """Else the time grows with the square of the number of frames."""
    x, faces, diagonal = tube
    seen = tm.Observation(50.5, x[0], vertices=torch.arange(x.shape[1]), noise=0.002)
    poses = FramePoses(CompletionProblem(x[2:3].numpy(), faces, np.zeros(0), [seen]))
    swing = [2, 3, 4, 3, 2, 1, 0, 1]
    known = [(float(t), 100 / diagonal * x[swing[t % 8]]) for t in range(100)]
    times, shapes = [t for t, _ in known], torch.stack([one for _, one in known])
    placed, knots = [], []

    def place(body, frame):
        placed.append(body)
        return poses.bending.still(), -len(placed)

    def path(near, *args, **options):
        knots.append(len(near))
        return tm.Path(near, *args, **options)

    monkeypatch.setattr(poses.poses, "place", place)
    monkeypatch.setattr("torch_modal.completion.poses.Path", path)
    assert len(poses._alike(0, list(shapes))) == 2 and len(placed) <= N_KNOWN
    start = poses._starts(50.5, known)[0][0]
    assert knots == [N_KNOWN]
    assert float((start - tm.Path(shapes, faces, times=times)(shapes, 50.5)).norm(dim=1).max()) < 0.01


# ---------------------------------------------------------------------------------------------------------------- noise
@pytest.mark.parametrize("kind", ["markers", "cloud"])
@pytest.mark.parametrize("noise", [0.4, 1.2])
def test_noise_is_estimated(tube, kind, noise):
    x, faces, diagonal = tube
    x = 100 / diagonal * x[2]
    if kind == "markers":
        points = x.numpy() + noise * np.random.default_rng(0).standard_normal(x.shape)
        places = np.eye(len(x))
    else:
        seen = scanned(x, faces, 0.0, VIEWS[2], n=2000, noise=noise)
        points, places = seen.points.numpy(), None
    given = ObservedPoints(points, None, np.ones(len(points)), np.arange(len(points)), 0.0, places)
    assert given.with_noise(SampledSurface(x.numpy(), faces.numpy())).noise == pytest.approx(noise, rel=0.15)


# ----------------------------------------------------------------------------------------------------------- confidence
def test_errors_grow_with_noise_way_and_what_was_not_seen(tube):
    """Each part alone, of a body at three times."""
    x, faces, diagonal = tube
    sides = [scanned(x[2], faces, t, VIEWS[1], n=1500, noise=1e-3 * diagonal) for t in range(3)]
    sides = [replace(one, noise=1e-3 * diagonal) for one in sides]
    problem = CompletionProblem(x[2:3].numpy(), faces, np.zeros(0), sides)
    still = problem.whole.expand(3, -1, -1)
    seen = compare(problem, problem.frames, still)[2]
    by_modes = {float(t): one for t, one in enumerate(still)}
    of_noise = expected_errors(problem, problem.frames, still, by_modes, seen)
    assert torch.allclose(of_noise, torch.full_like(seen, OF_NOISE * problem.frames[0].seen[0].noise), atol=1e-9)
    away = by_modes | {1.0: still[1] + torch.tensor([0.0, 2.0, 0.0])}
    of_way = expected_errors(problem, problem.frames, still, away, seen) - of_noise
    assert torch.allclose(of_way[1], torch.full_like(seen[1], 2 * OF_MODES)) and float(of_way[[0, 2]].max()) < 1e-9
    bent = still.clone()
    bent[1, ::2, 2] += 3.0
    bent[1, 1::2, 2] -= 3.0
    of_time = expected_errors(problem, problem.frames, bent, dict(zip(by_modes, bent, strict=True)), seen) - of_noise
    hidden, visible = seen[1] < 0.1, seen[1] > 0.9
    assert float(of_time[1, hidden].min()) > 2 * float(of_time[1, visible].max()) > 0


@pytest.mark.parametrize("unit", [1.0, 1000.0])
def test_errors_are_in_the_units_of_the_mesh_and_confidence_is_a_half_at_two_percent(tube, unit):
    x, faces, diagonal = tube
    seen = [
        replace(scanned(x[i], faces, float(i), VIEWS[i], noise=4e-3 * diagonal), noise=4e-3 * diagonal) for i in (1, 3)
    ]
    seen = [replace(one, points=unit * one.points, noise=unit * one.noise) for one in seen]
    found = tm.complete(unit * x[[0, 2, 4]], faces, seen, times=[0.0, 2.0, 4.0])
    off = (found.shapes - unit * x[[1, 3]]).norm(dim=-1)
    assert 0.85 < float((off <= found.errors).double().mean()) and float(found.errors.mean()) < 8 * float(off.mean())
    size = unit * float((x[2].amax(0) - x[2].amin(0)).norm())
    assert torch.allclose(found.confidence, torch.exp2(-found.errors / (0.02 * size)), rtol=0.2)


# ----------------------------------------------------------------------------------------------------- time and borders
def test_reversed_time_gives_the_motion_reversed(tube):
    x, faces, diagonal = tube
    seen = [marked(x[i], diagonal, float(i), seed=i) for i in (1, 3)]
    back = [replace(one, time=4 - one.time) for one in seen]
    one = tm.complete(x[[0, 4]], faces, seen, times=TIMES).shapes
    other = tm.complete(x[[4, 0]], faces, back, times=TIMES).shapes
    assert error(other.flip(0), one, diagonal) < 1e-2


def test_estimated_times_keep_their_order(monkeypatch):
    """Also where a shape lies further along the path than the next one."""
    monkeypatch.setattr(poses, "TIME_ROUNDS", 1)
    x, faces, _ = test_completion.bending_tube(8, 6)
    seen = [tm.Observation(t, x[1], vertices=torch.arange(len(x[1]))) for t in (0.99, 1.01)]
    problem = CompletionProblem(x[::2].numpy(), faces, np.array([0.0, 2.0, 4.0]), seen)
    path = tm.Path(problem.whole, faces, times=[0.0, 2.0, 4.0])
    first, second = times_between(problem, list(path(problem.whole, torch.tensor([1.1, 0.9]))))
    assert 0 < first < second < 2


@pytest.mark.parametrize("sums", [0.9, 1.1])
def test_barycentric_weights_have_the_sum_one(tube, sums):
    x, faces, _ = tube
    weights = torch.full((9, 3), 1 / 3, dtype=x.dtype)
    weights[4] *= sums
    with pytest.raises(ValueError, match=f"barycentric weights of a point have the sum one; got {sums}"):
        tm.Observation(1.0, x[0, faces[:9]].mean(1), corners=faces[:9], barycentric=weights)


def test_a_box_of_eight_vertices_is_completed():
    corners = torch.tensor(list(itertools.product((0.0, 1.0), (0.0, 2.0), (0.0, 3.0))), dtype=torch.float64)
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    faces = torch.tensor([t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))])
    moved = corners + torch.tensor([0.3, 0.0, 0.1])
    found = tm.complete(corners, faces, [tm.Observation(0.0, moved, vertices=torch.arange(8))])
    torch.testing.assert_close(found.shapes[0], moved)


def test_noise_may_be_a_tensor_of_one_number(tube):
    x, faces, _ = tube
    assert tm.Observation(0.0, x[0], noise=torch.tensor(0.5)).noise == 0.5
    with pytest.raises(ValueError, match=r"noise is one number; .* weights, 1 / noise\*\*2"):
        tm.Observation(0.0, x[0], noise=torch.ones(len(x[0])))
    with pytest.raises(ValueError, match=r"noise is 1e\+300, and the body's size"):
        tm.complete(x[0], faces, [tm.Observation(0.0, x[0], noise=1e300)])


def test_an_objective_is_no_word(tube):
    x, faces, _ = tube
    with pytest.raises(ValueError, match=r"objective is a torch_modal.Objective; got 'fast'"):
        tm.complete(x[0], faces, [tm.Observation(0.0, x[0])], objective="fast")


def test_transforms_are_refused_and_compile_steps_aside(tube):
    x, faces, diagonal = tube

    def total(points, rest):
        return tm.complete(rest, faces, [tm.Observation(0.0, points, vertices=torch.arange(len(points)))]).shapes.sum()

    for wrapped in (
        lambda: torch.func.grad(total)(x[1], x[2]),
        lambda: torch.func.grad(total, argnums=1)(x[1], x[2]),
        lambda: torch.vmap(total, (0, None))(x[:2], x[2]),
        lambda: torch.func.jvp(lambda p: total(p, x[2]), (x[1],), (x[1],)),
    ):
        with pytest.raises(RuntimeError, match=r"no transforms of torch\.func"):
            wrapped()
    seen = marked(x[1], diagonal)
    compiled = torch.compile(lambda: tm.complete(x[2], faces, [seen]).shapes * 1.0, backend="eager")
    assert torch.equal(compiled(), tm.complete(x[2], faces, [seen]).shapes)


def test_autocast_changes_nothing(tube):
    x, faces, diagonal = tube
    seen = scanned(x[1], faces, 1.0, VIEWS[1], n=200, noise=0.003 * diagonal)
    plain = tm.complete(x[[0, 4]], faces, [seen], times=TIMES)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        cast = tm.complete(x[[0, 4]], faces, [seen], times=TIMES)
        assert torch.equal(plain.shapes, cast.shapes)
        assert torch.equal(plain(0.5), cast(0.5))


def test_keyframes_that_require_gradients_are_warned_of(tube):
    x, faces, diagonal = tube
    with pytest.warns(tm.MeshWarning, match="no gradients in the key-frames"):
        found = tm.complete(x[[0, 4]].clone().requires_grad_(), faces, [marked(x[0], diagonal, 0.0)], times=TIMES)
    assert not found.knots.requires_grad
