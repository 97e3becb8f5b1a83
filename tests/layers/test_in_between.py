"""The in-between as a differentiable layer: values, gradients, single samples of a batch, torch's own tools."""

import copy
import math
import warnings
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
import trimesh
from bodies import bend, twisted_plate
from conftest import Shapes, bent_bar, modal, random_rotation
from shapes import diagonal
from torch import Tensor
from torch.func import functional_call, grad, vmap

import torch_modal as tm
from torch_modal.data.samples import load_sample
from torch_modal.energy.modal_energy import Derivatives
from torch_modal.energy.shell import ShellEnergy
from torch_modal.inbetween.joint import JointSpace
from torch_modal.inbetween.results import ConvergenceError, ConvergenceWarning
from torch_modal.inbetween.settings import Solver
from torch_modal.layers.in_between import InBetween
from torch_modal.layers.mid_shape import MidShape
from torch_modal.precompute.basis import ModalBasis
from torch_modal.solve import implicit
from torch_modal.solve.minimise import Status

DOUBLE = torch.float64
pytestmark = pytest.mark.usefixtures("converged")


def times(*values: float) -> Tensor:
    return torch.tensor(values, dtype=DOUBLE)


@pytest.fixture(scope="module")
def large() -> Shapes:
    """Bars bent by 1.4 and twisted by 1.2 rad: much residual is left at the optimum. 20 modes each, 41 unknowns."""
    return bent_bar((12, 3, 3), 20)


@pytest.fixture(scope="module")
def layer(bars: Shapes) -> InBetween:
    return InBetween(bars.bases[:2], bars.faces, **modal(coarse_faces=200))


class TestValues:
    @pytest.mark.parametrize(
        "lead, t_shape, expected",
        [((), (), ()), ((), (3,), (3,)), ((2,), (2,), (2,)), ((2, 1), (3,), (2, 3)), ((3, 2), (3, 1), (3, 2))],
    )
    def test_cardinality(
        self, layer: InBetween, bars: Shapes, lead: tuple[int, ...], t_shape: tuple[int, ...], expected: tuple[int, ...]
    ) -> None:
        x_a, x_b = (x.expand(*lead, -1, -1) for x in bars.keyframes[:2])
        assert layer(x_a, x_b, torch.full(t_shape, 0.4, dtype=DOUBLE)).shape == (*expected, *x_a.shape[-2:])

    def test_the_ends_are_the_key_frames_bit_for_bit(self, layer: InBetween, bars: Shapes) -> None:
        for dtype in (DOUBLE, torch.float32):
            x_a, x_b = bars.keyframes[:2].to(dtype)
            x = layer(x_a, x_b, times(0.0, 0.5, 1.0))
            assert x.dtype == dtype
            assert torch.equal(x[0], x_a)
            assert torch.equal(x[2], x_b)

    def test_half_way_is_the_mid_shape(self, layer: InBetween, bars: Shapes) -> None:
        mid = MidShape(bars.bases[:2], bars.faces, **modal(coarse_faces=200))
        assert torch.equal(layer(*bars.keyframes[:2], 0.5), mid(*bars.keyframes[:2]))

    def test_faces_may_be_a_reversed_view_of_an_array(self, bars: Shapes) -> None:
        x, turned = bars.keyframes, bars.faces.numpy()[:, ::-1]  # torch.from_numpy refuses negative strides
        assert InBetween(bars.bases[:2], turned)(x[0], x[1], 0.5).isfinite().all()
        assert ShellEnergy(turned)(x[0], x[1]) > 0

    def test_a_rigid_motion_is_followed_along_its_geodesic(self, layer: InBetween, bars: Shapes) -> None:
        x = bars.keyframes[0]
        centre = x.mean(0)

        def turned(angle: float) -> Tensor:
            c, s = math.cos(angle), math.sin(angle)
            return (x - centre) @ torch.tensor([[c, s, 0], [-s, c, 0], [0, 0, 1]], dtype=DOUBLE)

        # The centre of the turn is the area centroid, not this mean: compare shapes about their means.
        between = layer(x, turned(1.2) + 5, times(0.25))[0]
        expected = turned(0.3)
        torch.testing.assert_close(between - between.mean(0), expected - expected.mean(0), rtol=0, atol=1e-9)

    def test_local_interpolation_lowers_the_energy_and_keeps_the_conventions(self, bars: Shapes) -> None:
        layers = [
            InBetween(bars.bases[1:], bars.faces, **modal(coarse_faces=200, local=n > 0, polish=n // 2))
            for n in range(3)
        ]
        x_a, x_b = bars.keyframes[1:]
        shell = ShellEnergy(bars.faces)
        scale = 100 / diagonal(x_a)
        energies = [float(sum(shell(scale * layer(x_a, x_b, 0.5), scale * x) for x in (x_a, x_b))) for layer in layers]
        assert energies[2] < energies[1] < energies[0]
        at = times(0.0, 0.2, 0.9, 1.0)
        together = layers[1](x_a, x_b, at)
        assert torch.equal(together[0], x_a)
        assert torch.equal(together[3], x_b)
        alone = torch.stack([layers[1](x_a, x_b, t) for t in at])
        torch.testing.assert_close(together, alone, rtol=0, atol=1e-10)
        single = copy.deepcopy(layers[1]).float()(x_a.float(), x_b.float(), at.float())
        assert float((single - together).abs().max()) < 1e-3 * diagonal(x_a)

    def test_key_frames_in_the_place_of_bases_leave_out_the_modal_solve(self, bars: Shapes) -> None:
        x = bars.keyframes[1:]
        plain, modal_steps = InBetween(x, bars.faces), InBetween(bars.bases[1:], bars.faces, solver=Solver(max_steps=0))
        found = plain.solve(*x, times(0.0, 0.3, 1.0))
        assert torch.equal(found.shapes[::2], x) and bool(found.solution.converged.all())
        truth = modal_steps.solve(*x, times(0.3)).shapes[0]
        torch.testing.assert_close(found.shapes[1], truth, rtol=0, atol=1e-12)
        base = InBetween(x, bars.faces, solver=Solver(local_steps=0))(*x, 0.3)
        shell, scale = ShellEnergy(bars.faces), 100 / diagonal(x[0])
        energies = [
            sum(w * float(shell(scale * y, scale * end)) for w, end in zip((0.7, 0.3), x, strict=True))
            for y in (found.shapes[1], base)
        ]
        assert energies[0] < energies[1]
        with pytest.raises(ValueError, match="is one of modes; pass bases"):
            InBetween(x, bars.faces, "paper")

    def test_where_the_blend_is_far_worse_than_straight_lines_they_are_returned(
        self, bars: Shapes, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        layer, start = (InBetween(bars.bases[1:], bars.faces, **modal(coarse_faces=200, max_steps=n)) for n in (80, 0))
        blend = type(layer.core.blend)
        monkeypatch.setattr(blend, "forward", lambda self, shapes, weights, straight: straight)
        straight = start.solve(*bars.keyframes[1:], 0.4)
        monkeypatch.setattr(blend, "forward", lambda self, shapes, weights, straight: 3 * straight)
        found = layer.solve(*bars.keyframes[1:], 0.4)
        assert found.solution.status == Status.FELL_BACK
        torch.testing.assert_close(found.shapes, straight.shapes, rtol=0, atol=1e-9)

    def test_a_blend_that_is_not_finite_is_straight(self, bars: Shapes, monkeypatch: pytest.MonkeyPatch) -> None:
        layer = InBetween(bars.bases[1:], bars.faces, **modal(coarse_faces=200))
        poisson = type(layer.core.blend.poisson)
        monkeypatch.setattr(poisson, "forward", lambda self, edges, near: torch.nan * near)
        found = layer.solve(*bars.keyframes[1:], 0.4)
        assert found.shapes.isfinite().all() and found.solution.converged


def central_difference(f: Callable[[Tensor], Tensor], x: Tensor, direction: Tensor, h: float) -> float:
    """Fourth-order difference quotient along a direction."""
    with torch.no_grad():
        values = [float(f(x + k * h * direction)) for k in (-2, -1, 1, 2)]
    return (values[0] - 8 * values[1] + 8 * values[2] - values[3]) / (12 * h)


DIFFERENCE_STEPS = {"x_a": 2e-5, "x_b": 2e-5, "t": 1e-4, "mu": 1e-3, "alpha": 1e-1, "beta": 1e-2, "gamma": 10.0}


class TestGradients:
    def functional(self, shapes: Shapes, space: str, generator: torch.Generator) -> Callable[..., Tensor]:
        """Random weights on the vertices of one in-between, as a function of everything that it depends on."""
        weights = torch.randn(shapes.keyframes.shape[1:], generator=generator, dtype=DOUBLE)

        def value(**inputs: Tensor) -> Tensor:
            constants = {name: inputs[name] for name in ("mu", "alpha", "beta", "gamma")}
            layer = InBetween(
                shapes.bases[1:], shapes.faces, **modal(space=space, coarse_faces=200, tolerance=1e-13, **constants)
            )
            return (layer(inputs["x_a"], inputs["x_b"], inputs["t"]) * weights).sum()

        return value

    def inputs(self, shapes: Shapes, space: str, generator: torch.Generator) -> dict[str, Tensor]:
        x_a, x_b = shapes.keyframes[1:]
        # Stretched, squeezed and roughened: lengths that no shape can have at once leave a large residual.
        x_b = x_b * torch.tensor([1.5, 0.7, 1.2], dtype=DOUBLE)
        x_b = x_b + 0.1 * torch.randn(x_b.shape, generator=generator, dtype=DOUBLE)
        x_b = x_b @ random_rotation(generator).mT + 1
        values = {"mu": 3.0, "alpha": 400.0, "beta": 20.0, "gamma": 5e4, "t": 0.5 if space == "paired" else 0.37}
        inputs = {name: torch.tensor(value, dtype=DOUBLE) for name, value in values.items()}
        return {"x_a": x_a.clone(), "x_b": x_b, **inputs}

    @pytest.mark.parametrize("space", ["joint", "paired"])
    def test_against_central_differences_of_the_converged_solve(
        self, large: Shapes, space: str, generator: torch.Generator
    ) -> None:
        value = self.functional(large, space, generator)
        inputs = self.inputs(large, space, generator)
        names = [name for name in inputs if not (name == "mu" and space == "joint")]
        names = [name for name in names if not (name == "t" and space == "paired")]
        leaves = {name: x.clone().requires_grad_(name in names) for name, x in inputs.items()}
        gradients = torch.autograd.grad(value(**leaves), [leaves[name] for name in names])
        for name, gradient in zip(names, gradients, strict=True):
            x = inputs[name]
            direction = torch.randn(x.shape, generator=generator, dtype=DOUBLE) if x.dim() else torch.ones_like(x)
            expected = central_difference(
                lambda y, name=name: value(**{**inputs, name: y}), x, direction, DIFFERENCE_STEPS[name]
            )
            assert float((gradient * direction).sum()) == pytest.approx(expected, rel=1e-5), name

    def test_through_what_happens_on_the_fine_mesh(self, large: Shapes, generator: torch.Generator) -> None:
        """Local steps and polish are part of what is differentiated."""
        weights = torch.randn(large.keyframes.shape[1:], generator=generator, dtype=DOUBLE)
        inputs = self.inputs(large, "joint", generator)
        del inputs["mu"]

        def value(fine: bool = True, **inputs: Tensor) -> Tensor:
            constants = {name: inputs[name] for name in ("alpha", "beta", "gamma")}
            layer = InBetween(
                large.bases[1:],
                large.faces,
                **modal(local=fine, polish=int(fine), coarse_faces=200, tolerance=1e-13, **constants),
            )
            return (layer(inputs["x_a"], inputs["x_b"], inputs["t"]) * weights).sum()

        leaves = {name: x.clone().requires_grad_() for name, x in inputs.items()}
        gradients = torch.autograd.grad(value(**leaves), list(leaves.values()))
        for name, gradient in zip(inputs, gradients, strict=True):
            x = inputs[name]
            direction = torch.randn(x.shape, generator=generator, dtype=DOUBLE) if x.dim() else torch.ones_like(x)
            # Small: the Hessian of the steps has kinks, where an edge is neither stretched nor squeezed.
            step = 1e-6 if x.dim() else DIFFERENCE_STEPS[name]
            expected = central_difference(lambda y, name=name: value(**{**inputs, name: y}), x, direction, step)
            assert float((gradient * direction).sum()) == pytest.approx(expected, rel=1e-5), name
        (without,) = torch.autograd.grad(value(False, **leaves), leaves["x_a"])
        assert float((without - gradients[0]).norm()) > 1e-2 * float(without.norm())

    def test_the_gauss_newton_hessian_would_not_do(
        self, large: Shapes, generator: torch.Generator, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        """The case above has enough residual to tell the two apart: without the second-order term it is far off."""
        value = self.functional(large, "joint", generator)
        inputs = self.inputs(large, "joint", generator)
        x_a = inputs["x_a"].clone().requires_grad_()
        y = value(**{**inputs, "x_a": x_a})
        (exact,) = torch.autograd.grad(y, x_a, retain_graph=True)

        def without(*given: Any) -> Derivatives:
            found = whole(*given)
            assert found.second_order is not None, "backward needs it"
            return found._replace(second_order=torch.zeros_like(found.second_order))

        whole = JointSpace.derivatives
        monkeypatch.setattr(JointSpace, "derivatives", without)
        (wrong,) = torch.autograd.grad(y, x_a)
        assert float((wrong - exact).norm() / exact.norm()) > 1e-2

    @pytest.mark.parametrize("space", ["joint", "paired"])
    def test_gradcheck_and_gradgradcheck(self, small_bars: Shapes, space: str) -> None:
        layer = InBetween(small_bars.bases[1:], small_bars.faces, **modal(space=space, tolerance=1e-14))
        x_a, x_b = (x.clone().requires_grad_() for x in small_bars.keyframes[1:])
        t = torch.tensor([0.5], dtype=DOUBLE) if space == "paired" else times(0.3, 0.6).requires_grad_()
        with warnings.catch_warnings():
            # Under the finite differences a last step may stall just above the tolerance that is asked for here.
            warnings.simplefilter("ignore", ConvergenceWarning)
            assert torch.autograd.gradcheck(layer, (x_a, x_b, t), eps=1e-5, atol=1e-7, rtol=1e-5, fast_mode=True)
            assert torch.autograd.gradgradcheck(layer, (x_a, x_b, t), eps=1e-5, atol=1e-5, rtol=1e-3, fast_mode=True)

    def test_at_the_ends_the_time_has_a_gradient(self, layer: InBetween, bars: Shapes) -> None:
        t = times(0.0, 1.0).requires_grad_()
        weights = torch.linspace(-1, 1, bars.keyframes[0].numel(), dtype=DOUBLE).reshape(bars.keyframes[0].shape)
        (gradient,) = torch.autograd.grad((layer(*bars.keyframes[:2], t) * weights).sum(), t)
        near = layer(*bars.keyframes[:2], times(0.0, 1e-4, 1 - 1e-4, 1.0))
        slope = torch.stack([near[1] - near[0], near[3] - near[2]]) / 1e-4
        torch.testing.assert_close(gradient, (slope * weights).sum((1, 2)), rtol=2e-3, atol=1e-6)

    def test_unrolled_gradients_agree_once_converged(self, bars: Shapes) -> None:
        x_a = bars.keyframes[0].clone().requires_grad_()
        gradients = []
        for options in ({"gradient": "unroll", "max_steps": 8}, {"tolerance": 1e-12}):
            layer = InBetween(bars.bases[:2], bars.faces, **modal(coarse_faces=200, **options))
            gradients += torch.autograd.grad(layer(x_a, bars.keyframes[1], 0.4).pow(3).sum(), x_a)
        torch.testing.assert_close(gradients[0], gradients[1], rtol=1e-6, atol=1e-8)

    def test_memory_of_the_implicit_mode_does_not_grow_with_the_steps(self, bars: Shapes) -> None:
        def saved(gradient: str, max_steps: int) -> int:
            layer = InBetween(
                bars.bases[:2],
                bars.faces,
                **modal(coarse_faces=200, gradient=gradient, max_steps=max_steps, tolerance=0.0),
            )
            total = 0

            def pack(tensor: Tensor) -> Tensor:
                nonlocal total
                total += tensor.numel() * tensor.element_size()
                return tensor

            x_a = bars.keyframes[0].clone().requires_grad_()
            with torch.autograd.graph.saved_tensors_hooks(pack, lambda tensor: tensor), warnings.catch_warnings():
                warnings.simplefilter("ignore", ConvergenceWarning)
                layer(x_a, bars.keyframes[1], 0.4)
            return total

        assert saved("implicit", 6) == saved("implicit", 2)
        assert saved("unroll", 6) > 2 * saved("unroll", 2)


class TestSingleSamples:
    """What happens to one sample of a batch is its own affair."""

    def batch(self, bars: Shapes) -> tuple[Tensor, Tensor]:
        return bars.keyframes[0].expand(3, -1, -1).clone(), bars.keyframes[1].expand(3, -1, -1).clone()

    def spoil(self, x: Tensor, how: str) -> None:
        if how == "NaN":
            x[1, 4, 2] = torch.nan
        elif how == "infinite":
            x[1, 4, 2] = torch.inf
        elif how == "no size":
            x[1] = x[1, 0].clone()
        elif how == "mirror image":
            x[1, :, 0] *= -1

    @pytest.mark.parametrize("how", ["NaN", "infinite", "no size", "mirror image"])
    def test_unusable_samples_are_marked_and_do_not_spread(self, layer: InBetween, bars: Shapes, how: str) -> None:
        x_a, x_b = self.batch(bars)
        good = layer(x_a, x_b, 0.5)
        self.spoil(x_a, how)
        x_a.requires_grad_()
        t = times(0.5).requires_grad_()
        with pytest.warns(ConvergenceWarning, match="1 of 3 .*1 INVALID"):
            x = layer(x_a, x_b, t)
        assert layer.solve(x_a, x_b, t).solution.status.flatten().tolist() == [0, Status.INVALID, 0]
        assert bool(x[1].isnan().all())
        torch.testing.assert_close(x[[0, 2]], good[[0, 2]], rtol=0, atol=1e-10)
        x[[0, 2]].pow(2).sum().backward()
        assert x_a.grad is not None and t.grad is not None
        assert bool(x_a.grad[[0, 2]].isfinite().all())
        assert bool(t.grad.isfinite().all())

    @pytest.mark.parametrize("backend", ["torch", "auto"])
    def test_a_thin_plate_whose_volume_turns_over_has_an_in_between(self, backend: Any) -> None:
        """One sample beside a mirrored body: the volumes of both turn over."""
        flat, twisted, faces = map(torch.from_numpy, twisted_plate(1e-3))
        x, y = flat[:, 0], flat[:, 1]
        modes = torch.zeros(2, len(flat), 3, dtype=DOUBLE)
        modes[0, :, 2], modes[1, :, 2] = x * y, x * x - 1 / 3
        basis = ModalBasis(flat, times(1.0, 2.0), modes, times(*[0.0] * 6))
        layer = InBetween([basis, basis], faces, solver=Solver(backend=backend))
        deep = flat * times(1.0, 1.0, 1000.0)
        firsts, seconds = torch.stack([flat, deep, flat]), torch.stack([twisted, deep * times(1.0, 1.0, -1.0), flat])
        for after in (seconds, seconds.clone().requires_grad_()):
            found = layer.solve(firsts, after, 0.5)
            assert found.solution.usable.tolist() == [True, False, True]
            assert bool(found.shapes[[0, 2]].isfinite().all())

    @pytest.mark.parametrize("preset", ["fast", "accurate"])
    @pytest.mark.parametrize("dtype", [torch.float32, DOUBLE])
    def test_at_a_key_frame_there_is_nothing_to_gain(self, women: Shapes, preset: Any, dtype: torch.dtype) -> None:
        """The energy is zero there: less of it than rounding of sums as large as the weights may not stop a step."""
        for i, j in ((0, 1), (0, 2), (1, 2)):
            layer = InBetween([women.bases[i], women.bases[j]], women.faces, preset).to(dtype)
            ends = women.keyframes[[i, j]].to(dtype)
            with torch.no_grad():
                solution = layer.solve(*ends, torch.tensor([0.0, 1.0], dtype=dtype)).solution
            assert bool(solution.converged.all()), (i, j, solution.gradient_norm)

    def test_coincident_key_frames_stay(self, layer: InBetween, bars: Shapes) -> None:
        x = bars.keyframes[0].clone().requires_grad_()
        between = layer(x, x, times(0.2, 0.5))
        torch.testing.assert_close(between, x.detach().expand(2, -1, -1), rtol=0, atol=1e-9)
        # The in-between of x and x is x, so the gradient of its sum of squares is that of x's, at both times.
        (gradient,) = torch.autograd.grad(between.pow(2).sum(), x)
        assert bool(gradient.isfinite().all())

    def test_flat_hinges_are_harmless(self, generator: torch.Generator) -> None:
        """Faces of a box without jitter: most hinges are flat, two key-frames differ by a bend."""
        flat = bent_bar((6, 2, 2), 6)
        layer = InBetween(flat.bases[:2], flat.faces, **modal())
        x_a = flat.keyframes[0].clone().requires_grad_()
        x = layer(x_a, flat.keyframes[1], 0.5)
        (gradient,) = torch.autograd.grad(x.sum(), x_a)
        assert bool(gradient.isfinite().all())

    def test_half_a_turn_between_the_key_frames(self, layer: InBetween, bars: Shapes) -> None:
        x_a = bars.keyframes[0]
        x_b = (x_a * torch.tensor([-1.0, -1.0, 1.0], dtype=DOUBLE)).requires_grad_()
        x = layer(x_a, x_b, 0.5)
        lengths = torch.linalg.norm(x[1:] - x[:-1], dim=1)
        torch.testing.assert_close(lengths, torch.linalg.norm(x_a[1:] - x_a[:-1], dim=1), rtol=1e-9, atol=1e-9)
        (gradient,) = torch.autograd.grad(x.sum(), x_b)
        assert bool(gradient.isfinite().all())

    def test_twisted_by_half_a_turn_gets_an_answer_or_a_status(self, bars: Shapes, layer: InBetween) -> None:
        x, y, z = bars.keyframes[0].unbind(1)
        angle = math.pi * (x - x.min()) / (x.max() - x.min())
        y, z = y - y.mean(), z - z.mean()
        twisted = torch.stack([x, angle.cos() * y - angle.sin() * z, angle.sin() * y + angle.cos() * z], 1)
        shapes, solution, *_ = layer.solve(bars.keyframes[0], twisted, 0.5)
        assert bool(shapes.isfinite().all())
        # 1 to 3 are the statuses of a sample that did not converge; whatever it is, it is said.
        assert solution.converged.item() == (solution.gradient_norm.item() <= layer.solver.tolerance)

    def test_unconverged_samples_are_reported(self, bars: Shapes, monkeypatch: pytest.MonkeyPatch) -> None:
        x_a, x_b = bars.keyframes[1:]
        x_b = torch.stack([x_b, x_a]).clone().requires_grad_()
        layer = InBetween(bars.bases[1:], bars.faces, **modal(coarse_faces=200, max_steps=1))
        with pytest.warns(ConvergenceWarning, match="1 of 2 .* in 1 steps .*1 OUT_OF_STEPS"):
            shapes = layer(x_a, x_b, 0.5)
        # Of the sample that did not converge only the part moves that does not go through the amplitudes.
        adjoints, whole = [], JointSpace.gradient

        class Seen(torch.autograd.Function):
            @staticmethod
            def forward(x: Tensor) -> Tensor:
                return x.clone()

            @staticmethod
            def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
                """Saves nothing."""

            @staticmethod
            def backward(ctx: Any, adjoint: Tensor) -> Tensor:
                adjoints.append(adjoint)
                return adjoint

        monkeypatch.setattr(JointSpace, "gradient", lambda *given: Seen.apply(whole(*given)))
        (gradient,) = torch.autograd.grad((shapes * torch.cos(9 * x_b.detach())).sum(), x_b)
        assert bool(gradient.isfinite().all())
        unconverged = layer.solve(x_a, x_b, 0.5).solution.status != Status.CONVERGED
        assert (
            unconverged.sum() == 1 and (adjoints[0][unconverged] == 0).all() and (adjoints[0][~unconverged] != 0).any()
        )
        layer.solver = replace(layer.solver, unconverged="raise")
        with pytest.raises(ConvergenceError, match="1 of 2"):
            layer(x_a, x_b, 0.5)
        with torch.no_grad(), pytest.warns(ConvergenceWarning):
            layer(x_a, x_b, 0.5)


OPTIONS = {
    "modes": modal(),
    "local": modal(local=True),
    "polish": modal(polish=1),
    "paired": modal(space="paired"),
}


class TestTorch:
    def test_functional_call_replaces_a_stiffness(self, bars: Shapes) -> None:
        x_a, x_b = bars.keyframes[1:]
        beta = torch.nn.Parameter(torch.tensor(10.0, dtype=DOUBLE))
        layer = InBetween(bars.bases[1:], bars.faces, **modal(beta=beta, coarse_faces=200))
        other = InBetween(bars.bases[1:], bars.faces, **modal(beta=200.0, coarse_faces=200))
        names = [name for name, _ in layer.named_parameters()]
        called = functional_call(layer, {names[0]: torch.tensor(200.0, dtype=DOUBLE)}, (x_a, x_b, 0.5))
        torch.testing.assert_close(called, other(x_a, x_b, 0.5), rtol=0, atol=1e-8)
        assert float((called - layer(x_a, x_b, 0.5)).abs().max()) > 1e-4

    @pytest.mark.parametrize("option", OPTIONS)
    def test_every_option_is_mapped_differentiated_twice_and_borrowed(self, small_bars: Shapes, option: str) -> None:
        layer = InBetween(small_bars.bases[:2], small_bars.faces, **OPTIONS[option])
        x_a, x_b = small_bars.keyframes[:2]
        batch = torch.stack([x_a, x_a + 0.02 * x_b])
        truth = layer(batch, x_b, 0.5)

        def value(x: Tensor) -> Tensor:
            return layer(x, x_b, 0.5).pow(2).sum()

        torch.testing.assert_close(vmap(lambda x: layer(x, x_b, 0.5))(batch), truth, rtol=0, atol=1e-9)
        slopes = torch.stack([grad(value)(x) for x in batch])
        torch.testing.assert_close(vmap(grad(value))(batch), slopes, rtol=1e-6, atol=1e-7)
        curved = grad(lambda x: (grad(value)(x) * x_b).sum())(x_a)
        assert bool(curved.isfinite().all()) and float(curved.abs().max()) > 1e-3
        other = InBetween(small_bars.bases[1:], small_bars.faces, **OPTIONS[option])
        other(x_a, x_b, 0.5)
        borrowed = functional_call(other, dict(layer.named_buffers()), (batch, x_b, 0.5))
        torch.testing.assert_close(borrowed, truth, rtol=0, atol=1e-9)

    @pytest.mark.slow
    @pytest.mark.parametrize("option", OPTIONS)
    def test_every_option_is_compiled(self, small_bars: Shapes, option: str) -> None:
        layer, (x_a, x_b, _) = (
            InBetween(small_bars.bases[:2], small_bars.faces, **OPTIONS[option]),
            small_bars.keyframes,
        )
        with torch.no_grad():
            truth = layer(x_a, x_b, 0.5)
            torch.testing.assert_close(torch.compile(layer, backend="eager")(x_a, x_b, 0.5), truth, rtol=0, atol=1e-9)

    @pytest.mark.slow
    @pytest.mark.parametrize("backend", ["torch", "auto"])
    def test_a_layer_that_was_never_called_is_compiled(self, small_bars: Shapes, backend: str) -> None:
        """What is made at its first use is made outside of the trace: SciPy cannot be traced."""
        solver = Solver(backend=backend)
        x_a, x_b = small_bars.keyframes[0].clone().requires_grad_(), small_bars.keyframes[1]
        compiled, plain = (InBetween(small_bars.bases[:2], small_bars.faces, solver=solver) for _ in range(2))
        shape = torch.compile(compiled, backend="eager")(x_a, x_b, 0.5)
        torch.testing.assert_close(shape, plain(x_a, x_b, 0.5), rtol=0, atol=1e-9)

    @pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
    def test_low_precision_computes_in_float32(self, bars: Shapes, dtype: torch.dtype) -> None:
        layer = InBetween(bars.bases[:2], bars.faces, **modal(coarse_faces=200, local=True))
        x_a, x_b = bars.keyframes[:2]
        truth = layer(x_a, x_b, 0.5)
        low = copy.deepcopy(layer).to(dtype)
        assert low.dtype == torch.float32
        found = low(x_a.to(dtype), x_b.to(dtype), 0.5)
        assert found.dtype == dtype
        assert float((found - truth).abs().max()) < 0.02 * diagonal(x_a)
        single = copy.deepcopy(layer).float()
        with torch.autocast("cpu", torch.bfloat16):
            x = x_a.float().requires_grad_()
            found = single(x, x_b.float(), 0.5)
            (slope,) = torch.autograd.grad(found.sum(), x)
        assert float((found - truth).abs().max()) < 1e-3 * diagonal(x_a)
        assert bool(slope.isfinite().all())

    def test_products_of_float32_are_exact_inside(self, bars: Shapes) -> None:
        """Whatever is set outside, and it is set again afterwards."""
        layer, seen = InBetween(bars.bases[:2], bars.faces).float(), []
        layer.core.register_forward_pre_hook(lambda *_: seen.append(torch.get_float32_matmul_precision()))
        try:
            torch.set_float32_matmul_precision("medium")
            layer(*bars.keyframes[:2].float(), 0.5)
            assert (seen, torch.get_float32_matmul_precision()) == (["highest"], "medium")
        finally:
            torch.set_float32_matmul_precision("highest")

    def test_one_singular_sample_spoils_no_gradient_of_others(
        self, bars: Shapes, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        layer = InBetween(bars.bases[:2], bars.faces, **modal(coarse_faces=200))
        x_a = torch.stack([bars.keyframes[0]] * 2).requires_grad_()
        shapes = layer(x_a, bars.keyframes[1], 0.5)
        (truth,) = torch.autograd.grad(shapes.sum(), x_a, retain_graph=True)
        keep = torch.tensor([1.0, 0.0], dtype=DOUBLE)[:, None, None]
        monkeypatch.setattr(implicit, "ridged", lambda hessian: keep * hessian)
        with pytest.warns(ConvergenceWarning, match="the Hessian of 1 in-betweens is singular"):
            (found,) = torch.autograd.grad(shapes.sum(), x_a)
        torch.testing.assert_close(found[0], truth[0], rtol=1e-6, atol=1e-8)
        assert bool(found[1].isfinite().all())

    @pytest.mark.slow
    def test_fixed_steps_are_exported(self, small_bars: Shapes) -> None:
        layer = InBetween(small_bars.bases[1:], small_bars.faces, **modal(gradient="unroll", max_steps=3))
        x_a, x_b = small_bars.keyframes[1:]
        exported = torch.export.export(layer, (x_a, x_b, times(0.3)), strict=False).module()
        others = (1.01 * x_a, x_b + 0.1 * x_a, times(0.6))
        torch.testing.assert_close(exported(*others), layer(*others), rtol=0, atol=1e-12)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda layer, a, b: layer(a, b[:-1], 0.5), "x_b must be floating-point of shape"),
        (lambda layer, a, b: layer(a[:, :2], b, 0.5), r"got \(164, 2\)"),
        (lambda layer, a, b: layer(a.long(), b, 0.5), "x_a must be floating-point"),
        (lambda layer, a, b: layer(a.numpy(), b, 0.5), "x_a is a ndarray; pass a tensor"),
        (lambda layer, a, b: layer(a.expand(2, -1, -1), b.expand(3, -1, -1), 0.5), "does not broadcast"),
        (lambda layer, a, b: layer(a.expand(3, -1, -1), b, torch.rand(4)), r"t of shape \(4,\) .* x_a\[:, None\]"),
        *((lambda layer, a, b, t=t: layer(a, b, times(0.5, t)), r"t lies in \[0, 1\]") for t in (-0.1, 1.5, math.nan)),
    ],
)
def test_what_a_call_refuses(call: Any, message: str, layer: InBetween, bars: Shapes) -> None:
    with pytest.raises(ValueError, match=message):
        call(layer, *bars.keyframes[:2])


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (lambda: modal(gradient="magic"), "'implicit', 'unroll'"),
        (lambda: modal(unconverged="hide"), "'warn', 'raise'"),
        (lambda: modal(space="outer"), "'joint', 'paired'"),
        (lambda: modal(tolerance=-1.0), "tolerance bounds a relative gradient norm"),
        (lambda: modal(coarse_faces=3), "coarse_faces is a whole number, 4 or more"),
        (lambda: modal(polish=-1), "polish is a whole number"),
        (lambda: modal(polish=1.5), "polish is a whole number"),
        (lambda: {"preset": "best"}, "preset is one of 'accurate', 'fast', 'paper'; got 'best'"),
    ],
)
def test_what_settings_refuse(options: Any, message: str, bars: Shapes) -> None:
    with pytest.raises(ValueError, match=message):
        InBetween(bars.bases[:2], bars.faces, **options())


def test_bases_that_do_not_fit(bars: Shapes, small_bars: Shapes) -> None:
    for bases, message in (
        ([bars.bases[0], small_bars.bases[0]], r"meshes of \[30, 164\] vertices"),
        (small_bars.bases[:2], "vertices that do not exist"),
        (bars.bases, "between two bases, got 3; Path and Blend take more"),
        (bars.keyframes[0], r"key-frames are floating-point of shape \(K, V, 3\); got \(164, 3\)"),
        (bars.keyframes[:2].long(), "got .* of torch.int64"),
    ):
        with pytest.raises(ValueError, match=message):
            InBetween(bases, bars.faces)


def test_modes_that_span_all_shapes() -> None:
    """Nothing is left of the difference then: its column was rounding, another on the fine mesh than on the coarse."""
    ball = trimesh.creation.icosahedron()
    first = torch.from_numpy(np.array(ball.vertices))
    second = torch.from_numpy(bend(first.numpy() * 0.9 + np.array([1.0, 0.0, 0.0]), 1.0, 1.0, 0.0, 2.0))
    faces = torch.from_numpy(np.array(ball.faces))
    found = []
    for method in ("solid", "shell"):
        bases = tm.extract_bases(torch.stack([first, second]), faces, 30, method=method, cache=False)
        for preset in ("accurate", "fast"):
            free = replace(tm.PRESETS[preset].objective, anchor=0.0)
            found.append(tm.InBetween(bases, faces, preset, objective=free)(first, second, 0.5))
    for one in found:
        torch.testing.assert_close(one, found[0], rtol=0, atol=1e-4)


@pytest.mark.xfail(
    strict=True, reason="pieces far apart share the size, the alignment, the coarse mesh and the modes; all four matter"
)
def test_a_ball_far_away_changes_nothing() -> None:
    sample = load_sample("creature")
    x, faces = sample.keyframes[:2], sample.faces
    ball = trimesh.creation.icosphere(subdivisions=1, radius=0.1 * diagonal(x[0]))
    far = torch.tensor(np.array(ball.vertices)) + x[0].mean(0) + times(3 * diagonal(x[0]), 0, 0)
    both = torch.cat([x, far.expand(2, -1, -1)], 1)
    all_faces = torch.cat([faces, torch.tensor(np.array(ball.faces)) + x.shape[1]])
    alone, together = (
        InBetween(tm.extract_bases(given, own, 15, progress=False), own, "fast")(*given, 0.5)
        for given, own in ((x, faces), (both, all_faces))
    )
    off = (together - torch.cat([alone, far])).norm(dim=-1) / diagonal(x[0])
    assert float(off.max()) < 1e-4
