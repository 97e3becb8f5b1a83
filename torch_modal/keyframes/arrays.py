"""Positions and faces from tensors, NumPy arrays and sequences; vertices welded along seams."""

from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from torch_modal.arrays import IntArray
from torch_modal.autograd import broadcast_shapes
from torch_modal.errors import MeshError
from torch_modal.geometry.connectivity import merge_seams

UNITS = 8.0
"""Points that extend over more or less than known ones by this factor are in other units."""


def as_positions(keyframes: Any) -> Tensor:
    """Convert positions to a float tensor, sharing memory where possible."""
    if isinstance(keyframes, (list, tuple)):
        if not keyframes:
            raise MeshError("keyframes is empty; it needs the shape (K, V, 3)")
        shapes = [_as_tensor("keyframes", shape) for shape in keyframes]
        for i, shape in enumerate(shapes):
            for what, mine, its in (
                ("shape", tuple(shapes[0].shape), tuple(shape.shape)),
                ("dtype", shapes[0].dtype, shape.dtype),
                ("device", shapes[0].device, shape.device),
            ):
                if mine != its:
                    raise MeshError(f"key-frame {i} has {what} {its}, key-frame 0 has {mine}; they must be equal")
        positions = torch.stack(shapes)
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


def _as_tensor(name: str, value: Any) -> Tensor:
    """Convert a tensor, an array or nested lists to a dense tensor."""
    if isinstance(value, Tensor):
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


def check_tensor(
    name: str, x: Any, *sizes: int | str, device: torch.device | None = None, finite: bool = False, hint: str = ""
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
    try:
        return broadcast_shapes(*leading.values())
    except RuntimeError:
        got = ", ".join(f"{name} {tuple(shape)}" for name, shape in leading.items())
        raise ValueError(f"leading dimensions do not broadcast: {got}{hint and '; '}{hint}") from None


class WeldedKeyframes(NamedTuple):
    """Key-frames without duplicate vertices along seams."""

    keyframes: Tensor
    """*Shape:* ``(K, W, 3)``."""
    faces: Tensor
    """Indices of the W vertices, int64. *Shape:* ``(F, 3)``."""
    vertex_of: Tensor
    """Welded vertex of each of the V vertices. *Shape:* ``(V,)``."""

    @property
    def n_merged(self) -> int:
        """Number of removed vertices."""
        return len(self.vertex_of) - self.keyframes.shape[1]

    def scatter(self, shapes: Tensor) -> Tensor:
        """Positions of all V vertices; duplicates coincide exactly.

        *Shape:* ``(..., W, 3) -> (..., V, 3)``.
        """
        return shapes.index_select(-2, self.vertex_of.to(shapes.device))


def weld_seams(keyframes: Any, faces: Any) -> WeldedKeyframes:
    """Join the vertices that exporters split along seams of texture coordinates and normals.

    Otherwise the surface would tear there. Boundary vertices that coincide in all key-frames become one, with the
    position of the first. Faces that become degenerate are removed.

    Args:
        keyframes: Vertex positions, as for :func:`torch_modal.check_keyframes`. *Shape:* ``(K, V, 3)``.
        faces: Vertex indices. *Shape:* ``(F, 3)``.

    Returns:
        The welded key-frames; unchanged if nothing was split.

    Raises:
        MeshError: The arguments are not numeric arrays.
    """
    positions = as_positions(keyframes)
    indices = as_faces(faces)
    n = positions.shape[1] if positions.dim() == 3 else 0
    fits = positions.dim() == 3 and indices.ndim == 2 and indices.shape[1:] == (3,) and len(indices)
    # `check_keyframes` reports errors of the mesh.
    if fits and indices.min() >= 0 and indices.max() < n and bool(torch.isfinite(positions).all()):
        vertex_of = merge_seams(positions.detach().cpu().double().numpy(), indices)
    else:
        vertex_of = np.arange(n)
    welded = vertex_of.max(initial=-1) + 1
    if welded == n:
        return WeldedKeyframes(positions, torch.from_numpy(indices), torch.arange(n))
    first = torch.from_numpy(np.unique(vertex_of, return_index=True)[1]).to(positions.device)
    joined = vertex_of[indices]
    whole = (joined != np.roll(joined, 1, axis=1)).all(axis=1)
    return WeldedKeyframes(
        positions.index_select(1, first),
        torch.from_numpy(joined[whole]).to(positions.device),
        torch.from_numpy(vertex_of).to(positions.device),
    )


def require_units(name: str, points: Tensor, of: str, known: Tensor, unit: float = 1.0) -> None:
    """Raise for points that extend far less, or far more, than known ones of each shape.

    Args:
        name: Of the points.
        points: *Shape:* ``(n, 3)``.
        of: Says what is known.
        known: *Shape:* ``(K, m, 3)``.
        unit: Length of a coordinate of 1, for the message.

    Raises:
        ValueError: By more than :data:`UNITS`.
    """
    # By medians, which a few outliers do not change.
    extent, *others = [float((x - x.median(0).values).norm(dim=-1).median()) * unit for x in (points, *known)]
    if not min(others) / UNITS <= extent <= max(others) * UNITS:
        raise ValueError(
            f"{name} extend over {extent:.3g} around their middle, {of} over {min(others):.3g} to {max(others):.3g}: "
            "they are in other units; scale them to the units of the key-frames"
        )
