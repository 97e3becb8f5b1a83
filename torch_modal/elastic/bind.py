"""Names that formulas are written in: torch has them here, and kernels of NVIDIA Warp under the same names.

A formula is a plain function of these names, of other formulas, and of numbers that stand in its file under a name; a
number within is ``real(2.0)``. It is evaluated on tensors as it stands, with components first, and
:func:`for_kernels` makes the function of Warp from the same text. Annotations that are strings name the types of
arguments: without one, or with another, they are the edge vectors.
"""

import types
from collections.abc import Callable, Sequence
from functools import cache
from typing import Any

import torch
from torch import Tensor

from torch_modal.geometry.vectors import cross as cross
from torch_modal.geometry.vectors import inverse as inverse
from torch_modal.geometry.vectors import root as root
from torch_modal.geometry.vectors import tiny

Scalar = Tensor
"""A number of each element."""
Flag = Tensor
"""True or false."""
Vector = Tensor
"""Three components."""
Vectors = Tensor
"""The edge vectors of an element."""
Number = Tensor | float
"""A number of each element, or one of all."""
Pair = Sequence[Tensor]
"""Two numbers, such as cosine and sine of an angle."""
Triple = Sequence[Tensor]
Five = Sequence[Tensor]
Six = Sequence[Tensor]
Measure = Tensor | Sequence[Tensor]
"""A number, or cosine and sine of an angle."""
Formula = Callable[..., Any]
"""A function of edge vectors, measures or sums in these names."""

real: Callable[[float], Scalar] = float  # type: ignore[assignment]  # torch takes it for a tensor
cos, sin, sqrt, atan2 = torch.cos, torch.sin, torch.sqrt, torch.atan2
absolute, where = torch.abs, torch.where


def dot(a: Vector, b: Vector) -> Scalar:
    """Sum of the products of components."""
    return (a * b).sum(0)


def rows(*vectors: Vector) -> Vectors:
    """A vector for each edge vector."""
    return torch.stack(vectors)


def pair(*numbers: Scalar) -> Pair:
    """Several numbers as one value: ``triple``, ``five`` and ``six`` likewise."""
    return numbers


triple = five = six = pair


def maximum(a: Scalar, b: Number) -> Scalar:
    """The larger number."""
    return torch.maximum(a, b) if isinstance(b, Tensor) else a.clamp_min(b)


def minimum(a: Scalar, b: Number) -> Scalar:
    """The smaller number."""
    return torch.minimum(a, b) if isinstance(b, Tensor) else a.clamp_max(b)


def vanishes(squared: Scalar) -> Flag:
    """True for squared lengths without a direction."""
    return squared <= tiny(squared)


def underflows(x: Scalar) -> Flag:
    """True for numbers whose inverse is infinite."""
    return x <= torch.finfo(x.dtype).tiny


def above_rounding(number: float, x: Scalar) -> float:
    """A relative number, or more where the arithmetic does not resolve it."""
    return max(number, 100 * torch.finfo(x.dtype).eps)


@cache
def _names_of_kernels() -> dict[str, object]:
    """The names above in Warp, and its types under the names of the types."""
    import warp as wp

    from torch_modal.elastic.kernels import types as own

    made = {"pair": own.vec2, "triple": own.vec3, "five": own.vec5, "six": own.vec6}
    names = {name: getattr(wp, name) for name in ("dot", "cross", "sqrt", "sin", "cos", "atan2", "where")}
    names |= {name: getattr(own, name) for name in ("real", "vanishes", "underflows", "root", "inverse")}
    names |= {"maximum": wp.max, "minimum": wp.min, "absolute": wp.abs, "rows": wp.matrix_from_rows}
    kinds = {"Scalar": own.real, "Number": own.real, "Flag": bool, "Vector": own.vec3, "Measure": Any}
    kinds |= {name.title(): kind for name, kind in made.items()}
    return {**names, **made, **kinds, "above_rounding": own.above_rounding}


@cache
def for_kernels(formula: Formula, n: int = 1) -> Any:
    """The function of Warp with the text of a formula, of ``n`` edge vectors.

    Raises:
        ValueError: The formula uses a name that kernels do not have, variables of a function around it, or numbers
            that are not ``real(...)``.
    """
    import warp as wp

    known = _names_of_kernels() | {"Vectors": wp.types.matrix(shape=(n, 3), dtype=wp.float64)}
    code = formula.__code__
    found: dict[str, object] = {"__builtins__": __builtins__}
    for name in (*code.co_names, *code.co_freevars):
        value = formula.__globals__.get(name)
        if name in known and value is globals().get(name):
            found[name] = known[name]
        elif isinstance(value, float | int):
            found[name] = wp.constant(wp.float64(value))
        elif isinstance(value, types.FunctionType):
            found[name] = for_kernels(value, n)
        else:
            raise ValueError(
                f"the formula {formula.__qualname__} uses {name}, which kernels do not have: write it at the top level "
                "of a file, in the names of torch_modal.elastic.bind, formulas of these, and numbers under a name"
            )
    if "real" not in code.co_names and any(isinstance(each, float) for each in code.co_consts):
        raise ValueError(
            f"the formula {formula.__qualname__} has a number of Python's, which kernels take for float32: write "
            "real(2.0), or give it a name at the top level of the file"
        )
    bound: Callable[..., object] = types.FunctionType(code, found, formula.__name__)
    arguments, given = code.co_varnames[: code.co_argcount], formula.__annotations__
    bound.__annotations__ = {name: known.get(given.get(name, ""), known["Vectors"]) for name in arguments}
    bound.__module__, bound.__qualname__ = formula.__module__, f"{formula.__qualname__}_{n}"
    return wp.func(bound)
