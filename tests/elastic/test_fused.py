"""Kernels against the torch code that they stand in for: values, gradients, vmap, and where they are not used."""

import importlib.util
import subprocess
import sys
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from conftest import Shapes
from helpers.bodies import sheet_surface
from helpers.terms import Anchored, Area, Slopes, Spring, WholeAnchored, WholeArea, WholeSlope, fibres
from torch import Tensor
from torch.func import functional_call, grad, vmap

import torch_modal as tm
from torch_modal.elastic import backend
from torch_modal.elastic.backend import TorchBackend, choose
from torch_modal.elastic.bend import Bend
from torch_modal.elastic.distortion import Distortion, KernelDistortion
from torch_modal.elastic.energy import Energy, RestShapes
from torch_modal.elastic.kernel_energy import KernelEnergy, _MergeRests
from torch_modal.elastic.kernel_steps import KernelFineEnergy, KernelProblem, _Relaxation
from torch_modal.elastic.kernel_terms import by_kernels, has_kernels
from torch_modal.elastic.kernels import launch
from torch_modal.elastic.rotations import WarpRotations, best_rotations, mean_pose
from torch_modal.elastic.steps import FineEnergy, SumOfEnergies, TermsTowards, descend
from torch_modal.elastic.stretch import Stretch
from torch_modal.elastic.term import Mesh, Term
from torch_modal.elastic.volume import Volume
from torch_modal.errors import MissingPackageError
from torch_modal.geometry import procrustes, rigid
from torch_modal.geometry.canonical import CANONICAL_SIZE
from torch_modal.geometry.connectivity import Connectivity
from torch_modal.geometry.local_rotations import LocalRotations, Trajectory
from torch_modal.geometry.poisson import Poisson
from torch_modal.geometry.rotations import exp
from torch_modal.geometry.triangle_frames import frames_of
from torch_modal.inbetween.settings import PRESETS
from torch_modal.motion.cubics import cubics

pytest.importorskip("warp", reason="warp-lang is not installed")

DOUBLE = torch.float64


def by_kernels_alone(energy: Energy, mesh: Mesh) -> KernelEnergy:
    """Of terms that kernels serve."""
    assert all(map(has_kernels, energy.parts))
    return KernelEnergy(energy, [by_kernels(part, mesh) for part in energy.parts])


class Case:
    """Two samples between two shapes each, with stiffnesses of each element."""

    def __init__(self, shapes: Shapes, faces: Tensor, roughness: float) -> None:
        generator = torch.Generator().manual_seed(0)
        mesh = self.mesh = Mesh.of(faces, shapes.keyframes.shape[1])
        self.energy = Energy(mesh, [Stretch(), Bend(), Volume()])
        self.fused = by_kernels_alone(self.energy, mesh)
        x = shapes.keyframes * (CANONICAL_SIZE / (shapes.keyframes[0].amax(0) - shapes.keyframes[0].amin(0)).norm())
        n_edges, n_hinges = len(mesh.edges), len(mesh.hinges)
        stiffness = [
            500 + 100 * torch.rand(2, n_edges, generator=generator, dtype=DOUBLE),
            10 + torch.rand(2, n_hinges, generator=generator, dtype=DOUBLE),
            torch.full((2, 1), 1e3, dtype=DOUBLE),
        ]
        t = torch.tensor([0.3, 0.6], dtype=DOUBLE)
        start = torch.lerp(x[:2], x[1:3], 0.5)
        start = start + roughness * torch.randn(start.shape, dtype=DOUBLE, generator=generator)
        self.given = [start, x[:2].clone(), x[1:3].clone(), t, *stiffness]

    @staticmethod
    def rests(first: Tensor, second: Tensor, t: Tensor, *stiffness: Tensor) -> RestShapes:
        return RestShapes(torch.stack([first, second], 1), torch.stack([1 - t, t], -1), stiffness)

    def by_torch(self, x: Tensor, *rests: Tensor) -> Tensor:
        own = TermsTowards(self.energy, self.rests(*rests).reference(self.energy))
        return descend(SumOfEnergies([own]), x, [4, 4])

    def by_warp(self, x: Tensor, *rests: Tensor) -> Tensor:
        to = self.fused.target(self.rests(*rests))
        return _Relaxation(self.fused, [4, 4])(x, to.anchors, *to.records)[0]


@pytest.fixture(params=["closed", "open", "flat"])
def case(request: pytest.FixtureRequest, small_bars: Shapes) -> Case:
    if request.param == "flat":  # no volume: its weight is bounded by the area
        grid, faces = map(torch.from_numpy, sheet_surface((5, 5), (1.0, 1.0)))
        bent = grid + 0.3 * torch.stack([0 * grid[:, 0], grid[:, 0] ** 2, 0 * grid[:, 0]], -1)
        return Case(Shapes(torch.stack([grid, bent, 1.1 * bent]), faces, []), faces, 0.1)
    faces = small_bars.faces[6:] if request.param == "open" else small_bars.faces
    return Case(small_bars, faces, 0.3)


def records_by_torch(energy: Energy, rests: RestShapes) -> list[Tensor]:
    """In the layout of kernels."""
    return [record.mT for record in rests.reference(energy).records]


def gradients(run, given: list[Tensor], create: bool = False) -> tuple[Tensor, ...]:
    leaves = [value.clone().requires_grad_() for value in given]
    out = run(*leaves)
    weights = torch.randn(out.shape, dtype=out.dtype, generator=torch.Generator().manual_seed(1))
    found = torch.autograd.grad((out * weights).sum(), leaves, create_graph=create)
    if not create:
        return found
    return torch.autograd.grad(sum(g.square().sum() for g in found), leaves)


def assert_alike(found: tuple[Tensor, ...], truth: tuple[Tensor, ...], to: float) -> None:
    for got, wanted in zip(found, truth, strict=True):
        torch.testing.assert_close(got, wanted, rtol=0, atol=to * max(float(wanted.abs().max()), 0.01))


def assert_same_records(found: Sequence[Tensor], wanted: Sequence[Tensor], rtol: float) -> None:
    for got, truth in zip(found, wanted, strict=True):
        torch.testing.assert_close(got, torch.where(truth[..., :1] > 0, truth, got), rtol=rtol, atol=1e-9)


def assert_kernels(run: Any, truth: Any, given: list[Tensor], atol: float, to: float, second: bool = True) -> None:
    """Kernels have the values of torch, its gradients and its second ones."""
    torch.testing.assert_close(run(*given), truth(*given), rtol=0, atol=atol)
    assert_alike(gradients(run, given), gradients(truth, given), to)
    if second:
        assert_alike(gradients(run, given, True), gradients(truth, given, True), 1e-7)


def test_local_steps(case: Case) -> None:
    assert float((case.by_torch(*case.given) - case.given[0]).abs().max()) > 1e-2
    second = not case.fused.parts[2].extends
    start, *rests = case.given
    noise = 2.0**-52 * torch.randn(start.shape, dtype=DOUBLE, generator=torch.Generator().manual_seed(0))
    # Products amplify rounding, most for the flat one: torch's own result moves by this.
    rounding = float((case.by_torch(start * (1 + noise), *rests) - case.by_torch(*case.given)).abs().max())
    atol = max(1e-8 * CANONICAL_SIZE, 4 * rounding)
    assert_kernels(case.by_warp, case.by_torch, case.given, atol, 4e-6, second)


@torch.no_grad()
def test_distortion_by_kernels_and_by_torch_agree(case: Case) -> None:
    """Also of needles, whose weights are bounded."""
    i, j, *tips = case.mesh.hinges[0].tolist()
    for x in case.given[1:3]:
        middle = 0.5 * (x[:, [i]] + x[:, [j]])
        x[:, tips] = middle + 0.05 * (x[:, tips] - middle)
    shapes, rests = case.given[:3], case.rests(*case.given[1:])
    found, wanted = (kind(case.mesh, None)(shapes, rests) for kind in (KernelDistortion, Distortion))
    torch.testing.assert_close(found, wanted, rtol=1e-12, atol=0)


def test_edges_that_are_points_at_rest_weigh_nothing(small_bars: Shapes) -> None:
    case = Case(small_bars, small_bars.faces, 0.3)
    one, other = case.mesh.edges[0].tolist()
    case.given[1][:, other] = case.given[1][:, one] + 1e-7
    rests = case.rests(*case.given[1:])
    assert_same_records(case.fused.target(rests).records, records_by_torch(case.energy, rests), 1e-9)
    assert_alike(gradients(case.by_warp, case.given), gradients(case.by_torch, case.given), 1e-6)


def test_steps_that_would_go_uphill_are_shortened(small_bars: Shapes) -> None:
    case = Case(small_bars, small_bars.faces, 10.0)
    case.given[5] *= 1e5
    target, taken = case.fused.target(case.rests(*case.given[1:])), []
    found = descend(KernelProblem(case.fused, target), case.given[0].contiguous(), [4, 4], taken)
    lengths = torch.stack([step[3] for step in taken])
    assert float(lengths.min()) < 0.5 < float(lengths.max()), "no step is shortened, or all are"
    torch.testing.assert_close(found, case.by_torch(*case.given), rtol=0, atol=1e-8 * CANONICAL_SIZE)
    assert_alike(gradients(case.by_warp, case.given), gradients(case.by_torch, case.given), 1e-6)


def test_gradient_where_the_steps_start(small_bars: Shapes) -> None:
    # Steps from rounding have no derivative of their own there; no kink may make large numbers of it.
    case = Case(small_bars, small_bars.faces, 0.0)
    start = case.given[1].clone()
    given = [start, case.given[1], case.given[1].clone(), *case.given[3:]]
    for run in (case.by_warp, case.by_torch):
        assert all(float(own.abs().max()) < 10 for own in gradients(run, given))


class TestReferences:
    """Rest shapes merged into one."""

    @pytest.mark.parametrize("relative", [False, True])
    def test_softer_at_needles(self, case: Case, relative: bool) -> None:
        """Shapes with needles, along either side of their triangles; rest shapes with some, too."""
        start = case.given[0] * torch.tensor([0.02, 1.0, 3.0], dtype=DOUBLE)
        rests, weights = case.rests(*case.given[1:])[:2]
        rests = torch.cat([rests[:, :1] * torch.tensor([1.0, 0.04, 1.0], dtype=DOUBLE), rests[:, 1:]], 1)
        operation, given = _MergeRests(case.fused, [case.fused.parts[1]], relative), [rests, weights, case.given[5]]
        if relative:
            alone = torch.tensor([[1.0, 0.0]] * 2, dtype=DOUBLE)
            as_stiff = operation.by_torch(rests.flip(1), alone, case.given[5], rests[:, 1])[0]
            torch.testing.assert_close(as_stiff, operation.by_torch(rests.flip(1), alone, case.given[5])[0])
        hard, softened = (operation.by_torch(*given, *more)[0][..., 0] for more in ((), (start,)))
        assert float((softened / hard)[hard > 0].min()) < 0.1
        run, truth = lambda *x: operation(*x)[0], lambda *x: operation.by_torch(*x)[0]
        assert_kernels(run, truth, [*given, start], 1e-12 * float(hard.max()), 1e-11)

    @pytest.mark.parametrize("n_shapes", [1, 2, 4])
    def test_merged_references_by_kernels_and_by_torch_agree(self, case: Case, n_shapes: int) -> None:
        shell, (_, first, second, _, *stiffness) = case.fused, case.given
        shapes = torch.stack([first, second, 0.5 * (first + second), 1.1 * second], 1)[:, :n_shapes]
        weights = torch.tensor([[0.4, 0.7, 0.2, -0.3], [0.1, 0.2, 0.3, 0.4]], dtype=DOUBLE)[:, :n_shapes]

        def by_kernels(*given: Tensor) -> Sequence[Tensor]:
            return shell.target(RestShapes(*given[:2], given[2:])).records

        def by_torch(*given: Tensor) -> Sequence[Tensor]:
            return records_by_torch(case.energy, RestShapes(*given[:2], given[2:]))

        def flat(run: Any) -> Any:
            return lambda *given: torch.cat([part.flatten() for part in run(*given)])

        given = [shapes.clone(), weights.clone(), *stiffness]
        assert_same_records(by_kernels(*given), by_torch(*given), 1e-11)
        assert_kernels(flat(by_kernels), flat(by_torch), given, 1e-6, 1e-9)


def turned(rotations: WarpRotations, kind: type[LocalRotations] = WarpRotations) -> Any:
    """Pulls of the edge vectors of pairs at times, with stiffnesses of their own."""
    mesh = Connectivity(rotations.faces.numpy())
    poisson = Poisson(mesh, torch.linspace(1, 2, len(mesh.edges), dtype=DOUBLE))

    def run(first: Tensor, second: Tensor, t: Tensor) -> Tensor:
        return kind.right_hand_side(rotations, torch.stack([first, second], 1), torch.stack([1 - t, t], -1), poisson)

    return run


class TestAlignment:
    """Covariances of a reference with pairs of shapes, and of these."""

    @staticmethod
    def given(*, flat: float = 1.0) -> list[Tensor]:
        generator = torch.Generator().manual_seed(5)
        noise = torch.randn(6, 2, 20, 3, dtype=DOUBLE, generator=generator)
        x = noise[0, 0] * torch.tensor([3.0, flat, flat**2], dtype=DOUBLE) + 0.3 * flat**2 * noise
        x = x @ exp(2 * noise[:, :, 0]).mT
        t = torch.linspace(0, 1, 6, dtype=DOUBLE)
        return [x[0, 0].mT @ x, x[:, :, None].mT @ x[:, None], torch.stack([1 - t, t], 1)]

    @pytest.mark.parametrize("index", [0, 1], ids=["turns", "pose"])
    def test_of_two_shapes(self, index: int) -> None:
        for given in (self.given(), [0.01 * x for x in self.given()[:2]] + self.given()[2:]):
            run, truth = lambda *x: mean_pose(*x)[index], lambda *x: procrustes.mean_pose(*x)[index]
            assert_kernels(run, truth, given, 1e-12, 1e-10)

    def test_best_rotations_without_a_gradient(self) -> None:
        """Of any size, also of mirrored shapes and flat ones, whose rotation is determined."""
        generator = torch.Generator().manual_seed(0)
        given = torch.randn(500, 3, 3, dtype=DOUBLE, generator=generator)
        given[:100, 2] = 0  # of rank two
        truth = rigid.best_rotation(given)
        assert 100 < (torch.linalg.det(given) < 0).sum() < 300
        for size in (1e-9, 1.0, 1e9):
            torch.testing.assert_close(best_rotations(size * given), truth, rtol=0, atol=1e-11)

    def test_of_shapes_on_a_line(self) -> None:
        """Nothing determines the turn about it: it is a rotation all the same, and gradients are finite."""
        given = self.given(flat=0.0)
        for found in mean_pose(*given):
            torch.testing.assert_close(found @ found.mT, torch.eye(3, dtype=DOUBLE).expand_as(found))
            assert (torch.linalg.det(found) > 0).all()
        assert all(x.isfinite().all() for x in gradients(lambda *x: mean_pose(*x)[1], given))


class TestRotations:
    @pytest.fixture
    def rotations(self, small_bars: Shapes) -> WarpRotations:
        mesh = Mesh.of(small_bars.faces, small_bars.keyframes.shape[1])
        return WarpRotations(mesh.connectivity, small_bars.keyframes[:2])

    def test_between_two(self, rotations: WarpRotations, small_bars: Shapes) -> None:
        x = small_bars.keyframes
        given = [x[:2].clone(), x[1:3].clone(), torch.tensor([0.3, 0.8], dtype=DOUBLE)]
        assert_kernels(turned(rotations), turned(rotations, LocalRotations), given, 1e-12, 1e-9)
        found = vmap(lambda t: turned(rotations)(*given[:2], t.expand(2)))(given[2])
        torch.testing.assert_close(found[1], turned(rotations)(*given[:2], given[2][1].expand(2)), rtol=0, atol=1e-12)

    @pytest.mark.parametrize("which", [0, 1])
    @pytest.mark.parametrize("height", [0.0, 4e-7])
    def test_a_flat_triangle_has_no_large_gradients(
        self, rotations: WarpRotations, small_bars: Shapes, height: float, which: int
    ) -> None:
        """As by torch, which leaves out how the normal of a triangle without area turns."""
        x = small_bars.keyframes[:2].clone()
        i, j, k = small_bars.faces[7]
        x[which, k] = 0.5 * (x[which, i] + x[which, j]) + height * torch.tensor([1.0, 2.0, -1.0], dtype=DOUBLE)
        given = [x[:1], x[1:], torch.tensor([0.3], dtype=DOUBLE)]
        by_kernels, by_torch = (gradients(turned(rotations, kind), given) for kind in (WarpRotations, LocalRotations))
        for found, truth in zip(by_kernels, by_torch, strict=True):
            assert found.isfinite().all() and float(found.abs().max()) < 2 * float(truth.abs().max())

    @pytest.mark.parametrize("angle", [0.0, 0.03, 1.0, 3.0])
    def test_a_turn(self, small_bars: Shapes, angle: float) -> None:
        """Also none, and where the series end."""
        x = small_bars.keyframes[:1]
        roughened = x + 0.02 * torch.sin(40 * x) * (angle > 0)
        other = roughened @ exp(angle * torch.tensor([0.6, 0.0, 0.8], dtype=DOUBLE)).mT
        rotations = WarpRotations(Connectivity(small_bars.faces.numpy()), torch.cat([x, other]))
        given = [x.clone(), other, torch.tensor([0.3], dtype=DOUBLE)]
        assert_kernels(turned(rotations), turned(rotations, LocalRotations), given, 1e-12, 1e-7, angle > 0)

    @pytest.mark.parametrize("kind", ["point", "line", "half turn", "whole turn"])
    def test_gradients_of_what_is_degenerate_are_finite(
        self, rotations: WarpRotations, small_bars: Shapes, kind: str
    ) -> None:
        x, (i, j, k) = small_bars.keyframes[:1], small_bars.faces[0].tolist()
        other, t = x.clone(), torch.tensor([0.3], dtype=DOUBLE)
        if kind == "point":
            other[:, [j, k]] = x[:, [i]]
        elif kind == "line":
            other[:, k] = 0.3 * x[:, i] + 0.7 * x[:, j]
        else:
            other = other @ exp((1 + (kind == "whole turn")) * torch.pi * torch.tensor([0.6, 0.0, 0.8]).double()).mT
        for first, second in ((x, other), (other, x), (other, other)):
            found = gradients(turned(rotations), [first, second, t])
            assert all(bool(slope.isfinite().all()) and float(slope.abs().max()) < 1e6 for slope in found)
            lost = first.index_fill(1, torch.tensor([i]), torch.nan)
            assert gradients(turned(rotations), [lost, second, t])[0].isnan().any()

    def test_on_a_course(self, rotations: WarpRotations, small_bars: Shapes) -> None:
        x = small_bars.keyframes
        which, t = torch.zeros(3, dtype=torch.int64), torch.tensor([0.0, 0.3, 0.8], dtype=DOUBLE)

        def by(kind: type, first: Tensor, second: Tensor, t: Tensor) -> Tensor:
            before, own, after = (frames_of(shape, rotations.faces) for shape in (x[2:3], first, second))
            steps = torch.stack([rotations.step(before, own), rotations.step(own, after)])
            found = cubics(steps, torch.ones(2, dtype=DOUBLE), False)
            size = torch.stack(own[3:])
            trajectory = Trajectory(own.e1, own.e2, own.normal, size, *(part[1] for part in found))
            return kind.edges_along(rotations, trajectory, which, t)

        def by_warp(*given: Tensor) -> Tensor:
            return by(WarpRotations, *given)

        def by_torch(*given: Tensor) -> Tensor:
            return by(WarpRotations.__base__, *given)

        given = [x[:1].clone(), x[1:2].clone(), t]
        assert_kernels(by_warp, by_torch, given, 1e-12, 1e-9)
        found = vmap(lambda t: by_warp(*given[:2], t))(torch.stack([t, 0.5 * t]))
        torch.testing.assert_close(found[1], by_warp(*given[:2], 0.5 * t), rtol=0, atol=1e-12)


class TestLayers:
    @pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
    def test_in_between_and_path(self, bars: Shapes, dtype: torch.dtype) -> None:
        x, t = bars.keyframes.to(dtype), torch.tensor([0.3, 0.5], dtype=dtype)
        found = []
        for kind, fine in (("warp", KernelFineEnergy), ("torch", FineEnergy)):
            solver = tm.Solver(backend=kind)  # type: ignore[arg-type]
            layer = tm.InBetween(bars.bases[:2], bars.faces, solver=solver).to(dtype)
            assert type(layer.core.fine) is fine
            path = tm.Path(bars.bases, bars.faces, solver=solver).to(dtype)
            found.append(torch.cat([layer(*x[:2], t), path(x, 3 * t)]))
        assert found[0].dtype == dtype
        torch.testing.assert_close(*found, rtol=0, atol=1e-7 if dtype == torch.float64 else 1e-4)

    @pytest.mark.parametrize("over", ["t", "terms.0.stiffness", "terms.2.stiffness"])
    @pytest.mark.parametrize("preset", ["accurate", "modal"])
    def test_vmap_over_times_and_stiffnesses(self, small_bars: Shapes, preset: Any, over: str) -> None:
        """Over what not every tensor of a solve depends on; with its gradients, with and without recording."""
        stiffness = {"alpha": torch.tensor(500.0), "beta": torch.tensor(10.0), "gamma": torch.tensor(1e3)}
        objective = replace(PRESETS[preset].objective, **stiffness)
        layer = tm.InBetween(small_bars.bases[:2], small_bars.faces, preset, objective=objective).double()
        ends = small_bars.keyframes[:2]
        given = torch.tensor([0.3, 0.5, 0.8] if over == "t" else [100.0, 500.0, 900.0], dtype=DOUBLE)

        def at(value: Tensor) -> Tensor:
            return layer(*ends, value) if over == "t" else functional_call(layer, {over: value}, (*ends, 0.5))

        def slope(value: Tensor) -> Tensor:
            return grad(lambda value: at(value).square().sum())(value)

        for recorded in (True, False):
            with torch.set_grad_enabled(recorded):
                truth = torch.stack([at(value) for value in given])
                assert float((truth[0] - truth[1]).abs().max()) > 1e-7
                torch.testing.assert_close(vmap(at)(given), truth, rtol=0, atol=1e-9)
        slopes = torch.stack([slope(value) for value in given])
        torch.testing.assert_close(vmap(slope)(given), slopes, rtol=1e-7, atol=1e-9 * float(slopes.abs().max()))

    @pytest.mark.parametrize("smooth", [False, True], ids=["pair", "path"])
    def test_a_term_of_ones_own_is_beside_the_kernels(self, bars: Shapes, smooth: bool) -> None:
        """The same with kernels and without, with a gradient and without."""

        spring = Spring([5], bars.keyframes[0, :1] + 0.3, 1e-3)
        objective = tm.Objective(terms=(Area(0.3), Volume(1.0), spring))
        n, t = (3, 1.3) if smooth else (2, 0.3)
        found = []
        for kind in ("warp", "torch"):
            solver = tm.Solver(backend=kind, polish=1)  # type: ignore[arg-type]
            path = tm.Path(bars.bases[:n], bars.faces, objective=objective, solver=solver)
            assert isinstance(path.layers[0].core.fine, KernelFineEnergy) == (kind == "warp")
            keyframes = bars.keyframes[:n].clone().requires_grad_()
            shape = path(keyframes, t)
            with torch.no_grad():
                torch.testing.assert_close(path(keyframes, t), shape.detach(), rtol=0, atol=1e-9)
            found.append((shape.detach(), torch.autograd.grad(shape.square().sum(), keyframes)[0]))
        torch.testing.assert_close(found[0][0], found[1][0], rtol=0, atol=1e-7)
        torch.testing.assert_close(found[0][1], found[1][1], rtol=1e-4, atol=1e-5)

    @pytest.mark.parametrize("name", ["with its gradient", "measure alone", "without weights", "total", "anchored"])
    def test_a_term_of_ones_own_by_kernels(self, bars: Shapes, name: str) -> None:
        """The same numbers as torch's, with a gradient and without; its kernels compute them."""
        kind = {"total": WholeArea, "anchored": Anchored}.get(name) or fibres(weighted=name != "without weights")
        if name == "measure alone":
            kind.linearised = None
        x, found = bars.keyframes[:2], []
        for backend_name in ("warp", "torch"):
            solver = tm.Solver(backend=backend_name, tolerance=1e-12)
            objective = tm.Objective(terms=(kind(1e-2 if name == "total" else 1e3),))
            layer = tm.InBetween(bars.bases[:2], bars.faces, objective=objective, solver=solver)
            ends = x.clone().requires_grad_()
            with torch.no_grad():
                still = layer(*ends, 0.3)
            shape = layer(*ends, 0.3)
            found.append((still, shape.detach(), torch.autograd.grad(shape.square().sum(), ends)[0]))
            if backend_name == "warp":
                kernels = layer.core.fine.kernels
                assert layer.core.fine.further is None and len(kernels.parts) == 4
                assert (3 in kernels.weighed) == (name not in ("with its gradient", "measure alone"))
        plain = tm.InBetween(bars.bases[:2], bars.faces)(*x, 0.3)
        assert float((found[0][0] - plain).abs().max()) > 1e-3 * float(plain.abs().max())
        for got, wanted, to in zip(*found, (1e-11, 1e-11, 1e-9), strict=True):
            torch.testing.assert_close(got, wanted, rtol=0, atol=to * float(wanted.abs().max()))

    @pytest.mark.parametrize("name", ["measure alone", "beside the kernels"])
    def test_gradients_in_the_stiffness_alone(self, bars: Shapes, name: str) -> None:
        """With constant key-frames, nothing but the stiffness has a gradient."""
        kind, found = Area if name == "beside the kernels" else fibres(), []
        kind.linearised = None
        for backend_name in ("warp", "torch"):
            stiffness = torch.nn.Parameter(torch.tensor([1e3], dtype=DOUBLE))
            objective, solver = tm.Objective(terms=(kind(stiffness),)), tm.Solver(backend=backend_name)
            layer = tm.InBetween(bars.bases[:2], bars.faces, objective=objective, solver=solver)
            shape = layer(*bars.keyframes[:2], 0.3)
            found.append(torch.autograd.grad((shape * torch.arange(3)).sum(), stiffness)[0])
        assert float(found[1].abs()) > 0
        torch.testing.assert_close(*found, rtol=1e-8, atol=0)

    @pytest.mark.parametrize(
        "kind",
        [fibres(), fibres(weighted=False), Slopes, Anchored, WholeArea, WholeSlope, WholeAnchored],
        ids=["weights", "none", "angles", "anchored", "total", "total of angles", "anchored total"],
    )
    @torch.no_grad()
    def test_kernels_of_a_term_of_ones_own(self, case: Case, kind: type[Term]) -> None:
        """Energy, gradient and Hessian of one term are those of torch."""
        energy = Energy(case.mesh, [kind(1e3)])
        own = by_kernels_alone(energy, case.mesh)
        start, first, second, t, *_ = case.given
        rests = case.rests(first, second, t, torch.full((2, 1), 1e3, dtype=DOUBLE))
        anchors = own.no_anchors(start) + torch.tensor([30.0, 20.0, 10.0], dtype=DOUBLE)
        target, reference = own.target(rests)._replace(anchors=anchors), rests.reference(energy)
        found = KernelProblem(own, target).at(start.contiguous())
        wanted = TermsTowards(energy, reference, anchors).at(start)
        torch.testing.assert_close(found.value + reference.constant, wanted.value, rtol=1e-12, atol=0)
        assert_alike([found.gradient, found.diagonal], [wanted.gradient, wanted.diagonal], 1e-12)
        field, out = torch.randn_like(start).contiguous(), torch.zeros(start.shape, dtype=DOUBLE)
        own.add_products(field, found.factors, out)
        swept = (found.normals * field).sum((2, 3), keepdim=True)
        out += (found.stiffness[..., None, None] * swept * found.normals).sum(0)
        assert_alike([out], [wanted.product(field)], 1e-12)

    @pytest.mark.parametrize("relax", [[4], [4, 4]], ids=["one step", "two"])
    @pytest.mark.parametrize("n_open", [0, 6], ids=["closed", "open"])
    def test_totals_and_anchors_by_kernels(self, small_bars: Shapes, n_open: int, relax: list[int]) -> None:
        """Several beside the terms of Eq. 5; gradients in the shapes, times, stiffnesses and anchors."""
        case = Case(small_bars, small_bars.faces[n_open:], 0.3)
        kinds = Stretch(), Bend(), Volume(), WholeArea(), Anchored(), Volume(), WholeAnchored(point=(0.1, 0.5, 0.2))
        energy = Energy(case.mesh, kinds)
        own = by_kernels_alone(energy, case.mesh)
        more = [torch.full((2, 1), size, dtype=DOUBLE) for size in (1e-2, 1e-2, 3e2, 1e-2)]
        anchors = torch.tensor([[30.0, 20.0, 10.0], [-20.0, 40.0, 5.0]], dtype=DOUBLE).expand(2, 2, 3)
        given = [*case.given, *more, anchors.clone()]

        def by_warp(x: Tensor, *rests: Tensor) -> Tensor:
            to = own.target(case.rests(*rests[:-1]))
            return _Relaxation(own, relax)(x, rests[-1], *to.records)[0]

        def by_torch(x: Tensor, *rests: Tensor) -> Tensor:
            terms = TermsTowards(energy, case.rests(*rests[:-1]).reference(energy), rests[-1])
            return descend(SumOfEnergies([terms]), x, relax)

        assert float((by_torch(*given) - case.by_torch(*case.given)).abs().max()) > 1e-2
        assert_kernels(by_warp, by_torch, given, 1e-12 * CANONICAL_SIZE, 1e-9, False)

    def test_what_has_no_numbers_is_torchs(self, small_bars: Shapes) -> None:
        from torch._subclasses import FakeTensorMode

        layer = tm.InBetween(small_bars.bases[:2], small_bars.faces)
        with FakeTensorMode(allow_non_fake_inputs=True) as mode, torch.no_grad():
            x = mode.from_tensor(small_bars.keyframes[:1])
            weights = mode.from_tensor(torch.zeros(1, 2, dtype=DOUBLE))
            assert layer.core.blend.rotations(torch.stack([x, x], 1), weights).shape[0] == 3


def test_what_a_kernel_would_read_wrongly_is_refused() -> None:
    """Indices have 32 bits: beyond, they would wrap."""
    faces, x = torch.arange(3).int(), torch.zeros(6, 3, dtype=DOUBLE)
    results = [torch.zeros(n, dtype=DOUBLE) for n in (4, 1, 12)]
    huge = torch.empty(2**31, 3, dtype=DOUBLE, device="meta")
    cases = [
        (each, RuntimeError, r"contiguous tensor of torch\.float64") for each in (x.float(), x[:, :1].expand(6, 3))
    ]
    for wrong, error, message in (*cases, (huge, ValueError, r"2147483648 entries.* fewer samples")):
        with pytest.raises(error, match=message):
            launch.launch(launch.kernels("rotations").turns, (1, 1), [faces, 3, wrong, *results])


class TestBackend:
    @pytest.fixture(autouse=True)
    def tried_anew(self) -> Iterator[None]:
        backend.WarpBackend.works.cache_clear()
        yield
        backend.WarpBackend.works.cache_clear()

    def test_not_installed(self, monkeypatch: pytest.MonkeyPatch, small_bars: Shapes) -> None:
        there = importlib.util.find_spec
        monkeypatch.setattr("importlib.util.find_spec", lambda name: None if name == "warp" else there(name))
        assert type(tm.InBetween(small_bars.bases[:2], small_bars.faces).core.fine) is FineEnergy
        with pytest.raises(MissingPackageError, match="pip install warp-lang"):
            tm.InBetween(small_bars.bases[:2], small_bars.faces, solver=tm.Solver(backend="warp"))

    def test_not_usable(self, monkeypatch: pytest.MonkeyPatch) -> None:
        def broken(name: str) -> None:
            raise OSError("the cache folder is not writable")

        monkeypatch.setattr(backend, "kernels", broken)
        with pytest.warns(UserWarning, match="the cache folder is not writable"):
            assert type(choose("auto")) is TorchBackend

    def test_one_module_is_loaded_without_the_others_and_without_a_word(self) -> None:
        code = (
            "import sys, torch; from torch_modal.elastic.kernels.launch import kernels, launch; "
            "x = torch.zeros(1, 3, 3, dtype=torch.float64); own = torch.zeros(1, 2, dtype=torch.float64); "
            "two = torch.zeros(2, 3, 3, dtype=torch.float64); four = torch.zeros(4, 3, 3, dtype=torch.float64); "
            "launch(kernels('procrustes').mean_pose, (1,), [two, four, own, two.clone(), x]); "
            "sys.exit('torch_modal.elastic.kernels.steps' in sys.modules)"
        )
        folder = Path(tm.__file__).parents[1]
        result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120, cwd=folder)
        assert (result.returncode, result.stdout, result.stderr) == (0, "", "")

    def test_standard_error_is_left_as_it_was(self) -> None:
        """Also where there is none."""
        code = (
            "import os, sys; from torch_modal.elastic.kernels.launch import _quietly\n"
            "with _quietly(): print('during', file=sys.stderr, flush=True)\n"
            "os.write(2, b'native'); os.close(2)\n"
            "with _quietly(): print('out')\n"
        )
        folder = Path(tm.__file__).parents[1]
        result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120, cwd=folder)
        assert (result.returncode, result.stdout, result.stderr) == (0, "out\n", "during\nnative")


def test_what_warp_says_of_itself_is_left_alone() -> None:
    import warp

    with warnings.catch_warnings():
        warnings.simplefilter("error")
        before = warp.config.log_level
        launch._load.cache_clear()
        launch._load(launch.kernels("steps").begin.module, torch.device("cpu"))
        assert warp.config.log_level == before


def test_kernels_are_loaded_for_the_device_of_their_launch_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    """Their gradients take a minute to compile: on a GPU, nobody waits for those of the CPU."""
    import warp

    asked: list[tuple[str, str]] = []
    monkeypatch.setattr(warp, "load_module", lambda module, device, **_: asked.append((module.name, device)))
    monkeypatch.setattr(launch._COMMANDS, "known", {})
    launch._load.cache_clear()
    try:
        module, x = launch.kernels("rotations"), torch.ones(6, 3, dtype=DOUBLE)
        launch._adjoint(module.turns)
        assert not asked
        for _ in range(2):
            launch.launch(module.turns, (1, 1), [torch.arange(3).int(), 3, x, *torch.ones(3, 12, dtype=DOUBLE)])
        assert asked == [("torch_modal.elastic.kernels.rotations", "cpu")]
    finally:
        launch._load.cache_clear()
