"""Shapes, faces and materials of a page: quantised, predicted from what is before, deflated, as base64 text.

meshes.js reads it back. The sequences of a group share one grid of 16 bits a coordinate, whose step is the longest side
of the box around everything, divided by 65,535. So a position is off by at most half of that, 8e-6 of the longest side.

Two frames predict the next one of a smooth motion well. Frame n is stored as

    r_n = q_n - 2 q_{n-1} + q_{n-2}    (mod 2^16)                                                      (1)

with r_1 = q_1 - q_0, small numbers around zero. They are folded to positive numbers (0, -1, 1, -2, ... -> 0, 1, 2,
3, ...), split into planes of low and of high bytes (almost all zeros), and deflated. Textures are data URIs.
"""

import base64
import io
import zlib
from collections.abc import Mapping
from functools import cache
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from torch_modal.arrays import FloatArray, IntArray
from torch_modal.geometry.connectivity import merge_seams
from torch_modal.io.asset import Asset
from torch_modal.view.drawing import open_texture
from torch_modal.view.picture import up_axis, view_rotation

GRID_STEPS = 65_535  # steps of the grid along the longest side
TEXEL_STEPS = 65_536  # steps of texture coordinates along a side
TEXTURE_PIXELS = 2048  # the longer side of a texture, at most; every device has textures of this size


def pack_group(
    sequences: Mapping[str, FloatArray],
    faces: IntArray,
    view: tuple[float, float] | None = None,
    up: Literal["y", "z"] | None = None,
    asset: Asset | None = None,
) -> dict[str, Any]:
    """Pack shapes that share faces, a grid and a camera; lengths are in steps of the grid, which begins at ``origin``.

    Arguments as for :func:`torch_modal.show`.
    """
    shapes = next(iter(sequences.values()))
    first = shapes[0]
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
        "faces": pack_integers(faces),
        "surface": None if asset is None or not asset.is_painted else pack_surface(asset, shapes, faces),
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


def pack_surface(asset: Asset, shapes: FloatArray, faces: IntArray) -> dict[str, Any]:
    """Pack the parts of a file, of which a point is a vertex with one texture coordinate and one normal.

    Points with the same number in ``normals`` share the normal that the page computes for each shape: seams are smooth
    and hard edges hard, as in the file. *Shape of the shapes:* ``(N, V, 3)``.
    """
    merged, packed = merge_seams(shapes[[0, -1]], faces), cache(_texture)  # parts share textures
    columns: dict[str, list[Any]] = {"vertices": [], "normals": [], "triangles": [], "texcoords": [], "colors": []}
    parts, textures, n = [], [""], 0
    for part in asset.parts():
        used, corners = np.unique(part.triangles, return_inverse=True)
        vertices, material, uv = part.vertices[used], part.material, np.zeros((len(used), 2))
        colors, normals, texture = np.ones((len(used), 4)), np.zeros((len(used), 3)), ""
        if material.texture is not None and part.texcoords is not None:
            uv, texture = part.texcoords[used], packed(material.name, material.texture)
        if part.colors is not None:
            colors[:, : part.colors.shape[1]] = part.colors[used]
        if part.normals is not None:
            normals = part.normals[used]
        added = vertices, np.column_stack([merged[vertices], normals]), corners.reshape(-1) + n, uv, colors
        for column, rows in zip(columns.values(), added, strict=True):
            column.append(rows)
        textures += [texture] if texture not in textures else []
        look = {"color": np.nan_to_num(material.color).tolist(), "alpha": material.alpha}
        parts.append({"n_corners": corners.size, "texture": textures.index(texture), **look})
        n += len(used)
    vertices, normals, corners, uv, colors = map(np.concatenate, columns.values())
    whole = np.rint(TEXEL_STEPS * np.clip(np.nan_to_num(uv), -(2**14), 2**14))
    return {
        "n_points": n,
        "parts": parts,
        "textures": textures,
        "vertices": pack_integers(vertices),
        "normals": pack_integers(np.unique(normals, axis=0, return_inverse=True)[1]),
        "triangles": pack_integers(corners),
        "texcoords": pack_integers(whole.T),  # all u, then all v
        "colors": pack_integers(np.rint(GRID_STEPS * np.clip(np.nan_to_num(colors), 0, 1)).T),
    }


def _texture(name: str, data: bytes) -> str:
    """Data URI of a texture: the PNG or JPEG file, or if it is too large a smaller picture."""
    picture, kind = open_texture(name, data), "png" if data.startswith(b"\x89PNG") else "jpeg"
    if picture.format is None or max(picture.size) > TEXTURE_PIXELS:
        stream = io.BytesIO()
        picture = picture.convert("RGBA") if picture.mode == "P" else picture
        picture.thumbnail((TEXTURE_PIXELS, TEXTURE_PIXELS))
        picture.save(stream, kind, quality=90)
        data = stream.getvalue()
    return f"data:image/{kind};base64,{base64.b64encode(data).decode('ascii')}"


def pack_integers(numbers: NDArray[Any]) -> str:
    """Pack whole numbers, such as faces ``(F, 3)``, as text: the difference of each one from the one before."""
    steps = numbers.reshape(-1).astype(np.int32)
    steps[1:] -= steps[:-1].copy()
    return _pack(steps)


def _pack(numbers: NDArray[np.signedinteger]) -> str:
    """Fold integers to positive ones, and deflate their planes of bytes, the lowest first, as base64 text."""
    width = numbers.dtype.itemsize
    folded = ((numbers << 1) ^ (numbers >> (8 * width - 1))).view(f"u{width}")
    planes = np.ascontiguousarray(folded, f"<u{width}").view(np.uint8).reshape(-1, width).T
    return base64.b64encode(zlib.compress(planes.tobytes(), 9)).decode("ascii")
