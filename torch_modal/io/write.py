"""Checks of arrays and paths that all writers share."""

from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torch_modal.arrays import Array, FloatArray, IntArray


def to_numpy(array: Array) -> NDArray[Any]:
    """A torch tensor (any device, with or without gradient) or NumPy array as a NumPy array."""
    if hasattr(array, "detach"):
        tensor = array.detach().cpu()
        # NumPy has no bfloat16; float64 holds every torch float exactly.
        return (tensor.double() if tensor.is_floating_point() else tensor).numpy()
    return np.asarray(array)


def check_frames(frames: Array, faces: Array, name: str = "frames") -> tuple[FloatArray, IntArray]:
    """Shapes ``(N, V, 3)`` as float64 and faces ``(F, 3)`` as int64, after the checks that every output needs.

    Raises:
        ValueError: A shape is wrong, a value is not finite, or a face names a vertex that does not exist; the message
            calls the shapes ``name``.
    """
    shapes, triangles = to_numpy(frames), to_numpy(faces)
    if shapes.ndim != 3 or shapes.shape[2] != 3 or 0 in shapes.shape:
        hint = "; one shape alone is frames[None]" if shapes.ndim == 2 else ""
        raise ValueError(f"{name} must have shape (N, V, 3) with N, V >= 1, got {shapes.shape}{hint}")
    if triangles.ndim != 2 or triangles.shape[1] != 3 or len(triangles) == 0:
        raise ValueError(f"faces must have shape (F, 3), triangles, with F >= 1, got {triangles.shape}")
    if triangles.dtype.kind not in "iu":
        raise ValueError(f"faces must hold integers, got {triangles.dtype}")
    if triangles.min() < 0 or triangles.max() >= shapes.shape[1]:
        raise ValueError(
            f"faces must index the {shapes.shape[1]} vertices of {name} from 0, "
            f"got indices from {triangles.min()} to {triangles.max()}"
        )
    shapes = shapes.astype(np.float64)
    # Every format but OBJ and OFF stores float32, where larger numbers become infinite.
    bad = ~(np.abs(shapes) <= np.finfo(np.float32).max).all(axis=(1, 2))
    if bad.any():
        raise ValueError(
            f"{name} must hold finite numbers within float32; {int(bad.sum())} of {len(shapes)} shapes "
            f"do not, the first is number {int(bad.argmax())}"
        )
    return shapes, triangles.astype(np.int64)


def check_indices(indices: Sequence[int], n_frames: int, name: str) -> list[int]:
    """Frame numbers, each once and in order; negative ones are refused, not wrapped."""
    numbers = sorted({int(index) for index in indices})
    if numbers and (numbers[0] < 0 or numbers[-1] >= n_frames):
        raise ValueError(f"{name} must be numbers of frames, from 0 to {n_frames - 1}; got {list(indices)}")
    return numbers


def check_suffix(path: Path, suffixes: Collection[str]) -> str:
    """The suffix of a file in small letters, with its dot; raises a ValueError if it is not among ``suffixes``."""
    suffix = path.suffix.lower()
    if suffix not in suffixes:
        *others, last = suffixes
        wanted = f"{', '.join(others)} or {last}" if others else last
        raise ValueError(f"out must end in {wanted}, got {path.name!r}")
    return suffix


def refuse_existing(path: Path, overwrite: bool) -> None:
    """Raise an OSError, before any work is done, if ``path`` must not be written."""
    if path.is_dir():
        raise IsADirectoryError(f"{path} is a folder; name a file")
    if path.exists() and not overwrite:
        raise FileExistsError(f"{path} exists; pass overwrite=True (--overwrite) to replace it")
