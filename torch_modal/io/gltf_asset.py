"""GLB and GLTF files, which are written with other positions and their own nodes, materials and textures."""

import copy
from functools import cache
from itertools import groupby
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch

from torch_modal.arrays import FloatArray, IntArray
from torch_modal.errors import MeshError
from torch_modal.geometry.skin import blend_bones
from torch_modal.io.asset import Asset, Material, Part, as_png_or_jpeg
from torch_modal.io.gltf import (
    ARRAY_BUFFER,
    ELEMENT_ARRAY_BUFFER,
    Document,
    Json,
    Tracks,
    sample,
    world_transforms,
)
from torch_modal.io.normals import carry_together

_COMPRESSED = ("KHR_draco_mesh_compression", "EXT_meshopt_compression", "KHR_meshopt_compression")
_REBUILT = ("accessors", "bufferViews", "buffers", "meshes", "animations", "skins")
_TRIANGLES, _STRIP, _FAN = 4, 5, 6


class _Primitive(NamedTuple):
    """Triangles of one node, as indices into its vertices, which are a slice of the asset's. *Shape:* ``(F, 3)``."""

    node: int
    json: Json
    points: slice
    triangles: IntArray
    positions: FloatArray  # and normals, in the coordinates of the node
    normals: FloatArray | None


class GltfAsset(Asset):
    """A GLB or GLTF file. Its surface has the triangles of all nodes, moved by the transforms of these.

    It is written as GLB, with the same nodes, cameras, lights, materials, textures and further attributes. Tangents are
    left out: viewers compute them from normals and texture coordinates.
    """

    suffix = ".glb"

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self.document = Document.read(path)
        if compressed := sorted({*self.document.get("extensionsRequired")} & {*_COMPRESSED}):
            raise MeshError(f"{path}: its meshes are compressed ({compressed[0]}); export it without compression")
        self._world = world_transforms(self.document)
        self._primitives: list[_Primitive] = []
        positions, faces, n = [np.zeros((0, 3))], [np.zeros((0, 3), np.int64)], 0
        posing = {"animations"} if self.document.get("animations") else set()
        for node, world in self._world.items():
            node_json = self.document.get("nodes", node)
            if "mesh" not in node_json:
                continue
            posing |= {"skeleton"} if "skin" in node_json else set()
            shared: dict[int, tuple[FloatArray, slice]] = {}
            for primitive in self.document.get("meshes", node_json["mesh"])["primitives"]:
                mode = primitive.get("mode", _TRIANGLES)
                if mode in (_STRIP, _FAN):
                    raise MeshError(f"{path}: strips or fans of triangles are not read; export single triangles")
                if mode != _TRIANGLES or "POSITION" not in primitive.get("attributes", {}):
                    self.carries["groups"] = "lines and points"
                    continue
                posing |= {"morph targets"} if "targets" in primitive else set()
                accessor = primitive["attributes"]["POSITION"]
                if accessor not in shared:
                    local = self.document.floats(accessor)
                    shared[accessor] = local, slice(n, n + len(local))
                    positions.append(local @ world[:3, :3].T + world[:3, 3])
                    n += len(local)
                local, points = shared[accessor]
                count, attributes = len(local), primitive["attributes"]
                if any(len(self.document.accessor(number)) != count for number in attributes.values()):
                    raise ValueError("a primitive whose attributes have different lengths")
                indices = np.arange(count)
                if "indices" in primitive:
                    indices = self.document.accessor(primitive["indices"])[:, 0].astype(np.int64)
                if indices.max(initial=0) >= max(count, 1):
                    raise ValueError("a primitive with indices beyond its vertices")
                triangles = indices[: len(indices) // 3 * 3].reshape(-1, 3)
                mirrored = np.linalg.det(world[:3, :3]) < 0  # which turns the winding over
                faces.append((triangles[:, ::-1] if mirrored else triangles) + points.start)
                normals = self.document.floats(attributes["NORMAL"]) if "NORMAL" in attributes else None
                self._primitives.append(_Primitive(node, primitive, points, triangles, local, normals))
        self.positions, self.faces = np.concatenate(positions), np.concatenate(faces)
        names = {name for primitive in self._primitives for name in primitive.json["attributes"]}
        self._note("texcoords", "texture coordinates", "TEXCOORD_0" in names)
        self._note("normals", "normals", "NORMAL" in names)
        self._note("colors", "vertex colours", "COLOR_0" in names)
        self._note("materials", "materials", self.document.get("materials"))
        self._note("posing", " and ".join(sorted(posing)), posing)

    def play(self, times: FloatArray) -> FloatArray:
        """Shapes of the first animation, as players show them. *Shape:* ``(T,) -> (T, V, 3)``."""
        document = self.document
        moved: Tracks = {}
        for animation in document.get("animations")[:1]:
            for channel in animation["channels"]:
                sampler, target = animation["samplers"][channel["sampler"]], channel["target"]
                if "node" in target:
                    path = target["path"]
                    moved[target["node"], path] = sample(document, sampler, times, path == "rotation")
        worlds = world_transforms(document, moved)
        frames = np.empty((len(times), *self.positions.shape))
        for primitive in self._primitives:
            node, read = document.get("nodes", primitive.node), primitive.json["attributes"]
            points = np.repeat(primitive.positions[None], len(times), axis=0)
            if targets := primitive.json.get("targets"):
                mesh = document.get("meshes", node["mesh"])
                still = np.tile(node.get("weights", mesh.get("weights", [0.0] * len(targets))), (len(times), 1))
                offsets = [document.floats(one["POSITION"]) if "POSITION" in one else 0 * points[0] for one in targets]
                points += np.tensordot(moved.get((primitive.node, "weights"), still), np.stack(offsets), 1)
            bones, by_bone = worlds[primitive.node].reshape(-1, 1, 4, 4), np.ones((points.shape[1], 1))
            if "skin" in node:
                skin = document.get("skins", node["skin"])
                bones = np.stack([np.broadcast_to(worlds[n], (len(times), 4, 4)) for n in skin["joints"]], axis=1)
                if "inverseBindMatrices" in skin:
                    bones = bones @ document.floats(skin["inverseBindMatrices"]).reshape(-1, 4, 4).swapaxes(1, 2)
                by_bone = np.zeros((points.shape[1], bones.shape[1]))
                for joints in [name for name in read if name.startswith("JOINTS_")]:
                    shares = document.floats(read[joints.replace("JOINTS", "WEIGHTS")])
                    np.add.at(by_bone, (np.arange(len(by_bone))[:, None], document.accessor(read[joints])), shares)
            affine = np.broadcast_to(bones[:, :, :3], (len(times), *bones.shape[1:2], 3, 4)).copy()
            frames[:, primitive.points] = blend_bones(*map(torch.from_numpy, (by_bone, affine, points))).numpy()
        return frames

    # ------------------------------------------------------------------------------------------------ the file again
    def with_positions(self, positions: FloatArray) -> bytes:
        """The file with other positions."""
        return self.rebuild(positions[None]).to_glb()

    def rebuild(self, frames: FloatArray) -> Document:
        """Copy the used content, with frames as positions and morph targets. *Shape:* ``(N, V, 3)``."""
        old = self.document
        root = {key: copy.deepcopy(value) for key, value in old.root.items() if key not in _REBUILT}
        root["asset"] = {**root.get("asset", {}), "generator": "torch_modal"}
        for key in ("extensionsUsed", "extensionsRequired"):
            root[key] = [name for name in root.get(key, []) if name not in ("KHR_mesh_quantization", *_COMPRESSED)]
            if not root[key]:
                del root[key]
        document = Document(root)
        for number, image in enumerate(document.get("images")):
            image.pop("uri", None)
            image |= document.add_image(old.image(number))
        for node_json in document.get("nodes"):
            for key in ("mesh", "skin", "weights"):
                node_json.pop(key, None)

        @cache
        def take(accessor: int, target: int) -> int:
            """Copy an accessor as it is; returns its number in the copy."""
            source, numbers = old.get("accessors", accessor), old.accessor(accessor)
            normalized = source.get("normalized", False)
            if target == ARRAY_BUFFER and numbers.itemsize * numbers.shape[1] % 4:  # vertices start at multiples of 4
                numbers, normalized = old.floats(accessor).astype(np.float32), False
            return document.add(numbers, source["type"], target, "min" in source, normalized)

        # Each node gets a mesh of its own: the same mesh may be shown, and deformed, at several places.
        for node, group in groupby(self._primitives, lambda primitive: primitive.node):
            primitives = list(group)
            if np.linalg.det(self._world[node]) == 0:
                raise MeshError(f"{self.path}: node {node} flattens its mesh; positions cannot be transformed back")
            inverse = np.linalg.inv(self._world[node])
            mesh = copy.deepcopy({**old.get("meshes", old.get("nodes", node)["mesh"]), "primitives": []})
            mesh.pop("weights", None)
            shapes = [frames[:, one.points] @ inverse[:3, :3].T + inverse[:3, 3] for one in primitives]
            rotated = carry_together([(one.normals, one.positions, one.triangles) for one in primitives], shapes)
            by_points: dict[tuple[int, int | None], Json] = {}
            for primitive, shape, normals in zip(primitives, shapes, rotated, strict=True):
                attributes = primitive.json["attributes"]
                points = attributes["POSITION"], attributes.get("NORMAL")
                if points not in by_points:
                    by_points[points] = document.add_frames(shape, normals)
                kept = {key: primitive.json[key] for key in ("material", "mode", "extras") if key in primitive.json}
                copied = copy.deepcopy(kept | by_points[points])
                for name, accessor in attributes.items():
                    if name not in ("POSITION", "NORMAL", "TANGENT") and not name.startswith(("JOINTS_", "WEIGHTS_")):
                        copied["attributes"][name] = take(accessor, ARRAY_BUFFER)
                if "indices" in primitive.json:
                    copied["indices"] = take(primitive.json["indices"], ELEMENT_ARRAY_BUFFER)
                mesh["primitives"].append(copied)
            document.get("nodes", node)["mesh"] = document.append("meshes", mesh)
        return document

    # --------------------------------------------------------------------------------------------- for other formats
    def parts(self) -> list[Part]:
        """One part for each primitive; of materials, colour, roughness, alpha and the texture of the colour."""
        parts = []
        for primitive in self._primitives:
            attributes, material, channel = primitive.json["attributes"], Material(), 0
            if "material" in primitive.json:
                material, channel = self._material(primitive.json["material"])
            colors, texcoords = (
                None if name not in attributes else self.document.floats(attributes[name])
                for name in ("COLOR_0", f"TEXCOORD_{channel}")
            )
            vertices = np.arange(primitive.points.start, primitive.points.stop)
            parts.append(Part(vertices, primitive.triangles, material, texcoords, colors, primitive.normals))
        return parts

    def _material(self, index: int) -> tuple[Material, int]:
        """A material, and the number of the texture coordinates that its texture uses."""
        material = self.document.get("materials", index)
        surface = material.get("pbrMetallicRoughness", {})
        used, texture = surface.get("baseColorTexture", {}), None
        source = self.document.get("textures", used["index"]).get("source") if "index" in used else None
        if source is not None:  # otherwise it is that of an extension
            texture = as_png_or_jpeg(self.document.image(source))
        color = tuple(map(float, surface.get("baseColorFactor", (1, 1, 1, 1))))
        numbers = float(surface.get("metallicFactor", 1)), float(surface.get("roughnessFactor", 1))
        name, alpha = material.get("name", f"material-{index}"), material.get("alphaMode", "OPAQUE")
        return Material(name, color, *numbers, texture, alpha), used.get("texCoord", 0)
