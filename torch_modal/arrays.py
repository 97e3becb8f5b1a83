"""Types of arrays."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:  # at run time torch stays out: a reader of PLY files does not need it
    import torch

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]
AnyArray = NDArray[Any]
"""Of any dtype."""
Array: TypeAlias = "torch.Tensor | AnyArray"
ArrayLike: TypeAlias = "Array | float | Sequence[ArrayLike]"
"""Tensors, arrays and numbers, and nested sequences of these."""
