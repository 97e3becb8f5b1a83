"""Digests of settings and arrays, as keys of stored results.

Numbers count with their types and shapes, objects of this package with their classes and all their attributes. Objects
of other classes have no digest: their results follow from code that this module does not read.
"""

import hashlib
import struct
import sys
from collections import OrderedDict
from collections.abc import Iterable
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torch_modal.version import __version__


class ContentError(ValueError):
    """An object has contents that are not plain data, so that it has no digest."""


def content_digest(value: Any) -> str:
    """SHA-256 of all contents of a value, the same in every process.

    Raises:
        ContentError: Some of it is neither plain data nor an object of this package.
    """
    try:
        return _digest(value).hex()
    except RecursionError:
        raise ContentError(f"a {type(value).__name__} is nested too deeply") from None


@cache
def code_digest() -> str:
    """SHA-256 of the package's own code, which changes before its version does."""
    root = Path(__file__).parents[1]
    files = sorted(root.rglob("*.py"))
    parts = [part for file in files for part in (file.relative_to(root).as_posix().encode(), file.read_bytes())]
    return _joined(__version__, parts).hex()


def _digest(value: Any) -> bytes:
    kind = type(value)
    if value is None or kind in (bool, int, float, str):
        return _joined(kind.__name__, [repr(value).encode("utf-8", "surrogatepass")])
    if kind in (list, tuple):
        return _joined(kind.__name__, map(_digest, value))
    if kind in (dict, OrderedDict):
        return _joined(kind.__name__, (_digest(part) for pair in value.items() for part in pair))
    if kind in (set, frozenset):
        return _joined(kind.__name__, sorted(map(_digest, value)))
    if kind in (Tensor, torch.nn.Parameter):
        return _joined("tensor", [str(value.dtype).encode(), str(tuple(value.shape)).encode(), _bytes_of(value)])
    if isinstance(value, (np.ndarray, np.generic)) and not value.dtype.hasobject:
        return _joined("array", [str(value.dtype.descr).encode(), str(value.shape).encode(), value.tobytes()])
    if _is_of_package(kind):
        content = tuple(value) if isinstance(value, tuple) else dict(vars(value))
        return _joined(f"{kind.__module__}.{kind.__qualname__}", [_digest(content)])
    raise ContentError(f"a {kind.__qualname__} is neither plain data nor of a class of torch_modal")


def _bytes_of(x: Tensor) -> bytes:
    plain = x.detach()
    if plain.layout is not torch.strided or plain.is_meta or torch.func.debug_unwrap(plain, recurse=False) is not plain:
        raise ContentError(f"a tensor of {x.layout} on {x.device}, or inside a transform of torch.func, has no numbers")
    numbers = plain.cpu().resolve_conj().resolve_neg().contiguous().flatten().view(torch.uint8)
    return numbers.numpy().tobytes()


def _is_of_package(kind: type) -> bool:
    """Whether a class is the one of its name in this package."""
    found: Any = sys.modules.get(kind.__module__) if kind.__module__.startswith("torch_modal.") else None
    for name in kind.__qualname__.split("."):
        found = getattr(found, name, None)
    return found is kind


def _joined(kind: str, parts: Iterable[bytes]) -> bytes:
    total = hashlib.sha256(kind.encode())
    for part in parts:
        total.update(struct.pack("<q", len(part)))
        total.update(part)
    return total.digest()
