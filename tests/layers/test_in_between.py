"""The in-between as a differentiable layer: values, gradients, single samples of a batch, torch's own tools."""

import copy
import math
import warnings
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import pytest
import torch
import trimesh
from conftest import Shapes, modal
from helpers.bodies import bend, twisted_plate
from helpers.shapes import diagonal
from torch import Tensor

import torch_modal as tm
from torch_modal.elastic import implicit
from torch_modal.elastic.minimise import Status
from torch_modal.elastic.shell import ShellEnergy
from torch_modal.errors import ConvergenceError
from torch_modal.geometry.connectivity import Connectivity
from torch_modal.inbetween.joint import JointSpace
from torch_modal.inbetween.results import ConvergenceWarning
from torch_modal.inbetween.settings import PRESETS, Solver
from torch_modal.layers.in_between import InBetween
from torch_modal.modes.basis import ModalBasis

DOUBLE = torch.float64
pytestmark = pytest.mark.usefixtures("converged")


def times(*values: float) -> Tensor:
    return torch.tensor(values, dtype=DOUBLE)


@pytest.fixture(scope="module")
def layer(bars: Shapes) -> InBetween:
    return InBetween(bars.bases[:2], bars.faces, **modal(coarse_faces=200))


class TestValues:
    @pytest.mark.parametrize(
        "lead, t_shape, expected",
        [((), (), ()), ((), (3,), (3,)), ((2,), (2,), (2,)), ((2, 1), (3,), (2, 3)), ((3, 2), (3, 1), (3, 2))],
    )
    def test_leading_dimensions_broadcast(
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

    @pytest.mark.parametrize("dtype", [DOUBLE, torch.float32])
    def test_times_beside_the_ends_are_the_ends(self, layer: InBetween, bars: Shapes, dtype: torch.dtype) -> None:
        """Ten steps of a tenth, summed in float32, end at 1.0000001."""
        keyframes = bars.keyframes[:2].to(dtype)
        summed = float(sum(torch.full((10,), 0.1)))
        assert 1 < summed < 1 + 1e-6
        t = torch.tensor([-9e-7, summed, 1 + 9e-7], dtype=dtype, requires_grad=True)
        x = layer(*keyframes, t)
        assert torch.equal(x, keyframes[[0, 1, 1]])
        (slopes,) = torch.autograd.grad(x.square().sum(), t)
        assert bool((slopes != 0).all())  # a clamp would cut them
        for beyond in (-1.2e-6, 1 + 1.2e-6):
            with pytest.raises(ValueError, match=r"t lies in \[0, 1\]"):
                layer(*keyframes, beyond)

    def test_faces_may_be_a_reversed_view_of_an_array(self, bars: Shapes) -> None:
        x, turned = bars.keyframes, bars.faces.numpy()[:, ::-1]  # torch.from_numpy refuses negative strides
        assert InBetween(bars.bases[:2], turned)(x[0], x[1], 0.5).isfinite().all()
        assert ShellEnergy(turned)(x[0], x[1]) > 0

    def test_steps_of_all_vertices_lower_the_energy(self, bars: Shapes) -> None:
        layers = [
            InBetween(bars.bases[1:], bars.faces, **modal(coarse_faces=200, local=n > 0, polish=n // 2))
            for n in range(3)
        ]
        x_a, x_b = bars.keyframes[1:]
        shell = ShellEnergy(bars.faces)
        scale = 100 / diagonal(x_a)
        energies = [float(sum(shell(scale * layer(x_a, x_b, 0.5), scale * x) for x in (x_a, x_b))) for layer in layers]
        assert energies[2] < energies[1] < energies[0]

    def test_key_frames_in_the_place_of_bases_leave_out_the_modal_solve(self, bars: Shapes) -> None:
        x = bars.keyframes[1:]
        plain, given_bases = InBetween(x, bars.faces), InBetween(bars.bases[1:], bars.faces)
        found = plain.solve(*x, times(0.0, 0.3, 1.0))
        assert torch.equal(found.shapes[::2], x) and bool(found.solution.converged.all())
        torch.testing.assert_close(given_bases.solve(*x, times(0.0, 0.3, 1.0)).shapes, found.shapes, rtol=0, atol=0)
        no_steps = InBetween(bars.bases[1:], bars.faces, "modal", solver=Solver(max_steps=0))
        truth = no_steps.solve(*x, times(0.3)).shapes[0]
        torch.testing.assert_close(found.shapes[1], truth, rtol=0, atol=1e-12)
        with pytest.raises(ValueError, match="minimise in modes, and there are none: pass bases"):
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
        assert found.solution.status == Status.FELL_BACK and float(found.solution.start_weights[1]) == 1
        torch.testing.assert_close(found.shapes, straight.shapes, rtol=0, atol=1e-9)

    def test_a_blend_that_is_not_finite_is_straight(self, bars: Shapes, monkeypatch: pytest.MonkeyPatch) -> None:
        layer = InBetween(bars.bases[1:], bars.faces, **modal(coarse_faces=200))
        poisson = type(layer.core.blend.poisson)
        monkeypatch.setattr(poisson, "forward", lambda self, edges, near: torch.nan * near)
        found = layer.solve(*bars.keyframes[1:], 0.4)
        assert found.shapes.isfinite().all() and found.solution.converged


class TestGradients:
    @pytest.mark.parametrize("space", ["joint", pytest.param("paired", marks=pytest.mark.slow)])
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

    def test_memory_does_not_grow_with_the_steps(self, bars: Shapes) -> None:
        """With hooks on what is saved, as of checkpoints, which ``torch.func`` refuses."""

        def saved(tolerance: float) -> int:
            layer = InBetween(bars.bases[1:], bars.faces, **modal(coarse_faces=200, tolerance=tolerance))
            total = 0

            def pack(tensor: Tensor) -> Tensor:
                nonlocal total
                total += tensor.numel() * tensor.element_size()
                return tensor

            x_a = bars.keyframes[1].clone().requires_grad_()
            with torch.autograd.graph.saved_tensors_hooks(pack, lambda tensor: tensor):
                layer(x_a, bars.keyframes[2], 0.4)
            return total

        assert saved(1e-1) == saved(1e-12) > 0


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

    def test_unconverged_samples_are_reported(self, bars: Shapes, monkeypatch: pytest.MonkeyPatch) -> None:
        x_a, x_b = bars.keyframes[1:]
        x_b = torch.stack([x_b, x_a]).clone().requires_grad_()
        layer = InBetween(bars.bases[1:], bars.faces, **modal(coarse_faces=200, max_steps=0))
        with pytest.warns(ConvergenceWarning, match="1 of 2 .* in 0 steps .*1 OUT_OF_STEPS"):
            shapes = layer(x_a, x_b, 0.5)
        # Of the sample that did not converge only the part moves that does not go through the amplitudes.
        adjoints, whole = [], JointSpace.value_and_gradient

        def watch(*arguments: Any) -> tuple[Tensor, Tensor]:
            value, gradient = whole(*arguments)
            if gradient.requires_grad:
                gradient.register_hook(adjoints.append)
            return value, gradient

        monkeypatch.setattr(JointSpace, "value_and_gradient", watch)
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


class TestTorch:
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
        monkeypatch.setattr(implicit, "add_ridge", lambda hessian: keep * hessian)
        with pytest.warns(ConvergenceWarning, match="the Hessian of 1 in-betweens is singular"):
            (found,) = torch.autograd.grad(shapes.sum(), x_a)
        torch.testing.assert_close(found[0], truth[0], rtol=1e-6, atol=1e-8)
        assert bool(found[1].isfinite().all())


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda layer, a, b: layer(a, b[:-1], 0.5), "x_b must be floating-point of shape"),
        (lambda layer, a, b: layer(a[:, :2], b, 0.5), r"got \(164, 2\)"),
        (lambda layer, a, b: layer(a.long(), b, 0.5), "x_a must be floating-point"),
        (lambda layer, a, b: layer(a.numpy(), b, 0.5), "x_a is a ndarray; pass a tensor"),
        (lambda layer, a, b: layer(a.expand(2, -1, -1), b.expand(3, -1, -1), 0.5), "do not broadcast"),
        (lambda layer, a, b: layer(a.expand(3, -1, -1), b, torch.rand(4)), r"t \(4,\); .* x_a\[:, None\]"),
        *((lambda layer, a, b, t=t: layer(a, b, times(0.5, t)), r"t lies in \[0, 1\]") for t in (-0.1, 1.5, math.nan)),
    ],
)
def test_what_a_call_refuses(call: Any, message: str, layer: InBetween, bars: Shapes) -> None:
    with pytest.raises(ValueError, match=message):
        call(layer, *bars.keyframes[:2])


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (lambda: modal(unconverged="hide"), "'warn', 'raise'"),
        (lambda: modal(backend="cuda"), "backend is one of 'auto', 'torch', 'warp'; got 'cuda'"),
        (lambda: modal(tolerance=-1.0), "tolerance bounds a relative gradient norm"),
        (lambda: modal(coarse_faces=3), "coarse_faces is a whole number, 4 or more"),
        (lambda: modal(polish=-1), "polish is a whole number"),
        (lambda: modal(polish=1.5), "polish is a whole number"),
        (lambda: {"preset": "best"}, "preset is one of 'accurate', 'fast', 'modal', 'paper'; got 'best'"),
        (lambda: modal(space="both"), "space is one of 'joint', 'paired'; got 'both'"),
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
        (bars.keyframes[0], r"key-frames without modes must be floating-point of shape \(K, V, 3\); got \(164, 3\)"),
        (bars.keyframes[:2].long(), "dtype torch.int64.* convert"),
        ([bars.bases[0], bars.keyframes[1].numpy()], "come from extract_bases; got ndarray"),
        (["open.obj", "fist.obj"], "is a str that is no array of numbers"),
        (None, "is a NoneType that is no array of numbers"),
    ):
        with pytest.raises(ValueError, match=message):
            InBetween(bases, bars.faces)


@pytest.mark.parametrize("kind", [InBetween, tm.Blend, partial(tm.MidShape, preset="accurate"), tm.Path])
def test_key_frames_in_the_place_of_bases_are_arrays_or_lists(kind: Any, bars: Shapes) -> None:
    x = bars.keyframes[:2]
    wanted = kind(x, bars.faces).state_dict()
    for given in (x.numpy(), list(x), list(x.numpy()), x.tolist()):
        for own, value in zip(kind(given, bars.faces).state_dict().values(), wanted.values(), strict=True):
            assert torch.equal(own, value)


@pytest.mark.parametrize("preset", ["modal"])
def test_the_energy_is_that_of_the_shell(preset: Any, bars: Shapes) -> None:
    """Eq. 5 at a size of 100; the solver's mesh and alignment differ a little from the caller's."""
    x, y = bars.keyframes[:2]
    found, shell = InBetween(bars.bases[:2], bars.faces, preset).solve(x, y, 0.3), tm.ShellEnergy(bars.faces)
    scale = 100 / (x.amax(0) - x.amin(0)).norm()
    expected = 0.7 * shell(scale * found.shapes, scale * x) + 0.3 * shell(scale * found.shapes, scale * y)
    torch.testing.assert_close(found.solution.energy, expected, rtol=0.2, atol=0)


@pytest.mark.parametrize("wrong", ["not finite", "shape", "missing", "unexpected"])
@pytest.mark.parametrize("kind", [InBetween, tm.Path])
def test_a_state_that_is_refused_changes_nothing(kind: Any, wrong: str, bars: Shapes) -> None:
    layer = kind(bars.bases[:2], bars.faces, preset="modal", **({"smooth": False} if kind is tm.Path else {}))
    before = {name: value.clone() for name, value in layer.state_dict().items()}
    state = {name: 2 * value for name, value in before.items()}
    if wrong == "not finite":
        state["bases.1.reference"][3] = torch.nan
    elif wrong == "shape":
        state["bases.1.modes"] = state["bases.1.modes"][1:]
    elif wrong == "missing":
        del state["bases.1.modes"]
    else:
        state["bases.2.modes"] = state["bases.1.modes"]
    with pytest.raises((ValueError, RuntimeError), match=r"NaN|which stays as it is: bases"):
        layer.load_state_dict(state)
    with pytest.raises((ValueError, RuntimeError)):
        torch.nn.Sequential(layer).load_state_dict({f"0.{name}": value for name, value in state.items()})
    for name, value in layer.state_dict().items():
        assert torch.equal(value, before[name])


def test_a_loaded_state_does_not_reach_the_bases(bars: Shapes) -> None:
    """The basis that a layer was made from stays as it is."""
    own = [replace(basis, reference=basis.reference.clone(), modes=basis.modes.clone()) for basis in bars.bases[:2]]
    layer, other = (InBetween(bases, bars.faces, "modal") for bases in (own, bars.bases[1:]))
    layer.load_state_dict(other.state_dict())
    assert torch.equal(layer.bases[0].modes, bars.bases[1].modes)
    for basis, before in zip(own, bars.bases, strict=False):
        assert torch.equal(basis.reference, before.reference) and torch.equal(basis.modes, before.modes)


def test_stiffnesses_that_reach_a_few_edges_are_told(bars: Shapes) -> None:
    """One that is learned, or of each edge, is enough; the modal solve minimises with them."""
    n_edges = len(Connectivity(bars.faces.numpy()).edges)
    stiffnesses = torch.tensor(500.0, dtype=DOUBLE, requires_grad=True), torch.full((n_edges,), 500.0, dtype=DOUBLE)
    for alpha in stiffnesses:
        with pytest.warns(UserWarning, match="act on the local steps alone"):
            InBetween(bars.keyframes[:2], bars.faces, objective=tm.Objective(alpha=alpha))
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            InBetween(bars.bases[:2], bars.faces, objective=tm.Objective(space="joint", alpha=alpha))
            InBetween(bars.keyframes[:2], bars.faces, objective=tm.Objective(alpha=alpha.detach().mean()))


def test_other_bases_in_functional_call_are_refused(bars: Shapes) -> None:
    """What a layer computes from its bases is not computed again."""
    layer, x = InBetween(bars.bases[:2], bars.faces, "modal"), bars.keyframes
    own = torch.func.functional_call(layer, layer.state_dict(), (x[0], x[1], 0.4))
    torch.testing.assert_close(own, layer(x[0], x[1], 0.4))
    modes = [bars.bases[0], replace(bars.bases[1], modes=2 * bars.bases[1].modes)]
    for bases in (bars.bases[1:], modes):
        state = InBetween(bases, bars.faces, "modal").state_dict()
        for one in (layer, InBetween(bars.bases[:2], bars.faces, "modal").float()):
            with pytest.raises(RuntimeError, match="bases of this InBetween were replaced"):
                torch.func.functional_call(one, state, (x[0], x[1], 0.4))


def test_modes_that_span_all_shapes() -> None:
    """Nothing is left of the difference then: its column was rounding, another on the fine mesh than on the coarse."""
    ball = trimesh.creation.icosahedron()
    first = torch.from_numpy(np.array(ball.vertices))
    second = torch.from_numpy(bend(first.numpy() * 0.9 + np.array([1.0, 0.0, 0.0]), 1.0, 1.0, 0.0, 2.0))
    faces = torch.from_numpy(np.array(ball.faces))
    found = []
    for method in ("solid", "shell"):
        bases = tm.extract_bases(torch.stack([first, second]), faces, 30, method=method, cache=False)
        free = replace(PRESETS["modal"].objective, anchor=0.0)
        found.append(tm.InBetween(bases, faces, objective=free)(first, second, 0.5))
    for one in found:
        torch.testing.assert_close(one, found[0], rtol=0, atol=1e-4)


@pytest.mark.parametrize("kind", ["side", "line", "point"])
def test_gradients_at_a_triangle_without_area_have_a_bound(hands: Shapes, kind: str, backend: str) -> None:
    layer = tm.InBetween([hands.bases[0], hands.bases[4]], hands.faces, solver=tm.Solver(backend=backend))
    a, b, c = hands.faces[50]

    def gradient(x: Tensor) -> Tensor:
        x = x.clone().requires_grad_()
        return torch.autograd.grad(layer(x[0], x[1], 0.4).square().sum(), x)[0]

    x = hands.keyframes[[0, 4]]
    truth = gradient(x)
    x[1, a] = 0.5 * (x[1, b] + x[1, c]) if kind == "line" else x[1, b]
    if kind == "point":
        x[1, c] = x[1, b]
    assert gradient(x).norm() < 1.2 * truth.norm()


def test_a_key_frame_is_returned_beside_one_that_is_not_finite(small_bars: Shapes) -> None:
    layer = tm.InBetween(small_bars.bases[:2], small_bars.faces)
    x_a, x_b = small_bars.keyframes[:2]
    leaf = x_a.clone().requires_grad_()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ConvergenceWarning)
        for t in (0, torch.tensor(0.0, dtype=torch.float64)):
            shape = layer(leaf, x_b * torch.nan, t)
            assert torch.equal(shape, x_a)
            (gradient,) = torch.autograd.grad(shape.sum(), leaf)
            assert gradient.isfinite().all()
        assert layer(leaf, x_b * torch.nan, 0.5).isnan().all()


def test_other_units_than_those_of_the_bases_are_told_once(small_bars: Shapes, backend: str) -> None:
    solver = tm.Solver(backend=backend)
    layer = tm.InBetween(small_bars.bases[:2], small_bars.faces, solver=solver)
    with pytest.warns(tm.MeshWarning, match=r"are 4 times as large as the shapes"):
        layer.solve(*(4 * small_bars.keyframes[:2]), 0.5)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        layer.solve(*(4 * small_bars.keyframes[:2]), 0.5)
        tm.InBetween(small_bars.bases[:2], small_bars.faces, solver=solver).solve(*(2 * small_bars.keyframes[:2]), 0.5)
