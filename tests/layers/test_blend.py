"""Weighted in-betweens of several key-frames: invariances, gradients, what goes in and comes out."""

import warnings
from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np
import pytest
import torch
from conftest import Shapes, modal, random_rotation
from helpers.bodies import sheet_surface
from helpers.shapes import apart
from torch import Tensor

import torch_modal as tm
from torch_modal.data.samples import load_sample
from torch_modal.elastic.minimise import Status
from torch_modal.errors import ConvergenceError
from torch_modal.geometry.rigid import best_fit
from torch_modal.geometry.rotations import about, arc, conjugate, mean, product
from torch_modal.geometry.triangle_frames import sides
from torch_modal.geometry.vectors import cross
from torch_modal.layers.blend import Blend
from torch_modal.layers.in_between import InBetween

DOUBLE = torch.float64
pytestmark = pytest.mark.usefixtures("converged")
PRESETS = ("accurate", "fast")


def pulls(*values: float) -> Tensor:
    return torch.tensor(values, dtype=DOUBLE)


@pytest.fixture(scope="module")
def layer(bars: Shapes) -> Blend:
    return Blend(bars.bases, bars.faces, **modal(coarse_faces=200, local=True))


@pytest.fixture(scope="module")
def poses(bars: Shapes) -> Tensor:
    """Key-frames that are none of the bases', each with a rigid motion. *Shape:* ``(3, V, 3)``."""
    generator = torch.Generator().manual_seed(3)
    x = bars.keyframes + 0.02 * torch.randn(bars.keyframes.shape, generator=generator, dtype=DOUBLE)
    turn = torch.linalg.matrix_exp(torch.tensor([[0, -0.4, 0.1], [0.4, 0, 0.2], [-0.1, -0.2, 0]], dtype=DOUBLE))
    return torch.stack([x[0], x[1] @ turn.mT + 3, x[2] @ turn - 1])


def assert_no_order(layer: Blend, keyframes: Tensor, n: int = 6) -> None:
    """Two orders, and weights on both sides of a tie, of key-frames turned any way."""
    generator, d = torch.Generator().manual_seed(0), 1e-9
    for _ in range(n):
        turned = keyframes @ torch.stack([random_rotation(generator) for _ in range(3)]).mT
        w = torch.stack([pulls(0.4, 0.2, 0.4), pulls(0.42 + d, 0.42 - d, 0.16), pulls(0.42 - d, 0.42 + d, 0.16)])
        found, order = layer(turned, w), [2, 0, 1]
        assert apart(layer(turned[order], w[:, order]), found) < 1e-9
        assert apart(found[1], found[2]) < 1e-6


def assert_no_order_of_bases(layer: Blend, bases: list[tm.ModalBasis], keyframes: Tensor) -> None:
    w = torch.stack([pulls(0.4, 0.3, 0.3), pulls(0.2, 0.0, 0.8)])
    x, slope = (keyframes.clone().requires_grad_(), w.clone().requires_grad_())
    found = layer(x, slope)
    grads = torch.autograd.grad(found.square().sum(), (x, slope))
    for order in ([0, 2, 1], [1, 0, 2], [2, 1, 0]):
        other = Blend([bases[i] for i in order], layer.faces, objective=layer.objective, solver=layer.solver)
        y, weights = x[order].detach().requires_grad_(), w[:, order].requires_grad_()
        again = other(y, weights)
        assert apart(again.detach(), found.detach()) < 1e-9
        for own, wanted in zip(torch.autograd.grad(again.square().sum(), (y, weights)), grads, strict=True):
            wanted = wanted[order] if own.dim() == 3 else wanted[:, order]
            torch.testing.assert_close(own, wanted, rtol=1e-6, atol=1e-6 * float(wanted.abs().max()))


class TestTwo:
    @pytest.mark.parametrize("preset", PRESETS)
    def test_two_key_frames_are_an_in_between(self, bars: Shapes, preset: str) -> None:
        blend, between = (kind(bars.bases[1:], bars.faces, preset) for kind in (Blend, InBetween))
        for t in (0.0, 0.3, 0.5, 1.0):
            x = between(*bars.keyframes[1:], t)
            assert apart(blend(bars.keyframes[1:], pulls(1 - t, t)), x) < 1e-9


class TestInvariances:
    def test_all_the_weight_gives_the_key_frame_bit_for_bit(self, layer: Blend, poses: Tensor) -> None:
        for dtype in (DOUBLE, torch.float32):
            x = layer(poses.to(dtype), torch.eye(3, dtype=dtype))
            assert x.dtype == dtype
            assert torch.equal(x, poses.to(dtype))

    @pytest.mark.filterwarnings("ignore::torch_modal.MeshWarning")
    @pytest.mark.parametrize("name", [pytest.param("cow", marks=pytest.mark.slow), "hand"])
    def test_neither_order_nor_ties_count_in_bodies(self, name: str, data_dir: Path) -> None:
        if name == "cow":
            with np.load(data_dir / "animals" / "cow.npz") as given:
                frames, faces = torch.tensor(given["frames"]).double(), torch.tensor(given["faces"]).long()
            keyframes = frames[:: len(frames) // 3][:3]
        else:
            files = [data_dir / "mh-hand" / f"{n}.obj" for n in ("00-open", "02-fist", "04-spread")]
            keyframes, faces = tm.load_keyframes(files)
        bases = tm.extract_bases(keyframes, faces, 10, progress=False)
        warnings.simplefilter("ignore", tm.ConvergenceWarning)  # of the base alone
        for solver in (None, tm.Solver(max_steps=0, local_steps=0)):
            layer = Blend(bases, faces, solver=solver)
            assert_no_order(layer, keyframes, 2)
            assert_no_order_of_bases(layer, bases, keyframes)

    @pytest.mark.parametrize("backend", ["torch", "warp"])
    def test_neither_does_the_order_of_bases(
        self, bars: Shapes, poses: Tensor, backend: Literal["torch", "warp"]
    ) -> None:
        layer = Blend(bars.bases, bars.faces, **modal(coarse_faces=200, local=True, backend=backend))
        assert_no_order_of_bases(layer, bars.bases, poses)

    def test_a_weight_of_zero_leaves_the_in_between_of_the_others(self, bars: Shapes, poses: Tensor) -> None:
        """Exactly in one layer, and of the bases of these two alone; those of the third make the space another one."""
        three = Blend(bars.bases, bars.faces)
        for pair in ([0, 1], [2, 0]):
            bases, t, w = [bars.bases[i] for i in pair], pulls(0.6, 0.4), torch.zeros(3, dtype=DOUBLE)
            w[pair] = t
            assert apart(three(poses, w), three(poses[pair], t)) < 1e-9
            between = InBetween(bases, bars.faces)(*poses[pair], t[1])
            assert apart(Blend(bases, bars.faces)(poses, w), between) < 1e-9
            assert apart(three(poses, w), between) < 0.005

    def test_one_twice_has_both_weights(self, layer: Blend, poses: Tensor) -> None:
        x = layer(poses, pulls(0.5, 0.2, 0.3))
        assert apart(layer(poses[[0, 1, 1, 2]], pulls(0.5, 0.15, 0.05, 0.3)), x) < 1e-6
        assert apart(layer(poses[[0, 0]], pulls(0.6, 0.4)), poses[0]) < 1e-6

    def test_rigid_motions_have_a_mean(self, layer: Blend, bars: Shapes) -> None:
        x = bars.keyframes[0]
        angles = torch.tensor([0.0, 0.8, -0.5, 1.1], dtype=DOUBLE)
        c, s, zero = angles.cos(), angles.sin(), torch.zeros(4, dtype=DOUBLE)
        turns = torch.stack([c, -s, zero, s, c, zero, zero, zero, zero + 1], -1).view(4, 3, 3)
        w = pulls(0.1, 0.2, 0.3, 0.4)
        angle = (w * angles).sum()
        expected = x @ torch.linalg.matrix_exp(angle * torch.tensor([[0, -1, 0], [1, 0, 0], [0, 0, 0.0]]).double()).mT
        found = layer(x @ turns.mT + torch.arange(4)[:, None, None], w)
        area_centre = layer.core.alignment.weights @ x / layer.core.alignment.weights.sum()
        moves = torch.arange(4) + 0.0
        centre = (w[:, None] * (area_centre @ turns.mT + moves[:, None])).sum(0)
        expected = expected - expected.mean(0)
        assert apart(found - found.mean(0), expected) < 1e-9
        centres = layer.core.alignment.weights @ found / layer.core.alignment.weights.sum()
        torch.testing.assert_close(centres, centre, rtol=0, atol=1e-9)

    def test_weights_a_little_below_zero_go_on(self, layer: Blend, poses: Tensor) -> None:
        near, on, beyond = (layer(poses, pulls(0.6 - d, 0.4, d)) for d in (1e-3, 0.0, -1e-3))
        assert apart(near + beyond, 2 * on) < 1e-4  # no kink at zero
        result = layer.solve(poses, pulls(1.2, -0.1, -0.1))
        assert int(result.solution.status) == Status.CONVERGED
        assert apart(result.shapes, poses[0]) < 0.5

    def test_a_weight_of_one_beside_others_is_not_all_the_weight(self, layer: Blend, poses: Tensor) -> None:
        near, on, beyond = (layer(poses, pulls(1 - d, 0.1, d - 0.1)) for d in (1e-4, 0.0, -1e-4))
        assert apart(near + beyond, 2 * on) < 1e-4  # no jump to the key-frame
        assert apart(on, poses[0]) > 1e-2


class TestGradients:
    def test_at_a_key_frame_there_is_one(self, layer: Blend, poses: Tensor) -> None:
        w = pulls(0, 1, 0).requires_grad_()
        x = layer(poses, w)
        assert torch.equal(x, poses[1])
        x.square().sum().backward()
        assert w.grad is not None and bool(w.grad.isfinite().all()) and bool(w.grad.any())

    @pytest.mark.parametrize("of", [0, 1])
    def test_second_ones(self, layer: Blend, poses: Tensor, of: int) -> None:
        """Of reverse mode, against differences and forward mode."""
        given = [poses, pulls(0.5, 0.2, 0.3)]

        def value(x: Tensor) -> Tensor:
            return layer(*[x if i == of else other for i, other in enumerate(given)]).square().sum()

        leaf, generator = given[of].clone().requires_grad_(), torch.Generator().manual_seed(2)
        direction = torch.randn(leaf.shape, generator=generator, dtype=DOUBLE)
        direction = direction - direction.mean(0)  # weights add up to one
        slope, step = torch.func.grad(value), 1e-4
        wanted = (slope(given[of] + step * direction) - slope(given[of] - step * direction)) / (2 * step)
        (once,) = torch.autograd.grad(value(leaf), leaf, create_graph=True)
        (twice,) = torch.autograd.grad((once * direction).sum(), leaf)
        assert float((twice - wanted).norm()) < 1e-4 * float(wanted.norm())
        forward = torch.func.jvp(slope, (given[of],), (direction,))[1]
        torch.testing.assert_close(forward, twice, rtol=1e-6, atol=1e-6 * float(twice.abs().max()))


class TestResults:
    def test_it_is_near_the_optimum(self, bars: Shapes, poses: Tensor, layer: Blend) -> None:
        """Of the energy on the fine mesh, against that of a long descent of all vertices, and of the linear blend."""
        polished = Blend(bars.bases, bars.faces, solver=tm.Solver(polish=30))
        shell, frame, w = tm.ShellEnergy(bars.faces), layer.core.alignment, pulls(0.4, 0.3, 0.3)

        def energy(x: Tensor) -> float:
            each = (shell(frame.scale * x, frame.scale * pose) for pose in bars.keyframes)
            return float(sum(own * part for own, part in zip(w, each, strict=True)))

        best, found = (energy(one(bars.keyframes, w)) for one in (polished, layer))
        linear = energy((w[:, None, None] * bars.keyframes).sum(0))
        assert best <= found < best + 0.1 * (linear - best)

    @pytest.mark.filterwarnings("ignore::torch_modal.MeshWarning")
    @pytest.mark.parametrize("first", [1.6, 0.1])
    def test_strips_of_several_curvatures_have_the_mean_one(self, first: float) -> None:
        """Of 1.6 and -1.2 the ends turn by more than a full turn from each other."""
        flat, faces = map(torch.from_numpy, sheet_surface((29, 9), (3.0, 1.0)))
        u, v = flat[:, 0], flat[:, 2]

        def rolled(k: float) -> Tensor:
            return torch.stack([torch.sin(k * u) / k, v, (1 - torch.cos(k * u)) / k], -1)

        x = torch.stack([rolled(first), rolled(-1.2), rolled(0.7)])
        bases = tm.extract_bases(x, faces, 10, progress=False)
        truth = rolled(0.5 * first - 0.48 + 0.07)
        for order in ([0, 1, 2], [0, 2, 1], [2, 1, 0]):
            found = Blend([bases[i] for i in order], faces)(x, pulls(0.5, 0.4, 0.1))
            found = best_fit(found, truth, torch.ones(300, dtype=DOUBLE)).apply(found)
            assert apart(found, truth) < 1e-3

    @pytest.mark.parametrize("name", ["hand", pytest.param("creature", marks=pytest.mark.slow)])
    def test_no_triangle_folds_over(self, name: str) -> None:
        sample = load_sample(name)
        bases = tm.extract_bases(sample.keyframes, sample.faces, 15, progress=False)
        n, generator = len(bases), torch.Generator().manual_seed(0)
        w = torch.distributions.Exponential(1.0).icdf(torch.rand(8, n, generator=generator, dtype=DOUBLE))
        w = w / w.sum(-1, keepdim=True)
        result = Blend(bases, sample.faces, "fast").solve(sample.keyframes, w)
        assert bool(result.solution.usable.all())
        opposite = lambda x: turned_over(x, sample.faces)  # noqa: E731
        worst = max(opposite(x) for x in sample.keyframes)
        assert max(opposite(x) for x in result.shapes) <= worst + 0.001

    @pytest.mark.parametrize("place", [0, 2])
    def test_a_key_frame_without_weight_is_not_looked_at(self, layer: Blend, poses: Tensor, place: int) -> None:
        w, others = pulls(0.35, 0.3, 0.35), [i for i in range(3) if i != place]
        w[place] = 0
        w = (w / w.sum()).requires_grad_()
        truth = layer(poses[others], w[others]).detach()
        nothing = poses[place] * torch.nan, torch.ones_like(poses[0]), poses[place] * pulls(-1, 1, 1)
        for bad in nothing:
            x = poses.clone()
            x[place] = bad
            x.requires_grad_()
            found = layer(x, w)
            assert apart(found.detach(), truth) < 1e-6
            for slope in torch.autograd.grad(found.square().sum(), (x, w)):
                assert bool(slope.isfinite().all())


class TestErrors:
    @pytest.mark.parametrize(
        "weights, words",
        [
            (pulls(0.5, 0.2, 0.2), "add up to 1"),
            (pulls(0.9, 0.4, -0.3), "below zero to -0.25"),
            (pulls(1.4, -0.2, -0.2), "below zero to -0.25"),
            (pulls(0.5, torch.nan, 0.5), "add up to 1"),
            (pulls(0.5, 0.5), r"keyframes must be .* \(\.\.\., 2, 164, 3\)"),
            (torch.tensor([1, 0, 0]), "floating-point"),
            ([0.5, 0.2, 0.3], "weights is a list"),
        ],
    )
    def test_weights_that_do_not_fit(self, layer: Blend, poses: Tensor, weights: Tensor, words: str) -> None:
        with pytest.raises(ValueError, match=words):
            layer(poses, weights)

    def test_weights_of_low_precision_add_up_to_one(self, layer: Blend, poses: Tensor) -> None:
        weights = torch.tensor([0.2, 0.3, 0.5], dtype=torch.bfloat16)
        assert float(weights.double().sum()) != 1
        truth = layer(poses, weights.double() / weights.double().sum())
        assert apart(layer(poses, weights), truth) < 1e-5
        with pytest.raises(ValueError, match="weights add up to 1"):
            layer(poses, weights + torch.tensor([0.1, 0, 0], dtype=torch.bfloat16))

    def test_weights_that_do_not_fit_within_transforms(self, layer: Blend, poses: Tensor) -> None:
        wrong, pose = pulls(0.5, 0.2, 0.2), poses[0]

        def value(w: Tensor) -> Tensor:
            return (layer(poses, w) * pose).sum()

        for call in (
            lambda: torch.func.jvp(value, (wrong,), (wrong,)),
            lambda: torch.func.vmap(torch.func.grad(value), in_dims=1)(wrong[:, None]),
            lambda: torch.func.functional_call(layer, dict(layer.named_buffers()), (poses, wrong)),
        ):
            with pytest.raises(ValueError, match="add up to 1"):
                call()

    def test_unconverged_samples_are_reported(self, bars: Shapes, poses: Tensor) -> None:
        layer = Blend(bars.bases, bars.faces, **modal(coarse_faces=200, max_steps=0))
        weights = torch.stack([pulls(0.5, 0.2, 0.3), pulls(0.2, 0.3, 0.5)])
        with pytest.warns(tm.ConvergenceWarning, match="2 of 2 in-betweens did not converge in 0 steps"):
            layer(poses, weights)
        layer.solver = replace(layer.solver, unconverged="raise")
        with pytest.raises(ConvergenceError, match="2 of 2"):
            layer(poses.clone().requires_grad_(), weights)

    def test_settings_of_pairs(self, bars: Shapes) -> None:
        for changes in ({"space": "paired"}, {"contact": True}):
            with pytest.raises(ValueError, match="of two key-frames"):
                Blend(bars.bases, bars.faces, objective=tm.Objective(**changes))  # type: ignore[arg-type]


class TestParts:
    def test_the_mean_of_rotations_has_no_gradient_of_squared_angles(self, generator: torch.Generator) -> None:
        half = torch.randn(3, 5, 40, generator=generator, dtype=DOUBLE)
        half = 0.6 * half / half.norm(dim=0).clamp_min(1)
        w = torch.softmax(torch.randn(5, 1, generator=generator, dtype=DOUBLE), 0)
        rotations = about(half)
        found = mean(rotations, w)
        left = (w * arc(product(conjugate(found)[:, None], rotations))).sum(-2)
        assert float(left.abs().max()) < 1e-10


def turned_over(x: Tensor, faces: Tensor) -> float:
    """Part of the neighbouring triangles whose normals are opposite."""
    first, second = sides(x.T[:, None], faces)
    normals = torch.nn.functional.normalize(cross(first, second)[:, 0], dim=0)
    pairs = torch.tensor(tm.geometry.connectivity.Connectivity(faces.numpy(), len(x)).face_neighbours)
    return float(((normals[:, pairs[:, 0]] * normals[:, pairs[:, 1]]).sum(0) < -0.9).double().mean())
