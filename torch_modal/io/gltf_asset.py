"""GLB and GLTF files: their own nodes, materials and textures around other positions."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from torch_modal.arrays import FloatArray, IntArray
from torch_modal.errors import MeshError
from torch_modal.io.asset import Asset, Image, Material, Part, as_image
from torch_modal.io.gltf import (
    ARRAY_BUFFER,
    ELEMENT_ARRAY_BUFFER,
    Document,
    Drawn,
    Json,
    place_frames,
    world_transforms,
)
from torch_modal.io.normals import carry_together

_COMPRESSED = ("KHR_draco_mesh_compression", "EXT_meshopt_compression", "KHR_meshopt_compression")
_TRIANGLES, _STRIP, _FAN = 4, 5, 6


class _Primitive(NamedTuple):
    """Triangles of one node."""

    node: int
    json: Json
    points: slice
    """Its vertices among those of the asset; primitives that share them are alike here."""
    triangles: IntArray
    """Of its own vertices. *Shape:* ``(F, 3)``."""


class GltfAsset(Asset):
    """A GLB or GLTF file. All nodes with triangles count, at the places of their transforms.

    It is written as GLB, with the same nodes, cameras, lights, materials, textures and further attributes. Tangents are
    left out: viewers compute them from normals and texture coordinates.
    """

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self.document = Document.read(path)
        required: list[str] = self.document.root.get("extensionsRequired", [])
        compressed = sorted(set(required) & set(_COMPRESSED))
        if compressed:
            raise MeshError(f"{path}: its meshes are compressed ({compressed[0]}); export it without compression")
        self._world = world_transforms(self.document)
        self._primitives: list[_Primitive] = []
        self._collect()

    @property
    def suffix(self) -> str:
        """Of the files that it writes."""
        return ".glb"

    def _collect(self) -> None:
        positions, faces, n = [np.zeros((0, 3))], [np.zeros((0, 3), np.int64)], 0
        posed = 0
        for node, world in self._world.items():
            node_json = self.document.get("nodes", node)
            if "mesh" not in node_json:
                continue
            posed += "skin" in node_json
            mirrored = np.linalg.det(world[:3, :3]) < 0
            shared: dict[int, slice] = {}
            for primitive in self.document.get("meshes", node_json["mesh"])["primitives"]:
                attributes = primitive.get("attributes", {})
                if primitive.get("mode", _TRIANGLES) not in (_TRIANGLES, _STRIP, _FAN) or "POSITION" not in attributes:
                    self.carries["groups"] = "lines and points"
                    continue
                accessor = attributes["POSITION"]
                if accessor not in shared:
                    local = self.document.floats(accessor)
                    shared[accessor] = slice(n, n + len(local))
                    positions.append(local @ world[:3, :3].T + world[:3, 3])
                    n += len(local)
                points = shared[accessor]
                triangles = self._triangles(primitive, points.stop - points.start)
                # A mirroring transform turns the winding over.
                faces.append((triangles[:, ::-1] if mirrored else triangles) + points.start)
                self._primitives.append(_Primitive(node, primitive, points, triangles))
        self.positions = np.concatenate(positions)
        self.faces = np.concatenate(faces)
        names = {name for primitive in self._primitives for name in primitive.json["attributes"]}
        if "TEXCOORD_0" in names:
            self.carries["texcoords"] = "texture coordinates"
        if "NORMAL" in names:
            self.carries["normals"] = "normals"
        if "COLOR_0" in names:
            self.carries["colors"] = "vertex colours"
        if self.document.get("materials"):
            self.carries["materials"] = "materials"
        moving = ["skeleton"] if posed else []
        if self.document.get("animations"):
            moving.append("animations")
        if any("targets" in primitive.json for primitive in self._primitives):
            moving.append("morph targets")
        if moving:
            self.carries["posing"] = " and ".join(moving)

    def _inverse(self, node: int) -> FloatArray:
        try:
            return np.asarray(np.linalg.inv(self._world[node]), dtype=np.float64)
        except np.linalg.LinAlgError:
            name = self.document.get("nodes", node).get("name", node)
            raise MeshError(
                f"{self.path}: the node {name} flattens its mesh, so that positions cannot be transformed back"
            ) from None

    def _triangles(self, primitive: Json, n_points: int) -> IntArray:
        if "indices" in primitive:
            indices = self.document.accessor(primitive["indices"])[:, 0].astype(np.int64)
        else:
            indices = np.arange(n_points)
        mode = primitive.get("mode", _TRIANGLES)
        if mode == _TRIANGLES:
            return indices[: len(indices) // 3 * 3].reshape(-1, 3)
        first, second, third = indices[:-2], indices[1:-1], indices[2:]
        if mode == _FAN:
            return np.stack([np.full_like(second, indices[0]), second, third], axis=1)
        odd = np.arange(len(first)) % 2 == 1
        triangles = np.stack([first, np.where(odd, third, second), np.where(odd, second, third)], axis=1)
        return triangles[(np.diff(np.sort(triangles, axis=1)) > 0).all(axis=1)]  # strips turn by empty ones

    def morphs(self) -> FloatArray:
        """The file's shape, and that of each morph target at weight 1. *Shape:* ``(N, V, 3)``.

        Raises:
            ValueError: Its meshes do not have the same number of targets.
        """
        counts = {len(primitive.json.get("targets", [])) for primitive in self._primitives}
        if len(counts) > 1:
            raise ValueError(f"meshes of {sorted(counts)} morph targets")
        shapes = np.repeat(self.positions[None], 1 + max(counts, default=0), axis=0)
        for primitive in self._primitives:
            linear = self._world[primitive.node][:3, :3].T
            for number, target in enumerate(primitive.json.get("targets", []), start=1):
                moved = self.positions[primitive.points]
                if "POSITION" in target:
                    moved = moved + self.document.floats(target["POSITION"]) @ linear
                shapes[number, primitive.points] = moved
        return shapes

    # ------------------------------------------------------------------------------------------------ the file again
    def rebuilt(self, frames: FloatArray) -> tuple[Document, list[Drawn], list[int]]:
        """A copy without positions and normals, and without unused content.

        Args:
            frames: Those with normals, all or the first. *Shape:* ``(N, V, 3)``.

        Returns:
            The document; its primitives, for :func:`torch_modal.io.gltf.place_frames`; the nodes that show them.
        """
        old = self.document
        root = {key: copy.deepcopy(value) for key, value in old.root.items() if key not in _REPLACED}
        root["asset"] = {**root.get("asset", {}), "generator": "torch_modal"}
        for key in ("extensionsUsed", "extensionsRequired"):
            left = [name for name in root.get(key, []) if name not in ("KHR_mesh_quantization", *_COMPRESSED)]
            root.pop(key, None)
            if left:
                root[key] = left
        document = Document(root)
        self._embed_images(document)
        taken: dict[int, int] = {}
        drawn: list[Drawn] = []
        nodes: list[int] = []
        for node in self._world:
            mine = [primitive for primitive in self._primitives if primitive.node == node]
            node_json = document.get("nodes", node)
            for key in ("skin", "weights"):
                node_json.pop(key, None)
            node_json.pop("mesh", None)
            if not mine:
                continue
            # Each node gets a mesh of its own: the same mesh may be shown, and deformed, at several places.
            mesh = copy.deepcopy(old.get("meshes", old.get("nodes", node)["mesh"]))
            mesh.pop("weights", None)
            mesh["primitives"] = []
            inverse = self._inverse(node)
            normals = self._normals(mine, inverse, frames)
            for primitive, own_normals in zip(mine, normals, strict=True):
                attributes = primitive.json["attributes"]
                copied: Json = {"attributes": {}}
                for key in ("material", "mode", "extras"):
                    if key in primitive.json:
                        copied[key] = copy.deepcopy(primitive.json[key])
                for name, accessor in attributes.items():
                    if name not in ("POSITION", "NORMAL", "TANGENT") and not name.startswith(("JOINTS_", "WEIGHTS_")):
                        copied["attributes"][name] = self._take(document, accessor, ARRAY_BUFFER, taken)
                if "indices" in primitive.json:
                    copied["indices"] = self._take(document, primitive.json["indices"], ELEMENT_ARRAY_BUFFER, taken)
                mesh["primitives"].append(copied)
                drawn.append(Drawn(copied, primitive.points, inverse, own_normals))
            node_json["mesh"] = document.append("meshes", mesh)
            nodes.append(node)
        return document, drawn, nodes

    def _normals(
        self, primitives: Sequence[_Primitive], inverse: FloatArray, frames: FloatArray
    ) -> list[FloatArray | None]:
        """Normals of a node's primitives in each frame, None for those without. *Shape of each:* ``(N, P, 3)``."""
        own = [p for p in primitives if "NORMAL" in p.json["attributes"]]
        if not own:
            return [None] * len(primitives)
        read = [[self.document.floats(p.json["attributes"][name]) for name in ("NORMAL", "POSITION")] for p in own]
        points = np.concatenate([np.arange(p.points.start, p.points.stop) for p in own])
        local = [shape[points] @ inverse[:3, :3].T + inverse[:3, 3] for shape in frames]
        parts = [(normals, positions, p.triangles) for (normals, positions), p in zip(read, own, strict=True)]
        turned = iter(carry_together(parts, local))
        return [next(turned) if "NORMAL" in p.json["attributes"] else None for p in primitives]

    def _take(self, document: Document, accessor: int, target: int, taken: dict[int, int]) -> int:
        """Copy an accessor as it is; its number in the copy."""
        if accessor not in taken:
            old = self.document.get("accessors", accessor)
            taken[accessor] = document.add(
                self.document.accessor(accessor), old["type"], target, "min" in old, old.get("normalized", False)
            )
            if "name" in old:
                document.get("accessors", taken[accessor])["name"] = old["name"]
        return taken[accessor]

    def _embed_images(self, document: Document) -> None:
        for number, image in enumerate(document.get("images")):
            data = self._image_bytes(number)
            image.pop("uri", None)
            image["bufferView"] = document.add_bytes(data)
            image.setdefault("mimeType", "image/jpeg" if data.startswith(b"\xff\xd8") else "image/png")

    def _image_bytes(self, number: int) -> bytes:
        image = self.document.get("images", number)
        if "bufferView" in image:
            return self.document.view(image["bufferView"])
        return self.document.resource(image["uri"])

    def with_positions(self, positions: FloatArray) -> bytes:
        """The file with other positions."""
        frames = positions[None]
        document, drawn, _ = self.rebuilt(frames)
        place_frames(document, drawn, frames)
        return document.to_glb()

    def parts(self) -> list[Part]:
        """One part for each primitive."""
        found = []
        for primitive in self._primitives:
            attributes = primitive.json["attributes"]
            read = {name: self.document.floats(index) for name, index in attributes.items()}
            colors = read.get("COLOR_0")
            if colors is not None and colors.shape[1] == 3:
                colors = np.concatenate([colors, np.ones((len(colors), 1))], axis=1)
            normals = read.get("NORMAL")
            if normals is not None:
                normals = normals @ self._inverse(primitive.node)[:3, :3]  # n^T M^-1
                normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)
            vertices = np.arange(primitive.points.start, primitive.points.stop)
            material = self._material(primitive.json.get("material"))
            found.append(Part(vertices, primitive.triangles, material, read.get("TEXCOORD_0"), colors, normals))
        return found

    def _material(self, number: int | None) -> Material:
        if number is None:
            return Material("default", (1.0, 1.0, 1.0, 1.0), 1.0, 1.0)
        material = self.document.get("materials", number)
        surface = material.get("pbrMetallicRoughness", {})
        image = None
        if "baseColorTexture" in surface:
            texture = self.document.get("textures", surface["baseColorTexture"]["index"])
            if "source" in texture:
                data = self._image_bytes(texture["source"])
                image = as_image(data) or Image(data, "image/png")
        color = tuple(float(c) for c in surface.get("baseColorFactor", (1, 1, 1, 1)))
        metallic, roughness = surface.get("metallicFactor", 1.0), surface.get("roughnessFactor", 1.0)
        return Material(material.get("name", f"material-{number}"), color, metallic, roughness, image)


_REPLACED = ("accessors", "bufferViews", "buffers", "meshes", "animations", "skins")
