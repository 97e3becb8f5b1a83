"""Shapes between two key-frames at even times, and cubic interpolation among them."""

import contextlib
from pathlib import Path

from torch import Tensor

from torch_modal.io.tensors import TensorFile, write_tensors

FORMAT = "torch_modal.between"
VERSION = "2"


def interpolate(table: Tensor, t: Tensor) -> Tensor:
    """Cubic Lagrange interpolation among the four nearest of even times in [0, 1].

    Reads these four only, so that a memory-mapped table is not loaded whole. Exact at the times of the table.

    Args:
        table: Four shapes or more. *Shape:* ``(T, V, 3)``.
        t: Times in [0, 1]. *Shape:* ``(B,)``.

    Returns:
        *Shape:* ``(B, V, 3)``.
    """
    n = len(table)
    place = t * (n - 1)
    start = (place.detach().floor().long() - 1).clamp(0, n - 4)
    x = place - start
    # The basis polynomials of the nodes 0, 1, 2, 3.
    weights = [
        (1 - x) * (2 - x) * (3 - x) / 6,
        x * (2 - x) * (3 - x) / 2,
        x * (x - 1) * (3 - x) / 2,
        x * (x - 1) * (x - 2) / 6,
    ]
    return sum(weight[:, None, None] * table[start + i] for i, weight in enumerate(weights))  # type: ignore[return-value]


def read_table(path: Path, key: dict[str, str]) -> Tensor | None:
    """A memory-mapped table; None if it is missing, damaged, or of another key."""
    with contextlib.suppress(OSError, ValueError):
        file = TensorFile(path, FORMAT, VERSION, ["shapes"])
        if key.items() <= file.metadata.items():
            return file.tensor("shapes")
    return None


def write_table(path: Path, table: Tensor, key: dict[str, str]) -> None:
    """Store a table, if its folder is writable."""
    with contextlib.suppress(OSError):
        write_tensors(path, FORMAT, VERSION, {"shapes": table}, key)
