"""Positions and faces from tensors, NumPy arrays and sequences; checks of tensors."""

import numpy as np
import torch
from torch import Tensor

from torch_modal.arrays import ArrayLike, IntArray
from torch_modal.errors import MeshError

LARGEST_UNIT_RATIO = 8.0
"""Points that extend over more or less than known ones by this factor are in other units."""


def as_positions(keyframes: ArrayLike) -> Tensor:
    """Convert positions to a float tensor, sharing memory where possible."""
    if isinstance(keyframes, (list, tuple)):
        if not keyframes:
            raise MeshError("keyframes is empty; it needs the shape (K, V, 3)")
        shapes = [_as_tensor("keyframes", shape) for shape in keyframes]
        kinds = [f"shape {tuple(shape.shape)}, {shape.dtype}, on {shape.device}" for shape in shapes]
        for i, kind in enumerate(kinds):
            if kind != kinds[0]:
                raise MeshError(f"key-frame {i} has {kind}, key-frame 0 has {kinds[0]}; they must be equal")
        positions = torch.stack(shapes)
    else:
        positions = _as_tensor("keyframes", keyframes)
    if positions.dtype not in (torch.float32, torch.float64):
        raise MeshError(
            f"keyframes have dtype {positions.dtype}; vertex positions must be float32 or float64: convert "
            "them, for instance with .double()"
        )
    return positions


def as_faces(faces: ArrayLike) -> IntArray:
    """Convert faces to an int64 array."""
    tensor = _as_tensor("faces", faces)
    # An empty list becomes a float array; `check_keyframes` reports missing faces.
    if tensor.numel() and (tensor.dtype == torch.bool or tensor.is_floating_point() or tensor.is_complex()):
        raise MeshError(
            f"faces have dtype {tensor.dtype}; they are vertex indices and must be integers: convert with .long()"
        )
    return tensor.detach().cpu().numpy().astype(np.int64)


def _as_tensor(name: str, value: ArrayLike) -> Tensor:
    """Convert a tensor, an array or nested lists to a dense tensor."""
    if isinstance(value, Tensor):
        if value.layout != torch.strided or value.device.type == "meta" or value.is_quantized:
            raise MeshError(
                f"{name} is a {value.layout} tensor on {value.device}; a dense tensor with values is needed"
            )
        return value
    try:
        array = np.asarray(value)
        # PyTorch knows no negative strides, no read-only memory, and no other order of bytes.
        return torch.from_numpy(np.require(array, array.dtype.newbyteorder("="), ["C", "W"]))
    except (TypeError, ValueError, RuntimeError) as error:
        raise MeshError(
            f"{name} is a {type(value).__name__} that is no array of numbers ({str(error)[:150]}); "
            f"pass a tensor or a NumPy array"
        ) from error


def check_tensor(
    name: str, x: ArrayLike, *sizes: int | str, device: torch.device | None = None, finite: bool = False, hint: str = ""
) -> None:
    """Raise for what is not a floating-point tensor of a shape.

    Args:
        name: Of the argument, for the message.
        x: The argument.
        sizes: The size of each dimension, or its letter if any size will do; ``"..."`` first for any leading
            dimensions. Shapes of a mesh of 12 vertices are ``"...", 12, 3``.
        device: Where it must be.
        finite: True to look at its numbers.
        hint: A remedy, for the message on a wrong shape.

    Raises:
        ValueError: The argument is something else.
    """
    if not isinstance(x, Tensor):
        raise ValueError(f"{name} is a {type(x).__name__}; pass a tensor, for instance torch.as_tensor({name})")
    wanted = sizes[1:] if sizes[:1] == ("...",) else sizes
    last = x.shape[max(0, x.dim() - len(wanted)) :] if wanted is not sizes else x.shape
    fits = len(last) == len(wanted) and all(isinstance(a, str) or a == b for a, b in zip(wanted, last, strict=True))
    if not fits or not x.is_floating_point():
        shape = f"({', '.join(map(str, sizes))}{',' * (len(sizes) == 1)})"
        raise ValueError(
            f"{name} must be floating-point of shape {shape}; got {tuple(x.shape)} of {x.dtype}{hint and '; '}{hint}"
        )
    if device is not None and x.device != device:
        raise ValueError(f"{name} is on {x.device}, the other tensors on {device}; move one with .to()")
    if finite and not bool(x.isfinite().all()):
        raise ValueError(f"{name} has entries that are not finite")


def broadcast_leading(hint: str = "", **leading: torch.Size) -> torch.Size:
    """Common leading dimensions of several arguments.

    Args:
        hint: A remedy, for the message.
        leading: Leading dimensions of each argument, under its name.

    Raises:
        ValueError: They do not broadcast.
    """
    try:  # torch.broadcast_shapes imports SymPy, which takes a third of a second
        blank = (torch.empty((), device="meta").expand(shape) for shape in leading.values())
        return torch.broadcast_tensors(*blank)[0].shape
    except RuntimeError:
        got = ", ".join(f"{name} {tuple(shape)}" for name, shape in leading.items())
        raise ValueError(f"leading dimensions do not broadcast: {got}{hint and '; '}{hint}") from None


def require_units(name: str, points: Tensor, of: str, known: Tensor, unit: float = 1.0) -> None:
    """Raise for points that extend far less, or far more, than known ones of each shape.

    Args:
        name: Of the points.
        points: *Shape:* ``(n, 3)``.
        of: Says what is known.
        known: *Shape:* ``(K, m, 3)``.
        unit: Length of a coordinate of 1, for the message.

    Raises:
        ValueError: By more than :data:`LARGEST_UNIT_RATIO`.
    """
    # By medians, which a few outliers do not change.
    extent, *others = [float((x - x.median(0).values).norm(dim=-1).median()) * unit for x in (points, *known)]
    if not min(others) / LARGEST_UNIT_RATIO <= extent <= max(others) * LARGEST_UNIT_RATIO:
        raise ValueError(
            f"{name} extend over {extent:.3g} around their middle, {of} over {min(others):.3g} to {max(others):.3g}: "
            "they are in other units; scale them to the units of the key-frames"
        )
