"""Eq. 5 against numbers worked out by hand, against its invariances, and against finite differences."""

import math
from typing import Any

import numpy as np
import pytest
import torch
from conftest import Shapes
from helpers.solids import box, surface
from torch import Tensor
from torch.autograd import gradcheck

from torch_modal.elastic.bend import Bend, wrap_angle
from torch_modal.elastic.shell import ShellEnergy

TRIANGLE = torch.tensor([[0, 1, 2]])
HINGE = torch.tensor([[0, 1, 2], [1, 0, 3]])


def hinge(fold: float) -> Tensor:
    """Two triangles at the edge from (-1, 0, 0) to (1, 0, 0), the first turned about it by ``fold`` radians."""
    tip = [0.0, math.cos(fold), -math.sin(fold)]
    return torch.tensor([[-1.0, 0, 0], [1, 0, 0], tip, [0, -1, 0]], dtype=torch.float64)


@pytest.fixture
def brick() -> tuple[Tensor, Tensor]:
    """A closed box of 2 x 3 x 4, away from the origin: vertices, faces."""
    solid = box((2, 2, 2), (2.0, 3.0, 4.0))
    used, faces = np.unique(surface(solid), return_inverse=True)
    return torch.from_numpy(solid.vertices[used]) + 7, torch.from_numpy(faces.reshape(-1, 3))


@pytest.fixture
def pair(small_bars: Shapes) -> tuple[Tensor, Tensor, Tensor]:
    """A bent bar, the straight one, faces; scaled to a size at which all three terms count."""
    scale = 100 / 4.3
    return small_bars.keyframes[1] * scale, small_bars.keyframes[0] * scale, small_bars.faces


# ----------------------------------------------------------------------------------------------------- by hand


WIDE, NEEDLE = (torch.tensor(factors, dtype=torch.float64) for factors in ([2.0, 1, 1], [1.0, 5e-4, 5e-4]))
TALL, LOW = ([[-w, 0, 0], [w, 0, 0], [0, h, 0]] for w, h in ((3.0, 4.0), (4.0, 3.0)))
DEGREE = math.pi / 180
BENDING = {"gamma": 0.0}


@pytest.mark.parametrize(
    ("faces", "x", "rest", "stiffness", "energy"),
    [
        # Sides 5, 5, 6 become 5, 5, 8: alpha (8 - 6)^2 / 6. There is no hinge, and no volume. Back, the length is 8.
        (TRIANGLE, LOW, TALL, {}, 500 * 4 / 6),
        (TRIANGLE, TALL, LOW, {}, 500 * 4 / 8),
        (TRIANGLE, LOW, TALL, {"alpha": 3.0}, 2.0),
        # No edge changes its length. l = 2 and A = 1 + 1: beta fold^2 4 / 2.
        *((HINGE, hinge(fold), hinge(0.0), BENDING, 20 * fold**2) for fold in (-2.0, -0.3, 0.3, 3.0)),
        (HINGE, hinge(0.3), hinge(0.0), {"beta": 1.5, **BENDING}, 3 * 0.3**2),
        # From +170 to -170 degrees: 20 degrees, not 340.
        (HINGE, hinge(170 * DEGREE), hinge(-170 * DEGREE), BENDING, 20 * (20 * DEGREE) ** 2),
        # Edge 01 of length 2 becomes 4, the others sqrt(2) become sqrt(5); flat, so no bending and no volume.
        (HINGE, hinge(0.0) * WIDE, hinge(0.0), {}, 500 * (2 + 4 * (math.sqrt(5) - math.sqrt(2)) ** 2 / math.sqrt(2))),
        # The other way round the hinge has l^2 / A = 16 / 4: beta 0.25 * 4.
        (HINGE, hinge(0.5) * WIDE, hinge(0.0) * WIDE, BENDING, 10.0),
        # l = 2 and A = 0.001: l^2 / A = 4000 counts as 1000.
        (HINGE, hinge(0.3) * NEEDLE, hinge(0.0) * NEEDLE, BENDING, 10 * 0.3**2 * 1000),
    ],
)
def test_energies_by_hand(faces: Tensor, x: Any, rest: Any, stiffness: dict[str, float], energy: float) -> None:
    x, rest = (torch.as_tensor(shape, dtype=torch.float64) for shape in (x, rest))
    assert float(ShellEnergy(faces, **stiffness)(x, rest)) == pytest.approx(energy, rel=1e-9)


def test_wrap_angle() -> None:
    angles = torch.linspace(-10, 10, 401, dtype=torch.float64)
    wrapped = wrap_angle(angles)
    torch.testing.assert_close(wrapped, torch.atan2(angles.sin(), angles.cos()), atol=1e-12, rtol=0)
    angles.requires_grad_()
    assert torch.autograd.grad(wrap_angle(angles).sum(), angles)[0].eq(1).all()


def test_volume_term_by_hand(brick: tuple[Tensor, Tensor]) -> None:
    x, faces = brick
    shell = ShellEnergy(faces, alpha=0.0, beta=0.0)
    assert float(shell.measure(x).volume) == pytest.approx(24, rel=1e-13)
    # 10 % larger: gamma (1.331 - 1)^2 = 109.561
    assert float(shell(1.1 * x, x)) == pytest.approx(109.561, rel=1e-11)
    inside_out = ShellEnergy(faces.flip(1), alpha=0.0, beta=0.0)
    assert float(inside_out.measure(x).volume) == pytest.approx(-24, rel=1e-13)
    assert float(inside_out(1.1 * x, x)) == pytest.approx(109.561, rel=1e-11)


def test_volume_of_an_open_surface_by_hand() -> None:
    # A pyramid without its base, 2 x 2 and height 5: the cone from the mean of its five vertices, at height 1,
    # leaves out a pyramid of height 1 over the base: (5 - 1) * 4 / 3.
    x = torch.tensor([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0], [0, 0, 5], [99, 99, 99]], dtype=torch.float64)
    faces = torch.tensor([[0, 1, 4], [1, 2, 4], [2, 3, 4], [3, 0, 4]])
    assert float(ShellEnergy(faces).measure(x + 3).volume) == pytest.approx(16 / 3, rel=1e-13)


def test_convex_edges_have_positive_angles(brick: tuple[Tensor, Tensor]) -> None:
    angle = ShellEnergy(brick[1]).measure(brick[0]).angle
    bent = angle.abs() > 0.1
    torch.testing.assert_close(angle[bent], torch.full_like(angle[bent], math.pi / 2), atol=1e-13, rtol=0)
    assert int(bent.sum()) == 24  # two on each of the box's 12 edges
    assert angle[~bent].abs().max() < 1e-13


# ------------------------------------------------------------------------------------------------- invariances


def test_translation_of_an_open_surface_changes_nothing(pair: tuple[Tensor, Tensor, Tensor]) -> None:
    x, rest, faces = pair
    shell = ShellEnergy(faces[6:], alpha=0.0, beta=0.0)
    energy = float(shell(x, rest))
    assert energy > 1e-2
    move = torch.tensor([300.0, -200.0, 100.0], dtype=torch.float64)
    assert float(shell(x + move, rest - 2 * move)) == pytest.approx(energy, rel=1e-10)


def test_zero_at_rest_only(pair: tuple[Tensor, Tensor, Tensor], generator: torch.Generator) -> None:
    x, _, faces = pair
    shell = ShellEnergy(faces)
    assert float(shell(x, x)) == 0 and shell(x.expand(2, 1, -1, -1), x.expand(3, -1, -1)).shape == (2, 3)
    (gradient,) = torch.autograd.grad(shell(x.requires_grad_(), x.detach()), x)
    assert gradient.abs().max() == 0
    noise = 1e-3 * torch.randn(20, *x.shape, dtype=torch.float64, generator=generator)
    assert (shell(x + noise, x) > 0).all()


# ------------------------------------------------------------------------------------ residuals, shapes, dtypes


def test_residuals_square_to_the_energy(pair: tuple[Tensor, Tensor, Tensor]) -> None:
    x, rest, faces = pair
    shell = ShellEnergy(faces)
    residuals = shell.residuals(x, rest)
    n_edges, n_hinges = (part.corners.shape[1] for part in list(shell.energy.parts)[:2])
    assert residuals.shape == (n_edges + n_hinges + 1,)
    assert float((residuals**2).sum()) == pytest.approx(float(shell(x, rest)), rel=1e-13)
    # The order is stretching, bending, volume: each alone is the energy with the other stiffnesses at zero.
    parts = residuals.split([n_edges, n_hinges, 1])
    for i, part in enumerate(parts):
        alone = ShellEnergy(faces, *(s if i == j else 0.0 for j, s in enumerate((500.0, 10.0, 1000.0))))
        assert float((part**2).sum()) == pytest.approx(float(alone(x, rest)), rel=1e-13)


def test_one_stiffness_per_sample(pair: tuple[Tensor, Tensor, Tensor]) -> None:
    x, rest, faces = pair
    values = [torch.tensor(v, dtype=torch.float64)[:, None] for v in ([1.0, 500.0], [10.0, 0.1], [7.0, 1000.0])]
    energies = ShellEnergy(faces, *values)(x.expand(2, -1, -1), rest)
    for i in range(2):
        assert float(energies[i]) == pytest.approx(float(ShellEnergy(faces, *(float(v[i]) for v in values))(x, rest)))


@pytest.mark.parametrize(("dtype", "error"), [(torch.float32, 1e-5), (torch.bfloat16, 0.05)])
def test_low_precision_is_computed_in_float32(
    dtype: torch.dtype, error: float, pair: tuple[Tensor, Tensor, Tensor]
) -> None:
    x, rest, faces = pair
    found = ShellEnergy(faces)(x.to(dtype), rest.to(dtype))
    assert found.dtype == torch.float32
    assert float(found) == pytest.approx(float(ShellEnergy(faces)(x, rest)), rel=error)


# ------------------------------------------------------------------------------------------------- derivatives


@pytest.mark.parametrize("cut", [0, 6], ids=["closed", "open"])
def test_gradcheck_away_from_rest(cut: int, pair: tuple[Tensor, Tensor, Tensor]) -> None:
    # A tenth of the size, a fifth larger: stretching, bending and volume are then of one magnitude.
    x, rest, faces = (pair[0] * 0.12).requires_grad_(), (pair[1] * 0.1).requires_grad_(), pair[2][cut:]
    stiffness = [torch.tensor(s, dtype=torch.float64, requires_grad=True) for s in (5.0, 1.0, 30.0)]

    def energy(x: Tensor, rest: Tensor, *stiffness: Tensor) -> Tensor:
        return ShellEnergy(faces, *stiffness)(x, rest)

    gradients = torch.autograd.grad(energy(x, rest, *stiffness), (x, rest, *stiffness))
    assert all(float(g.abs().max()) > 0.1 for g in gradients), "a check at rest would compare 0 with 0"
    assert gradcheck(energy, (x, rest, *stiffness), atol=1e-6)


def test_gradcheck_of_the_angle_through_half_a_turn() -> None:
    for fold in (0.0, 1.0, 3.1, -3.1):
        e, a, b = hinge(fold)[[1, 2, 3]] - hinge(fold)[0]
        assert gradcheck(Bend().measure, (torch.stack([e, a, b]).requires_grad_(),), atol=1e-7)


def test_a_collapsed_triangle_has_no_gradient() -> None:
    e, b = torch.tensor([25.0, 0, 0], dtype=torch.float64), torch.tensor([3.0, -7, 0], dtype=torch.float64)
    for a in (torch.zeros(3, dtype=torch.float64), 0.5 * e, e):
        gradient = Bend().linearise(torch.stack([e, a, b])[..., None])[1].squeeze(-1)
        # A hinge with a collapsed triangle is flat, whatever its other tip does.
        assert torch.equal(gradient, torch.zeros_like(gradient))


def collapse(kind: str, x: Tensor, faces: Tensor) -> Tensor:
    """A shape with something collapsed."""
    x = x.clone()
    a, b, c = faces[0]
    if kind == "vertices coincide":
        x[a] = x[b]
    elif kind == "triangle in line":
        x[a] = 0.5 * (x[b] + x[c])
    elif kind == "triangle in a point":
        x[a] = x[b] = x[c]
    elif kind == "flat":
        x[:, 2] = 0
    else:
        x[:] = x[0]
    return x


COLLAPSED = ["vertices coincide", "triangle in line", "triangle in a point", "flat"]


@pytest.mark.parametrize(
    ("which", "kind"),
    # A rest shape of no size at all is refused at the border.
    [*(("shape", kind) for kind in (*COLLAPSED, "all equal")), *(("rest", kind) for kind in COLLAPSED)],
)
def test_degenerate_shapes_give_finite_energy_and_gradient(
    which: str, kind: str, pair: tuple[Tensor, Tensor, Tensor]
) -> None:
    x, rest, faces = pair
    x, rest = (collapse(kind, x, faces), rest) if which == "shape" else (x, collapse(kind, rest, faces))
    for dtype in (torch.float64, torch.float32):
        shapes = [shape.to(dtype).requires_grad_() for shape in (x, rest)]
        energy = ShellEnergy(faces)(*shapes)
        assert energy.isfinite()
        assert energy > 0
        for gradient in torch.autograd.grad(energy, shapes):
            assert gradient.isfinite().all()


# ------------------------------------------------------------------------------------------------------ module


def test_only_stiffnesses_are_saved(pair: tuple[Tensor, Tensor, Tensor]) -> None:
    x, rest, faces = pair
    stiffness = torch.rand(1, dtype=torch.float64)
    shell, other = ShellEnergy(faces, alpha=stiffness), ShellEnergy(faces, alpha=torch.ones(1, dtype=torch.float64))
    assert len(shell.state_dict()) == 1
    assert not ShellEnergy(faces).state_dict()
    other.load_state_dict(shell.state_dict())
    assert torch.equal(other(x, rest), shell(x, rest))


def test_one_stiffness_per_edge(pair: tuple[Tensor, Tensor, Tensor]) -> None:
    x, rest, faces = pair
    plain = ShellEnergy(faces, beta=0.0, gamma=0.0)
    parts = plain.residuals(x, rest)[: plain.energy.parts[0].corners.shape[1]] ** 2
    factor = torch.rand(len(parts), dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    each = ShellEnergy(faces, alpha=500 * factor, beta=0.0, gamma=0.0)
    assert float(each(x, rest)) == pytest.approx(float((factor * parts).sum()), rel=1e-12)
