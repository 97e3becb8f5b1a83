"""What torch does too, at less: functions with a derivative of their own where none is recorded, shapes together."""

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor


def traced(x: Tensor) -> bool:
    """Whether a tensor only stands for one (torch.compile, export, fake tensors), so that no kernel can have it."""
    return torch.compiler.is_compiling() or type(x) not in (Tensor, torch.nn.Parameter)


def transformed(x: Tensor) -> bool:
    """Whether a tensor stands for others in a transform of ``torch.func``."""
    return torch.func.debug_unwrap(x, recurse=False) is not x


def applied(function: Any, *given: Any) -> Any:
    """``function.apply`` of a :class:`torch.autograd.Function` with ``setup_context``.

    Where nothing is recorded it goes straight to ``forward``: torch looks at its signature at every call, which takes
    as long as a small kernel.
    """
    plain = not torch.is_grad_enabled() and not any(
        isinstance(value, Tensor) and (traced(value) or transformed(value)) for value in given
    )
    return function.forward(*given) if plain else function.apply(*given)


def broadcast_shapes(*shapes: Sequence[int]) -> torch.Size:
    """``torch.broadcast_shapes``, which imports SymPy, a third of a second, when it is first called.

    Raises:
        RuntimeError: They do not broadcast.
    """
    return torch.broadcast_tensors(*(torch.empty((), device="meta").expand(shape) for shape in shapes))[0].shape
