"""Adjoints of the kernels of rotations and poses, which Warp generates, against differences."""

import ast
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import torch
from conftest import Shapes
from torch import Tensor

import torch_modal as tm
from torch_modal.elastic.warp_procrustes import mean_pose
from torch_modal.elastic.warp_rotations import WarpRotations
from torch_modal.geometry.connectivity import Connectivity
from torch_modal.geometry.local_rotations import Trajectory
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


def assert_differences(run: Any, given: list[Tensor], h: float = 1e-4) -> None:
    """Central differences of fourth order, along a direction in each argument."""
    found, value = gradients(run, given)
    for i, slope in enumerate(found):
        direction = noise(*slope.shape, seed=2)

        def at(step: float, i: int = i, direction: Tensor = direction) -> float:
            return float(value(*given[:i], given[i] + step * direction, *given[i + 1 :]))

        wanted = (8 * (at(h) - at(-h)) - (at(2 * h) - at(-2 * h))) / (12 * h)
        size = float(slope.norm() * direction.norm())
        assert abs(float((slope * direction).sum()) - wanted) < 1e-8 * size, f"argument {i}"


def pulls(x: Tensor, faces: Tensor) -> Any:
    rotations = WarpRotations(Connectivity(faces.numpy()), x)
    poisson = Poisson(mesh := Connectivity(faces.numpy()), torch.linspace(1, 2, len(mesh.edges), dtype=DOUBLE))
    return lambda shapes, weights: rotations.pulls(shapes, weights, poisson)


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


def test_on_a_trajectory(small_bars: Shapes) -> None:
    rotations = WarpRotations(Connectivity(small_bars.faces.numpy()), small_bars.keyframes[:2])
    n, which = len(small_bars.faces), torch.tensor([0, 1, 1])
    frame = exp(noise(2, n, 3)).movedim((2, 3), (0, 1))
    size = torch.tensor([1.0, 0.0, 1.0], dtype=DOUBLE)[:, None, None] + 0.2 * noise(3, 2, n)
    given = [*frame, size, *(0.3 * noise(6, 2, n, seed=seed) for seed in (1, 2, 3)), noise(3).sigmoid()]

    def run(*given: Tensor) -> Tensor:
        return rotations.along(Trajectory(*given[:-1]), which, given[-1])

    assert_differences(run, given)


@pytest.mark.parametrize("index", [0, 1], ids=["turns", "pose"])
def test_poses(index: int) -> None:
    x = noise(1, 20, 3) * torch.tensor([3.0, 2.0, 1.0]) + 0.3 * noise(3, 2, 20, 3, seed=1)
    x = x @ exp(noise(3, 2, 3, seed=2)).mT
    t = torch.tensor([0.0, 0.3, 1.0], dtype=DOUBLE)
    given = [x[0, 0].mT @ x, x[:, :, None].mT @ x[:, None], torch.stack([1 - t, t], 1)]
    assert_differences(lambda *given: mean_pose(*given)[index], given)


def test_kernels_that_differentiate_can_be_differentiated() -> None:
    """``wp.grad`` drops what nested functions pass on, and says nothing, in a kernel without its own adjoint."""
    found = {}
    for path in PACKAGE.rglob("kernels/**/*.py"):
        tree = ast.parse(path.read_text(encoding="utf-8"))
        functions = [node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)]
        texts = {one.name: "\n".join(map(ast.unparse, one.body)) for one in functions}
        those = {name for name, text in texts.items() if "wp.grad(" in text}
        while more := {name for name, text in texts.items() if any(f"{one}(" in text for one in those)} - those:
            those |= more
        for one in functions:
            if one.name in those:
                found[path.name, one.name] = "enable_backward=False" in map(ast.unparse, _options(one))
    assert found, "no kernel uses wp.grad: this test has nothing to check"
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
