"""Shapes and faces of a page: quantised, predicted from earlier frames, deflated, as base64 text.

meshes.js reads it back. The sequences of a group share one grid of 16 bits a coordinate, whose step is the longest side
of the box around everything, divided by 65,535. So a position is off by at most half of that, 8e-6 of the longest side.

Two frames predict the next one of a smooth motion well. Frame n is stored as

    r_n = q_n - 2 q_{n-1} + q_{n-2}    (mod 2^16)                                                      (1)

with r_1 = q_1 - q_0, small numbers around zero. They are folded to positive numbers (0, -1, 1, -2, ... -> 0, 1, 2,
3, ...), split into planes of low and of high bytes (almost all zeros), and deflated.
"""

import base64
import zlib
from collections.abc import Mapping
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from torch_modal.arrays import FloatArray, IntArray
from torch_modal.view.picture import up_axis, view_rotation

GRID_STEPS = 65_535  # steps of the grid along the longest side


def pack_group(
    sequences: Mapping[str, FloatArray],
    faces: IntArray,
    view: tuple[float, float] | None = None,
    up: Literal["y", "z"] | None = None,
) -> dict[str, Any]:
    """Pack shapes that share faces, a grid and a camera; lengths are in steps of the grid, which begins at ``origin``.

    Arguments as for :func:`torch_modal.show`.
    """
    first = next(iter(sequences.values()))[0]
    corners = np.stack([f(x.reshape(-1, 3), axis=0) for f in (np.min, np.max) for x in sequences.values()])
    origin = corners.min(0)
    step = float(np.ptp(corners, axis=0).max()) / GRID_STEPS or 1.0
    numbers = {
        name: np.clip(np.rint((x - origin) / step), 0, GRID_STEPS).astype(np.uint16) for name, x in sequences.items()
    }
    # The box around everything along right, up and front; the camera orbits its middle. A frame at a time saves memory.
    rotation = view_rotation(first, view, up)
    seen = (shape @ rotation.T for frames in numbers.values() for shape in frames)
    bounds = np.array([(points.min(0), points.max(0)) for points in seen])
    low, high = bounds[:, 0].min(0), bounds[:, 1].max(0)
    return {
        "origin": origin.tolist(),
        "step": step,
        "n_vertices": len(first),
        "n_faces": len(faces),
        "faces": pack_faces(faces),
        "sequences": [{"name": name, "frames": pack_frames(frames)} for name, frames in numbers.items()],
        "view": {
            "front": rotation[2].tolist(),
            "centre": (0.5 * (low + high) @ rotation).tolist(),
            "half": (0.5 * (high - low)).tolist(),
            "world_up": [0, 1, 0] if up_axis(first, up) == "y" else [0, 0, 1],
        },
    }


def pack_frames(numbers: NDArray[np.uint16]) -> str:
    """Pack shapes ``(N, V, 3)`` in whole steps of the grid as text."""
    residual = numbers.copy()
    residual[1:] -= numbers[:-1]  # wraps, here and in the page
    residual[2:] -= numbers[1:-1] - numbers[:-2]
    return _pack(residual.view(np.int16).transpose(0, 2, 1))  # all x of a frame, then all y, all z


def pack_faces(faces: IntArray) -> str:
    """Pack faces ``(F, 3)`` as text: the difference of each corner from the one before."""
    steps = faces.reshape(-1).astype(np.int32)
    steps[1:] -= steps[:-1].copy()
    return _pack(steps)


def _pack(numbers: NDArray[np.signedinteger]) -> str:
    """Fold integers to positive ones, and deflate their planes of bytes, the lowest first, as base64 text."""
    width = numbers.dtype.itemsize
    folded = ((numbers << 1) ^ (numbers >> (8 * width - 1))).view(f"u{width}")
    planes = np.ascontiguousarray(folded, f"<u{width}").view(np.uint8).reshape(-1, width).T
    return base64.b64encode(zlib.compress(planes.tobytes(), 9)).decode("ascii")
