"""The shell energy as a loss: units, refinement, gradients, errors."""

import pytest
import torch
import trimesh
from conftest import Shapes
from torch import Tensor

import torch_modal as tm
from torch_modal.data.samples import load_sample
from torch_modal.geometry.rotations import exp

DOUBLE = torch.float64


def noisy(x: Tensor, generator: torch.Generator, size: float = 0.02) -> Tensor:
    return x + size * torch.randn(x.shape, generator=generator, dtype=DOUBLE)


@pytest.mark.parametrize("name", ["hand", "creature"])
def test_units_and_poses_change_nothing(name: str) -> None:
    sample = load_sample(name)
    loss = tm.losses.ShellLoss(sample.faces)
    a, b = sample.keyframes[:2]
    turn = exp(torch.tensor([0.4, -1.1, 0.3], dtype=DOUBLE))
    expected = float(loss(b, a))
    assert expected > 1e-3
    assert float(loss(1000 * b, 1000 * a)) == pytest.approx(expected, rel=1e-9)
    assert float(loss(b @ turn.mT + 5, a - 3)) == pytest.approx(expected, rel=1e-9)
    assert float(loss(a @ turn.mT, a)) < 1e-20
    single = tm.losses.ShellLoss(sample.faces).to(torch.float32)
    small = 1e-3 * b.float(), 1e-3 * a.float()
    assert float(single(*small)) == pytest.approx(expected, rel=1e-3)
    assert float(single.terms_of(*small).bend) == pytest.approx(float(loss.terms_of(b, a).bend), rel=1e-3)


@pytest.mark.parametrize("name", ["hand", "creature"])
def test_a_refined_mesh_has_the_same_value(name: str) -> None:
    sample = load_sample(name)
    a, b = (x.numpy() for x in sample.keyframes[:2])
    faces = sample.faces.numpy()
    coarse = tm.losses.ShellLoss(sample.faces).terms_of(sample.keyframes[1], sample.keyframes[0])

    def refined(subdivide: object) -> tm.losses.ShellTerms:
        (x, own), (y, _) = (subdivide(x, faces) for x in (a, b))  # type: ignore[operator]
        return tm.losses.ShellLoss(torch.from_numpy(own)).terms_of(torch.from_numpy(y), torch.from_numpy(x))

    smooth = refined(lambda x, f: trimesh.remesh.subdivide_loop(x, f, 1))
    assert float(smooth.stretch) == pytest.approx(float(coarse.stretch), rel=0.02)
    assert float(smooth.bend) == pytest.approx(float(coarse.bend), rel=0.05)
    cut = refined(trimesh.remesh.subdivide)
    assert float(cut.stretch) == pytest.approx(float(coarse.stretch), rel=1e-9)
    assert float(cut.bend) == pytest.approx(2 * float(coarse.bend), rel=1e-9)


def test_terms_are_what_they_are_said_to_be(bars: Shapes) -> None:
    loss = tm.losses.ShellLoss(bars.faces, alpha=3.0, beta=0.5, gamma=2.0)
    x = bars.keyframes[0]
    terms = loss.terms_of(1.1 * x, x)
    assert float(terms.stretch) == pytest.approx(0.01)
    assert float(terms.bend) < 1e-20
    assert float(terms.volume) == pytest.approx((1.1**3 - 1) ** 2)
    assert float(loss(1.1 * x, x)) == pytest.approx(3 * 0.01 + 2 * (1.1**3 - 1) ** 2)


def test_open_surfaces_have_no_volume(generator: torch.Generator) -> None:
    n = torch.linspace(0, 1, 6, dtype=DOUBLE)
    x = torch.stack([*torch.meshgrid(n, n, indexing="ij"), torch.zeros(6, 6, dtype=DOUBLE)], -1).view(-1, 3)
    i = torch.arange(30).view(5, 6)[:, :5].flatten()
    faces = torch.cat([torch.stack([i, i + 6, i + 1], 1), torch.stack([i + 1, i + 6, i + 7], 1)])
    loss = tm.losses.ShellLoss(faces)
    bent = x + torch.tensor([0.0, 0.0, 0.3]) * (x[:, :1] - 0.5) ** 2
    terms = loss.terms_of(bent, x)
    assert float(terms.volume) == 0 and float(loss(bent, x)) < 0.02
    assert bool(loss(noisy(x, generator), x).isfinite())


def test_gradients_and_double_backward(small_bars: Shapes, generator: torch.Generator) -> None:
    loss = tm.losses.ShellLoss(small_bars.faces, beta=0.01, gamma=0.1)
    leaves = [noisy(small_bars.keyframes[k], generator).requires_grad_() for k in (1, 0)]
    assert torch.autograd.gradcheck(loss, leaves, fast_mode=True)
    assert torch.autograd.gradgradcheck(loss, leaves, fast_mode=True)


def test_batches_broadcast(bars: Shapes, generator: torch.Generator) -> None:
    loss = tm.losses.ShellLoss(bars.faces)
    x = noisy(bars.keyframes[[0, 1]].repeat(2, 1, 1), generator).view(2, 2, -1, 3)
    found = loss(x, bars.keyframes[2])
    assert found.shape == (2, 2)
    torch.testing.assert_close(found[1, 0], loss(x[1, 0], bars.keyframes[2]))


def test_shapes_without_extent_have_finite_gradients(bars: Shapes) -> None:
    loss = tm.losses.ShellLoss(bars.faces)
    for x, rest in ((0 * bars.keyframes[0], bars.keyframes[0]), (bars.keyframes[0], 0 * bars.keyframes[0])):
        leaf = x.clone().requires_grad_()
        loss(leaf, rest).backward()
        assert leaf.grad is not None and bool(leaf.grad.isfinite().all())


@pytest.mark.parametrize("shape", [(163, 3), (5, 164), (164, 3, 1)])
def test_other_shapes(bars: Shapes, shape: tuple[int, ...]) -> None:
    loss = tm.losses.ShellLoss(bars.faces)
    with pytest.raises(ValueError, match="164 vertices that the faces name"):
        loss(torch.zeros(shape), bars.keyframes[0])


@pytest.mark.parametrize("height", [1.0, 0.1])
def test_thin_bodies_have_a_volume(height: float) -> None:
    """That of a pancake is a hundredth of a sphere's for its area, and its changes count in full."""
    ball = trimesh.creation.icosphere(3)
    rest = torch.from_numpy(ball.vertices.copy()) * torch.tensor([1.0, 1.0, height])
    terms = tm.losses.ShellLoss(torch.from_numpy(ball.faces.copy())).terms_of(1.1 * rest, rest)
    assert float(terms.volume) == pytest.approx((1.1**3 - 1) ** 2)


def test_stiffnesses_are_about_the_papers() -> None:
    """At a size of 100, bending has about the same part of the energy as in Eq. 5."""
    sample = load_sample("hand")
    a, b = sample.keyframes[:2]
    scale = 100 / float((a.amax(0) - a.amin(0)).norm())
    bends, stretches = (
        [float(kind(sample.faces, **none)(scale * b, scale * a)) for kind in (tm.losses.ShellLoss, tm.ShellEnergy)]
        for none in ({"alpha": 0.0, "gamma": 0.0}, {"beta": 0.0, "gamma": 0.0})
    )
    parts = [bend / stretch for bend, stretch in zip(bends, stretches, strict=True)]
    assert 1 / 3 < parts[0] / parts[1] < 3
