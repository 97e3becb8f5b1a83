"""Digests change with whatever a result may depend on, and with nothing else."""

import subprocess
import sys
import threading
from collections import OrderedDict
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import torch_modal as tm
from torch_modal.energy.stretch import Stretch
from torch_modal.io.cache import ContentError, content_digest

ROOT = Path(__file__).parents[2]


class Own(tm.Term):
    """A term of a user."""


def long(last: float) -> torch.Tensor:
    """A tensor whose repr leaves out most numbers."""
    x = torch.zeros(2000)
    x[1000] = last
    return x


def stretch(stiffness: Any = 1.0, **attributes: Any) -> Stretch:
    term = Stretch(stiffness)
    vars(term).update(attributes)
    return term


DIFFERENT: dict[str, tuple[Any, Any]] = {
    "a term's stiffness": (stretch(2.0), stretch(3.0)),
    "a term's buffer": (stretch(long(2.0)), stretch(long(3.0))),
    "a term's parameter": (stretch(torch.nn.Parameter(long(2.0))), stretch(torch.nn.Parameter(long(3.0)))),
    "an attribute with an underscore": (stretch(_c=2.0), stretch(_c=3.0)),
    "a class": (Stretch(), tm.Objective().all_terms()[1]),
    "a type of numbers": (torch.zeros(2), torch.zeros(2, dtype=torch.float64)),
    "a shape": (np.zeros((2, 3)), np.zeros((3, 2))),
    "fields": (np.zeros(1, dtype=[("a", "<i4")]), np.zeros(1, dtype=[("a", "<f4")])),
    "the last digit": (1.0, float(np.nextafter(1.0, 2.0))),
    "a kind of number": (1, 1.0),
    "a truth": (1, True),
    "a kind of list": ([1, 2], (1, 2)),
    "nesting": ([[1], 2], [[1, 2]]),
    "an order": ({"a": 1, "b": 2}, {"b": 2, "a": 1}),
    "values deep inside": ([{"b": OrderedDict(c=long(2.0))}], [{"b": OrderedDict(c=long(3.0))}]),
    "settings": (tm.Objective(beta=2.0), tm.Objective(beta=3.0)),
    "terms of settings": (tm.Objective(terms=(stretch(2.0),)), tm.Objective(terms=(stretch(3.0),))),
    "bfloat16": (torch.zeros(2, dtype=torch.bfloat16), torch.ones(2, dtype=torch.bfloat16)),
    "a conjugate": (torch.tensor([1j]), torch.tensor([1j]).conj()),
}


@pytest.mark.parametrize("what", DIFFERENT)
def test_what_differs_has_another_digest(what: str) -> None:
    first, second = (content_digest(value) for value in DIFFERENT[what])
    assert first != second
    assert first == content_digest(DIFFERENT[what][0])


def test_what_is_equal_has_the_same() -> None:
    pairs = [
        (stretch(long(2.0)), stretch(long(2.0))),
        (long(2.0), torch.stack([long(2.0), long(2.0)], 1)[:, 0]),
        (np.arange(6.0).reshape(2, 3), np.arange(6.0).reshape(2, 3).copy(order="F")),
        ({"a", "b", "c"}, {"c", "b", "a"}),
        (tm.Objective(alpha=np.float64(5.0)), tm.Objective(alpha=np.float64(5.0))),
    ]
    for first, second in pairs:
        assert content_digest(first) == content_digest(second)


def test_the_same_in_another_process() -> None:
    code = (
        "import torch, torch_modal as tm\n"
        "from torch_modal.io.cache import content_digest\n"
        "print(content_digest([{'a', 'bb', 'ccc'}, tm.Objective(alpha=torch.tensor([2.0]))]))\n"
    )
    found = {
        subprocess.run(
            [sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT, timeout=120
        ).stdout.strip()
        for _ in range(2)
    }
    assert found == {content_digest([{"a", "bb", "ccc"}, tm.Objective(alpha=torch.tensor([2.0]))])}


def disguised() -> tm.Term:
    """A term whose class has the name and the module of another one's."""
    other = type("Stretch", (Stretch,), {})
    other.__module__ = Stretch.__module__
    return other(1.0)  # type: ignore[no-any-return]


def hooked() -> tm.Term:
    term = Stretch(1.0)
    term.register_forward_hook(lambda module, args, output: 2 * output)
    return term


def circle() -> list[Any]:
    values: list[Any] = []
    values.append(values)
    return values


@pytest.mark.parametrize(
    "value",
    [
        threading.Lock(),
        (n for n in "abc"),
        sys.stdout,
        torch.zeros(2, device="meta"),
        torch.zeros(2).to_sparse(),
        np.array([{}], dtype=object),
        lambda x: x,
        Own(2.0),
        tm.Objective(terms=(Own(2.0),)),
        stretch(measure=lambda spokes: 2 * spokes[0].norm()),
        disguised(),
        hooked(),
        circle(),
    ],
)
def test_what_is_not_plain_data_is_refused(value: Any) -> None:
    with pytest.raises(ContentError):
        content_digest([value])


def test_tensors_inside_a_transform_are_refused() -> None:
    with pytest.raises(ContentError):
        torch.func.vmap(lambda x: torch.tensor(len(content_digest(x))))(torch.zeros(2, 3))
