"""Adjoints of kernels, which Warp generates: what it must not leave out, and its messages."""

import ast
import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch

import torch_modal as tm

pytest.importorskip("warp", reason="warp-lang is not installed")

DOUBLE = torch.float64
PACKAGE = Path(tm.__file__).parent


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
            kernel = "kernel_of" in ast.unparse(scope)  # on for measures without a gradient alone
            for one in functions:
                if one.name in those:
                    alias = kernel and "kernel" in map(ast.unparse, one.decorator_list)
                    off = alias or "enable_backward=False" in map(ast.unparse, _options(one))
                    found[path.name, getattr(scope, "name", ""), one.name] = off
    names = {(file, name) for file, _, name in found}
    assert ("measures.py", "functions_of") in names
    assert [name for name, off in found.items() if off] == []


def _options(function: ast.FunctionDef) -> list[ast.keyword]:
    return [word for call in function.decorator_list if isinstance(call, ast.Call) for word in call.keywords]


@pytest.mark.slow
def test_compiling_them_says_nothing(tmp_path: Path) -> None:
    """Warp warns of kernels that use ``wp.grad`` when it compiles them: not to users."""
    code = (
        "import sys, torch; sys.path.append('tests'); from helpers.terms import fibres; "
        "from torch_modal.elastic.kernels import launch; "
        "kind = fibres(); kind.linearised = None; "
        "kernel = launch.of_elements('elements', 'convex', kind(1.0).kernel_formulas(1), None).linearise; "
        "launch._load(kernel.module, torch.device('cpu'))"
    )
    given = os.environ | {"WARP_CACHE_PATH": str(tmp_path)}
    result = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=120, cwd=PACKAGE.parent, env=given
    )
    assert (result.returncode, result.stdout, result.stderr) == (0, "", "")
