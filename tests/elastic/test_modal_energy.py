"""Derivatives in the amplitudes against autograd of the energy, on closed, open and odd surfaces."""

import pytest
import torch
from conftest import Shapes
from helpers.terms import WholeSlope
from torch import Tensor
from torch.func import hessian, jacfwd

from torch_modal.elastic import modal
from torch_modal.elastic.bend import Bend
from torch_modal.elastic.energy import Energy, RestShapes
from torch_modal.elastic.modal import Derivatives, ModalEnergy
from torch_modal.elastic.shell import ALPHA, BETA, GAMMA, ShellEnergy
from torch_modal.elastic.term import Mesh, Term

N, BATCH = 5, 3
MOEBIUS = [[i, (i + 1) % 7, (i + 2) % 7] if i % 2 == 0 else [(i + 1) % 7, i, (i + 2) % 7] for i in range(7)]
FINS = [[0, 1, 2], [1, 0, 3], [0, 1, 4]]


class SmoothShell(ShellEnergy):
    """Eq. 5 with the periodic function of angles that in-betweens have."""

    def __init__(self, faces: Tensor, alpha: float = ALPHA, beta: float = BETA, gamma: float = GAMMA) -> None:
        super().__init__(faces, alpha, beta, gamma)
        self.terms[1] = Bend(beta)
        self.energy = Energy(Mesh.of(self.faces, int(faces.max()) + 1), [*self.terms])


class PlainShell(SmoothShell):
    """The same by ``torch.func``, without what the terms write out."""

    def __init__(self, faces: Tensor) -> None:
        super().__init__(faces)
        for term in self.terms:
            term.__class__ = type("Plain", (type(term),), {"linearise": Term.linearise})


class SlopedShell(ShellEnergy):
    """With the sum of a few angles as a further term."""

    def __init__(self, faces: Tensor) -> None:
        super().__init__(faces, terms=(WholeSlope(1e4),))


class Case:
    """A shell in a random space, away from rest, with two references of different pull."""

    def __init__(self, faces: Tensor, x: Tensor, kind: type[ShellEnergy] = ShellEnergy, **stiffness: float) -> None:
        generator = torch.Generator().manual_seed(0)

        def random(*shape: int) -> Tensor:
            return torch.randn(*shape, dtype=torch.float64, generator=generator)

        size = float(x[faces.unique()].std())
        self.shell = kind(faces, **stiffness)
        self.columns = random(N, *x.shape)
        self.modal = ModalEnergy(self.shell, self.columns)
        self.base = base = x + 0.05 * size * random(BATCH, *x.shape)
        self.rests = [base + 0.1 * size * random(BATCH, *x.shape) for _ in range(2)]
        self.pulls = [torch.tensor([0.5, 0.9, 0.0], dtype=torch.float64), torch.tensor([0.5, 0.2, 2.0]).double()]
        rests = RestShapes(torch.stack(self.rests, 1), torch.stack(self.pulls, -1), self.shell.stiffness)
        self.placement = self.modal.place(base, rests.reference(self.shell.energy))
        self.a = 0.02 * size * random(BATCH, N)

    def shape_by_hand(self, a: Tensor) -> Tensor:
        return self.base + torch.einsum("bn,nvc->bvc", a, self.columns)

    def energy_by_hand(self, a: Tensor) -> Tensor:
        x = self.shape_by_hand(a)
        return sum(p * self.shell(x, r) for r, p in zip(self.rests, self.pulls, strict=True))

    def residuals_by_hand(self, a: Tensor) -> Tensor:
        x = self.shape_by_hand(a)
        parts = [p.sqrt()[:, None] * self.shell.residuals(x, r) for r, p in zip(self.rests, self.pulls, strict=True)]
        return torch.cat(parts, -1)

    def hessian_by_autograd(self) -> Tensor:
        whole = hessian(lambda a: self.energy_by_hand(a).sum())(self.a)
        return torch.stack([whole[i, :, i] for i in range(BATCH)])

    def jacobian_by_autograd(self) -> Tensor:
        whole = jacfwd(self.residuals_by_hand)(self.a)
        return torch.stack([whole[i, :, i] for i in range(BATCH)])

    def derivatives(self, second_order: bool = True) -> Derivatives:
        return self.modal.derivatives(self.a, self.placement, second_order)


def odd_surface(faces: list[list[int]]) -> tuple[Tensor, Tensor]:
    n = 1 + max(max(face) for face in faces)
    x = torch.randn(n, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    return torch.tensor(faces), 5 * x


def relative(got: Tensor, truth: Tensor) -> float:
    return float((got - truth).norm() / truth.norm())


@pytest.fixture(params=["closed", "open", "open in pieces", "unused vertex"])
def surface_of(request: pytest.FixtureRequest, small_bars: Shapes) -> tuple[Tensor, Tensor]:
    faces, x = small_bars.faces, small_bars.keyframes[1] * 20
    if request.param == "open":
        faces = faces[6:]
    elif request.param == "open in pieces":
        faces = faces[torch.arange(len(faces)) % 5 > 1]
    elif request.param == "unused vertex":
        faces, x = faces + 1, torch.cat([torch.full((1, 3), 1e3, dtype=torch.float64), x])
    return faces, x


@pytest.mark.parametrize("kind", [ShellEnergy, SmoothShell, PlainShell])
def test_agrees_with_autograd(surface_of: tuple[Tensor, Tensor], kind: type[ShellEnergy]) -> None:
    """Gauss-Newton takes the largest curvature of the periodic function; with the rest it is the true Hessian."""
    case = Case(*surface_of, kind)
    rows = case.modal.rows(case.a, case.placement)[..., : case.base.shape[1]]
    torch.testing.assert_close(rows.movedim(0, -1), case.shape_by_hand(case.a))
    torch.testing.assert_close(case.modal.value(case.a, case.placement), case.energy_by_hand(case.a))
    gradient = torch.autograd.functional.jacobian(lambda a: case.energy_by_hand(a).sum(), case.a)
    got, truth = case.derivatives(), case.hessian_by_autograd()
    assert relative(got.gradient, gradient) < 1e-12
    both = case.modal.value_and_gradient(case.a, case.placement)
    torch.testing.assert_close(both[0], case.energy_by_hand(case.a))
    assert relative(both[1], gradient) < 1e-12
    if kind is ShellEnergy:
        jacobian = case.jacobian_by_autograd()
        assert relative(got.gauss_newton, 2 * jacobian.mT @ jacobian) < 1e-12
    assert torch.linalg.eigvalsh(got.gauss_newton).amin() > 0
    assert relative(got.gauss_newton, truth) > 1e-2, "at rest there would be nothing to see"
    assert relative(got.hessian, truth) < 1e-11


def test_closed_forms_are_the_jacobians_of_torch_func(surface_of: tuple[Tensor, Tensor]) -> None:
    case, plain = (Case(*surface_of, kind) for kind in (SmoothShell, PlainShell))
    for summand in case.shell.energy.parts:
        vectors = summand.edge_vectors(case.modal.rows(case.a, case.placement))
        for found, wanted in zip(summand.term.linearise(vectors), summand.term.jacobian(vectors), strict=True):
            assert relative(found, wanted) < 1e-10
    assert relative(case.derivatives().hessian, plain.derivatives().hessian) < 1e-10


def require_true_hessian(case: Case) -> None:
    got = case.derivatives()
    gradient = torch.autograd.functional.jacobian(lambda a: case.energy_by_hand(a).sum(), case.a)
    assert relative(got.gradient, gradient) < 1e-12
    assert relative(got.hessian, case.hessian_by_autograd()) < 1e-11


@pytest.mark.parametrize("cut", [0, 6])
@pytest.mark.parametrize("stiffness", [(500.0, 0.0, 0.0), (0.0, 10.0, 0.0), (0.0, 0.0, 1000.0)])
def test_each_term_alone(stiffness: tuple[float, float, float], cut: int, small_bars: Shapes) -> None:
    names = dict(zip(("alpha", "beta", "gamma"), stiffness, strict=True))
    require_true_hessian(Case(small_bars.faces[cut:], small_bars.keyframes[1] * 20, **names))


def test_a_total_of_angles(small_bars: Shapes) -> None:
    require_true_hessian(Case(small_bars.faces, small_bars.keyframes[1] * 20, SlopedShell))


@pytest.mark.parametrize("stiffness", [{"gamma": 0.0}, {"alpha": 0.0, "beta": 0.0}], ids=["area", "volume"])
@pytest.mark.parametrize("faces", [FINS, MOEBIUS], ids=["three faces at an edge", "moebius strip"])
def test_no_consistent_winding(faces: list[list[int]], stiffness: dict[str, float]) -> None:
    require_true_hessian(Case(*odd_surface(faces), **stiffness))


def test_second_order_is_optional_and_comes_in_chunks(small_bars: Shapes, monkeypatch: pytest.MonkeyPatch) -> None:
    case = Case(small_bars.faces, small_bars.keyframes[1] * 20)
    whole, first_order = case.derivatives(), case.derivatives(second_order=False)
    assert first_order.second_order is None
    assert torch.equal(whole.gradient, first_order.gradient)
    assert torch.equal(whole.gauss_newton, first_order.gauss_newton)
    monkeypatch.setattr(modal, "MOST_BYTES", 1)  # one sample at a time
    torch.testing.assert_close(case.derivatives().second_order, whole.second_order, rtol=1e-12, atol=1e-9)


def test_cardinality_value_takes_more_leading_dimensions(small_bars: Shapes) -> None:
    case = Case(small_bars.faces, small_bars.keyframes[1] * 20)
    many = case.a + 0.01 * torch.arange(4, dtype=torch.float64)[:, None, None]
    energies = case.modal.value(many, case.placement)
    assert energies.shape == (4, BATCH)
    for a, energy in zip(many, energies, strict=True):
        torch.testing.assert_close(energy, case.energy_by_hand(a))


@pytest.mark.parametrize("second_order", [False, True])
def test_collapsed_triangles_give_finite_derivatives(second_order: bool, small_bars: Shapes) -> None:
    case = Case(small_bars.faces, small_bars.keyframes[1] * 20)
    base = case.placement.base.clone()
    base[0, :, small_bars.faces[0, 0]] = base[0, :, small_bars.faces[0, 1]]
    base[1, :, small_bars.faces[0]] = base[1, :, small_bars.faces[0, :1]]
    placement = case.placement._replace(base=base)
    got = case.modal.derivatives(torch.zeros(BATCH, N, dtype=torch.float64), placement, second_order)
    got = got if second_order else got._replace(second_order=got.gradient)
    for value in got:
        assert value is not None
        assert value.isfinite().all()
    assert torch.linalg.eigvalsh(got.gauss_newton).amin() > 0


def test_resolution_is_the_size_of_rounding(bars: Shapes) -> None:
    """Moving the shape far away rounds its positions: the gradient then changes by about ``resolution``."""
    shell = ShellEnergy(bars.faces)
    modal = ModalEnergy(shell, bars.bases[0].modes)
    x = bars.keyframes[:1] * 25
    a = torch.zeros(1, 8, dtype=torch.float64)
    for far in (1e5, 1e7):
        got = modal.derivatives(a, modal.place(x + far, shell.reference_of(x)), second_order=False)
        noise, bound = float(got.gradient.norm()), float(got.resolution)
        assert 0 < noise < 4 * bound
        assert bound < 1e3 * noise
