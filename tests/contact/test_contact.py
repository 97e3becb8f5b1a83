"""In-betweens whose parts do not pass through each other, alone, and their gradients."""

import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from conftest import Shapes
from helpers.contacts import far
from torch import Tensor

import torch_modal as tm
from torch_modal.contact import in_between as contact_layer
from torch_modal.contact import separate
from torch_modal.contact.active import ContactEnergy, Contacts, ContactSearch, Pull
from torch_modal.elastic.energy import RestShapes
from torch_modal.geometry.connectivity import Connectivity
from torch_modal.geometry.crossings import Crossings
from torch_modal.inbetween.results import Samples

pytest.importorskip("igl")
DOUBLE = torch.float64


@pytest.fixture(scope="module")
def fists(data_dir: Path) -> Shapes:
    """A hand that closes to a fist."""
    files = sorted((data_dir / "mh-hand").glob("*.obj"))[1:3]
    keyframes, faces = tm.load_keyframes(files)
    return Shapes(keyframes, faces, tm.extract_bases(keyframes, faces, 20, progress=False))


# ------------------------------------------------------------------------------------------------------------ energies
def test_contact_energy_is_that_of_heights_below_the_gap() -> None:
    x = torch.tensor([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0.2, 0.2, 0]], dtype=DOUBLE).repeat(3, 1, 1)
    x[:, 3, 2] = torch.tensor([-0.1, 0.1, 0.3])
    contacts = Contacts(torch.arange(3), torch.tensor([[0, 1, 2, 3]]).repeat(3, 1))
    energy = ContactEnergy(contacts, torch.tensor([9, 9, 9, 2.0]), x)
    assert energy.value(x).tolist() == pytest.approx([6000 * 0.25**2, 6000 * 0.05**2, 0])
    assert energy.at(x).gradient[:, 3, 2].tolist() == pytest.approx([-12000 * 0.25, -12000 * 0.05, 0])


@pytest.mark.parametrize("kind", ["contact", "pull"])
def test_energies_have_the_derivatives_of_their_values(kind: str, generator: torch.Generator) -> None:
    x, places, field = torch.randn(3, 2, 9, 3, dtype=DOUBLE, generator=generator)
    areas = torch.rand(9, dtype=DOUBLE, generator=generator)
    elements = torch.tensor([[0, 1, 2, 5], [3, 4, 5, 8], [6, 7, 8, 0]]).repeat(2, 1)
    contacts = Contacts(torch.arange(2).repeat_interleave(3), elements)
    energy: Any = ContactEnergy(contacts, areas, x) if kind == "contact" else Pull(places, areas)
    at = energy.at(x)
    torch.testing.assert_close(at.value, energy.value(x))
    gradient, full = torch.func.jvp(torch.func.grad(lambda x: energy.value(x).sum()), (x,), (field,))
    torch.testing.assert_close(at.gradient, gradient)
    if kind == "pull":
        torch.testing.assert_close(at.product(field), full)
    else:  # Gauss-Newton's: along the gradient of each height
        shortfall, heights = energy.shortfall(x)
        rate = (field.view(-1, 3).T[:, energy.corners] * heights.transpose(0, 1)).sum((0, 1))
        curvature = (2 * energy.weights * (shortfall < 0) * rate**2).sum()
        torch.testing.assert_close((at.product(field) * field).sum(), curvature)
    unit = torch.zeros_like(x)
    unit[0, 5, 0] = 1
    torch.testing.assert_close(at.diagonal[0, 5, 0], at.product(unit)[0, 5, 0])


# --------------------------------------------------------------------------------------------------------------- layer
def test_layer_pushes_fingers_apart(hand: Shapes) -> None:
    x_a, x_b = hand.keyframes
    t = torch.tensor([0.25, 0.875], dtype=DOUBLE)
    with torch.no_grad():
        plain = tm.InBetween(hand.bases, hand.faces)(x_a, x_b, t)
        layer = tm.InBetween(hand.bases, hand.faces, contact=True)
        shapes, solution, *_ = layer.solve(x_a, x_b, t)
    before = far(plain, hand)
    assert int(before[0]) == 0 and int(before[1]) > 20
    assert solution.n_crossing is not None and solution.n_crossing.tolist() == far(shapes, hand).tolist() == [0, 0]
    assert bool(solution.usable.all())
    # What does not touch is what it is without contact; what does is bent no more than it has to.
    assert torch.equal(shapes[0], plain[0])
    shell = tm.ShellEnergy(hand.faces)
    scale = 100 / float((x_a.amax(0) - x_a.amin(0)).norm())

    def energy(x: Tensor) -> float:
        return float(torch.lerp(shell(scale * x, scale * x_a), shell(scale * x, scale * x_b), t[1]))

    assert energy(shapes[1]) < 1.06 * energy(plain[1])


def test_gradients_are_exact_with_the_set_held(hand: Shapes, monkeypatch: pytest.MonkeyPatch) -> None:
    x_a, x_b = hand.keyframes
    layer = tm.InBetween(hand.bases, hand.faces, contact=True)
    search = ContactSearch.__call__
    found: list[Any] = []
    calls = 0

    def kept(*given: Any) -> Any:
        nonlocal calls
        if calls == len(found):
            found.append(search(*given))
        calls += 1
        return found[calls - 1]

    monkeypatch.setattr(ContactSearch, "__call__", kept)

    def shape(x_a: Tensor, x_b: Tensor, t: Tensor) -> Tensor:
        nonlocal calls
        calls = 0
        mu, stiffness = torch.ones_like(t), layer.stiffness_of(t, t.shape)
        samples = Samples(torch.stack([x_a, x_b])[None], torch.stack([1 - t, t], -1), mu, stiffness)
        return layer.core(samples).shapes[0]

    given = [x_a.clone(), x_b.clone(), torch.tensor([0.875], dtype=DOUBLE)]
    for tensor in given:
        tensor.requires_grad_()
    shapes = shape(*given)
    assert len(found) >= separate.SEPARATION_ROUNDS[0] and len(found[0][0].shapes) > 10
    weights = torch.cos(7 * x_a)
    gradients = torch.autograd.grad((shapes * weights).sum(), given)
    direction = 0.01 * torch.sin(9 * x_a + 1)

    def value(*arguments: Tensor) -> float:
        moved = [argument.clone().requires_grad_() for argument in arguments]  # as if for a gradient: to the tolerance
        return float((shape(*moved).detach() * weights).sum())

    at = [tensor.detach() for tensor in given]
    # Small: where a contact becomes active, the steps jump.
    for which, moved, size in ((0, direction, 1e-5), (1, direction, 1e-5), (2, torch.ones(1, dtype=DOUBLE), 1e-7)):
        up, down = (
            value(*(x + sign * size * moved if i == which else x for i, x in enumerate(at))) for sign in (1, -1)
        )
        assert float((gradients[which] * moved).sum()) == pytest.approx((up - down) / (2 * size), rel=1e-5)


def test_key_frames_exchanged(data_dir: Path) -> None:
    """The same shape, as without contact: no length is measured in the first key-frame."""
    (a, b), faces = tm.load_keyframes([data_dir / "mh-hand" / f"{name}.obj" for name in ("00-open", "02-fist")])
    one, other = (tm.InBetween(x, faces, contact=True) for x in ([a, b], [b, a]))
    found = one(a, b, 0.75)
    assert float((found - tm.InBetween([a, b], faces)(a, b, 0.75)).abs().max()) > 0.01, "contacts"
    torch.testing.assert_close(other(b, a, 0.25), found, rtol=0, atol=1e-9)


@pytest.fixture(scope="module")
def frogs(data_dir: Path) -> Shapes:
    """Poses of a frog whose limbs lie deep in each other on the way."""
    clips = np.load(data_dir / "animals" / "frog.npz")
    keyframes = torch.from_numpy(clips["frames"][[35, 46, 50, 52]].astype(np.float64))
    faces = torch.from_numpy(clips["faces"].astype(np.int64))
    return Shapes(keyframes, faces, tm.extract_bases(keyframes, faces, 30, mesher="lattice", progress=False))


def deepest(x: Tensor, shapes: Shapes) -> float:
    """How deep the contacts of a shape are: of vertices, and of triangles that cross."""
    found = tm.self_contacts(x, shapes.faces, ignore=shapes.keyframes)
    crossings = Crossings(Connectivity(shapes.faces.numpy()), shapes.keyframes.numpy())
    return max(float(found.depth.max()), crossings.reach(x.numpy(), found.pairs[found.far].numpy()))


@pytest.mark.parametrize(
    ("pair", "times"), [((0, 1), [0.051, 0.677]), ((1, 2), [0.507, 0.538]), ((1, 3), [0.583, 0.627])]
)
def test_a_shape_is_never_made_worse(frogs: Shapes, pair: tuple[int, int], times: list[float]) -> None:
    shapes, t = frogs.pick(*pair), torch.tensor(times, dtype=DOUBLE)
    x_a, x_b = shapes.keyframes
    with torch.no_grad():
        plain = tm.InBetween(shapes.bases, shapes.faces)(x_a, x_b, t)
        pushed, solution = tm.InBetween(shapes.bases, shapes.faces, contact=True).solve(x_a, x_b, t)[:2]
    before, after = far(plain, shapes), far(pushed, shapes)
    assert int(before.max()) > 0
    assert bool((after <= before).all())
    assert solution.n_crossing.tolist() == after.tolist()
    gap = 0.0016 * float((x_a.amax(0) - x_a.amin(0)).norm())
    for x, y in zip(plain, pushed, strict=True):
        assert float((y - x).norm(dim=-1).max()) <= 3 * (deepest(x, shapes) + gap)


def test_a_push_that_moves_too_much_is_not_kept(hand: Shapes, monkeypatch: pytest.MonkeyPatch) -> None:
    x_a, x_b = hand.keyframes
    layers = [tm.InBetween(hand.bases, hand.faces, contact=contact) for contact in (False, True)]
    monkeypatch.setattr(separate, "MOST_MOVED", 1e-3)
    with torch.no_grad():
        plain = layers[0](x_a, x_b, 0.875)
        kept, solution = layers[1].solve(x_a, x_b, 0.875)[:2]
    torch.testing.assert_close(kept, plain, rtol=0, atol=1e-12)
    assert int(solution.n_crossing) == int(far(plain, hand)) > 0


def test_the_round_with_the_fewest_crossings_is_kept(hand: Shapes, monkeypatch: pytest.MonkeyPatch) -> None:
    layer = tm.InBetween(hand.bases, hand.faces, contact=True)
    steps, taken = contact_layer._steps, []

    def worsening(*given: Any) -> Any:
        step = steps(*given)

        def relax(x: Tensor, some: Tensor, beside: Any) -> Tensor:
            # Most of a push first; then back to the shape without contact.
            taken.append(x)
            n = len(taken) - separate.SEPARATION_ROUNDS[0]
            return step(x, some, beside) if n < 0 else x if n == 0 else taken[0]

        return relax

    monkeypatch.setattr(contact_layer, "_steps", worsening)
    with torch.no_grad():
        shape, solution = layer.solve(*hand.keyframes, 0.875)[:2]
        plain = tm.InBetween(hand.bases, hand.faces)(*hand.keyframes, 0.875)
    assert len(taken) > separate.SEPARATION_ROUNDS[0]
    assert int(solution.n_crossing) == int(far(shape, hand)) < int(far(plain, hand))


def test_a_sample_does_not_depend_on_its_batch(hand: Shapes) -> None:
    x_a, x_b = hand.keyframes
    t = torch.tensor([0.7, 0.875, 0.1, 0.9], dtype=DOUBLE)
    layer = tm.InBetween(hand.bases, hand.faces, contact=True)
    size = float((x_a.amax(0) - x_a.amin(0)).norm())
    with torch.no_grad():
        alone = torch.stack([layer(x_a, x_b, own) for own in t])
        batches = [
            layer(x_a.expand(4, -1, -1), x_b.expand(4, -1, -1), t),
            layer(x_a, x_b, t),
            torch.cat([layer(x_a, x_b, some) for some in t.split(3)]),
        ]
        twice = layer(x_a, x_b, t[[1, 1]])
        noise = size * 1e-13 * torch.cos(1e4 * hand.keyframes)
        moved = torch.stack([layer(x_a + noise[0], x_b + noise[1], own) for own in t])
        plain = tm.InBetween(hand.bases, hand.faces)(x_a, x_b, t)
    assert int(((alone - plain).abs().amax((1, 2)) > 1e-3 * size).sum()) >= 2  # these were pushed apart
    for found in batches:
        assert float((found - alone).norm(dim=-1).max()) < 1e-12 * size
    assert torch.equal(twice[0], twice[1])
    assert float((moved - alone).norm(dim=-1).max()) < 1e-6 * size


def test_contacts_of_earlier_rounds_stay_active(fists: Shapes) -> None:
    """Without them, six pairs are left: what was pushed out of reach falls back."""
    with torch.no_grad():
        _, solution, *_ = tm.InBetween(fists.bases, fists.faces, contact=True).solve(*fists.keyframes, 0.66)
    assert int(solution.n_crossing) == 0


def test_edges_that_cross_beside_all_vertices_come_apart(data_dir: Path) -> None:
    """Thumb and palm of long triangles: with the gap of the first rounds kept, 4, 4 and 8 pairs stay."""
    keyframes, faces = tm.load_keyframes([data_dir / "mh-hand-path" / f"0{i}.obj" for i in (4, 8)])
    hand = Shapes(keyframes, faces, tm.extract_bases(keyframes, faces, 30, mesher="lattice", progress=False))
    t = torch.tensor([0.1875, 0.4375, 0.5], dtype=DOUBLE)
    with torch.no_grad():
        plain = tm.InBetween(hand.bases, faces)(*keyframes, t)
        pushed = tm.InBetween(hand.bases, faces, contact=True)(*keyframes, t)
    assert int(far(plain, hand).min()) > 30 and far(pushed, hand).tolist() == [0, 0, 0]


def test_what_contact_needs_is_said_before_any_work(hand: Shapes, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(ValueError, match="one shape for each in-between"):
        tm.Objective(space="paired", contact=True)
    monkeypatch.setitem(sys.modules, "igl", None)
    for make in (
        lambda: tm.InBetween(hand.bases, hand.faces, contact=True),
        lambda: tm.Path(hand.bases, hand.faces, contact=True),
        lambda: tm.ShapeSpace(hand.bases, hand.faces, contact=True),
        lambda: tm.subdivide(hand.keyframes, hand.faces, contact=True),
    ):
        with pytest.raises(ImportError, match=r"contact needs igl.*torch_modal\[contact\]"):
            make()


# ------------------------------------------------------------------------------------------------ steps of each shape
def test_kernels_and_torch_step_alike(hand: Shapes) -> None:
    pytest.importorskip("warp")
    t = torch.tensor([0.2, 0.875], dtype=DOUBLE)  # no parts meet in the first shape
    weights, results = torch.stack([1 - t, t], -1), []
    for backend in ("torch", "warp"):
        layer = tm.InBetween(hand.bases, hand.faces, solver=tm.Solver(backend=backend))
        core = layer.core
        shapes, pose, _ = core.alignment(hand.keyframes.expand(2, -1, -1, -1), weights)
        x = core.alignment.to_frame(layer(*hand.keyframes, t), pose)
        search = contact_layer.contact_search(core, shapes[0], 2)
        active, _ = search(x, torch.arange(2))
        assert active.shapes.unique().tolist() == [1]
        # One shape is free, the other has contacts, and a corner of both is pulled elsewhere.
        distance = (x[0] - x[0].amin(0)).norm(dim=-1)
        corner = distance <= distance.kthvalue(40).values
        pull = Pull(x + torch.tensor([0.5, 0, 0], dtype=DOUBLE), 40.0 * corner * search.areas)
        steps = contact_layer._steps(core, RestShapes(shapes, weights, layer.stiffness_of(t, t.shape)))

        def beside(
            some: slice, like: Tensor, active: Contacts = active, pull: Pull = pull, areas: Tensor = search.areas
        ) -> list[ContactEnergy | Pull]:
            contact = ContactEnergy(active.rows(torch.arange(2)[some]), areas, like)
            return [contact, Pull(pull.to[some].to(like), pull.weights.to(like))]

        y = x
        for _ in range(2):
            y = steps(y, torch.arange(2), beside)
        contact = ContactEnergy(active, search.areas, x)
        before, pushed = (contact.value(z.contiguous()) for z in (x, y))
        assert float(pushed[0]) == 0 and float(pushed[1]) < 0.3 * float(before[1])
        assert bool((pull.value(y) < 0.5 * pull.value(x)).all())
        results.append(y)
    torch.testing.assert_close(*results, rtol=0, atol=1e-6)
