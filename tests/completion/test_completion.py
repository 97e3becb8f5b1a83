"""Motions from partial and noisy samples, against motions that are known."""

import copy

import numpy as np
import pytest
import torch
from helpers.terms import Spring

import torch_modal as tm
from torch_modal.completion.bending import ModalBending
from torch_modal.completion.energy import PointEnergy
from torch_modal.completion.frames import CompletionProblem
from torch_modal.completion.gradient import LastSolve
from torch_modal.completion.markers import shape_of_markers
from torch_modal.completion.pairs import ObservedPoints, SampledSurface
from torch_modal.elastic.steps import FineEnergy
from torch_modal.elastic.term import Mesh
from torch_modal.motion.decoder import scale_modes
from torch_modal.registration.surface import places_between
from torch_modal.statistics.variation import Variation


def bending_tube(n, m):
    """A bending tube of rings, half as thick as it is wide: shapes at five times, faces, and its diagonal."""
    t, a = np.meshgrid(np.linspace(0, 1, n), np.arange(m) * 2 * np.pi / m, indexing="ij")
    radius, shapes = 0.12 - 0.05 * t, []
    for bend in (-1.2, -0.6, 1e-6, 0.6, 1.2):
        angle, out = bend * t, radius * np.cos(a)
        x, y = np.sin(angle) / bend - out * np.sin(angle), (1 - np.cos(angle)) / bend + out * np.cos(angle)
        rings = np.stack([x, y, 0.5 * radius * np.sin(a)], -1).reshape(-1, 3)
        shapes.append(np.concatenate([rings, rings[:m].mean(0)[None], rings[-m:].mean(0)[None]]))
    i, j = np.meshgrid(np.arange(n - 1), np.arange(m), indexing="ij")
    p, q = i * m + j, i * m + (j + 1) % m
    sides = np.concatenate([np.stack([p, p + m, q], -1), np.stack([q, p + m, q + m], -1)]).reshape(-1, 3)
    k = np.arange(m)
    caps = [np.stack([np.full(m, n * m), k, (k + 1) % m], -1)]
    caps.append(np.stack([np.full(m, n * m + 1), (n - 1) * m + (k + 1) % m, (n - 1) * m + k], -1))
    faces = np.concatenate([sides, *caps])[:, ::-1].copy()
    x = torch.from_numpy(np.stack(shapes))
    return x, torch.from_numpy(faces), float((x[0].amax(0) - x[0].amin(0)).norm())


@pytest.fixture(scope="module")
def tube():
    return bending_tube(24, 12)


def scanned(x, faces, time, view, seed=0, n=400, noise=0.0):
    """A cloud of what faces a direction."""
    rng = np.random.default_rng(seed)
    corners = x.numpy()[faces.numpy()]
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    areas = np.linalg.norm(across, axis=1)
    normals = across / areas[:, None]
    part = areas * (normals @ view > 0.1)
    face = rng.choice(len(faces), n, p=part / part.sum())
    points = (rng.dirichlet([1, 1, 1], n)[..., None] * corners[face]).sum(1) + noise * rng.standard_normal((n, 3))
    given = {"normals": torch.from_numpy(normals[face]), "view": torch.from_numpy(view)}
    return tm.Observation(time, torch.from_numpy(points), **given, noise=noise or None)


def error(x, truth, diagonal):
    """Mean distance of all vertices, in % of the diagonal."""
    return 100 * float((x - truth).norm(dim=-1).mean()) / diagonal


VIEWS = [np.array([0.5, np.cos(a), np.sin(a)]) / 1.25**0.5 for a in (0.3, 1.2, 2.1, 3.0, 3.9)]


@pytest.fixture(scope="module")
def between(tube):
    """The tube from its first and last shape, and scans of the others."""
    x, faces, diagonal = tube
    scans = [scanned(x[i], faces, float(i), VIEWS[i], i, noise=0.003 * diagonal) for i in (1, 2, 3)]
    return tm.complete(x[[0, 4]], faces, scans[::-1], times=[0.0, 4.0], progress=False)


def test_shapes_of_a_gallop_are_far_nearer_than_the_path():
    sample = tm.load_sample("creature")
    ends, truth, faces = sample.keyframes[[0, 1]].double(), sample.truth[:1].double(), sample.faces
    diagonal = float((truth[0].amax(0) - truth[0].amin(0)).norm())
    scan = scanned(truth[0], faces, 0.5, np.array([0.6, 0.0, 0.8]), n=1000, noise=0.003 * diagonal)
    found = tm.complete(ends, faces, [scan], progress=False)
    path = tm.Path(ends, faces)(ends, 0.5)[None]
    assert sample.true_times[0] == 0.5
    assert error(found.shapes, truth, diagonal) < 0.4 * error(path, truth, diagonal)


def test_times_are_sorted_keyframes_exact_and_misses_in_the_given_order(tube, between):
    x = tube[0]
    assert between.times.tolist() == [1.0, 2.0, 3.0]
    assert torch.equal(between(0.0), x[0])
    assert torch.equal(between(4.0), x[4])
    assert torch.equal(between(torch.tensor([1.0, 2.0, 3.0])), between.shapes)
    assert [len(one) for one in between.misses] == [400] * 3
    assert all(float(one.median()) < 0.02 for one in between.misses)
    assert all(float(one.min()) >= 0 and float(one.max()) <= 1 for one in between.trust)


def test_each_vertex_has_an_expected_error_and_a_confidence(tube, between):
    assert between.confidence.shape == between.errors.shape == (3, tube[0].shape[1])
    assert float(between.errors.min()) > 0 and 0 < float(between.confidence.min())
    halves = between.errors / -between.confidence.log2()  # the error at which the confidence is a half
    torch.testing.assert_close(halves, halves[:1, :1].expand_as(halves))
    assert float(halves.mean()) == pytest.approx(0.02 * tube[2], rel=0.1)


def test_what_is_far_from_the_truth_is_less_certain(tube, between):
    """Ring by ring: a smooth tube slides along itself, most in its middle."""
    off = (between.shapes[1] - tube[0][2]).norm(dim=1)
    by_ring = torch.stack([off, between.confidence[1]])[:, :-2].reshape(2, -1, 12).mean(2)
    assert float(torch.corrcoef(by_ring)[0, 1]) < -0.6


def test_a_template_follows_scans_of_two_sides(tube):
    x, faces, diagonal = tube
    scans = [scanned(x[i], faces, i, side * VIEWS[i], i, noise=0.002 * diagonal) for i in range(5) for side in (1, -1)]
    found = tm.complete(x[2], faces, scans, progress=False)
    assert found.shapes.shape == x.shape
    assert error(found.shapes, x, diagonal) < 0.25 * error(x[2].expand_as(x), x, diagonal)


def test_the_number_of_threads_changes_no_bit(tube):
    x, faces, _ = tube
    scans, found, before = [scanned(x[i], faces, i, VIEWS[i], i) for i in (1, 2)], [], torch.get_num_threads()
    try:
        for n in (1, 3):
            torch.set_num_threads(n)
            found.append(tm.complete(x[0], faces, scans, progress=False).shapes)
            assert torch.get_num_threads() == n
    finally:
        torch.set_num_threads(before)
    assert torch.equal(*found)


def test_one_observation_is_one_shape(tube):
    x, faces, diagonal = tube
    seen = tm.Observation(3.0, x[1], vertices=torch.arange(len(x[1])))
    found = tm.complete(x[2], faces, [seen], progress=False)
    assert found.path is None
    assert error(found(3.0), x[1], diagonal) < 0.7
    assert found(torch.tensor([3.0, 3.0])).shape == (2, *x[1].shape)
    for t in (4.0, torch.tensor([3.0, 4.0])):
        with pytest.raises(ValueError, match="one shape alone"):
            found(t)


def test_a_loose_part_that_was_not_seen_stays_with_the_body(tube):
    x, faces, diagonal = tube
    eye = x[2, :40] * 0.1 + x[2].mean(0) + torch.tensor([0.0, 0.0, 0.15])
    some = faces[(faces < 40).all(1)]
    rest = torch.cat([x[2], eye])
    scans = [scanned(x[i], faces, i, VIEWS[i], i, noise=0.003 * diagonal) for i in (1, 2, 3)]
    found = tm.complete(rest, torch.cat([faces, some + x.shape[1]]), scans, progress=False)
    assert bool(found.shapes.isfinite().all())
    assert float((found.shapes[1, -40:] - eye).norm(dim=-1).max()) < 0.1 * diagonal


def test_noise_of_meshes_is_removed(tube):
    x, faces, diagonal = tube
    noise = 0.01 * diagonal / 3**0.5
    noisy = x + noise * torch.randn(x.shape, generator=torch.Generator().manual_seed(0), dtype=x.dtype)
    every = torch.arange(x.shape[1])
    given = [tm.Observation(i, one, vertices=every, noise=noise) for i, one in enumerate(noisy)]
    found = tm.complete(x[2], faces, given, progress=False)
    assert error(found.shapes, x, diagonal) < 0.6 * error(noisy, x, diagonal)


def test_markers_within_triangles_are_met(tube):
    x, faces, diagonal = tube
    corners = faces[::20]
    weights = torch.full((len(corners), 3), 1 / 3, dtype=x.dtype)
    places = x[1][corners].mean(1)
    seen = tm.Observation(1.0, places, corners=corners, barycentric=weights, noise=0.001 * diagonal)
    found = tm.complete(x[[0, 4]], faces, [seen], times=[0.0, 4.0], progress=False)
    assert float(found.misses[0].mean()) < 0.006 * diagonal
    assert error(found.shapes, x[1:2], diagonal) < 1.0


def test_markers_show_a_mixture_of_the_keyframes(tube):
    """Nearer than the path by far; without a marker of another place; its derivatives are those of differences."""
    x, faces, diagonal = tube
    generator = torch.Generator().manual_seed(0)
    corners = faces[::12]
    weights = torch.rand(len(corners), 3, generator=generator, dtype=x.dtype)
    weights = weights / weights.sum(1, keepdim=True)
    places = (weights[..., None] * x[1][corners]).sum(1)
    places[3] += 0.3 * diagonal
    seen = tm.Observation(1.0, places, corners=corners, barycentric=weights, noise=0.001 * diagonal)
    problem = CompletionProblem(x[::2].numpy(), faces, np.array([0.0, 2.0, 4.0]), [seen])
    truth, variation = torch.from_numpy(problem.to_canonical(x[1])), Variation(problem.whole, faces)
    about = torch.tensor([0.5, 0.5, 0.0], dtype=x.dtype)
    found = shape_of_markers(variation, problem.frames[0], about, truth, differentiable=True)
    path = tm.Path(problem.whole, faces, times=[0.0, 2.0, 4.0])(problem.whole, 1.0)
    assert error(found.x, truth, 100) < 0.1 * error(path, truth, 100)
    assert sorted(found.numbers) == [i for i in range(len(corners)) if i != 3]

    probe, move = (torch.randn(y.shape, generator=generator, dtype=x.dtype) for y in (found.x, found.points))
    (slope,) = torch.autograd.grad((found.x * probe).sum(), found.points)
    (one,), ends = problem.frames[0].seen, []
    for sign in (1, -1):
        points = one.points.copy()
        points[found.numbers] += sign * 1e-3 * move.numpy()
        frame = problem.frames[0]._replace(seen=[one._replace(points=points)])
        ends.append(shape_of_markers(variation, frame, about, truth).x)
    difference = float(((ends[0] - ends[1]) * probe).sum()) / 2e-3
    assert float((slope * move).sum()) == pytest.approx(difference, rel=1e-3)


@pytest.mark.parametrize("vertices", [[0, 12, 24], [0, 120, 240]])
def test_three_markers_leave_the_rest_to_the_path(tube, vertices):
    x, faces, diagonal = tube
    seen = tm.Observation(1.0, x[1][vertices], vertices=torch.tensor(vertices), noise=0.001 * diagonal)
    found = tm.complete(x[::2], faces, [seen], times=[0.0, 2.0, 4.0], progress=False)
    path = tm.Path(x[::2], faces, times=[0.0, 2.0, 4.0])(x[::2], 1.0)
    assert error(found.shapes[0], x[1], diagonal) < 0.5 * error(path, x[1], diagonal)


def test_a_motion_and_other_units_change_nothing(tube):
    x, faces, _ = tube
    turn = torch.linalg.qr(torch.randn(3, 3, generator=torch.Generator().manual_seed(1), dtype=x.dtype)).Q
    turn = turn * torch.linalg.det(turn).sign()
    scan = scanned(x[1], faces, 1.0, VIEWS[1])

    def moved(points):
        return 25.4 * points @ turn.T + 3.0

    other = tm.Observation(1.0, moved(scan.points), normals=scan.normals @ turn.T, view=turn @ scan.view)
    first = tm.complete(x[[0, 4]], faces, [scan], times=[0.0, 4.0], progress=False).shapes
    second = tm.complete(moved(x[[0, 4]]), faces, [other], times=[0.0, 4.0], progress=False).shapes
    assert float((moved(first) - second).abs().max()) < 1e-4 * 25.4


def test_other_units_and_shapes_are_refused(tube):
    x, faces, _ = tube
    seen, paired = [tm.Observation(0.0, x[1])], tm.Objective(space="paired")
    for observations, options, message in (
        ([tm.Observation(1.0, 1000 * x[1])], {}, "other units"),
        (seen, {"times": [0.0]}, "has no time"),
        ([tm.Observation(0.0, x[1][:3], vertices=[0, 1, 9999])], {}, "vertices lie in"),
        ([], {}, "got none"),
        (seen, {"objective": paired}, "space='joint'"),
    ):
        with pytest.raises(ValueError, match=message):
            tm.complete(x[0], faces, observations, progress=False, **options)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"points": torch.zeros(2, 3)}, "n of 3 or more"),
        ({"points": torch.full((4, 3), torch.nan)}, "points must be finite"),
        ({"time": torch.inf}, "time must be finite"),
        ({"normals": torch.zeros(3, 3)}, "normals have the shape"),
        ({"vertices": [0, 1, 2, 3], "normals": torch.ones(4, 3)}, "clouds"),
        ({"corners": torch.zeros(4, 3, dtype=torch.int64)}, "go together"),
        ({"weights": torch.zeros(4)}, "weight above 0"),
        ({"noise": 0.0}, "above 0"),
        ({"view": torch.zeros(3)}, "direction"),
    ],
)
def test_an_observation_says_what_does_not_fit(given, message):
    with pytest.raises(ValueError, match=message):
        tm.Observation(**({"time": 0.0, "points": torch.rand(4, 3)} | given))


def test_something_else_has_low_confidence_and_a_warning(tube):
    x, faces, diagonal = tube
    ball = torch.randn(400, 3, generator=torch.Generator().manual_seed(0), dtype=x.dtype)
    ball = 0.4 * diagonal * ball / ball.norm(dim=1, keepdim=True)
    with pytest.warns(tm.MeshWarning, match="doubtful"):
        found = tm.complete(x[0], faces, [tm.Observation(0.0, ball, noise=0.002)], progress=False)
    assert float(found.confidence.mean()) < 0.5


def test_derivatives_of_modal_bending(tube):
    x, faces, _ = tube
    modes = scale_modes(tm.extract_modes(x[0], faces, 6).modes, 100.0)
    bending = ModalBending(100 * x[0], faces, modes)
    rotation = torch.linalg.qr(torch.rand(3, 3, dtype=x.dtype)).Q
    pose = bending.still()._replace(amplitudes=torch.linspace(-3, 3, 6).double(), rotation=rotation)
    shape, fields = bending.linearise(100 * x[1], pose)
    for k in range(12):
        step = 1e-5 * torch.eye(12, dtype=x.dtype)[k]
        there, back = (bending.shape(100 * x[1], bending.step(pose, s * step, shape.mean(0))) for s in (1, -1))
        assert torch.allclose(
            (there - back) / 2e-5, fields[..., k], atol=1e-6 * float(fields[..., k].abs().max()) + 1e-8
        )


def test_no_amplitude_blows_a_shape_up(tube):
    """Amplitudes are found on a coarse mesh; on the caller's, a triangle may have ten times the strain."""
    x, faces, diagonal = tube
    modes = scale_modes(tm.extract_modes(x[0], faces, 6).modes, 100.0)
    bending = ModalBending(100 * x[0], faces, modes)
    bending.columns = 10 * bending.columns
    shape = bending.shape(100 * x[0], bending.still()._replace(amplitudes=torch.full((6,), 10.0).double()))
    assert float((shape.amax(0) - shape.amin(0)).norm()) < 300 * diagonal


def test_derivatives_of_the_energy_of_points(tube):
    x, faces, _ = tube
    surface = SampledSurface(100 * x[0].numpy(), faces.numpy())
    weights, numbers = np.ones(len(x[1])), np.arange(len(x[1]))
    cloud = ObservedPoints(100 * x[1].numpy() + 1, None, weights / weights.sum(), numbers, 1.0)
    pairs = cloud.pair(surface)
    normals = np.random.default_rng(0).standard_normal((len(pairs.points), 3))
    places = places_between(faces.numpy()[:5], np.full((5, 3), 1 / 3), len(x[0]))
    markers = ObservedPoints(np.ones((5, 3)), None, np.ones(5), np.arange(5), 1.0, places)
    energy = PointEnergy([pairs._replace(normals=normals / np.linalg.norm(normals, axis=1, keepdims=True)), markers])
    at = energy.at(100 * x[:1])
    field = torch.randn(x[:1].shape, generator=torch.Generator().manual_seed(0), dtype=x.dtype)
    there, back = (energy.value(100 * x[:1] + s * field) for s in (1e-3, -1e-3))
    assert torch.allclose((there - back) / 2e-3, at.slope(field), rtol=1e-6)
    second = (there + back - 2 * at.value) / 1e-6
    assert torch.allclose(second, (field * at.product(field)).sum((1, 2)), rtol=1e-4)


def test_points_of_weight_zero_do_not_count_in_a_score(tube):
    x, faces, _ = tube
    surface, on, away = SampledSurface(100 * x[0].numpy(), faces.numpy()), 100 * x[0].numpy(), np.full((9, 3), 500.0)
    for points, n, score in ((np.concatenate([on, away]), len(on), 0), (away, 9, 1)):
        weights = (np.arange(len(points)) < n) / n
        cloud = ObservedPoints(points, None, weights, np.arange(len(points)), 1.0)
        assert cloud.score(surface, 1.0) == pytest.approx(score, abs=1e-3)


@pytest.mark.parametrize("given", [pytest.param(True, marks=pytest.mark.slow), False])
def test_gradients_of_markers_are_those_of_differences(given):
    """Through robust weights and neighbours in time, also where the noise is estimated."""
    x, faces, diagonal = bending_tube(10, 8)
    vertices, generator = torch.arange(0, x.shape[1], 5), torch.Generator().manual_seed(0)
    noise, shape = 0.005 * diagonal, (2, len(vertices), 3)
    drawn, moves = (torch.randn(shape, generator=generator, dtype=x.dtype) for _ in range(2))
    probe = torch.randn(2, *x.shape[1:], generator=generator, dtype=x.dtype)

    def total(points):
        options = {"vertices": vertices, "noise": noise if given else None}
        seen = [tm.Observation(t, p, **options) for t, p in zip((1, 3), points, strict=True)]
        return (tm.complete(x[[0, 4]], faces, seen, times=[0.0, 4.0]).shapes * probe).sum()

    points = (x[[1, 3]][:, vertices] + noise * drawn).requires_grad_()
    (slope,) = torch.autograd.grad(total(points), points)
    step = 1e-4 * diagonal * moves
    with torch.no_grad():
        difference = float(total(points + step) - total(points - step)) / 2e-4 / diagonal
    assert float((slope * moves).sum()) == pytest.approx(difference, rel=1e-3)


def test_gradients_in_points_of_a_cloud(tube):
    """Against differences of the last minimisation, with its pairs: every point, in turned and scaled coordinates."""
    x, faces, _ = tube
    turn = torch.linalg.qr(torch.randn(3, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(2)))[0]
    turn = turn * turn.det()
    x = 1000 * x @ turn.mT + 5
    seen = scanned(x[1], faces, 1.0, turn.numpy() @ VIEWS[1], noise=2.0)
    points = seen.points.clone().requires_grad_()
    seen = tm.Observation(1.0, points, seen.normals, seen.vertices, noise=seen.noise, view=seen.view)
    solves = []

    def keep(*given):
        solves.append(LastSolve(*given))
        return solves[-1]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("torch_modal.completion.refinement.LastSolve", keep)
        with pytest.warns(tm.MeshWarning, match="gradients of clouds"):
            found = tm.complete(x[::2], faces, [seen], times=[0.0, 2.0, 4.0])
    probe = torch.randn(x[1].shape, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    (slope,) = torch.autograd.grad((found.shapes[0] * probe).sum(), points)
    (same,) = torch.autograd.grad((found(1.0) * probe).sum(), points)
    assert torch.allclose(slope, same, rtol=1e-6, atol=1e-9)

    last, step = solves[-1], 1e-3
    (pairs,), (rests,) = last.points, last.rests(last.x, last.own)
    axes = torch.linalg.lstsq(  # of the solve, from the coordinates of points there and here
        seen.points.detach()[pairs.numbers] - seen.points.detach()[pairs.numbers[0]],
        pairs.points - pairs.points[0],
    ).solution
    scale = float(axes.det()) ** (1 / 3)
    moves = torch.randn(points.shape, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    ends = []
    for sign in (-1, 1):
        springs = copy.copy(pairs)
        springs.points = pairs.points + sign * step * (moves @ axes)[pairs.numbers]
        fine = FineEnergy(Mesh.of(faces, len(x[1])), [part.term for part in last.energy.parts])
        ends.append(fine.relax(last.x, rests, 12 * [200], lambda *_, own=springs: [own]))
    moved = ((ends[1] - ends[0])[0] / (2 * step)) @ axes.mT / scale**2
    assert float((moved * probe).sum()) == pytest.approx(float((slope * moves).sum()), rel=1e-4)


def test_gradients_of_shapes_are_first_ones_only(tube):
    x, faces, _ = tube
    points = x[1, ::9].clone().requires_grad_()
    one = tm.Observation(0.5, points, vertices=torch.arange(0, len(x[1]), 9))
    found = tm.complete(x[::2], faces, (each for each in [one]))  # read once
    with pytest.raises(RuntimeError, match="first derivatives only"):
        torch.autograd.grad(found.shapes.sum(), points, create_graph=True)
    with torch.no_grad():
        again = tm.complete(x[::2], faces, [tm.Observation(0.5, points, vertices=torch.arange(0, len(x[1]), 9))])
    assert not again.shapes.requires_grad
    assert torch.equal(again.shapes, found.shapes)


def test_times_that_are_off_are_estimated(tube):
    x, faces, diagonal = tube
    path, true = tm.Path(x, faces), torch.tensor([0.6, 1.3, 2.7, 3.4], dtype=torch.float64)
    told = (true + torch.tensor([0.3, -0.1, 0.2, -0.3])).tolist()
    shapes, noise = path(x, true), 1e-3 * diagonal
    every = torch.arange(x.shape[1])
    seen = [tm.Observation(t, one, vertices=every, noise=noise) for t, one in zip(told, shapes, strict=True)]
    plain, found = (
        tm.complete(x[::2], faces, seen, times=[0.0, 2.0, 4.0], estimate_times=estimate) for estimate in (False, True)
    )
    assert plain.times.tolist() == told
    assert float((found.times - true).abs().max()) < 0.1
    assert error(found(true), shapes, diagonal) < 0.5 * error(plain(true), shapes, diagonal)


@pytest.mark.parametrize("unit", [1.0, 1000.0])
def test_terms_take_part_in_the_coordinates_of_the_caller(tube, unit):
    x, faces, diagonal = unit * tube[0], tube[1], unit * tube[2]
    seen = [tm.Observation(2.0, x[2, ::5], vertices=torch.arange(x.shape[1])[::5], noise=0.01 * diagonal)]
    target = x[2, 150] + torch.tensor([0.0, 0.0, 0.05]) * diagonal
    plain, pulled = (
        tm.complete(x[[0, 4]], faces, seen, times=[0.0, 4.0], objective=tm.Objective(terms=terms)).shapes[0, 150]
        for terms in ((), (Spring([150], target[None], 1e5),))
    )
    assert float((pulled - target).norm()) < 0.2 * float((plain - target).norm())


def test_fingers_are_pushed_apart():
    pytest.importorskip("igl")
    sample = tm.load_sample("hand")
    rests, faces = sample.keyframes.double(), sample.faces
    crossing = tm.Path(rests, faces)(rests, 0.875)
    seen = [tm.Observation(0.875, crossing[::20], vertices=torch.arange(len(crossing))[::20])]
    plain, apart = (tm.complete(rests, faces, seen, contact=contact) for contact in (False, True))
    assert int(tm.self_contacts(plain.shapes, faces, ignore=rests).n_far) > 20
    assert int(tm.self_contacts(apart.shapes, faces, ignore=rests).n_far) == 0
    assert apart.path.contact
    moved = (apart.shapes - plain.shapes).norm(dim=-1)
    assert float(moved.median()) < 0.02 * float(moved.max()), "more is moved than what touches"
