"""Bounds on the code of the package, and on how much of it a call runs through.

Docstrings, comments and blank lines cost nothing. A commit that needs more than the slack raises the number and says
why in its message. Run as a script, this prints today's numbers.
"""

import ast
import io
import os
import re
import sys
import tempfile
import tokenize
from collections.abc import Callable
from pathlib import Path
from types import FrameType
from typing import Any

import pytest
import torch

import torch_modal as tm

BOUNDS = {
    "lines of code": 17600,
    "functions": 1571,
    "docstrings that begin with no noun": 0,
    "functions of in-between": 88,
    "files of in-between": 22,
    "functions of in-between, forward and backward": 113,
    "files of in-between, forward and backward": 22,
    "functions of subdivide": 159,
    "files of subdivide": 35,
    "functions of making a layer": 107,
    "files of making a layer": 33,
}
SLACK = 0.02
"""Relative growth that no commit has to explain."""

PACKAGE = Path(tm.__file__).parent
OPENING = re.compile(r"(What|Whether|Where|The same|As the|Of|How)\b")
"""Docstrings begin with a verb or with what is computed instead."""
LAYOUT = {tokenize.COMMENT, tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT, tokenize.ENDMARKER}


def lines_of_code(text: str, tree: ast.Module) -> int:
    """Number of lines without blanks, comments, and strings that are statements."""
    strings = [
        node
        for node in ast.walk(tree)
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str)
    ]
    within = {line for node in strings for line in range(node.lineno, (node.end_lineno or node.lineno) + 1)}
    tokens = [token for token in tokenize.generate_tokens(io.StringIO(text).readline) if token.type not in LAYOUT]
    return len({line for token in tokens for line in range(token.start[0], token.end[0] + 1)} - within)


def sizes() -> dict[str, int]:
    """Counts over all files of the package."""
    texts = [path.read_text(encoding="utf-8") for path in sorted(PACKAGE.rglob("*.py"))]
    trees = [ast.parse(text) for text in texts]
    nodes = [node for tree in trees for node in ast.walk(tree)]
    documented = (node for node in nodes if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef))
    words = [text for node in documented if (text := ast.get_docstring(node))]
    return {
        "lines of code": sum(map(lines_of_code, texts, trees)),
        "functions": sum(isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef) for node in nodes),
        "docstrings that begin with no noun": sum(OPENING.match(text) is not None for text in words),
    }


def run_through(call: Callable[[], Any]) -> tuple[int, int]:
    """Numbers of functions and of files of the package that a call runs through, without its lambdas."""
    seen = set()

    def record(frame: FrameType, event: str, argument: Any) -> None:
        code = frame.f_code
        if event == "call" and code.co_filename.startswith(str(PACKAGE)) and not code.co_name.startswith("<"):
            seen.add((code.co_filename, code.co_firstlineno))

    call()  # what is made at the first use is no part of it
    sys.setprofile(record)
    try:
        call()
    finally:
        sys.setprofile(None)
    return len(seen), len({file for file, _ in seen})


def paths() -> dict[str, int]:
    """Functions and files on the way of calls that users make most often, on the sample creature."""
    x, faces = tm.load_keyframes(sorted((PACKAGE / "samples" / "creature").glob("key-*.ply"))[:3])
    layer = tm.InBetween(x[:2], faces)

    def backward() -> None:
        leaf = x[0].clone().requires_grad_()
        layer(leaf, x[1], 0.4).sum().backward()

    calls = {
        "in-between": lambda: layer(x[0], x[1], 0.4),
        "in-between, forward and backward": backward,
        "subdivide": lambda: tm.subdivide(x, faces, 1, progress=False),
        "making a layer": lambda: tm.InBetween(x[:2], faces),
    }
    found = {}
    for name, call in calls.items():
        found[f"functions of {name}"], found[f"files of {name}"] = run_through(call)
    return found


def assert_within(found: dict[str, int]) -> None:
    over = {name: f"{n} of {BOUNDS[name]}" for name, n in found.items() if n > (1 + SLACK) * BOUNDS[name]}
    assert not over


def test_size_of_the_package() -> None:
    assert_within(sizes())


def test_functions_on_the_way_of_a_call() -> None:
    pytest.importorskip("warp")  # with torch alone, other files serve
    assert_within(paths())


def test_counts_by_hand() -> None:
    text = '"""Of a\nmodule."""\n\n# why\nx = """a\nb"""\n\n\ndef f():\n    """How."""\n    y = (\n        1\n    )\n'
    assert lines_of_code(text, ast.parse(text)) == 6
    assert OPENING.match("Of a") and not OPENING.match("Offsets")


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as folder:
        os.environ["TORCH_MODAL_CACHE"] = folder
        torch.set_num_threads(1)
        for key, value in {**sizes(), **paths()}.items():
            print(f'    "{key}": {value},')
