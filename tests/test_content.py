"""Digests change with whatever a result may depend on, and with nothing else."""

import subprocess
import sys
import threading
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
import torch

import torch_modal as tm
from torch_modal.io.content import ContentError, content_digest


def made(source: str, name: str = "made") -> Any:
    """What a module of this source has under a name."""
    module = ModuleType("users_module")
    exec(source, vars(module))
    return vars(module)[name]


TERM = """
import torch, torch_modal as tm
{before}
class made(tm.Term):
    def __init__(self, {given}):
        super().__init__(2.0)
        {init}
    def elements(self, mesh):
        return mesh.edges
    def measure(self, spokes):
        return {measure}
"""


def term(before: str = "", given: str = "", init: str = "pass", measure: str = "spokes[0].norm()", *values: Any) -> Any:
    return made(TERM.format(before=before, given=given, init=init, measure=measure))(*values)


class Holder:
    """With whatever attributes."""

    def __init__(self, **attributes: Any) -> None:
        vars(self).update(attributes)


@dataclass
class Point:
    x: float
    y: int = 2


def long(last: float) -> torch.Tensor:
    """A tensor whose repr leaves out most numbers."""
    x = torch.zeros(2000)
    x[1000] = last
    return x


def closure(value: float) -> Callable[[float], float]:
    return lambda x: value * x


DIFFERENT: dict[str, tuple[Any, Any]] = {
    "code": (term(measure="spokes[0].norm()"), term(measure="2 * spokes[0].norm()")),
    "constants of the code": (term(measure="1.5 * spokes[0].norm()"), term(measure="2.5 * spokes[0].norm()")),
    "a function that the code calls": tuple(
        term(before=f"def f(x):\n    return {factor} * x.norm()", measure="f(spokes[0])") for factor in (2, 3)
    ),
    "a constant of the module": tuple(term(before=f"C = {c}", measure="C * spokes[0].norm()") for c in (2, 3)),
    "a base class": tuple(
        made(
            TERM.format(before="", given="", init="pass", measure=f"{c} * spokes[0].norm()") + "class B(made): pass",
            "B",
        )()
        for c in (2, 3)
    ),
    "attributes with an underscore": tuple(term("", "c", "self._c = c", "spokes[0].norm()", c) for c in (2.0, 3.0)),
    "a long tensor": tuple(term("", "c", "self.c = c", "spokes[0].norm()", long(c)) for c in (2.0, 3.0)),
    "a buffer": tuple(term("", "c", "self.register_buffer('c', c)", "spokes[0].norm()", long(c)) for c in (2.0, 3.0)),
    "a closure": (closure(2.0), closure(3.0)),
    "defaults": (lambda x=2: x, lambda x=3: x),
    "keyword defaults": (lambda *, x=2: x, lambda *, x=3: x),
    "a bound method's own": (Point(1.0).__eq__, Point(2.0).__eq__),
    "a partial function": (partial(closure, 2.0), partial(closure, 3.0)),
    "a function that is cached": (cache(closure(2.0)), cache(closure(3.0))),
    "a type of numbers": (torch.zeros(2), torch.zeros(2, dtype=torch.float64)),
    "a shape": (np.zeros((2, 3)), np.zeros((3, 2))),
    "fields": (np.zeros(1, dtype=[("a", "<i4")]), np.zeros(1, dtype=[("a", "<f4")])),
    "the last digit": (1.0, float(np.nextafter(1.0, 2.0))),
    "a kind of number": (1, 1.0),
    "a truth": (1, True),
    "a kind of list": ([1, 2], (1, 2)),
    "nesting": ([[1], 2], [[1, 2]]),
    "an order": ({"a": 1, "b": 2}, {"b": 2, "a": 1}),
    "values of a dataclass": (Point(1.0), Point(1.5)),
    "values deep inside": (Holder(a=[{"b": OrderedDict(c=long(2.0))}]), Holder(a=[{"b": OrderedDict(c=long(3.0))}])),
    "settings": (tm.Objective(beta=2.0), tm.Objective(beta=3.0)),
    "terms of settings": (tm.Objective(terms=(term(),)), tm.Objective(terms=(term(measure="spokes[0].sum()"),))),
    "bfloat16": (torch.zeros(2, dtype=torch.bfloat16), torch.ones(2, dtype=torch.bfloat16)),
    "objects in an array": (np.array([Point(1.0)], dtype=object), np.array([Point(2.0)], dtype=object)),
}


@pytest.mark.parametrize("what", DIFFERENT)
def test_what_differs_has_another_digest(what: str) -> None:
    first, second = (content_digest(value) for value in DIFFERENT[what])
    assert first != second
    assert first == content_digest(DIFFERENT[what][0])


def test_what_is_equal_has_the_same() -> None:
    for _ in range(2):
        pairs = [
            (term("C = 2", "c", "self._c = c", "C * spokes[0].norm()", long(2.0)) for _ in range(2)),
            (long(2.0), long(2.0).clone()),
            (long(2.0), torch.stack([long(2.0), long(2.0)], 1)[:, 0]),
            (
                np.arange(6.0).reshape(2, 3),
                np.arange(6.0).reshape(2, 3, order="F").copy().T.copy().T * 0 + np.arange(6.0).reshape(2, 3),
            ),
            ({"a", "b", "c"}, {"c", "b", "a"}),
            (closure(2.0), closure(2.0)),
        ]
        for first, second in pairs:
            assert content_digest(first) == content_digest(second)


def test_circles_come_to_an_end() -> None:
    holders = [Holder(), Holder(), Holder(value=2)]
    for holder in holders:
        holder.own = [holder]
    assert content_digest(holders[0]) == content_digest(holders[1]) != content_digest(holders[2])


def test_the_same_in_another_process(tmp_path: Path) -> None:
    code = (
        "import torch, torch_modal as tm\n"
        "from torch_modal.io.content import content_digest\n"
        "class Own(tm.Term):\n"
        "    names = {'a', 'bb', 'ccc'}\n"
        "    def elements(self, mesh): return mesh.edges\n"
        "    def measure(self, spokes): return spokes[0].norm()\n"
        "print(content_digest(tm.Objective(terms=(Own(torch.tensor([2.0])),))))\n"
    )
    (tmp_path / "script.py").write_text(code)
    run = partial(
        subprocess.run, capture_output=True, text=True, check=True, cwd=Path(__file__).parents[1], timeout=120
    )
    root = str(Path(__file__).parents[1])
    found = {
        run(
            [
                sys.executable,
                "-c",
                f"import sys; sys.path.insert(0, {root!r}); exec(open({str(tmp_path / 'script.py')!r}).read())",
            ]
        ).stdout
        for _ in range(2)
    }
    assert len(found) == 1 and len(found.pop().strip()) == 64


@pytest.mark.parametrize("value", [threading.Lock(), (n for n in "abc"), sys.stdout, torch.zeros(2, device="meta")])
def test_what_cannot_be_looked_into_is_refused(value: Any) -> None:
    with pytest.raises(ContentError):
        content_digest(Holder(deep=[value]))
