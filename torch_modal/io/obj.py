"""Wavefront OBJ: the lines of the file, with other numbers in the place of positions and normals."""

import re
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from torch_modal.arrays import FloatArray, IntArray
from torch_modal.errors import MeshError
from torch_modal.io.asset import Asset, Material, Part, Polygons, linear
from torch_modal.io.mtl import Libraries, read_libraries
from torch_modal.io.normals import CarriedNormals

_LINE_END = re.compile(r"\r\n|\n|\r")


class ObjAsset(Asset):
    """An OBJ file, kept as lines. Written again it differs in its ``v`` and ``vn`` lines alone.

    trimesh has no options for this: with texture coordinates it drops unused vertices and splits and reorders
    the rest at seams, and with several materials it repeats all vertices per material and reorders the faces.

    Normals that several vertices share are written once for each vertex, as they rotate differently; ``f`` lines then
    name the new ones.
    """

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        text = path.read_bytes().decode("utf-8", errors="surrogateescape")
        text = re.sub(r"\\(\r\n|\n|\r)", " ", text)
        self.lines = _LINE_END.split(text.removesuffix("\n").removesuffix("\r"))
        self._v_lines: list[int] = []
        self._vn_lines: list[int] = []
        self._f_lines: list[int] = []
        self._libraries: list[str] = []
        vertices: list[list[float]] = []
        self._colors: list[list[float]] = []
        texcoords: list[list[float]] = []
        normals: list[list[float]] = []
        corners: list[tuple[int, int, int]] = []  # vertex, texture coordinate, normal; -1 where there is none
        known: dict[str, tuple[int, int, int]] = {}
        sizes: list[int] = []
        self._materials: list[str] = []
        material_of: list[int] = []
        material, groups = -1, set()
        for number, line in enumerate(self.lines):
            words = line.partition("#")[0].split()
            if not words:
                continue
            kind = words[0]
            if kind == "v":
                if len(words) < 4:
                    raise MeshError(f"{path}: vertex line with fewer than three numbers: {line.strip()[:60]!r}")
                vertices.append([float(word) for word in words[1:4]])
                self._v_lines.append(number)
                if len(words) >= 7:
                    self._colors.append([float(word) for word in words[4:7]])
            elif kind == "vt":
                texcoords.append([float(word) for word in (*words[1:3], "0")[:2]])
            elif kind == "vn":
                normals.append([float(word) for word in words[1:4]])
                self._vn_lines.append(number)
            elif kind == "f":
                if len(words) < 4:
                    raise self._bad_face(line)
                counts = (len(vertices), len(texcoords), len(normals))
                for word in words[1:]:
                    corner = known.get(word)
                    if corner is None:
                        corner = self._corner(word, counts, line)
                        if "-" not in word:  # counted from the start, so the same wherever it stands
                            known[word] = corner
                    corners.append(corner)
                sizes.append(len(words) - 1)
                material_of.append(material)
                self._f_lines.append(number)
            elif kind == "usemtl":
                name = line.partition("#")[0].strip()[len("usemtl") :].strip()
                if name not in self._materials:
                    self._materials.append(name)
                material = self._materials.index(name)
            elif kind == "mtllib":
                self._libraries.append(line.partition("#")[0].strip()[len("mtllib") :].strip())
            elif kind in ("g", "o", "s"):
                groups.add(line.strip())
        self.positions = np.array(vertices, dtype=np.float64).reshape(-1, 3)
        self._texcoords = np.array(texcoords, dtype=np.float64).reshape(-1, 2)
        self._normals = np.array(normals, dtype=np.float64).reshape(-1, 3)
        self._corners = np.array(corners, dtype=np.int64).reshape(-1, 3)
        self._sizes = np.array(sizes, dtype=np.int64)
        self._cut(material_of)
        for column, count in ((1, len(texcoords)), (2, len(normals))):  # faces may name what the file does not have
            self._corners[self._corners[:, column] >= count, column] = -1
        self._describe(len(groups))

    def _bad_face(self, line: str) -> MeshError:
        return MeshError(
            f"{self.path}: face line with fewer than three corners or index 0 (OBJ counts from 1): "
            f"{line.strip()[:60]!r}"
        )

    def _corner(self, word: str, counts: tuple[int, int, int], line: str) -> tuple[int, int, int]:
        """Indices of a corner from 0; negative ones count back from the last that was read so far."""
        given = [int(part) if part else None for part in word.split("/")]
        if 0 in given or given[0] is None:
            raise self._bad_face(line)
        found = [-1, -1, -1]
        for place, (index, count) in enumerate(zip(given, counts, strict=False)):
            if index is not None:
                found[place] = index - 1 if index > 0 else count + index
        return found[0], max(found[1], -1), max(found[2], -1)

    def _cut(self, material_of: list[int]) -> None:
        """Polygons to fans of triangles, as rows of corners."""
        triangles, materials = [], []
        for start, size, material in zip(np.cumsum(self._sizes) - self._sizes, self._sizes, material_of, strict=True):
            triangles += [(start, start + b, start + c) for b, c in pairwise(range(1, size))]
            materials += [material] * (size - 2)
        self._triangles = np.array(triangles, dtype=np.int64).reshape(-1, 3)  # of corners
        self._material_of = np.array(materials, dtype=np.int64)
        self.faces = self._corners[self._triangles, 0]

    def _describe(self, n_groups: int) -> None:
        if (self._sizes > 3).any():
            self.carries["polygons"] = "quads" if set(self._sizes.tolist()) <= {3, 4} else "polygons"
        if (self._corners[:, 1] >= 0).any():
            self._carry("texcoords")
        if (self._corners[:, 2] >= 0).any():
            self._carry("normals")
        if self._has_colors:
            self._carry("colors")
        if self._materials:
            self._carry("materials", len(self._materials))
        if n_groups > 1:
            self._carry("groups")

    @property
    def _has_colors(self) -> bool:
        return len(self._colors) == len(self.positions) > 0

    # ------------------------------------------------------------------------------------------------ the file again
    def with_positions(self, positions: FloatArray) -> bytes:
        """The file with other positions."""
        lines = list(self.lines)
        for number, (x, y, z) in zip(self._v_lines, positions.tolist(), strict=True):
            rest = lines[number].split(None, 4)[4:]
            lines[number] = " ".join([f"v {x!r} {y!r} {z!r}", *rest])
        if (self._corners[:, 2] >= 0).any():
            self._write_normals(lines, positions)
        return ("\n".join(lines) + "\n").encode("utf-8", errors="surrogateescape")

    @cached_property
    def _pairs(self) -> tuple[IntArray, IntArray]:
        """Each vertex with each of its normals, ``(n, 2)``; which of them each corner has, -1 for none."""
        with_normal = self._corners[:, 2] >= 0
        pairs, inverse = np.unique(self._corners[with_normal][:, [2, 0]], axis=0, return_inverse=True)
        which = np.full(len(self._corners), -1)
        which[with_normal] = inverse.reshape(-1)
        return pairs[:, ::-1], which

    @cached_property
    def _carried(self) -> CarriedNormals:
        pairs, which = self._pairs
        triangles = which[self._triangles]
        vertices, normals = pairs.T
        return CarriedNormals(self._normals[normals], self.positions[vertices], triangles[(triangles >= 0).all(axis=1)])

    def _write_normals(self, lines: list[str], positions: FloatArray) -> None:
        pairs, which = self._pairs
        turned = self._carried.at(positions[pairs[:, 0]]).tolist()
        text = [f"vn {x!r} {y!r} {z!r}" for x, y, z in turned]
        if len(np.unique(pairs[:, 1])) == len(pairs):
            for index, line in zip(pairs[:, 1].tolist(), text, strict=True):
                lines[self._vn_lines[index]] = line
            return
        # A normal of several vertices: one for each instead, all at the place of the first.
        for number in self._vn_lines:
            lines[number] = "#"
        lines[self._vn_lines[0]] = "\n".join(text)
        starts = np.cumsum(self._sizes) - self._sizes
        for number, start in zip(self._f_lines, starts.tolist(), strict=True):
            words = lines[number].partition("#")[0].split()
            for place, word in enumerate(words[1:]):
                if which[start + place] >= 0:
                    head = word.rsplit("/", 1)[0]
                    words[place + 1] = f"{head}/{which[start + place] + 1}"
            lines[number] = " ".join(words)

    @cached_property
    def companions(self) -> dict[str, bytes]:
        """Material libraries and their textures."""
        return self._materials_read.files

    @cached_property
    def _materials_read(self) -> Libraries:
        return read_libraries(self.path, self._libraries)

    # --------------------------------------------------------------------------------------------- for other formats
    def polygons(self) -> Polygons:
        """The faces with their texture coordinates."""
        texcoords = self._corners[:, 1]
        known = len(texcoords) and (texcoords >= 0).all()
        return Polygons(self._sizes, self._corners[:, 0], self._texcoords[texcoords] if known else None)

    def parts(self) -> list[Part]:
        """One part for each material that faces use."""
        materials = self._materials_read.materials
        colors = linear(np.array(self._colors)) if self._has_colors else None
        found = []
        for number in np.unique(self._material_of):
            corners = self._corners[self._triangles[self._material_of == number]].reshape(-1, 3)
            points, triangles = np.unique(corners, axis=0, return_inverse=True)
            vertices, texcoords, normals = points.T
            name = self._materials[number] if number >= 0 else ""
            material = materials.get(name) or (Material(name) if name else Material())
            if colors is not None and name not in materials:
                material = material._replace(color=(1.0, 1.0, 1.0, 1.0))
            found.append(
                Part(
                    vertices,
                    triangles.reshape(-1, 3),
                    material,
                    self._texcoords[texcoords] * [1, -1] + [0, 1] if (texcoords >= 0).all() else None,
                    colors[vertices] if colors is not None else None,
                    self._normals[normals] if (normals >= 0).all() else None,
                )
            )
        return found


def obj_bytes(vertices: FloatArray, faces: IntArray, asset: Any = None) -> bytes:
    """Text, float64."""
    points = "".join(f"v {x!r} {y!r} {z!r}\n" for x, y, z in vertices.tolist())
    return (points + "".join(f"f {a} {b} {c}\n" for a, b, c in (faces + 1).tolist())).encode("ascii")
