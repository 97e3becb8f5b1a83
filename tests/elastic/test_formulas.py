"""Formulas: one text for torch and for kernels, and what they may not use."""

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
