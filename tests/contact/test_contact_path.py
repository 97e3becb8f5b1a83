"""In-betweens along a trajectory, whose parts do not pass through each other: smooth in time."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from conftest import Shapes
from helpers.contacts import far, peak_acceleration
from scipy.integrate import quad
from scipy.interpolate import CubicSpline
from scipy.optimize import minimize
from torch import Tensor

import torch_modal as tm
from torch_modal.contact import in_between as contact_layer
from torch_modal.contact import modal, separate
from torch_modal.contact.acceleration import AccelerationLimit
from torch_modal.contact.active import ContactEnergy, Contacts, ContactSearch, Pull
from torch_modal.contact.separate import spline_weights
from torch_modal.elastic.backend import TorchBackend
from torch_modal.geometry.connectivity import Connectivity
from torch_modal.motion import path as path_module

pytest.importorskip("igl")
DOUBLE = torch.float64


# ---------------------------------------------------------------------------------------------------------------- paths
@pytest.mark.parametrize(("keys", "levels", "least"), [((0, 1), 5, 6), ((0, 1, 0), 3, 4)], ids=["pair", "smooth"])
def test_trajectory_is_free_of_crossings_and_does_not_pop(
    hand: Shapes, keys: tuple[int, ...], levels: int, least: int
) -> None:
    own = hand.pick(*keys)
    plain, frames = (
        tm.subdivide(own.keyframes, hand.faces, levels, contact=contact, bases=own.bases, progress=False)
        for contact in (False, True)
    )
    assert int((far(plain, hand) > 0).sum()) >= least
    assert int(far(frames, hand).sum()) == 0
    assert torch.equal(frames[[0, -1]], own.keyframes[[0, -1]])
    assert peak_acceleration(frames) < 1.3 * peak_acceleration(plain)


def test_path_takes_any_time(hand: Shapes) -> None:
    path = tm.Path(hand.bases, hand.faces, contact=True)
    t = torch.tensor([0.1, 0.86, 0.9, 1.0], dtype=DOUBLE)
    with torch.no_grad():
        shapes, solution, *_ = path.solve(hand.keyframes, t)
        alone = path(hand.keyframes, 0.9)
    assert int(far(shapes, hand).sum()) == 0
    assert int(solution.n_crossing.sum()) == 0
    torch.testing.assert_close(alone, shapes[2], rtol=0, atol=1e-6)  # the time alone says what a shape is
    assert torch.equal(shapes[3], hand.keyframes[1])


def test_nothing_changes_where_nothing_touches(bars: Shapes) -> None:
    pair = bars.pick(0, 1)
    found = tm.subdivide(pair.keyframes, pair.faces, 2, bases=pair.bases, contact=True, progress=False)
    plain = tm.Path(pair.bases, pair.faces)(pair.keyframes, torch.linspace(0, 1, 5))
    torch.testing.assert_close(found, plain, rtol=0, atol=1e-12)


def with_crossed_fingers(hand: Shapes) -> Tensor:
    """The tip of the little finger goes into its neighbour, in the open hand. *Shape:* ``(2, V, 3)``."""
    crossed = hand.keyframes.clone()
    reach = (crossed[0] - crossed[0, crossed[0, :, 0].argmin()]).norm(dim=-1)
    crossed[0, :, 0] += 0.22 * torch.exp(-((reach / 0.12) ** 2))
    return crossed


def test_crossings_of_keyframes_are_said_and_stay(hand: Shapes) -> None:
    crossed = with_crossed_fingers(hand)
    both = Shapes(crossed, hand.faces, hand.bases)
    pairs = int(tm.self_contacts(crossed[0], hand.faces).number)
    assert pairs > 10
    options = {"levels": 3, "bases": hand.bases, "progress": False}
    plain = tm.subdivide(crossed, hand.faces, **options)
    with pytest.warns(tm.MeshWarning, match=f"key-frame 0 passes through itself: {pairs} pairs") as told:
        frames = tm.subdivide(crossed, hand.faces, contact=True, **options)
    assert {one.filename for one in told} == {__file__}  # where it was called
    assert int(far(frames, both).sum()) <= int(far(plain, both).sum())
    assert peak_acceleration(frames) < 1.3 * peak_acceleration(plain)
    assert torch.equal(frames[[0, -1]], crossed)


@pytest.mark.parametrize("order", [(0, 1), (1, 0)], ids=["first", "last"])
def test_what_crosses_in_either_keyframe_is_not_counted_beside_it(hand: Shapes, order: tuple[int, int]) -> None:
    both = Shapes(with_crossed_fingers(hand), hand.faces, hand.bases).pick(*order)
    path = tm.Path(both.bases, both.faces, contact=True)
    with torch.no_grad():
        shapes, solution, *_ = path.solve(both.keyframes, abs(order[0] - torch.tensor([0.02, 0.1], dtype=DOUBLE)))
    assert bool((tm.self_contacts(shapes, both.faces).number > 10).all())
    assert torch.equal(solution.n_crossing, far(shapes, both)) and int(solution.n_crossing[0]) == 0


def test_in_betweens_that_still_cross_are_counted(hand: Shapes, monkeypatch: pytest.MonkeyPatch) -> None:
    """Shapes, not pairs of triangles."""
    monkeypatch.setattr(contact_layer, "separate", lambda x, relax, search, *others: (x, search.count(x)))
    with pytest.warns(tm.MeshWarning) as told:
        frames = tm.subdivide(hand.keyframes, hand.faces, 3, contact=True, bases=hand.bases, progress=False)
    crossing = far(frames, hand)
    assert 0 < int((crossing > 0).sum()) < int(crossing.sum())
    message = f"in {int((crossing > 0).sum())} of 7 in-betweens, parts still go through each other"
    assert any(message in str(one.message) for one in told)


def test_in_betweens_of_a_space_have_no_crossings(hand: Shapes) -> None:
    space = tm.ShapeSpace(hand.bases, hand.faces, contact=True)
    draw = tm.RandomInBetween(p=1.0, space=space, generator=torch.Generator().manual_seed(0))
    assert int(far(draw(hand.keyframes[[0, 1] * 3]), hand).sum()) == 0


def test_pairs_that_a_displacement_adds_in_between_are_counted(hand: Shapes, monkeypatch: pytest.MonkeyPatch) -> None:
    push_apart = path_module.push_apart

    def folding(core: Any, x: Tensor, u: Tensor, *given: Any) -> contact_layer.Displacement:
        """One half of the hand onto the other."""
        side = x[..., 0] - x[..., 0].mean(-1, keepdim=True)
        field = torch.zeros_like(x)
        field[..., 0] = -2 * side.clamp_min(0)
        return push_apart(core, x, u, *given)._replace(field=field)

    t = torch.tensor([0.3, 0.45], dtype=DOUBLE)
    with torch.no_grad():
        plain = tm.Path(hand.bases, hand.faces)(hand.keyframes, t)
        monkeypatch.setattr(path_module, "push_apart", folding)
        folded, solution = tm.Path(hand.bases, hand.faces, contact=True).solve(hand.keyframes, t)[:2]
    after = far(folded, hand)
    assert bool((after > far(plain, hand)).all()) and solution.n_crossing.tolist() == after.tolist()


@pytest.mark.slow
def test_few_shapes_stay_beside_keyframes_that_intersect_themselves(data_dir: Path) -> None:
    """Shapes that contact would make worse stay nearly as they are; the others are separated all the same.

    Between the times that are searched, the displacement is as smooth as at these, and what it leaves is counted.
    """
    keyframes, faces = tm.load_keyframes([data_dir / f"mh-hand/{name}.obj" for name in ("02-fist", "04-spread")])
    own = Shapes(keyframes, faces, tm.extract_bases(keyframes, faces, 30, progress=False))
    t = torch.linspace(0, 1, 97, dtype=DOUBLE)
    with torch.no_grad():
        plain = tm.Path(own.bases, faces)(keyframes, t)
        pushed, solution, *_ = tm.Path(own.bases, faces, contact=True).solve(keyframes, t)
    before, after = far(plain, own), far(pushed, own)
    assert solution.n_crossing.tolist() == after.tolist()
    assert bool((after <= before)[::3].all())
    for some in (slice(None), slice(None, None, 3)):
        assert int(after[some].sum()) <= 0.32 * int(before[some].sum())
    assert peak_acceleration(pushed[::3]) < 1.3 * peak_acceleration(plain[::3])
    # Not of the shapes, which jump without contact, too. It was 90 and 40 times as much with jumps.
    displacement = pushed - plain
    assert 9 * peak_acceleration(displacement) < 2 * peak_acceleration(displacement[::3])


# ---------------------------------------------------------------------------------------------- times and accelerations
def test_values_in_time_lie_on_a_curve_through_them() -> None:
    times = torch.tensor([0.2, 0.5, 0.6, 0.9], dtype=DOUBLE)
    torch.testing.assert_close(spline_weights(times, times), torch.eye(4, dtype=DOUBLE))
    assert float(spline_weights(times, torch.tensor([0.0, 1.0], dtype=DOUBLE)).abs().max()) < 1e-15
    t = torch.linspace(0, 1, 1001, dtype=DOUBLE)
    line = spline_weights(times, t) @ torch.sin(torch.pi * times)
    torch.testing.assert_close(line, torch.sin(torch.pi * t), rtol=0, atol=0.02)
    at = torch.tensor([0.3], dtype=DOUBLE, requires_grad=True)
    (slope,) = torch.autograd.grad(spline_weights(times, at) @ torch.sin(torch.pi * times), at)
    assert float(slope) == pytest.approx(float((line[301] - line[299]) * 500), rel=1e-4)


def unlimited(n: int, n_vertices: int, most: float = 10.0) -> AccelerationLimit:
    """A trajectory at rest, with a limit of accelerations between frames."""
    limit = AccelerationLimit(
        torch.zeros(n + 2, n_vertices, 3, dtype=DOUBLE), torch.eye(3, dtype=DOUBLE).repeat(n, 1, 1)
    )
    limit.most = most
    return limit


def test_a_displacement_is_reduced_where_it_makes_shapes_worse() -> None:
    n = 15
    field = torch.ones(n, 2, 3, dtype=DOUBLE)

    class Fake:
        def __init__(self, worse: list[int]) -> None:
            self.worse = worse

        def count(self, x: Tensor) -> Tensor:
            moved = x.abs().amax((1, 2)) > 1e-9
            return torch.tensor([3 if i in self.worse and moved[i] else 1 + 1 * ~moved[i] for i in range(n)])

    for worse in ([], [7], [3, 4], list(range(n))):
        fake: Any = Fake(worse)
        found, n_far = separate._never_worse(torch.zeros_like(field), field, fake, unlimited(n, 2), torch.full((n,), 2))
        assert bool((n_far <= 2).all()) and float(found[worse].abs().sum()) == 0
        assert float(found[12].min()) == (len(worse) < n)


def test_shapes_beside_keyframes_that_intersect_themselves_all_take_steps() -> None:
    t = torch.arange(1, 64, dtype=DOUBLE) / 64
    for pairs, some in (([], [1]), ([(0, 1)], range(1, 8))):
        search: Any = SimpleNamespace(search=SimpleNamespace(known_pairs=pairs))
        wanted = {*range(4, 64, 4), *some, *(64 - i for i in some)}
        assert separate._choose_shapes(t, search).tolist() == [i - 1 for i in sorted(wanted)]


def test_neighbours_in_time_are_watched_on_either_side(hand: Shapes) -> None:
    search = ContactSearch(TorchBackend(), Connectivity(hand.faces.numpy()), hand.keyframes, hand.keyframes[0], 9)
    search.watch(Contacts(torch.tensor([4]), hand.faces[:1, [0, 1, 2, 0]]), 2)
    rings = search.search.grow(hand.faces[0].numpy(), 2)
    assert 3 < rings.sum() < 100
    assert [bool((row == rings).all()) for row in search.watched] == [2 <= i <= 6 for i in range(9)]


def test_the_first_displacement_is_smooth_as_its_integral_says(generator: torch.Generator) -> None:
    """Forces on one mode at four times, and springs: the minimum with the squared acceleration by quadrature."""
    n, times = 400, torch.tensor([0.2, 0.4, 0.5, 0.8], dtype=DOUBLE)
    mode, x = torch.randn(2, 1, 5, 3, dtype=DOUBLE, generator=generator)
    masses = torch.rand(5, dtype=DOUBLE, generator=generator)
    slope, springs = torch.randn(4, 1, dtype=DOUBLE, generator=generator), torch.tensor([5.0, 1, 2, 3], dtype=DOUBLE)
    spline = spline_weights(times, torch.linspace(0, 1, n + 1, dtype=DOUBLE))
    nothing = Contacts(torch.zeros(0, dtype=torch.int64), torch.zeros(0, 4, dtype=torch.int64))
    shapes = x.expand(4, -1, -1).contiguous()
    energy = ContactEnergy(nothing, masses, shapes)
    given: Any = slope, springs[:, None, None], shapes, energy, spline[2:] - 2 * spline[1:-1] + spline[:-2]
    found = modal.modal_displacement(mode, masses, *given)
    knots = np.array([0, 0.2, 0.4, 0.5, 0.8, 1])
    rates = CubicSpline(knots, np.eye(6)[:, 1:-1], bc_type="natural").derivative(2)
    bend = [
        [quad(lambda t, i=i, j=j: rates(t)[i] * rates(t)[j], 0, 1, points=knots[1:-1])[0] for i in range(4)]
        for j in range(4)
    ]
    inertia = float((masses * mode[0].square().sum(-1)).sum())
    hessian = torch.diag(springs) + 2 * modal.SMOOTHNESS * inertia * torch.tensor(bend, dtype=DOUBLE)
    amplitudes = torch.linalg.solve(hessian, -slope)
    torch.testing.assert_close(
        found, amplitudes[:, :, None] * mode, rtol=0.02, atol=1e-4 * float(amplitudes.abs().max())
    )


@pytest.mark.parametrize("goes_on", [(False, False), (True, False), (False, True), (True, True)])
def test_each_side_has_half_of_the_room_at_a_keyframe(goes_on: tuple[bool, bool]) -> None:
    """Where the motion goes on, twice the displacement beside it is within the bound, added to the acceleration."""
    x = torch.zeros(4, 1, 3, dtype=DOUBLE)
    x[[0, 3], 0, 0] = torch.tensor([0.4, 0.2], dtype=DOUBLE)
    turn = torch.tensor([[0, -1, 0], [1, 0, 0], [0, 0, 1]], dtype=DOUBLE)  # the viewer sees -y as x
    limit = AccelerationLimit(x, turn.repeat(2, 1, 1), goes_on)
    limit.most = 1.0
    found, limited = limit.nearest(torch.tensor([0, -0.7, 0], dtype=DOUBLE).expand(2, 1, 3))
    assert len(limited) == any(goes_on)  # |0.4 - 2 * 0.7 + 0.7| and |0.2 + 0.7 - 2 * 0.7| are below 1
    for side, bounded in zip((0.4 - 2 * found[0, 0, 1], 0.2 - 2 * found[1, 0, 1]), goes_on, strict=True):
        assert float(side) < 1.011 or not bounded
    assert float(found[:, 0, 1].max()) < -0.1 and float(found[..., [0, 2]].abs().max()) < 1e-9


def test_shapes_rest_as_far_as_accelerations_allow(generator: torch.Generator, monkeypatch: pytest.MonkeyPatch) -> None:
    """Shapes on springs of different stiffness, held below the limit: SciPy finds the same rest."""
    n, places = 7, 2 * torch.randn(7, 3, 3, dtype=DOUBLE, generator=generator)
    springs = torch.tensor([1.0, 30, 1, 5, 1, 0.2, 3], dtype=DOUBLE)[:, None, None]

    class Fake:
        areas, n_far = torch.ones(3, dtype=DOUBLE), 99
        search = SimpleNamespace(known_pairs=[])

        def __call__(self, x: Tensor, some: Tensor) -> tuple[Contacts, Tensor]:
            self.n_far -= 1  # the last is the best
            return Contacts(some[:1], torch.tensor([[0, 1, 2, 0]])), torch.full((len(some),), self.n_far)

        def count(self, x: Tensor) -> Tensor:
            return 1 * (x == 0).all(2).all(1)

        def watch(self, *_: Any) -> None:
            """Nothing."""

    def relax(x: Tensor, some: Tensor, beside: Any) -> Tensor:
        pulls = [energy for energy in beside(slice(None), x) if isinstance(energy, Pull)]
        found: Tensor = springs * places + sum(pull.weights[:, None] * pull.to for pull in pulls)
        return found / (springs + sum(pull.weights[:, None] for pull in pulls))

    monkeypatch.setattr(separate, "SEPARATION_ROUNDS", (4, 90))
    monkeypatch.setattr(separate, "PULL", 3.0)
    fake, trajectory = Fake(), unlimited(n, 3, 1.0)
    given: Any = torch.zeros_like(places), relax, fake, trajectory
    x, _ = separate.separate(*given)
    differences = trajectory.differences.numpy()
    for v in range(3):
        best = minimize(
            lambda d, v=v: float((springs[:, 0].numpy() * (d.reshape(n, 3) - places[:, v].numpy()) ** 2).sum()),
            np.zeros(3 * n),
            constraints={"type": "ineq", "fun": lambda d: 1 - ((differences @ d.reshape(n, 3)) ** 2).sum(1)},
            method="SLSQP",
            options={"maxiter": 500},
        )
        np.testing.assert_allclose(x[:, v].numpy(), best.x.reshape(n, 3), rtol=0, atol=0.03)
