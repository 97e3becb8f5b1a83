"""Frames as morph targets of glTF primitives, and the animation that plays them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from torch_modal.arrays import FloatArray, IntArray
from torch_modal.io.gltf import ARRAY_BUFFER, Document, Json

TARGET_NAME = "frame-{:03d}"


class Drawn(NamedTuple):
    """A primitive of a document without its positions."""

    json: Json
    points: Any
    """Its vertices among all; indices or a slice. *Shape:* ``(P,)``."""
    inverse: FloatArray | None = None
    """From the scene to the node. *Shape:* ``(4, 4)``."""
    normals: FloatArray | None = None
    """Of each frame, or of frame 0 alone if they do not move. *Shape:* ``(N, P, 3)`` or ``(1, P, 3)``."""


def place_frames(document: Document, drawn: Sequence[Drawn], frames: FloatArray) -> None:
    """Add the positions of frame 0 to primitives, and a morph target for each further frame.

    Args:
        document: The document.
        drawn: Its primitives.
        frames: Positions of all vertices, in the scene. *Shape:* ``(N, V, 3)``.
    """
    made: dict[tuple[int, int], tuple[Json, list[Json]]] = {}
    for primitive in drawn:
        key = (id(primitive.points), id(primitive.normals))
        if key not in made:
            made[key] = _attributes(document, primitive, frames)
        attributes, targets = made[key]
        primitive.json["attributes"] = {**attributes, **primitive.json.get("attributes", {})}
        if targets:
            primitive.json["targets"] = targets


def _attributes(document: Document, primitive: Drawn, frames: FloatArray) -> tuple[Json, list[Json]]:
    local = frames[:, primitive.points]
    if primitive.inverse is not None:
        local = local @ primitive.inverse[:3, :3].T + primitive.inverse[:3, 3]
    base = local[0].astype(np.float32)
    attributes = {"POSITION": document.add(base, "VEC3", ARRAY_BUFFER, bounds=True)}
    normals = [] if primitive.normals is None else [_unit(own) for own in primitive.normals]
    if normals:
        normals[0] = normals[0].astype(np.float32)
        attributes["NORMAL"] = document.add(normals[0], "VEC3", ARRAY_BUFFER)
    targets = []
    for number, shape in enumerate(local[1:], start=1):
        # Against the rounded base, so that its rounding is not carried into every frame.
        target = {"POSITION": document.add((shape - base).astype(np.float32), "VEC3", ARRAY_BUFFER, bounds=True)}
        if number < len(normals):
            target["NORMAL"] = document.add((normals[number] - normals[0]).astype(np.float32), "VEC3", ARRAY_BUFFER)
        targets.append(target)
    return attributes, targets


def _unit(vectors: FloatArray) -> FloatArray:
    """Of unit length, as glTF demands; ``(0, 0, 1)`` where there is none. Unit vectors stay bit for bit."""
    length = np.linalg.norm(vectors, axis=1, keepdims=True)
    usable = length > 1e-12
    scaled = np.where(np.abs(length - 1) < 1e-6, vectors, vectors / np.where(usable, length, 1.0))
    return np.where(usable, scaled, np.array([0.0, 0.0, 1.0]))


def animate(
    document: Document,
    nodes: Sequence[int],
    numbers: Sequence[int],
    times: FloatArray,
    shown: IntArray,
    extras: Json,
) -> None:
    """Play the frames of meshes by the weights of their morph targets.

    Args:
        document: The document; primitives have their targets.
        nodes: Which show the meshes.
        numbers: Frame numbers behind the base and the morph targets, for their names.
        times: In seconds, increasing. *Shape:* ``(T,)``.
        shown: Which of the frames is shown at each time: 0 for the base. *Shape:* ``(T,)``.
        extras: Metadata of the animation.
    """
    weights = np.eye(len(numbers), dtype=np.float32)[:, 1:][shown]
    sampler = {
        "input": document.add(times.astype(np.float32), "SCALAR", bounds=True),
        "output": document.add(weights.reshape(-1), "SCALAR"),
        "interpolation": "LINEAR",
    }
    channels = []
    for node in nodes:
        mesh = document.get("meshes", document.get("nodes", node)["mesh"])
        mesh["weights"] = [0.0] * (len(numbers) - 1)
        names = [TARGET_NAME.format(number) for number in numbers[1:]]
        mesh["extras"] = {**mesh.get("extras", {}), "targetNames": names}
        channels.append({"sampler": 0, "target": {"node": node, "path": "weights"}})
    document.append("animations", {"name": "sequence", "samplers": [sampler], "channels": channels, "extras": extras})
