"""Conversion of tensors, NumPy arrays and sequences to tensors."""

from typing import Any

import numpy as np
import torch

from torch_modal.arrays import IntArray
from torch_modal.errors import MeshError


def as_positions(keyframes: Any) -> torch.Tensor:
    """Convert positions to a float tensor, sharing memory where possible."""
    if isinstance(keyframes, (list, tuple)):
        if not keyframes:
            raise MeshError("keyframes is empty; it needs the shape (K, V, 3)")
        parts = [_as_tensor("keyframes", part) for part in keyframes]
        for i, part in enumerate(parts):
            for what, mine, its in (
                ("shape", tuple(parts[0].shape), tuple(part.shape)),
                ("dtype", parts[0].dtype, part.dtype),
                ("device", parts[0].device, part.device),
            ):
                if mine != its:
                    raise MeshError(f"key-frame {i} has {what} {its}, key-frame 0 has {mine}; they must be equal")
        positions = torch.stack(parts)
    else:
        positions = _as_tensor("keyframes", keyframes)
    if positions.dtype not in (torch.float32, torch.float64):
        raise MeshError(
            f"keyframes have dtype {positions.dtype}; vertex positions must be float32 or float64: convert "
            "them, for instance with .double()"
        )
    return positions


def as_faces(faces: Any) -> IntArray:
    """Convert faces to an int64 array."""
    tensor = _as_tensor("faces", faces)
    # An empty list becomes a float array; `check_keyframes` reports missing faces.
    if tensor.numel() and (tensor.dtype == torch.bool or tensor.is_floating_point() or tensor.is_complex()):
        raise MeshError(
            f"faces have dtype {tensor.dtype}; they are vertex indices and must be integers: convert with .long()"
        )
    array = tensor.detach().cpu().numpy()
    if array.dtype == np.uint64 and array.size and array.max() > np.iinfo(np.int64).max:
        raise MeshError(f"faces hold the index {array.max()}; vertex indices must fit into int64")
    return array.astype(np.int64)


def _as_tensor(name: str, value: Any) -> torch.Tensor:
    """Convert a tensor, an array or nested lists to a dense tensor."""
    if isinstance(value, torch.Tensor):
        if value.layout != torch.strided or value.device.type == "meta" or value.is_quantized:
            raise MeshError(
                f"{name} is a {value.layout} tensor on {value.device}; a dense tensor with values is needed"
            )
        return value
    try:
        array = np.asarray(value)
        if array.dtype.kind not in "biufc":
            raise TypeError(f"elements of type {array.dtype}")
        if not array.dtype.isnative:
            array = array.astype(array.dtype.newbyteorder("="))
        # PyTorch knows no negative strides and no read-only memory.
        return torch.from_numpy(array if array.flags.writeable and array.flags.c_contiguous else array.copy(order="C"))
    except (TypeError, ValueError, RuntimeError) as error:
        raise MeshError(
            f"{name} is a {type(value).__name__} that is no array of numbers ({str(error)[:150]}); "
            f"pass a tensor or a NumPy array"
        ) from error
