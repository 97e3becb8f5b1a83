"""The in-between as a layer: its laws on bars, its quality on hands and on a figure."""

import warnings
from dataclasses import replace
from itertools import pairwise
from typing import Any

import pytest
import torch
from conftest import Shapes, modal, placement_of, random_rotation
from torch import Tensor
from torch.func import functional_call
from torch_modal.inbetween.samples import ConvergenceWarning

from torch_modal.energy.shell import ShellEnergy
from torch_modal.geometry import connectivity
from torch_modal.geometry.rigid import best_fit, blend
from torch_modal.inbetween.settings import Objective
from torch_modal.layers.mid_shape import MidShape
from torch_modal.precompute.basis import ModalBasis

SPACES = ["joint", "paired"]


def moved(basis: ModalBasis, rotation: Tensor, move: Tensor, factor: float = 1.0) -> ModalBasis:
    """The basis of the same shape elsewhere, in other units."""
    reference = factor * basis.reference @ rotation.mT + move
    modes = basis.modes @ rotation.mT * factor**-1.5
    return replace(basis, reference=reference, modes=modes, eigenvalues=basis.eigenvalues / factor**2)


def diagonal(x: Tensor) -> float:
    return float((x.amax(-2) - x.amin(-2)).norm(dim=-1).max())


def linear(x_a: Tensor, x_b: Tensor, faces: Tensor) -> Tensor:
    weights = torch.from_numpy(connectivity.vertex_areas(x_a.numpy(), faces.numpy()))
    return blend(x_a, x_b, torch.tensor(0.5, dtype=torch.float64), weights)


def largest(x: Tensor) -> float:
    return float(x.abs().max())


@pytest.fixture(scope="module", params=SPACES)
def space(request: pytest.FixtureRequest) -> str:
    return request.param


@pytest.fixture(scope="module")
def bent(bars: Shapes) -> Shapes:
    """The bent and the twisted bar, the second somewhere else."""
    generator = torch.Generator().manual_seed(5)
    turn, move = random_rotation(generator), torch.tensor([6.0, -4.0, 3.0], dtype=torch.float64)
    bases = [bars.bases[1], moved(bars.bases[2], turn, move)]
    return Shapes(torch.stack([bars.keyframes[1], bars.keyframes[2] @ turn.mT + move]), bars.faces, bases)


@pytest.fixture(scope="module")
def layer(bent: Shapes, space: str) -> MidShape:
    return MidShape(bent.bases, bent.faces, space, **modal(coarse_faces=200))


@pytest.fixture(scope="module")
def middle(layer: MidShape, bent: Shapes) -> Tensor:
    return layer(*bent.keyframes)


# ---------------------------------------------------------------------------------------------------- its laws


def test_energy_is_below_linear_interpolation_and_at_a_minimum(bent: Shapes, generator: torch.Generator) -> None:
    """Told by Eq. 5 on the fine mesh, which is here the one that is solved on."""
    layer = MidShape(bent.bases, bent.faces, **modal(coarse_faces=1000))
    found = layer.solve(*bent.keyframes)
    shell, scale = ShellEnergy(bent.faces), layer.space.frame.scale

    def energy(x: Tensor) -> Tensor:
        return 0.5 * sum(shell(scale * x, scale * end) for end in bent.keyframes)

    straight = linear(*bent.keyframes, bent.faces)
    assert float(energy(found.shapes)) == pytest.approx(float(found.solution.energy), rel=1e-6)
    assert float(energy(found.shapes)) < 0.8 * float(energy(straight))
    # No direction of the space goes down.
    x = found.shapes.clone().requires_grad_()
    (gradient,) = torch.autograd.grad(energy(x), x)
    pair = layer.space.frame.place(*bent.keyframes[:, None])
    half = pair.between.fraction(torch.tensor([0.5], dtype=torch.float64))
    turn = pair.placed.inverse().rotation[0] @ half.rotation[0]
    columns = layer.space.columns.fine @ turn.mT
    slopes = torch.einsum("nvc,vc->n", columns, gradient)
    assert len(slopes) == 16
    assert (slopes.abs() < 1e-7 * torch.linalg.norm(columns.flatten(1), dim=1) * gradient.norm()).all()


def test_moves_along_with_both_keyframes(
    layer: MidShape, middle: Tensor, bent: Shapes, space: str, generator: torch.Generator
) -> None:
    turn, move = random_rotation(generator), torch.tensor([50.0, -60.0, 70.0], dtype=torch.float64)
    along = layer(*(bent.keyframes @ turn.mT + move))
    assert largest(along - (middle @ turn.mT + move)) < 1e-8 * diagonal(middle)
    # And with the bases too, which are then made elsewhere. A quarter turn, as the box around the first sets the scale.
    turn = torch.tensor([[0.0, -1, 0], [0, 0, 1], [-1, 0, 0]], dtype=torch.float64)
    bases = [moved(basis, turn, move) for basis in bent.bases]
    there = MidShape(bases, bent.faces, space, **modal(coarse_faces=1000))(*(bent.keyframes @ turn.mT + move))
    here = MidShape(bent.bases, bent.faces, space, **modal(coarse_faces=1000))(*bent.keyframes)
    assert largest(there - (here @ turn.mT + move)) < 1e-8 * diagonal(middle)


def test_rigid_motion_between_keyframes_is_followed_half_way(layer: MidShape, bent: Shapes) -> None:
    x = bent.keyframes[0]
    quarter = torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]], dtype=torch.float64)
    move = torch.tensor([3.0, 1.0, -2.0], dtype=torch.float64)
    middle = layer(x, x @ quarter.mT + move)
    root = 0.5**0.5
    eighth = torch.tensor([[root, -root, 0], [root, root, 0], [0, 0, 1]], dtype=torch.float64)
    centre = (layer.space.frame.weights[:, None] * x).sum(0)
    between = 0.5 * (centre + quarter @ centre + move)
    assert largest(middle - ((x - centre) @ eighth.mT + between)) < 1e-10 * diagonal(x)


@pytest.mark.parametrize("factor", [1e3, 1e-3])
def test_units(factor: float, space: str, middle: Tensor, bent: Shapes) -> None:
    eye, origin = torch.eye(3, dtype=torch.float64), torch.zeros(3, dtype=torch.float64)
    bases = [moved(basis, eye, origin, factor) for basis in bent.bases]
    scaled = MidShape(bases, bent.faces, space, **modal(coarse_faces=200))(*(factor * bent.keyframes))
    assert largest(scaled - factor * middle) < 1e-8 * factor * diagonal(middle)


def test_coincident_keyframes_return_the_keyframe(layer: MidShape, bent: Shapes, generator: torch.Generator) -> None:
    noise = 0.02 * torch.randn(bent.keyframes[0].shape, dtype=torch.float64, generator=generator)
    for x in (bent.keyframes[0], bent.keyframes[1] + noise):
        found = layer.solve(x, x)
        assert found.solution.converged
        assert largest(found.shapes - x) < 1e-10 * diagonal(x)


@pytest.mark.parametrize("coarse_faces", [200, 1000])
def test_the_other_way_round(coarse_faces: int, space: str, bent: Shapes) -> None:
    """The first basis sets scale and alignment weights: the two ways are near, not equal.

    Measured, of the diagonal: 0.5 % as they lie, 0.01 to 0.04 % when laid upon each other.
    """
    x_a, x_b = bent.keyframes
    there = MidShape(bent.bases, bent.faces, space, **modal(coarse_faces=coarse_faces))(x_a, x_b)
    back = MidShape(bent.bases[::-1], bent.faces, space, **modal(coarse_faces=coarse_faces))(x_b, x_a)
    laid = best_fit(back, there, torch.ones(len(x_a), dtype=torch.float64)).apply(back)
    assert largest(there - back) < 0.01 * diagonal(x_a)
    assert largest(there - laid) < 1e-3 * diagonal(x_a)


def test_a_vertex_of_no_face_has_no_say(middle: Tensor, bent: Shapes, space: str) -> None:
    def with_stray(x: Tensor, at: float) -> Tensor:
        return torch.cat([torch.full_like(x[..., :1, :], at), x], -2)

    bases = [replace(b, reference=with_stray(b.reference, 900.0), modes=with_stray(b.modes, 0.0)) for b in bent.bases]
    found = MidShape(bases, bent.faces + 1, space, **modal(coarse_faces=200))(*with_stray(bent.keyframes, -50.0))
    assert found.isfinite().all()
    assert largest(found[1:] - middle) < 1e-8 * diagonal(middle)


# ------------------------------------------------------------------------------------- shapes, dtypes, borders


def test_cardinality(layer: MidShape, middle: Tensor, bent: Shapes) -> None:
    x_a, x_b = bent.keyframes
    many = torch.stack([x_b, x_a, 0.5 * (x_b + linear(x_a, x_b, bent.faces))])
    found = layer.solve(x_a, many[:, None].expand(3, 2, -1, -1))
    assert found.shapes.shape == (3, 2, *x_a.shape)
    for value in (found.solution.energy, found.solution.n_steps, found.solution.converged):
        assert value.shape == (3, 2)
    for i, x in enumerate(many):
        alone = layer(x_a, x)
        for copy in found.shapes[i]:
            assert largest(copy - alone) < 1e-8 * diagonal(x_a)
    assert largest(found.shapes[0, 0] - middle) < 1e-8 * diagonal(x_a)


def test_float32(layer: MidShape, middle: Tensor, bent: Shapes, space: str) -> None:
    given = layer(*bent.keyframes.float())
    assert given.dtype == torch.float32
    assert largest(given - middle) < 1e-5 * diagonal(middle)
    mixed = layer(bent.keyframes[0].float(), bent.keyframes[1])
    assert mixed.dtype == torch.float64
    single = MidShape(bent.bases, bent.faces, space, **modal(coarse_faces=200)).float()
    found = single.solve(*bent.keyframes.float())
    assert found.solution.energy.dtype == torch.float32
    assert found.solution.converged
    assert largest(found.shapes - middle) < 1e-3 * diagonal(middle)


def test_bases_are_constants(layer: MidShape) -> None:
    tensors = [*layer.buffers(), *layer.parameters()]
    assert tensors
    assert not any(tensor.requires_grad for tensor in tensors)


def test_state_dict_and_functional_call(layer: MidShape, middle: Tensor, bent: Shapes, space: str) -> None:
    """What is saved are the bases; what follows from them is made anew when others are loaded."""
    before = [basis.reference.clone() for basis in bent.bases]
    bases = [replace(basis, modes=basis.modes.roll(1, 1)) for basis in bent.bases]
    other = MidShape(bases, bent.faces, space, **modal(coarse_faces=200))
    buffers, own = dict(layer.named_buffers()), other(*bent.keyframes)
    assert largest(own - middle) > 1e-6
    torch.testing.assert_close(functional_call(other, buffers, tuple(bent.keyframes)), middle, rtol=0, atol=1e-9)
    state = layer.state_dict()
    assert sorted(state) == sorted(f"in_between.bases.{i}.{name}" for i in range(2) for name in ("reference", "modes"))
    other.load_state_dict(state)
    assert torch.equal(other(*bent.keyframes), middle)
    assert all(torch.equal(a, b.reference) for a, b in zip(before, bent.bases, strict=True))
    with pytest.raises(ValueError, match="zero size"):
        other.load_state_dict({name: torch.zeros_like(tensor) for name, tensor in state.items()})


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
    options: dict[str, Any] = {"alpha": 5e3, "beta": 1e2, "gamma": 1e4, "mu": 10 * Objective().mu, "coarse_faces": 200}
    factor = MidShape(bent.bases, bent.faces, space, **modal(**options))(x_a, x_b)
    assert largest(factor - middle) < 1e-7 * diagonal(x_a)


def test_warns_if_it_gives_up(bent: Shapes, space: str) -> None:
    hasty = MidShape(bent.bases, bent.faces, space, **modal(coarse_faces=200, max_steps=1))
    found = hasty.solve(*bent.keyframes)
    assert not found.solution.converged
    with pytest.warns(ConvergenceWarning, match=r"1 of 1 in-betweens did not converge in 1 steps"):
        assert hasty(*bent.keyframes).isfinite().all()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        MidShape(bent.bases, bent.faces, space, **modal(coarse_faces=200))(*bent.keyframes)


def test_one_bad_sample(layer: MidShape, middle: Tensor, bent: Shapes) -> None:
    x_a = bent.keyframes[0].expand(2, -1, -1).clone()
    x_a[0, 0, 0] = torch.nan
    found = layer.solve(x_a, bent.keyframes[1])
    assert found.solution.converged.tolist() == [False, True]
    assert largest(found.shapes[1] - middle) < 1e-8 * diagonal(middle)


def test_exception(layer: MidShape, bent: Shapes) -> None:
    x_a, x_b = bent.keyframes
    with pytest.raises(ValueError, match=r"x_b must be .* \(\.\.\., 164, 3\).*got \(163, 3\)"):
        layer(x_a, x_b[1:])
    with pytest.raises(ValueError, match="x_a must be floating-point"):
        layer(x_a.long(), x_b)
    with pytest.raises(ValueError, match=r"got \(164, 2\)"):
        layer(x_a[:, :2], x_b)
    with pytest.raises(ValueError, match="space is one of 'joint', 'paired'; got 'both'"):
        MidShape(bent.bases, bent.faces, "both", **modal())
    with pytest.raises(ValueError, match="between two bases, got 1"):
        MidShape(bent.bases[:1], bent.faces, **modal())
    with pytest.raises(ValueError, match=r"does not broadcast against key-frames of \(2,\) and \(3,\)"):
        layer(x_a.expand(2, -1, -1), x_b.expand(3, -1, -1))


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


def edge_error(x: Tensor, truth: Tensor, faces: Tensor) -> float:
    """Mean over edges of the relative error of their length."""
    i, j = torch.tensor(connectivity.Connectivity(faces.numpy()).edges).T
    lengths = torch.linalg.norm(truth[i] - truth[j], dim=1)
    return float(((torch.linalg.norm(x[i] - x[j], dim=1) - lengths).abs() / lengths).mean())


@pytest.mark.parametrize(
    ("ends", "truth", "bound"), [((0, 4), 2, 0.05), ((0, 2), 1, 0.011), ((2, 4), 3, 0.018)], ids=["0-8", "0-4", "4-8"]
)
def test_hand_that_closes(ends: tuple[int, int], truth: int, bound: float, hands: Shapes) -> None:
    """Linear interpolation: 27.5 %, 6.2 %, 8.2 %. Measured here: 4.0 %, 0.90 %, 1.5 %, in about 20 steps.

    They vary with the meshing, which is not deterministic.
    """
    pair = hands.pick(*ends)
    found = MidShape(pair.bases, pair.faces, **modal()).solve(*pair.keyframes)
    wanted = hands.keyframes[truth]
    shell = ShellEnergy(hands.faces)
    if ends == (0, 2):  # on some meshings the wider spans end STALLED, at a collapsed triangle; their shape is as good
        assert found.solution.converged
        assert found.solution.gradient_norm <= 1e-7
        assert found.solution.n_steps <= 30
    assert edge_error(found.shapes, wanted, hands.faces) <= bound
    assert float(shell.measure(found.shapes).volume) == pytest.approx(float(shell.measure(wanted).volume), rel=0.03)


def test_hand_without_its_rigid_motion(hands: Shapes, generator: torch.Generator) -> None:
    """On a real mesh, through coarsening, with the second key-frame turned away from the first."""
    pair = hands.pick(0, 2)
    turn, move = random_rotation(generator), torch.tensor([9.0, 8.0, 7.0], dtype=torch.float64)
    layer = MidShape(pair.bases, pair.faces, **modal())
    x_a, x_b = pair.keyframes
    here, away = layer.solve(x_a, x_b), layer.solve(x_a, x_b @ turn.mT + move)
    assert float(away.solution.energy) == pytest.approx(float(here.solution.energy), rel=1e-9)
    lengths = [ShellEnergy(pair.faces).measure(x.shapes).length for x in (here, away)]
    torch.testing.assert_close(*lengths, rtol=1e-7, atol=0)


@pytest.mark.parametrize("space", SPACES)
@pytest.mark.parametrize("ends", [(0, 4), (0, 2), (2, 4)], ids=["0-8", "0-4", "4-8"])
def test_hand_energy_falls_at_every_step(ends: tuple[int, int], space: str, hands: Shapes) -> None:
    pair = hands.pick(*ends)
    layer = MidShape(pair.bases, pair.faces, space, **modal())
    t = torch.tensor([0.5], dtype=torch.float64)
    placement = placement_of(layer, layer.space.frame.place(*pair.keyframes[:, None]), t)
    a = torch.zeros(1, layer.space.n_unknowns, dtype=torch.float64)
    energies = [float(layer.space.energy.value(a, placement))]
    for _ in range(12):
        a = layer.step(a, placement).amplitudes
        energies.append(float(layer.space.energy.value(a, placement)))
    assert all(later <= earlier * (1 + 1e-14) for earlier, later in pairwise(energies))
    assert energies[-1] < 0.95 * energies[0]


@pytest.mark.slow
@pytest.mark.parametrize("ends", [(1, 2), (0, 1)], ids=["2-3", "0-2"])
def test_walking_figure(ends: tuple[int, int], women: Shapes) -> None:
    pair = women.pick(*ends)
    solution = MidShape(pair.bases, pair.faces, **modal()).solve(*pair.keyframes).solution
    assert solution.converged
    assert solution.gradient_norm <= 3e-7
    assert solution.n_steps <= 60, "Newton steps had to take over"
