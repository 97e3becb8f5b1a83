"""The in-between as a layer: its laws on bars, its quality on hands and on a figure."""

from dataclasses import replace
from typing import Any

import pytest
import torch
from conftest import Shapes, modal
from helpers.shapes import diagonal, edge_error, largest, rigid_blend
from torch import Tensor

from torch_modal.elastic.bend import Bend
from torch_modal.elastic.shell import ShellEnergy
from torch_modal.elastic.term import Term
from torch_modal.geometry import connectivity
from torch_modal.inbetween.settings import Objective, Solver
from torch_modal.layers.mid_shape import MidShape

SPACES = ["joint", "paired"]


def linear(x_a: Tensor, x_b: Tensor, faces: Tensor) -> Tensor:
    weights = torch.from_numpy(connectivity.vertex_areas(x_a.numpy(), faces.numpy()))
    return rigid_blend(x_a, x_b, torch.tensor(0.5, dtype=torch.float64), weights)


@pytest.fixture(scope="module", params=SPACES)
def space(request: pytest.FixtureRequest) -> str:
    return request.param


@pytest.fixture(scope="module")
def bent(bars: Shapes) -> Shapes:
    """The bent and the twisted bar."""
    return bars.pick(1, 2)


@pytest.fixture(scope="module")
def layer(bent: Shapes, space: str) -> MidShape:
    return MidShape(bent.bases, bent.faces, space, **modal(coarse_faces=200))


@pytest.fixture(scope="module")
def middle(layer: MidShape, bent: Shapes) -> Tensor:
    return layer(*bent.keyframes)


# ---------------------------------------------------------------------------------------------------- its laws


def test_energy_is_below_linear_interpolation_and_at_a_minimum(bent: Shapes, monkeypatch: pytest.MonkeyPatch) -> None:
    """Told by Eq. 5 on the fine mesh, which is here the one that is solved on, without softer needles."""
    monkeypatch.setattr(Bend, "softening", Term.softening)
    layer = MidShape(bent.bases, bent.faces, **modal(coarse_faces=1000, anchor=0.0, backend="torch"))
    found = layer.solve(*bent.keyframes)
    shell, scale = ShellEnergy(bent.faces), layer.in_between.core.alignment.scale

    def energy(x: Tensor) -> Tensor:
        return 0.5 * sum(shell(scale * x, scale * end) for end in bent.keyframes)

    straight = linear(*bent.keyframes, bent.faces)
    assert float(energy(found.shapes)) == pytest.approx(float(found.solution.energy), rel=1e-6)
    assert float(energy(found.shapes)) < 0.8 * float(energy(straight))
    # No direction of the space goes down.
    x = found.shapes.clone().requires_grad_()
    (gradient,) = torch.autograd.grad(energy(x), x)
    half = torch.full((1, 2), 0.5, dtype=torch.float64)
    turn = layer.in_between.core.alignment(bent.keyframes[None], half)[1].rotation[0]
    columns = layer.space.basis @ turn.mT
    slopes = torch.einsum("nvc,vc->n", columns, gradient)
    assert len(slopes) == 16
    assert (slopes.abs() < 1e-7 * torch.linalg.norm(columns.flatten(1), dim=1) * gradient.norm()).all()


def test_a_vertex_of_no_face_has_no_say(middle: Tensor, bent: Shapes, space: str) -> None:
    def with_stray(x: Tensor, at: float) -> Tensor:
        return torch.cat([torch.full_like(x[..., :1, :], at), x], -2)

    bases = [replace(b, reference=with_stray(b.reference, 900.0), modes=with_stray(b.modes, 0.0)) for b in bent.bases]
    found = MidShape(bases, bent.faces + 1, space, **modal(coarse_faces=200))(*with_stray(bent.keyframes, -50.0))
    assert found.isfinite().all()
    assert largest(found[1:] - middle) < 1e-8 * diagonal(middle)


# ------------------------------------------------------------------------------------- shapes, dtypes, borders


def test_stiffnesses_count(bent: Shapes, middle: Tensor, space: str) -> None:
    """A large volume stiffness keeps the volume; a common factor of all changes nothing."""
    x_a, x_b = bent.keyframes
    measure = ShellEnergy(bent.faces).measure
    if space == "joint":
        stiff, soft = (
            MidShape(bent.bases, bent.faces, **modal(gamma=gamma, coarse_faces=1000))(x_a, x_b) for gamma in (1e9, 0.0)
        )
        wanted = 0.5 * float(measure(x_a).volume + measure(x_b).volume)
        errors = [abs(float(measure(x).volume) / wanted - 1) for x in (stiff, soft)]
        assert errors[0] < 0.1 * errors[1]
    options: dict[str, Any] = {"alpha": 5e3, "beta": 1e2, "gamma": 1e4, "mu": 10 * Objective().mu}
    options.update(anchor=10 * Objective().anchor, coarse_faces=200)
    factor = MidShape(bent.bases, bent.faces, space, **modal(**options))(x_a, x_b)
    assert largest(factor - middle) < 1e-7 * diagonal(x_a)


def test_coincident_vertices_are_survived(bars: Shapes) -> None:
    """The border lets them through with a warning."""
    i, j = bars.faces[100, :2]
    keyframes = bars.keyframes.clone()
    keyframes[:, i] = keyframes[:, j]
    bases = []
    for x, basis in zip(keyframes, bars.bases, strict=True):
        modes = basis.modes.clone()
        modes[:, i] = modes[:, j]
        bases.append(replace(basis, reference=x, modes=modes))
    found = MidShape(bases[:2], bars.faces, **modal()).solve(*keyframes[:2])
    assert found.solution.converged


# ---------------------------------------------------------------------------------------------- on real shapes


@pytest.mark.parametrize(
    ("ends", "truth", "bound"), [((0, 4), 2, 0.05), ((0, 2), 1, 0.011), ((2, 4), 3, 0.018)], ids=["0-8", "0-4", "4-8"]
)
def test_hand_that_closes(ends: tuple[int, int], truth: int, bound: float, hands: Shapes) -> None:
    """Linear interpolation: 27.5 %, 6.2 %, 8.2 %; measured here: 4.0 %, 0.90 %, 1.5 %. The paper lies between."""
    pair = hands.pick(*ends)
    found = MidShape(pair.bases, pair.faces, **modal()).solve(*pair.keyframes)
    wanted = hands.keyframes[truth]
    shell = ShellEnergy(hands.faces)
    if ends == (0, 2):  # on some meshings the wider spans end STALLED, at a collapsed triangle; their shape is as good
        assert found.solution.converged
        assert found.solution.gradient_norm <= 3e-7
        assert found.solution.n_steps <= 30
    error = edge_error(found.shapes, wanted, hands.faces)
    assert error <= bound
    paired = MidShape(pair.bases, pair.faces, "paired", **modal()).solve(*pair.keyframes).shapes
    assert (
        error
        < edge_error(paired, wanted, hands.faces)
        < edge_error(linear(*pair.keyframes, pair.faces), wanted, hands.faces)
    )
    assert float(shell.measure(found.shapes).volume) == pytest.approx(float(shell.measure(wanted).volume), rel=0.03)


@pytest.mark.slow
@pytest.mark.parametrize("ends", [(0, 4), (0, 2), (2, 4)])
def test_way_in_energy_to_the_optimum_over_all_vertices(ends: tuple[int, int], hands: Shapes) -> None:
    from full_space import full_space

    pair = hands.pick(*ends)
    x_a, x_b = pair.keyframes
    shapes = [
        MidShape(pair.bases, pair.faces, solver=Solver(local_steps=local_steps, polish=polish))(x_a, x_b)
        for local_steps, polish in ((0, 0), (2, 0), (2, 2))
    ]
    scale, shell = 100 / diagonal(x_a), ShellEnergy(pair.faces)
    straight, optimum = linear(x_a, x_b, pair.faces), full_space(x_a, x_b, pair.faces, start=shapes[0]).shape
    most, *energies, least = (
        float(sum(shell(scale * x, scale * end) for end in (x_a, x_b))) for x in (straight, *shapes, optimum)
    )
    gaps = [(most - energy) / (most - least) for energy in energies]
    assert gaps[0] > 0.85 and gaps[1] > 0.95 and gaps[2] > 0.98
    # All vertices have several minima; the polish may end in a deeper one than the full solve, by one percent.
    assert gaps[0] < gaps[1] and gaps[1] - 1e-3 < gaps[2] < 1.02
