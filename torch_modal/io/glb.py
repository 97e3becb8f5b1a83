"""A sequence, or one shape, as GLB."""

import warnings
from pathlib import Path

import numpy as np
import torch

from torch_modal.arrays import FloatArray, IntArray
from torch_modal.geometry.connectivity import merge_seams
from torch_modal.geometry.skin import Skin
from torch_modal.geometry.vectors import vertex_normals
from torch_modal.io.asset import Asset, Material, Part
from torch_modal.io.formats import Animation
from torch_modal.io.gltf import ARRAY_BUFFER, ELEMENT_ARRAY_BUFFER, Document, Json, world_transforms
from torch_modal.io.gltf_asset import GltfAsset
from torch_modal.io.normals import carry_together

MANY_TARGETS = 64
SMALLEST_EXTENT = 1e-30  # instead of zero, where shapes do not move


def glb_bytes(vertices: FloatArray, faces: IntArray, asset: Asset | None) -> bytes:
    """A GLB file of one shape, without an animation."""
    return _document(vertices[None], faces, asset, "shape").to_glb()


def write_glb(animation: Animation, path: Path) -> None:
    """Write an animation as frame 0 and a morph target for each further frame, as a skin, or as principal shapes.

    An asset that is a GLB or GLTF file also contributes its nodes and everything else.
    """
    shapes, asset, timing, keyframes = animation.shapes, animation.asset, animation.timing, animation.keyframes
    skin, n_targets, name = animation.skin, animation.targets, animation.name
    if skin is not None:
        drawn, weights = skin.rest[None].double().cpu().numpy(), np.empty((len(shapes), 0))
    elif n_targets:
        drawn, weights = _principal(shapes, n_targets)
    else:
        drawn, weights = shapes, np.eye(len(shapes))[:, 1:]  # frame n is the target n - 1 alone
        if len(shapes) > MANY_TARGETS:
            count = f"{len(shapes) - 1} morph targets, which players hold in memory"
            warnings.warn(f"{name} has {count}; bones or targets are smaller", stacklevel=3)
    if isinstance(asset, GltfAsset):
        document = asset.rebuild(drawn)
    else:
        document = _document(drawn, animation.faces, asset, Path(name).stem)
    if len(shapes) > 1:
        times, shown = timing.knots()
        steps = len(shapes) if timing.cyclic else len(shapes) - 1
        extras: Json = {"fps": steps / timing.duration, "frames": list(range(len(shapes))), "keyframes": keyframes}
        if timing.ping_pong:
            extras["ping_pong"] = True
        inputs = document.add(times.astype(np.float32), "SCALAR", bounds=True)
        if skin is not None:
            samplers, channels = _add_skin(document, skin, asset, inputs, shown)
        else:
            rows = weights[shown]
            outputs = document.add(rows.astype(np.float32).reshape(-1), "SCALAR")
            samplers = [{"input": inputs, "output": outputs, "interpolation": "LINEAR"}]
            names = [f"principal-{n}" if n_targets else f"frame-{n:03d}" for n in range(1, len(drawn))]
            for mesh in document.get("meshes"):
                mesh["weights"] = rows[0].tolist()
                mesh["extras"] = {**mesh.get("extras", {}), "targetNames": names}
            nodes = [number for number, node in enumerate(document.get("nodes")) if "mesh" in node]
            channels = [{"sampler": 0, "target": {"node": number, "path": "weights"}} for number in nodes]
        played = {"name": "sequence", "samplers": samplers, "channels": channels, "extras": extras}
        document.append("animations", played)
    path.write_bytes(document.to_glb())


def _principal(shapes: FloatArray, n: int) -> tuple[FloatArray, FloatArray]:
    """A base shape, the base plus each of the first n principal shapes, and their weights in the frames, from 0 to 1.

    Blender clamps weights to this range, so the base is the mean plus the least part of each shape. *Shape:*
    ``(N, V, 3) -> (1 + n, V, 3), (N, n)``; n is smaller where fewer give the frames exactly.
    """
    mean = shapes.mean(0)
    vectors, sizes, components = np.linalg.svd((shapes - mean).reshape(len(shapes), -1), full_matrices=False)
    n = min(n, int((sizes >= 1e-7 * sizes[0]).sum()))
    vectors, parts = vectors[:, :n], (sizes[:n, None] * components[:n]).reshape(n, *mean.shape)
    low, extent = vectors.min(0), np.maximum(np.ptp(vectors, axis=0), SMALLEST_EXTENT)
    base = mean + np.tensordot(low, parts, 1)
    return np.concatenate([base[None], base + extent[:, None, None] * parts]), (vectors - low) / extent


def _add_skin(
    document: Document, skin: Skin, asset: Asset | None, inputs: int, shown: IntArray
) -> tuple[list[Json], list[Json]]:
    """Bind the meshes to joints below a root, which carries the rigid motion; returns their samplers and channels.

    Skinned meshes ignore the transforms of their nodes, which therefore go into the inverse bind matrices.
    """
    weights, (bind, turns, shifts) = skin.weights.double().cpu().numpy(), skin.tracks()
    primitives = [primitive for mesh in document.get("meshes") for primitive in mesh["primitives"]]
    vertices = [np.arange(len(weights))] if asset is None else [surface.vertices for surface in asset.parts()]
    for primitive, rows in zip(primitives, vertices, strict=True):
        primitive["attributes"] |= document.add_influences(weights[rows])
    turns, shifts = turns[:, shown], shifts[shown]
    turns[:, 1:] *= torch.where((turns[:, 1:] * turns[:, :-1]).sum(0) < 0, -1, 1).cumprod(0)  # never the long way round
    rotations = (turns[[1, 2, 3, 0]] * 32_767).round().permute(2, 1, 0).numpy().astype("<i2", order="C")
    translations = shifts.transpose(0, 1).numpy().astype("<f4", order="C")
    first = len(document.get("nodes"))
    joints = list(range(first + 1, first + len(bind)))
    document.append("nodes", {"name": "root", "translation": bind[0, :3, 3].tolist(), "children": joints})
    for number, place in enumerate((bind[1:, :3, 3] - bind[0, :3, 3]).tolist()):
        document.append("nodes", {"name": f"bone-{number:02d}", "translation": [float(f"{x:.7g}") for x in place]})
    top: list[int] = document.get("scenes", document.root.get("scene", 0))["nodes"] if document.get("scenes") else []
    top.append(first)
    for number, world in world_transforms(document).items():
        node = document.get("nodes", number)
        if "mesh" in node:
            inverse = (torch.linalg.inv(bind[1:]).numpy() @ world).transpose(0, 2, 1).reshape(-1, 16)
            matrices = document.add(inverse.astype("<f4"), "MAT4")
            skin_json = {"inverseBindMatrices": matrices, "joints": joints, "skeleton": first}
            skinned = {"mesh": node.pop("mesh"), "skin": document.append("skins", skin_json)}
            if np.linalg.det(world[:3, :3]) < 0:
                skinned["scale"] = [-1, 1, 1]  # its sign alone counts, for the winding
            if number in top and np.array_equal(world, np.eye(4)):
                node.update(skinned)
            else:
                top.append(document.append("nodes", {"name": node.get("name", "mesh"), **skinned}))
    samplers: list[Json] = []
    channels = []
    for path, tracks, kind in (("rotation", rotations, "VEC4"), ("translation", translations, "VEC3")):
        for number, track in enumerate(tracks):
            channels.append({"sampler": len(samplers), "target": {"node": first + number, "path": path}})
            output = document.add(track, kind, normalized=path == "rotation")
            samplers.append({"input": inputs, "output": output})
    return samplers, channels


def _document(shapes: FloatArray, faces: IntArray, asset: Asset | None, name: str) -> Document:
    """Document of one node, with shapes as morph targets: the parts of an asset, or all faces in clay without one."""
    parts = [Part(np.arange(shapes.shape[1]), faces, Material())] if asset is None else asset.parts()
    positions = shapes[0] if asset is None else asset.positions
    copies = merge_seams(shapes[[0, -1]], faces)
    _, first = np.unique(copies, return_index=True)
    smooth = np.stack([vertex_normals(shape[first], copies[faces])[copies] for shape in shapes])
    turned = carry_together(
        [(surface.normals, positions[surface.vertices], surface.triangles) for surface in parts],
        [shapes[:, surface.vertices] for surface in parts],
    )
    document = Document()
    primitives = []
    materials: dict[Material, int] = {}
    for surface, normals in zip(parts, turned, strict=True):
        index_type = np.uint16 if len(surface.vertices) <= 65535 else np.uint32  # 65535 itself is no valid uint16 index
        if surface.material not in materials:
            materials[surface.material] = document.append("materials", _material(document, surface.material))
        normals = smooth[:, surface.vertices] if normals is None else normals
        primitive = document.add_frames(shapes[:, surface.vertices], normals)
        for key, kind, numbers in (("TEXCOORD_0", "VEC2", surface.texcoords), ("COLOR_0", "VEC4", surface.colors)):
            if numbers is not None:
                primitive["attributes"][key] = document.add(numbers.astype(np.float32), kind, ARRAY_BUFFER)
        corners = surface.triangles.astype(index_type).reshape(-1)
        primitive["indices"] = document.add(corners, "SCALAR", ELEMENT_ARRAY_BUFFER)
        primitive["material"] = materials[surface.material]
        primitives.append(primitive)
    document.append("meshes", {"name": name, "primitives": primitives})
    document.append("nodes", {"name": name, "mesh": 0})
    document.append("scenes", {"name": "scene", "nodes": [0]})
    document.root["scene"] = 0
    return document


def _material(document: Document, material: Material) -> Json:
    surface: Json = {"metallicFactor": material.metallic, "roughnessFactor": material.roughness}
    surface["baseColorFactor"] = list(material.color)
    if material.texture is not None:
        image = document.append("images", document.add_image(material.texture))
        if not document.get("samplers"):
            document.append("samplers", {"wrapS": 10497, "wrapT": 10497})  # repeat, as OBJ does
        texture = document.append("textures", {"source": image, "sampler": 0})
        surface["baseColorTexture"] = {"index": texture}
    made: Json = {"name": material.name, "doubleSided": True, "pbrMetallicRoughness": surface}
    if material.alpha != "OPAQUE":
        made["alphaMode"] = material.alpha
    return made
