"""Adjoints of kernels, which Warp generates, against differences."""

import ast
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import torch
from conftest import Shapes
from terms import fibres
from torch import Tensor

import torch_modal as tm
from torch_modal.elastic.bend import Bend
from torch_modal.elastic.energy import Energy, Reference, RestShapes
from torch_modal.elastic.kernel_energy import KernelEnergy
from torch_modal.elastic.kernel_steps import _Relaxation
from torch_modal.elastic.modal import KernelModalEnergy, _GradientAndValue
from torch_modal.elastic.rotations import WarpRotations
from torch_modal.elastic.stretch import Stretch
from torch_modal.elastic.term import Mesh, Term
from torch_modal.elastic.volume import Volume
from torch_modal.geometry.connectivity import Connectivity
from torch_modal.geometry.poisson import Poisson
from torch_modal.geometry.rotations import exp

pytest.importorskip("warp", reason="warp-lang is not installed")

DOUBLE = torch.float64
PACKAGE = Path(tm.__file__).parent


def noise(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(*shape, dtype=DOUBLE, generator=torch.Generator().manual_seed(seed))


def gradients(run: Any, given: list[Tensor]) -> tuple[list[Tensor], Any]:
    """Gradients of a weighted sum of the results, and that sum as a function."""

    def value(*given: Tensor) -> Tensor:
        found = run(*given)
        return (noise(*found.shape, seed=1) * found).sum()

    leaves = [x.clone().requires_grad_() for x in given]
    return list(torch.autograd.grad(value(*leaves), leaves)), value


def assert_differences(run: Any, given: list[Tensor], h: float = 1e-4, to: float = 1e-8) -> None:
    """Central differences of fourth order, along a direction in each argument."""
    found, value = gradients(run, given)
    for i, slope in enumerate(found):
        direction = noise(*slope.shape, seed=2)

        def at(step: float, i: int = i, direction: Tensor = direction) -> float:
            return float(value(*given[:i], given[i] + step * direction, *given[i + 1 :]))

        wanted = (8 * (at(h) - at(-h)) - (at(2 * h) - at(-2 * h))) / (12 * h)
        size = float(slope.norm() * direction.norm())
        assert abs(float((slope * direction).sum()) - wanted) < to * size, f"argument {i}"


def pulls(x: Tensor, faces: Tensor) -> Any:
    rotations = WarpRotations(Connectivity(faces.numpy()), x)
    poisson = Poisson(mesh := Connectivity(faces.numpy()), torch.linspace(1, 2, len(mesh.edges), dtype=DOUBLE))
    return lambda shapes, weights: rotations.right_hand_side(shapes, weights, poisson)


@pytest.mark.parametrize("angle", [0.0, 0.03, 1.0, 3.0])
def test_between_two_shapes(small_bars: Shapes, angle: float) -> None:
    """Also without a turn, and where the series end."""
    x = small_bars.keyframes[:1]
    other = (x + (0.02 * noise(*x.shape) if angle else 0)) @ exp(angle * torch.tensor([0.6, 0.0, 0.8]).double()).mT
    shapes = torch.stack([x, other], 1)
    assert_differences(pulls(shapes[0], small_bars.faces), [shapes, torch.tensor([[0.7, 0.3]], dtype=DOUBLE)])


@pytest.mark.parametrize("kind", ["point", "line", "half turn", "whole turn"])
def test_gradients_of_what_is_degenerate_are_finite(small_bars: Shapes, kind: str) -> None:
    x, (i, j, k) = small_bars.keyframes[0], small_bars.faces[0].tolist()
    run, other = pulls(small_bars.keyframes[:2], small_bars.faces), x.clone()
    if kind == "point":
        other[[j, k]] = x[i]
    elif kind == "line":
        other[k] = 0.3 * x[i] + 0.7 * x[j]
    else:
        other = other @ exp((1 + (kind == "whole turn")) * torch.pi * torch.tensor([0.6, 0.0, 0.8]).double()).mT
    for shapes in (torch.stack([x, other])[None], torch.stack([other, x])[None], torch.stack([other, other])[None]):
        found, _ = gradients(run, [shapes, torch.tensor([[0.7, 0.3]], dtype=DOUBLE)])
        assert all(bool(slope.isfinite().all()) and float(slope.abs().max()) < 1e6 for slope in found)
        shapes[0, 0, i] = torch.nan
        assert gradients(run, [shapes, torch.tensor([[0.7, 0.3]], dtype=DOUBLE)])[0][0].isnan().any()


class Elastic:
    """Terms between two rest shapes, away from both."""

    def __init__(self, bars: Shapes, terms: list[Term]) -> None:
        mesh = Mesh.of(bars.faces, bars.keyframes.shape[1])
        self.kernels = KernelEnergy.of(Energy(mesh, terms), mesh)
        x = 40 * bars.keyframes
        self.shapes = x[None, :2] + noise(2, 1, *x.shape[1:])
        self.weights = torch.tensor([[0.4, 0.6], [0.7, 0.3]], dtype=DOUBLE)
        self.stiffness = [3.0 + noise(2, 1, seed=i).abs() for i in range(len(terms))]

    def reference(self) -> Reference:
        return self.kernels.reference(RestShapes(self.shapes, self.weights, self.stiffness))


@pytest.fixture(params=["closed", "open", "fibres"])
def elastic(request: pytest.FixtureRequest, small_bars: Shapes) -> Elastic:
    if request.param == "fibres":  # the gradient's adjoint comes from wp.grad, too
        return Elastic(small_bars, [fibres()()])
    bars = small_bars if request.param == "closed" else small_bars._replace(faces=small_bars.faces[6:])
    return Elastic(bars, [Stretch(), Bend(), Volume()])


def test_gradients_in_amplitudes(elastic: Elastic) -> None:
    modal = KernelModalEnergy(elastic.kernels, noise(4, *elastic.shapes.shape[2:]))
    given = [0.1 * noise(2, 4), elastic.shapes.mean(1), *elastic.reference().records]
    assert_differences(lambda *x: _GradientAndValue(modal)(*x)[0], given)
    placement, a, direction, h = modal.place(given[1], elastic.reference()), given[0], noise(2, 4, seed=5), 1e-4
    with torch.no_grad():
        derivatives = modal.derivatives(a, placement)
        slopes = [modal.value_and_gradient(a + step * direction, placement)[1] for step in (h, -h, 2 * h, -2 * h)]
    wanted = (8 * (slopes[0] - slopes[1]) - (slopes[2] - slopes[3])) / (12 * h)
    found = (derivatives.hessian @ direction[..., None]).squeeze(-1)
    torch.testing.assert_close(found, wanted, rtol=1e-8, atol=1e-8 * float(wanted.abs().max()))


def test_gradients_of_steps_of_all_vertices(elastic: Elastic) -> None:
    x, records = elastic.shapes.mean(1), elastic.reference().records

    def run(x: Tensor, *factors: Tensor) -> Tensor:
        own = [factor * record for factor, record in zip(factors, records, strict=True)]
        return _Relaxation(elastic.kernels, [3, 3])(x, *own)[0]

    assert_differences(run, [x, *map(torch.ones_like, records)], to=1e-7)


def test_kernels_that_differentiate_can_be_differentiated() -> None:
    """``wp.grad`` drops what nested functions pass on, and says nothing, in a kernel without its own adjoint."""
    found = {}
    for path in PACKAGE.rglob("elastic/**/*.py"):
        tree = ast.parse(path.read_text(encoding="utf-8"))
        for scope in [tree, *(node for node in tree.body if isinstance(node, ast.FunctionDef))]:
            own = scope.body if scope is tree else [node for node in ast.walk(scope) if node is not scope]
            functions = [node for node in own if isinstance(node, ast.FunctionDef) and node.decorator_list]
            texts = {one.name: "\n".join(map(ast.unparse, one.body)) for one in functions}
            those = {name for name, text in texts.items() if "wp.grad(" in text}
            while more := {name for name, text in texts.items() if any(f"{one}(" in text for one in those)} - those:
                those |= more
            kernel = "kernel = _kernel(" in ast.unparse(scope)  # on for measures without a gradient alone
            for one in functions:
                if one.name in those:
                    alias = kernel and "kernel" in map(ast.unparse, one.decorator_list)
                    off = alias or "enable_backward=False" in map(ast.unparse, _options(one))
                    found[path.name, getattr(scope, "name", ""), one.name] = off
    names = {(file, name) for file, _, name in found}
    assert {
        ("elements.py", "linearise"),
        ("rotations_adjoint.py", "right_hand_side"),
    } <= names
    assert [name for name, off in found.items() if off] == []


def _options(function: ast.FunctionDef) -> list[ast.keyword]:
    return [word for call in function.decorator_list if isinstance(call, ast.Call) for word in call.keywords]


@pytest.mark.slow
def test_compiling_them_says_nothing(tmp_path: Path) -> None:
    """Warp warns of kernels that use ``wp.grad`` when it compiles them: not to users."""
    code = "from torch_modal.elastic.kernels.launch import kernels; kernels('rotations_adjoint')"
    given = os.environ | {"WARP_CACHE_PATH": str(tmp_path)}
    result = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=120, cwd=PACKAGE.parent, env=given
    )
    assert (result.returncode, result.stdout, result.stderr) == (0, "", "")
