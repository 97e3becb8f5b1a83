"""Forward-mode derivatives of all layers: what backward has, transposed."""

import warnings
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import pytest
import torch
from conftest import Shapes
from torch import Tensor
from torch.autograd import forward_ad
from torch.func import functional_call, grad, jacfwd, jvp
from torch_modal.inbetween.among import _aligned
from torch_modal.layers.modal_decoder import ModalDecoder

import torch_modal as tm
from torch_modal.geometry.rotations import about, mean

DOUBLE = torch.float64


@pytest.fixture(autouse=True)
def quiet_is_converged() -> Iterator[None]:
    """A minimisation that does not converge fails the test, unless the test expects it."""
    with warnings.catch_warnings():
        warnings.simplefilter("error", tm.ConvergenceWarning)
        yield


class Case(NamedTuple):
    """A layer, where it is differentiated, and directions."""

    layer: Callable[..., Tensor]
    given: tuple[Tensor, ...]
    tangents: tuple[Tensor, ...]


def numbers(*values: float) -> Tensor:
    return torch.tensor(values, dtype=DOUBLE)


def like(x: Tensor, seed: int = 0) -> Tensor:
    return torch.randn(x.shape, dtype=DOUBLE, generator=torch.Generator().manual_seed(seed + x.numel()))


def in_between(bars: Shapes, preset: Any) -> Case:
    layer = tm.InBetween(bars.bases[:2], bars.faces, preset)
    x_a, x_b, _ = bars.keyframes
    middle = preset == "paper"
    t = numbers(0.5, 0.5) if middle else numbers(0.3, 0.6)
    return Case(layer, (x_a, x_b, t), (like(x_a), like(x_b, 1), 0 * t if middle else like(t)))


def mid_shape(bars: Shapes) -> Case:
    pair = tuple(bars.keyframes[:2])
    return Case(tm.MidShape(bars.bases[:2], bars.faces, preset="fast"), pair, tuple(map(like, pair)))


def blend(bars: Shapes, preset: Any) -> Case:
    weights = numbers(0.3, 0.5, 0.2)
    tangents = like(bars.keyframes), numbers(1, -3, 2)
    return Case(tm.Blend(bars.bases, bars.faces, preset), (bars.keyframes, weights), tangents)


def decoder(bars: Shapes) -> Case:
    layer = ModalDecoder(bars.keyframes, bars.faces, [0, 1, 2], bars.keyframes[0], bars.bases[0].modes)
    given = 0.5 * like(torch.empty(2, 8)), numbers(0.3, 1.4), 0.1 * like(torch.empty(2, 6)), bars.keyframes
    return Case(layer, given, tuple(like(x, 1) for x in given))


def path(bars: Shapes, preset: Any, smooth: bool) -> Case:
    layer = tm.Path(bars.bases, bars.faces, preset=preset, smooth=smooth)
    given = bars.keyframes, numbers(0.3, 1.4)
    return Case(layer, given, tuple(like(x) for x in given))


CASES: dict[str, Callable[[Shapes], Case]] = {
    **{f"in_between_{p}": lambda bars, p=p: in_between(bars, p) for p in ("paper", "fast", "accurate")},
    **{f"blend_{p}": lambda bars, p=p: blend(bars, p) for p in ("fast", "accurate")},
    "mid_shape": mid_shape,
    "decoder": decoder,
    "path_smooth": lambda bars: path(bars, "accurate", smooth=True),
    **{f"path_{p}": lambda bars, p=p: path(bars, p, smooth=False) for p in ("fast", "accurate")},
}


@pytest.fixture(scope="module", params=CASES)
def case(request: pytest.FixtureRequest, bars: Shapes) -> Case:
    return CASES[request.param](bars)


def dual(
    layer: Callable[..., Tensor], given: tuple[Tensor, ...], tangents: tuple[Tensor, ...]
) -> tuple[Tensor, Tensor]:
    """As ``torch.func.jvp``, without ``torch.func``."""
    with forward_ad.dual_level():
        out = layer(*map(forward_ad.make_dual, given, tangents))
        value, tangent = forward_ad.unpack_dual(out)
        assert tangent is not None
        return value, tangent


def backward(layer: Callable[..., Tensor], given: tuple[Tensor, ...], weights: Tensor) -> tuple[Tensor, ...]:
    leaves = [x.clone().requires_grad_() for x in given]
    return torch.autograd.grad(layer(*leaves), leaves, weights)


def require_transposed(case: Case, run: Callable[..., tuple[Tensor, Tensor]] = jvp, rtol: float = 1e-8) -> None:
    """Forward and backward are the same Jacobian; the value is that of the ordinary call."""
    with torch.no_grad():
        ordinary = case.layer(*case.given)
    weights = like(ordinary, 2)
    gradients = backward(case.layer, case.given, weights)
    value, tangent = run(case.layer, case.given, case.tangents)
    torch.testing.assert_close(value, ordinary, rtol=1e-12, atol=1e-12)
    each = [float((g * v).sum()) for g, v in zip(gradients, case.tangents, strict=True)]
    assert float((weights * tangent).sum()) == pytest.approx(sum(each), rel=rtol, abs=rtol * max(map(abs, each)))


def test_forward_is_the_transpose_of_backward(case: Case) -> None:
    require_transposed(case)
    require_transposed(case, dual)
    with torch.no_grad():  # of reverse mode alone
        found = dual(*case)
    for own, other in zip(found, jvp(*case), strict=True):
        torch.testing.assert_close(own, other, rtol=1e-10, atol=1e-12)


def test_each_argument_alone(case: Case) -> None:
    """The others are no dual tensors: kernels and torch meet."""
    weights = like(case.layer(*case.given), 2)
    gradients = backward(case.layer, case.given, weights)
    for i, (own, direction) in enumerate(zip(case.given, case.tangents, strict=True)):
        if not bool(direction.any()):
            continue

        def of_one(x: Tensor, i: int = i) -> Tensor:
            return case.layer(*case.given[:i], x, *case.given[i + 1 :])

        for run in (jvp, dual):
            tangent = run(of_one, (own,), (direction,))[1]
            assert float((weights * tangent).sum()) == pytest.approx(float((gradients[i] * direction).sum()), rel=1e-8)


@pytest.mark.parametrize("made", [in_between, blend])
def test_forward_is_the_limit_of_differences(bars: Shapes, made: Callable[[Shapes, str], Case]) -> None:
    case, step = made(bars, "accurate"), 1e-4
    tangents = tuple(0.05 * v for v in case.tangents)
    with torch.no_grad():
        up, down = (case.layer(*(x + s * v for x, v in zip(case.given, tangents, strict=True))) for s in (step, -step))
    tangent = jvp(case.layer, case.given, tangents)[1]
    assert float((tangent - (up - down) / (2 * step)).norm() / tangent.norm()) < 1e-4


def latents(name: str, case: Case) -> Callable[[Tensor], Tensor]:
    """The layer as a decoder of two numbers."""
    layer, (first, *_) = case.layer, case.given
    if name == "blend":
        return lambda z: layer(first, torch.softmax(torch.cat([z, z[:1] * z[1:]]), 0))
    if name == "decoder":
        return lambda z: layer(torch.cat([z, 0 * z, z.sin(), z.cos()]), 0.4 + z[1])
    if name == "path":
        return lambda z: layer(first + 0.01 * z[0] * case.tangents[0], 0.4 + z[1])
    return lambda z: layer(first + 0.01 * z[0] * case.tangents[0], case.given[1], 0.4 + z[1])


@pytest.mark.parametrize("name", ["in_between", "blend", "decoder", "path"])
def test_jacfwd_of_a_layer_that_nothing_has_used_before(bars: Shapes, name: str) -> None:
    """What layers keep is made within the transforms, and is good outside of them."""
    makers = {"in_between": lambda: in_between(bars, "accurate"), "blend": lambda: blend(bars, "fast")}
    makers |= {"decoder": lambda: decoder(bars), "path": lambda: path(bars, "accurate", smooth=True)}
    decode, z = latents(name, makers[name]()), numbers(0.1, -0.2)
    jacobian = jacfwd(decode)(z)
    eye = torch.eye(2, dtype=DOUBLE)
    torch.testing.assert_close(jacobian, torch.stack([jvp(decode, (z,), (e,))[1] for e in eye], -1))
    weights = like(jacobian[..., 0], 2)
    (gradient,) = backward(decode, (z,), weights)
    torch.testing.assert_close((weights[..., None] * jacobian).flatten(0, 1).sum(0), gradient, rtol=1e-8, atol=1e-10)


@pytest.mark.parametrize("kind", [tm.InBetween, tm.Blend])
def test_by_torch_alone(bars: Shapes, kind: type[Any]) -> None:
    made = in_between if kind is tm.InBetween else blend
    bases = bars.bases[:2] if kind is tm.InBetween else bars.bases
    layer = kind(bases, bars.faces, solver=tm.Solver(backend="torch"))
    require_transposed(made(bars, "accurate")._replace(layer=layer))


def test_stiffness_and_mu(bars: Shapes) -> None:
    for preset, objective, t in (
        ("fast", tm.Objective(coarse_faces=300, alpha=numbers(500.0), beta=numbers(10.0)), 0.3),
        ("paper", tm.Objective(space="paired", mu=torch.tensor(2.0, dtype=DOUBLE)), 0.5),
    ):
        layer = tm.InBetween(bars.bases[:2], bars.faces, preset, objective=objective)
        names = [name for name in layer.state_dict() if "bases" not in name]
        given = tuple(layer.state_dict()[name] for name in names)

        def run(*values: Tensor, layer: Any = layer, names: list[str] = names, t: float = t) -> Tensor:
            found: Tensor = functional_call(layer, dict(zip(names, values, strict=True)), (*bars.keyframes[:2], t))
            return found

        require_transposed(Case(run, given, tuple(x * (1 + i) for i, x in enumerate(given))))


@pytest.mark.parametrize("run", [jvp, dual])
def test_at_key_frames_the_tangent_is_that_of_the_in_between(bars: Shapes, run: Any) -> None:
    case = in_between(bars, "fast")._replace(given=(*bars.keyframes[:2], numbers(0, 1)))

    def without_reverse_mode(*given: Any) -> tuple[Tensor, Tensor]:
        with torch.no_grad():
            value, tangent = run(*given)
        assert torch.equal(value, bars.keyframes[:2])
        return value, tangent

    require_transposed(case, without_reverse_mode)


def test_no_tangent_goes_through_amplitudes_that_did_not_converge(bars: Shapes) -> None:
    layer = tm.InBetween(bars.bases[:2], bars.faces, solver=tm.Solver(max_steps=1))
    assert not bool(layer.solve(*bars.keyframes[:2], 0.3).solution.converged)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", tm.ConvergenceWarning)
        require_transposed(in_between(bars, "accurate")._replace(layer=layer))


def test_second_derivatives(bars: Shapes) -> None:
    case = in_between(bars, "accurate")
    decode, z, v = latents("in_between", case), numbers(0.1, -0.2), numbers(1, 2)
    weights = like(bars.keyframes[0], 2)

    def loss(z: Tensor) -> Tensor:
        return (weights * decode(z)).sum()

    leaf = z.clone().requires_grad_()
    (gradient,) = torch.autograd.grad(loss(leaf), leaf, create_graph=True)
    (expected,) = torch.autograd.grad(gradient, leaf, v)
    torch.testing.assert_close(jvp(grad(loss), (z,), (v,))[1], expected, rtol=1e-8, atol=0)
    torch.testing.assert_close(grad(lambda z: jvp(loss, (z,), (v,))[1])(z), expected, rtol=1e-8, atol=0)
    # Backward of dual tensors, whose kernels have no tangents.
    with forward_ad.dual_level():
        leaf = forward_ad.make_dual(z.clone().requires_grad_(), v)
        (gradient,) = torch.autograd.grad(loss(leaf), leaf)
        found = forward_ad.unpack_dual(gradient).tangent
    torch.testing.assert_close(found, expected, rtol=1e-8, atol=0)


def test_the_tangent_of_what_backward_receives(bars: Shapes) -> None:
    x_a, x_b, _ = bars.keyframes
    layer, leaf, direction = in_between(bars, "accurate").layer, x_a.clone().requires_grad_(), like(x_a, 3)
    (expected,) = torch.autograd.grad(layer(leaf, x_b, 0.3), leaf, direction)
    x = layer(leaf, x_b, 0.3)
    with forward_ad.dual_level():
        (gradient,) = torch.autograd.grad(x, leaf, forward_ad.make_dual(like(x_a, 4), direction))
        found = forward_ad.unpack_dual(gradient).tangent
    torch.testing.assert_close(found, expected, rtol=1e-8, atol=1e-10)


def test_forward_mode_within_forward_mode_is_refused(bars: Shapes) -> None:
    decode, z, v = latents("in_between", in_between(bars, "fast")), numbers(0.1, -0.2), numbers(1, 2)
    with pytest.raises(RuntimeError, match="forward mode within forward mode"):
        jvp(lambda z: jvp(decode, (z,), (v,))[1], (z,), (v,))
    assert jvp(decode, (z,), (v,))[1].isfinite().all()


@pytest.mark.parametrize("kind", [tm.InBetween, tm.Path])
@pytest.mark.parametrize("run", [jvp, dual])
def test_contact_is_refused(bars: Shapes, kind: Any, run: Any) -> None:
    pytest.importorskip("ipctk")
    pytest.importorskip("igl")
    layer = kind(bars.bases[:2], bars.faces, contact=True)
    t, pair = numbers(0.3), bars.keyframes[:2]
    given = (*pair, t) if kind is tm.InBetween else (pair, t)
    with pytest.raises(RuntimeError, match="no forward mode"):
        run(layer, given, tuple(like(x) for x in given))
    # And where it is the time alone that has a tangent.
    with pytest.raises(RuntimeError, match="no forward mode"):
        run(lambda t: layer(*given[:-1], t), (t,), (torch.ones_like(t),))


@pytest.mark.parametrize("run", [jvp, dual])
def test_a_fit_to_observations_is_refused(bars: Shapes, run: Any) -> None:
    space, picked = tm.ShapeSpace(bars.bases, bars.faces, dtype=DOUBLE), torch.arange(0, len(bars.keyframes[0]), 9)
    points = bars.keyframes[1][picked]
    with pytest.raises(RuntimeError):
        run(lambda points: space.fit(points, picked).shape, (points,), (like(points),))


@pytest.mark.parametrize("run", [jvp, dual])
def test_the_mean_of_rotations_that_are_far_apart(run: Any) -> None:
    """Its last step alone has derivatives, although ``torch.no_grad`` does not end forward mode."""
    rotations = about(0.6 * like(torch.empty(3, 3, 20)))
    weights = numbers(0.3, 0.5, 0.2)[:, None]
    require_transposed(Case(mean, (rotations, weights), (like(rotations), numbers(1, -3, 2)[:, None])), run, 1e-12)


@pytest.mark.parametrize("run", [jvp, dual])
def test_poses_of_key_frames_that_are_far_from_each_other(bars: Shapes, run: Any) -> None:
    """Likewise: the last rounds alone."""
    frame = tm.Blend(bars.bases, bars.faces, "fast").layer.members[0].frame
    keyframes = bars.keyframes[None] + 0.8 * like(bars.keyframes[None])
    given = keyframes, numbers(0.3, 0.5, 0.2)[None]

    def shapes(*given: Tensor) -> Tensor:
        return _aligned(frame, *given).shapes

    require_transposed(Case(shapes, given, (like(keyframes), numbers(1, -3, 2)[None])), run, 1e-11)
