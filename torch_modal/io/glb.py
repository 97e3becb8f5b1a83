"""A sequence, or one shape, as GLB."""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np

from torch_modal.arrays import FloatArray, IntArray
from torch_modal.geometry.connectivity import merge_seams
from torch_modal.geometry.vectors import vertex_normals
from torch_modal.io.asset import Asset, Material, Part
from torch_modal.io.formats import GLB_HOLDS, Animation
from torch_modal.io.gltf import ARRAY_BUFFER, ELEMENT_ARRAY_BUFFER, Document, Json
from torch_modal.io.gltf_asset import GltfAsset
from torch_modal.io.normals import carry_together

# Normals double the file. Beyond this size (POSITION alone) they are left out.
LARGEST_FILE_WITH_NORMALS = 48 * 2**20


def glb_bytes(vertices: FloatArray, faces: IntArray, asset: Asset | None) -> bytes:
    """One shape without an animation."""
    return _document(vertices[None], faces, asset, "shape").to_glb()


def write_glb(animation: Animation, path: Path) -> None:
    """Frame 0, a morph target for each further frame, and an animation of their weights.

    Key-frames are kept when frames are left out, and named in the animation's extras. Materials, textures and texture
    coordinates come from the asset; from a GLB or GLTF file also its nodes and everything else.
    """
    shapes, asset, timing, keyframes = animation.shapes, animation.asset, animation.timing, animation.keyframes
    name, max_targets = animation.name, animation.max_targets
    if max_targets < 1:
        raise ValueError(f"max_targets must be at least 1, got {max_targets}.")
    kept = thinned(len(shapes), max_targets + 1, keyframes)
    if len(kept) < len(shapes):
        warnings.warn(
            f"{name} holds {len(kept)} of the {len(shapes)} frames (max_targets={max_targets}); "
            "players interpolate linearly between them.",
            stacklevel=3,
        )
    move_normals = shapes[kept].size * 4 <= LARGEST_FILE_WITH_NORMALS
    if not move_normals:
        warnings.warn(f"{name} is large: its normals stay those of frame 0.", stacklevel=3)
    if asset is not None:
        asset.warn_lost(name, asset.keeps if isinstance(asset, GltfAsset) else GLB_HOLDS)
    if isinstance(asset, GltfAsset):
        document = asset.rebuilt(shapes[kept], move_normals)
    else:
        document = _document(shapes[kept], animation.faces, asset, Path(name).stem, move_normals)
    if len(kept) > 1:
        times, shown = timing.knots(kept)
        steps = len(shapes) if timing.cyclic else len(shapes) - 1
        extras: Json = {"fps": steps / timing.duration, "frames": kept.tolist(), "keyframes": keyframes}
        if timing.ping_pong:
            extras["ping_pong"] = True
        weights = np.eye(len(kept), dtype=np.float32)[:, 1:][shown]
        sampler = {
            "input": document.add(times.astype(np.float32), "SCALAR", bounds=True),
            "output": document.add(weights.reshape(-1), "SCALAR"),
            "interpolation": "LINEAR",
        }
        for mesh in document.get("meshes"):
            mesh["weights"] = [0.0] * (len(kept) - 1)
            mesh["extras"] = {**mesh.get("extras", {}), "targetNames": [f"frame-{n:03d}" for n in kept[1:]]}
        channels = [
            {"sampler": 0, "target": {"node": number, "path": "weights"}}
            for number, node in enumerate(document.get("nodes"))
            if "mesh" in node
        ]
        played = {"name": "sequence", "samplers": [sampler], "channels": channels, "extras": extras}
        document.append("animations", played)
    path.write_bytes(document.to_glb())


def thinned(n_frames: int, most: int, wanted: list[int]) -> IntArray:
    """At most ``most`` frame numbers, evenly spread, with both ends and (if they fit) the wanted ones."""
    if n_frames <= most:
        return np.arange(n_frames)
    fixed = sorted({0, n_frames - 1, *wanted})
    if len(fixed) > most:
        return np.unique(np.linspace(0, n_frames - 1, most).round().astype(np.int64))
    gaps, pieces = np.diff(fixed), np.ones(len(fixed) - 1, dtype=np.int64)
    for _ in range(most - len(fixed)):
        pieces[np.argmax(gaps / pieces)] += 1  # the widest step is shortened
    inside = [np.linspace(a, b, n + 1) for a, b, n in zip(fixed[:-1], fixed[1:], pieces, strict=True)]
    return np.unique(np.concatenate(inside).round().astype(np.int64))


def _document(
    shapes: FloatArray, faces: IntArray, asset: Asset | None, name: str, move_normals: bool = True
) -> Document:
    """A document of one node, with the parts of a file or with all faces in clay, and the shapes as morph targets."""
    parts = [Part(np.arange(shapes.shape[1]), faces, Material())] if asset is None else asset.parts()
    positions = shapes[0] if asset is None else asset.positions
    frames = shapes if move_normals else shapes[:1]
    copies = merge_seams(shapes[[0, -1]], faces)
    _, first = np.unique(copies, return_index=True)
    smooth = np.stack([vertex_normals(shape[first], copies[faces])[copies] for shape in frames])
    turned = carry_together(
        [(part.normals, positions[part.vertices], part.triangles) for part in parts],
        [frames[:, part.vertices] for part in parts],
    )
    document = Document()
    primitives = []
    materials: dict[Material, int] = {}
    for part, normals in zip(parts, turned, strict=True):
        index_type = np.uint16 if len(part.vertices) <= 65535 else np.uint32  # 65535 itself is no valid uint16 index
        if part.material not in materials:
            materials[part.material] = document.append("materials", _material(document, part.material))
        attributes, *targets = document.add_frames(
            shapes[:, part.vertices], smooth[:, part.vertices] if normals is None else normals
        )
        if part.texcoords is not None:
            attributes["TEXCOORD_0"] = document.add(part.texcoords.astype(np.float32), "VEC2", ARRAY_BUFFER)
        if part.colors is not None:
            attributes["COLOR_0"] = document.add(part.colors.astype(np.float32), "VEC4", ARRAY_BUFFER)
        primitive: Json = {
            "attributes": attributes,
            "indices": document.add(part.triangles.astype(index_type).reshape(-1), "SCALAR", ELEMENT_ARRAY_BUFFER),
            "material": materials[part.material],
        }
        primitives.append(primitive | ({"targets": targets} if targets else {}))
    document.append("meshes", {"name": name, "primitives": primitives})
    document.append("nodes", {"name": name, "mesh": 0})
    document.append("scenes", {"name": "scene", "nodes": [0]})
    document.root["scene"] = 0
    return document


def _material(document: Document, material: Material) -> Json:
    surface: Json = {
        "baseColorFactor": list(material.color),
        "metallicFactor": material.metallic,
        "roughnessFactor": material.roughness,
    }
    if material.texture is not None:
        image = document.append("images", document.add_image(material.texture))
        if not document.get("samplers"):
            document.append("samplers", {"wrapS": 10497, "wrapT": 10497})  # repeat, as OBJ does
        texture = document.append("textures", {"source": image, "sampler": 0})
        surface["baseColorTexture"] = {"index": texture}
    made: Json = {"name": material.name, "doubleSided": True, "pbrMetallicRoughness": surface}
    if material.color[3] < 1:
        made["alphaMode"] = "BLEND"
    return made
