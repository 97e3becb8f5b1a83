"""Derivatives in times, weights, amplitudes, terms and stiffnesses, backward and forward; what has none."""

import warnings
from collections.abc import Callable
from typing import Any, NamedTuple

import pytest
import torch
from conftest import Shapes, bent_bar, random_rotation
from helpers.terms import Area, Spring
from torch import Tensor
from torch.autograd import forward_ad
from torch.func import functional_call, grad, jacfwd, jvp

import torch_modal as tm
from torch_modal.geometry.rotations import about, mean

DOUBLE = torch.float64
pytestmark = pytest.mark.usefixtures("converged")


class Case(NamedTuple):
    """A layer, where it is differentiated, and directions."""

    layer: Callable[..., Tensor]
    given: tuple[Tensor, ...]
    tangents: tuple[Tensor, ...]


def numbers(*values: float) -> Tensor:
    return torch.tensor(values, dtype=DOUBLE)


def like(x: Tensor, seed: int = 0) -> Tensor:
    return torch.randn(x.shape, dtype=DOUBLE, generator=torch.Generator().manual_seed(seed + x.numel()))


def in_between(bars: Shapes, **options: Any) -> Case:
    x_a, x_b, _ = bars.keyframes
    t = numbers(0.3, 0.6)
    return Case(tm.InBetween(bars.bases[:2], bars.faces, **options), (x_a, x_b, t), (like(x_a), like(x_b, 1), like(t)))


def with_state(layer: torch.nn.Module, *given: Tensor | float) -> Case:
    """Of a layer in its stiffnesses and other parameters, too."""
    names = [name for name in layer.state_dict() if "bases" not in name and not name.endswith("points")]
    own = tuple(layer.state_dict()[name] for name in names)
    shapes = tuple(x for x in given if isinstance(x, Tensor))
    rest = given[len(shapes) :]

    def run(*values: Tensor) -> Tensor:
        state = dict(zip(names, values[len(shapes) :], strict=True))
        found: Tensor = functional_call(layer, state, (*values[: len(shapes)], *rest))
        return found

    return Case(run, (*shapes, *own), (*map(like, shapes), *(x * (1 + i) for i, x in enumerate(own))))


def strained(bars: Shapes, **options: Any) -> Case:
    """Stretched, squeezed and roughened: lengths that no shape can have at once leave a large residual."""
    x_a, x_b = bars.keyframes[1:]
    x_b = x_b * numbers(1.5, 0.7, 1.2) + 0.1 * like(x_b, 5)
    x_b = x_b @ random_rotation(torch.Generator().manual_seed(0)).mT + 1
    stiffness = {"alpha": numbers(400.0)[0], "beta": numbers(20.0)[0], "gamma": numbers(5e4)[0]}
    objective = tm.Objective(space="joint", coarse_faces=200, **stiffness)
    layer = tm.InBetween(bars.bases[1:], bars.faces, objective=objective, solver=tm.Solver(tolerance=1e-13, **options))
    return with_state(layer, x_a, x_b, numbers(0.37))


def own_terms(bars: Shapes) -> Case:
    """A term on the coarse mesh, and one on the fine mesh."""
    x_a, x_b = bars.keyframes[1:]
    point = x_a[[7]] + numbers(0.1, 0.2, -0.1)
    terms = Area(torch.tensor(40.0, dtype=DOUBLE)), Spring([7], point, torch.tensor(40.0, dtype=DOUBLE))
    objective, solver = tm.Objective(terms=terms), tm.Solver(tolerance=1e-13)
    layer = tm.InBetween(bars.bases[1:], bars.faces, objective=objective, solver=solver)
    assert float((layer(x_a, x_b, 0.4) - tm.InBetween(bars.bases[1:], bars.faces)(x_a, x_b, 0.4)).abs().max()) > 1e-4
    return with_state(layer, x_a, x_b, numbers(0.4))


def paper(bars: Shapes) -> Case:
    objective = tm.Objective(
        space="paired", mu=torch.tensor(2.0, dtype=DOUBLE), alpha=torch.tensor(400.0, dtype=DOUBLE)
    )
    solver = tm.Solver(local_steps=0, tolerance=1e-13)
    layer = tm.InBetween(bars.bases[:2], bars.faces, objective=objective, solver=solver)
    return with_state(layer, *bars.keyframes[:2], 0.5)


def blend(bars: Shapes, *weights: float, backend: Any = "auto") -> Case:
    tangents = like(bars.keyframes), numbers(1, -3, 2)
    layer = tm.Blend(bars.bases, bars.faces, solver=tm.Solver(tolerance=1e-12, backend=backend))
    return Case(layer, (bars.keyframes + 0.02 * like(bars.keyframes, 4), numbers(*weights)), tangents)


def decoder(bars: Shapes) -> Case:
    layer = tm.ModalDecoder(bars.keyframes, bars.faces, [0, 1, 2], bars.keyframes[0], bars.bases[0].modes)
    given = (
        0.5 * like(torch.empty(2, bars.bases[0].n_modes)),
        numbers(0.3, 1.4),
        0.1 * like(torch.empty(2, 6)),
        bars.keyframes,
    )
    return Case(layer, given, tuple(like(x, 1) for x in given))


def path(bars: Shapes, **options: Any) -> Case:
    given = bars.keyframes, numbers(0.3, 1.4)
    return Case(tm.Path(bars.bases, bars.faces, **options), given, tuple(map(like, given)))


CASES: dict[str, Callable[[Shapes], Case]] = {
    "in_between": in_between,
    "in_between, modal": lambda bars: in_between(bars, preset="modal", solver=tm.Solver(tolerance=1e-12)),
    "in_between, torch": lambda bars: in_between(bars, solver=tm.Solver(backend="torch")),
    "strained": lambda bars: strained(bars, local_steps=0),
    "strained, torch": lambda bars: strained(bars, local_steps=0, backend="torch"),
    "strained, all vertices": strained,
    "strained, polished": lambda _: strained(bent_bar((12, 3, 3), 8), polish=1),
    "own terms": own_terms,
    "paper": paper,
    "blend": lambda bars: blend(bars, 0.3, 0.5, 0.2),
    "blend, torch": lambda bars: blend(bars, 0.3, 0.5, 0.2, backend="torch"),
    "blend, one without weight": lambda bars: blend(bars, 0.6, 0.4, 0.0),
    "blend, one below zero": lambda bars: blend(bars, 0.7, 0.4, -0.1),
    "decoder": decoder,
    "path": path,
    "path of pairs": lambda bars: path(bars, smooth=False, preset="fast"),
}

HEAVY = {"strained, torch", "strained, all vertices", "blend, torch", "blend, one below zero", "paper"}
"""Not in the default run: other cases take most of their ways through the code."""
each_case = pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[pytest.mark.slow] * (name in HEAVY)) for name in CASES]
)


def dual(
    layer: Callable[..., Tensor], given: tuple[Tensor, ...], tangents: tuple[Tensor, ...]
) -> tuple[Tensor, Tensor]:
    """As ``torch.func.jvp``, without ``torch.func``."""
    with forward_ad.dual_level():
        value, tangent = forward_ad.unpack_dual(layer(*map(forward_ad.make_dual, given, tangents)))
        assert tangent is not None
        return value, tangent


either = pytest.mark.parametrize("run", [jvp, dual])


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


@each_case
def test_forward_is_the_transpose_of_backward(name: str, small_bars: Shapes) -> None:
    """In all arguments, and in each alone: the others are no dual tensors, so kernels and torch meet."""
    case = CASES[name](small_bars)
    require_transposed(case)
    with torch.no_grad():  # of reverse mode alone
        for own, other in zip(dual(*case), jvp(*case), strict=True):
            torch.testing.assert_close(own, other, rtol=1e-10, atol=1e-12)
    for i, (own, tangent) in enumerate(zip(case.given, case.tangents, strict=True)):

        def of_one(x: Tensor, i: int = i) -> Tensor:
            return case.layer(*case.given[:i], x, *case.given[i + 1 :])

        require_transposed(Case(of_one, (own,), (tangent,)), (dual, jvp)[i % 2])


@each_case
def test_backward_is_the_limit_of_differences(name: str, small_bars: Shapes) -> None:
    """Of fourth order; in each argument. The Hessian of steps of all vertices has kinks: changes are small."""
    case, h = CASES[name](small_bars), 3e-6
    weights = like(case.layer(*case.given), 2)
    gradients = backward(case.layer, case.given, weights)
    for i, (gradient, tangent) in enumerate(zip(gradients, case.tangents, strict=True)):
        values = []
        for k in (-2, -1, 1, 2):
            given = [x + k * h * tangent if i == j else x for j, x in enumerate(case.given)]
            values.append(float((weights * case.layer(*given)).sum()))
        expected = (values[0] - 8 * values[1] + 8 * values[2] - values[3]) / (12 * h)
        assert float((gradient * tangent).sum()) == pytest.approx(expected, rel=1e-5, abs=1e-6), (name, i)


@pytest.mark.parametrize("name", ["in_between", "in_between, modal", "blend", "decoder", "path"])
def test_jacfwd_of_a_layer_that_nothing_has_used_before(small_bars: Shapes, name: str) -> None:
    """Of a decoder of two numbers: what layers keep is made within the transforms, and is good outside of them."""
    case, z, directions = CASES[name](small_bars), numbers(0.1, -0.2), numbers(1, -0.5)

    def decode(z: Tensor) -> Tensor:
        parts = zip(z * directions, case.given[:2], case.tangents[:2], strict=True)
        return case.layer(*(x + 0.01 * own * tangent for own, x, tangent in parts), *case.given[2:])

    jacobian = jacfwd(decode)(z)
    weights = like(jacobian[..., 0], 2)
    (gradient,) = backward(decode, (z,), weights)
    torch.testing.assert_close((weights[..., None] * jacobian).flatten(0, -2).sum(0), gradient, rtol=1e-8, atol=1e-10)


@either
def test_at_key_frames_the_tangent_is_that_of_the_in_between(small_bars: Shapes, run: Any) -> None:
    case = in_between(small_bars, preset="fast")._replace(given=(*small_bars.keyframes[:2], numbers(0, 1)))

    def without_reverse_mode(*given: Any) -> tuple[Tensor, Tensor]:
        with torch.no_grad():
            value, tangent = run(*given)
        assert torch.equal(value, small_bars.keyframes[:2])
        return value, tangent

    require_transposed(case, without_reverse_mode)


def test_no_tangent_goes_through_amplitudes_that_did_not_converge(bars: Shapes) -> None:
    case = in_between(bars, preset="modal", solver=tm.Solver(max_steps=0))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", tm.ConvergenceWarning)
        assert not bool(case.layer.solve(*bars.keyframes[:2], 0.3).solution.converged)  # type: ignore[attr-defined]
        require_transposed(case)


@pytest.mark.parametrize("preset", ["accurate", pytest.param("modal", marks=pytest.mark.slow)])
def test_second_derivatives(small_bars: Shapes, preset: Any) -> None:
    case = in_between(small_bars, preset=preset)
    x_a, x_b, _ = small_bars.keyframes
    z, v, weights, along = numbers(0.1, -0.2), numbers(1, 2), like(x_a, 2), like(x_a)

    def loss(z: Tensor) -> Tensor:
        return (weights * case.layer(x_a + 0.01 * z[0] * along, x_b, 0.4 + z[1])).sum()

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
    with pytest.raises(RuntimeError, match="forward mode within forward mode"):
        jvp(lambda z: jvp(loss, (z,), (v,))[1], (z,), (v,))
    assert jvp(loss, (z,), (v,))[1].isfinite()


def test_the_tangent_of_what_backward_receives(small_bars: Shapes) -> None:
    x_a, x_b, _ = small_bars.keyframes
    layer, leaf, direction = in_between(small_bars).layer, x_a.clone().requires_grad_(), like(x_a, 3)
    (expected,) = torch.autograd.grad(layer(leaf, x_b, 0.3), leaf, direction)
    x = layer(leaf, x_b, 0.3)
    with forward_ad.dual_level():
        (gradient,) = torch.autograd.grad(x, leaf, forward_ad.make_dual(like(x_a, 4), direction))
        found = forward_ad.unpack_dual(gradient).tangent
    torch.testing.assert_close(found, expected, rtol=1e-8, atol=1e-10)


@either
@pytest.mark.parametrize("kind", [tm.InBetween, tm.Path])
def test_contact_is_refused_also_where_the_time_alone_has_a_tangent(small_bars: Shapes, kind: Any, run: Any) -> None:
    pytest.importorskip("igl")
    layer, pair = kind(small_bars.bases[:2], small_bars.faces, contact=True), small_bars.keyframes[:2]
    given = tuple(pair) if kind is tm.InBetween else (pair,)
    with pytest.raises(RuntimeError, match="no forward mode"):
        run(lambda t: layer(*given, t), (numbers(0.3),), (numbers(1),))


@either
def test_a_fit_to_observations_is_refused(bars: Shapes, run: Any) -> None:
    space, picked = tm.ShapeSpace(bars.bases, bars.faces, dtype=DOUBLE), torch.arange(0, len(bars.keyframes[0]), 9)
    points = bars.keyframes[1][picked]
    with pytest.raises(RuntimeError):
        run(lambda points: space.fit(points, picked).shape, (points,), (like(points),))


@either
def test_the_mean_of_rotations_that_are_far_apart(run: Any) -> None:
    """Its last step alone has derivatives, although ``torch.no_grad`` does not end forward mode."""
    rotations = about(0.6 * like(torch.empty(3, 3, 20)))
    weights = numbers(0.3, 0.5, 0.2)[:, None]
    require_transposed(Case(mean, (rotations, weights), (like(rotations), numbers(1, -3, 2)[:, None])), run, 1e-12)


@either
def test_poses_of_key_frames_that_are_far_from_each_other(bars: Shapes, run: Any) -> None:
    """Likewise: the last rounds alone."""
    frame = tm.Blend(bars.bases, bars.faces, "fast").core.alignment
    keyframes = bars.keyframes[None] + 0.8 * like(bars.keyframes[None])
    given = keyframes, numbers(0.3, 0.5, 0.2)[None]

    def shapes(*given: Tensor) -> Tensor:
        return frame(*given)[0]

    require_transposed(Case(shapes, given, (like(keyframes), numbers(1, -3, 2)[None])), run, 1e-11)
