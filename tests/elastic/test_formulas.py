"""Formulas: one text for torch and for kernels, and what they may not use."""

import math
from collections.abc import Callable
from typing import Any

import pytest
import torch
from torch import Tensor

from torch_modal.elastic import formulas
from torch_modal.elastic.bind import cross, dot, for_kernels, real, root
from torch_modal.elastic.formulas import length
from torch_modal.elastic.kernels.launch import launch

wp: Any = pytest.importorskip("warp", reason="warp-lang is not installed")

DOUBLE = torch.float64


def face_area(x: Tensor) -> Tensor:
    """A measure of faces."""
    return real(0.5) * length(cross(x[0], x[1]))


def with_torch(x: Tensor) -> Tensor:
    return torch.linalg.norm(x[0])


def with_a_number(x: Tensor) -> Tensor:
    return 2.0 * length(x[0])


def vectors(n: int) -> Tensor:
    """Edge vectors of usual elements, then of one that is flat, and of one without size. *Shape:* ``(n, 3, 10)``."""
    x = torch.randn(n, 3, 10, generator=torch.Generator().manual_seed(3), dtype=DOUBLE)
    x[1:, :, 8] = 2 * x[:1, :, 8]
    x[..., 9] = 0
    return x


def by_kernel(formula: Callable[..., Any], x: Tensor) -> Tensor:
    """A measure of elements, by a kernel. *Shape:* ``(n, 3, M) -> (M,)``, or ``(M, 2)`` of a phase."""
    n, m = len(x), x.shape[-1]
    function, is_phase = for_kernels(formula, n), formula is formulas.hinge_phase
    edges, kind = wp.types.matrix(shape=(n, 3), dtype=wp.float64), wp.vec2d if is_phase else wp.float64

    @wp.kernel(module="unique")  # type: ignore[untyped-decorator]
    def run(given: wp.array[edges], out: wp.array[kind]):  # type: ignore[no-untyped-def, valid-type]
        i = wp.tid()
        out[i] = function(given[i])

    out = torch.zeros((m, 2) if is_phase else m, dtype=DOUBLE)
    launch(run, (m,), [x.permute(2, 0, 1).contiguous(), out])
    return out


@pytest.mark.parametrize(
    ("formula", "n"),
    [(formulas.edge_length, 1), (formulas.hinge_phase, 3), (formulas.tetrahedron, 3), (face_area, 2)],
    ids=["edge", "hinge", "tetrahedron", "face"],
)
def test_kernels_compute_what_torch_computes(formula: Callable[..., Any], n: int) -> None:
    """Also of elements without a length or a normal; with a formula of one's own that calls others."""
    x = vectors(n)
    wanted = formula(x)
    wanted = torch.stack(wanted, -1) if isinstance(wanted, tuple) else wanted
    torch.testing.assert_close(by_kernel(formula, x), wanted, rtol=1e-14, atol=1e-76)


def test_values_that_are_known() -> None:
    """Torch and kernels share the text, so that neither is a reference of the other."""
    e, up = torch.tensor([[2.0, 0, 0], [1, 3**0.5, 0]], dtype=DOUBLE)
    hinge = torch.stack([e, up, torch.tensor([1.0, 0, 3**0.5], dtype=DOUBLE)])
    angle = formulas.hinge_angle(hinge)
    assert float(angle.abs()) == pytest.approx(math.pi / 2)  # flat would be 0
    assert float(formulas.hinge_weight(hinge, angle, angle)) == pytest.approx(2 / 3**0.5)
    assert float(formulas.hinge_fullness(hinge, 0.75)) == pytest.approx(0.25)  # each a half at its own altitude
    assert float(formulas.tetrahedron(torch.diag(torch.tensor([1.0, 2, 3], dtype=DOUBLE)))) == pytest.approx(1)
    assert float(formulas.triangle_area(e, up)) == pytest.approx(3**0.5)
    ratios = torch.tensor([0, 0.5, 1, 2], dtype=DOUBLE)
    torch.testing.assert_close(formulas.softness(0.3 * ratios, 0.3 * torch.ones(4, dtype=DOUBLE)), ratios.clamp_max(1))
    stretched, pressed = (formulas.tension(ratios[1], slope * ratios[2], 2 * ratios[2]) for slope in (1.0, -1.0))
    assert float(stretched) == pytest.approx(2, rel=1e-5) and float(pressed) < 1e-5


@pytest.mark.parametrize("name", ["square", "periodic"])
def test_sums_over_rest_shapes(name: str) -> None:
    """Energy and what is left are the sum over the rest shapes; slopes and curvatures are its derivatives."""
    rest, weights = torch.tensor([0.1, -0.4, 1.9], dtype=DOUBLE), torch.tensor([0.5, 2, 0.3], dtype=DOUBLE)
    moments, record, left, energy, slope = (
        getattr(formulas, f"{name}_{part}") for part in ("moments", "record", "left", "energy", "slope")
    )
    of = formulas.phase if name == "periodic" else (lambda q: q)
    one = formulas.periodic_square if name == "periodic" else torch.square
    sums = [each.sum() for each in moments(of(rest), weights)]
    to = record(sums, 3.0)
    for value in torch.tensor([-2.5, 0.3, 1.0], dtype=DOUBLE):
        whole = lambda q: (3 * weights * one(q - rest)).sum()  # noqa: E731
        torch.testing.assert_close(energy(of(value), to) + left(sums, 3.0, to), whole(value))
        torch.testing.assert_close(slope(of(value), to), torch.func.grad(whole)(value))
        if name == "periodic":
            curvature = torch.func.grad(torch.func.grad(whole))(value)
            torch.testing.assert_close(formulas.periodic_curvature(of(value), to), curvature)


def test_second_derivative_of_an_angle() -> None:
    """The closed form is the derivative of the gradient."""
    x, d = vectors(3)[..., :8], torch.randn(3, 3, 8, dtype=DOUBLE)
    _, wanted = torch.func.jvp(lambda y: formulas.linearised_phase(y)[1], (x,), (d,))
    torch.testing.assert_close(formulas.angle_hessian_product(x, d), wanted, rtol=1e-10, atol=1e-10)


def test_gradients_of_small_hinges_in_float32() -> None:
    """Products of squared areas stay within the range of float32: the gradient grows as the hinge shrinks."""
    x = vectors(3)[..., :8]
    wanted = formulas.linearised_phase(x)[1]
    found = formulas.linearised_phase(1e-4 * x.float())[1]
    torch.testing.assert_close(1e-4 * found.double(), wanted, rtol=1e-3, atol=1e-3)


def test_what_kernels_do_not_have_is_named() -> None:
    """Other modules, variables of a function around, and numbers of another type."""
    factor = 2.0

    def enclosed(x: Tensor) -> Tensor:
        return factor * root(dot(x[0], x[0]))

    for formula, name in ((with_torch, "torch"), (enclosed, "factor")):
        with pytest.raises(ValueError, match=rf"{formula.__name__} uses {name}, .* at the top level of a file"):
            for_kernels(formula)
    with pytest.raises(ValueError, match=r"with_a_number has a number of Python's, .* write real\(2.0\)"):
        for_kernels(with_a_number)
