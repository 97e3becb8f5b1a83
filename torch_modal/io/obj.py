"""Wavefront OBJ: the lines of the file, in which positions and normals are replaced."""

import re
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from torch_modal.arrays import FloatArray, IntArray
from torch_modal.errors import MeshError
from torch_modal.io.asset import CLAY, Asset, Material, Part, linear_rgba
from torch_modal.io.mtl import read_libraries
from torch_modal.io.normals import CarriedNormals


class ObjAsset(Asset):
    """An OBJ file, kept as lines. Written again it differs in its ``v`` and ``vn`` lines alone.

    trimesh has no options for this: with texture coordinates it drops unused vertices and splits and reorders
    the rest at seams, and with several materials it repeats all vertices per material and reorders the faces.

    Normals that several vertices share are written once for each vertex, as they rotate differently; ``f`` lines then
    name the new ones.
    """

    suffix = ".obj"

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        text = path.read_bytes().decode("utf-8", errors="surrogateescape")
        text = re.sub(r"\\(\r\n|\n|\r)", " ", text)
        self.lines = re.split(r"\r\n|\n|\r", text.removesuffix("\n").removesuffix("\r"))
        numbers: dict[str, list[list[float]]] = {"v": [], "vt": [], "vn": []}
        self._line_of: dict[str, list[int]] = {"v": [], "vt": [], "vn": [], "f": []}
        self._libraries: dict[int, str] = {}
        materials: dict[str, int] = {}
        corners: list[tuple[int, ...]] = []  # vertex, texture coordinate, normal; -1 where there is none
        known: dict[str, tuple[int, ...]] = {}
        triangles: list[tuple[int, int, int]] = []  # polygons as fans, of corners of the file
        sizes, material_of, material, groups = [], [], -1, set()
        for number, line in enumerate(self.lines):
            content = line.partition("#")[0].strip()
            kind, *words = content.split() or [""]
            rest = content[len(kind) :].strip()
            if kind in self._line_of:
                self._line_of[kind].append(number)
            if kind == "v" and len(words) < 3:
                raise MeshError(f"{path}: vertex line with fewer than three numbers: {line.strip()[:60]!r}")
            if kind in numbers:
                numbers[kind].append([float(word) for word in words])
            elif kind == "f":
                counts = tuple(map(len, numbers.values()))
                place = f"{path}: face line {line.strip()[:60]!r}"
                if len(words) < 3:
                    raise MeshError(f"{place} has fewer than three corners")
                first, n_triangles = len(corners), len(words) - 2
                triangles += [(first, first + i, first + i + 1) for i in range(1, n_triangles + 1)]
                material_of += [material] * n_triangles
                for word in words:
                    if word not in known or "-" in word:  # negative indices count back from the place of the line
                        known[word] = _corner(word, counts, place)
                    corners.append(known[word])
                sizes.append(len(words))
            elif kind == "usemtl":
                material = materials.setdefault(rest, len(materials))
            elif kind == "mtllib":
                self._libraries[number] = rest
            elif kind in ("g", "o", "s"):
                groups.add(line.strip())
        self._materials = list(materials)
        self.positions = np.array([row[:3] for row in numbers["v"]], np.float64).reshape(-1, 3)
        self._texcoords = np.array([[*row, 0.0, 0.0][:2] for row in numbers["vt"]], np.float64).reshape(-1, 2)
        self._normals = np.array([row[:3] for row in numbers["vn"]], np.float64).reshape(-1, 3)
        colored = all(len(row) >= 6 for row in numbers["v"])
        self._colors = np.array([row[3:6] for row in numbers["v"]]) if colored else None
        self._corners = np.array(corners, dtype=np.int64).reshape(-1, 3)
        for column, count in ((1, len(self._texcoords)), (2, len(self._normals))):
            self._corners[self._corners[:, column] >= count, column] = -1  # faces may name what the file does not have
        self._sizes = np.array(sizes, dtype=np.int64)
        self._starts = np.cumsum(self._sizes) - self._sizes
        self._triangles = np.array(triangles, dtype=np.int64).reshape(-1, 3)
        self._material_of = np.array(material_of, dtype=np.int64)
        self.faces = self._corners[self._triangles, 0]
        self._note("polygons", "quads" if (self._sizes <= 4).all() else "polygons", (self._sizes > 3).any())
        self._note("texcoords", "texture coordinates", (self._corners[:, 1] >= 0).any())
        self._note("normals", "normals", (self._corners[:, 2] >= 0).any())
        self._note("colors", "vertex colours", self._colors is not None)
        self._note("materials", f"{len(materials)} material{'s' * (len(materials) > 1)}", materials)
        self._note("groups", "groups", len(groups) > 1)

    # ------------------------------------------------------------------------------------------------ the file again
    def with_positions(self, positions: FloatArray) -> bytes:
        """The file with other positions."""
        lines = list(self.lines)
        for number, (x, y, z) in zip(self._line_of["v"], positions.tolist(), strict=True):
            lines[number] = " ".join([f"v {x!r} {y!r} {z!r}", *lines[number].split(None, 4)[4:]])
        for number, names in self._library_content[2].items():
            lines[number] = f"mtllib {names}"
        if "normals" in self.carries:
            self._write_normals(lines, positions)
        return ("\n".join(lines) + "\n").encode("utf-8", errors="surrogateescape")

    @cached_property
    def _normals_carrier(self) -> tuple[IntArray, IntArray, IntArray, CarriedNormals]:
        """Vertex and normal of each pair that corners use; the pair of each corner, -1 for none; the pairs' normals.

        *Shape:* ``(n,), (n,), (C,)``.
        """
        with_normal = self._corners[:, 2] >= 0
        pairs, inverse = np.unique(self._corners[with_normal][:, [2, 0]], axis=0, return_inverse=True)
        which = np.full(len(self._corners), -1)
        which[with_normal] = inverse.reshape(-1)
        normals, vertices = pairs.T
        triangles = which[self._triangles]
        triangles = triangles[(triangles >= 0).all(axis=1)]
        carried = CarriedNormals(self._normals[normals], self.positions[vertices], triangles)
        return vertices, normals, which, carried

    def _write_normals(self, lines: list[str], positions: FloatArray) -> None:
        vertices, normals, which, carried = self._normals_carrier
        text = [f"vn {x!r} {y!r} {z!r}" for x, y, z in carried.at(positions[vertices]).tolist()]
        if len(np.unique(normals)) == len(normals):
            for index, line in zip(normals.tolist(), text, strict=True):
                lines[self._line_of["vn"][index]] = line
            return
        # Vertices shared this normal: it becomes one for each of them, all on the line of the first.
        for number in self._line_of["vn"]:
            lines[number] = "#"
        lines[self._line_of["vn"][0]] = "\n".join(text)
        for number, start in zip(self._line_of["f"], self._starts.tolist(), strict=True):
            kind, *words = lines[number].partition("#")[0].split()
            for i, word in enumerate(words):
                if which[start + i] >= 0:
                    words[i] = f"{word.rsplit('/', 1)[0]}/{which[start + i] + 1}"
            lines[number] = " ".join([kind, *words])

    @cached_property
    def _library_content(self) -> tuple[dict[str, Material], dict[str, bytes], dict[int, str]]:
        return read_libraries(self.path, self._libraries)

    @property
    def companions(self) -> dict[str, bytes]:
        """Material libraries and their textures."""
        return self._library_content[1]

    # --------------------------------------------------------------------------------------------- for other formats
    def polygons(self) -> tuple[IntArray, IntArray, FloatArray | None]:
        """The faces with their texture coordinates."""
        texcoords = self._corners[:, 1]
        known = (texcoords >= 0).all()
        return self._sizes, self._corners[:, 0], self._texcoords[texcoords] if known else None

    def parts(self) -> list[Part]:
        """A part for each material that faces use."""
        colors = None if self._colors is None else linear_rgba(self._colors)
        parts = []
        for number in np.unique(self._material_of):
            corners = self._corners[self._triangles[self._material_of == number]].reshape(-1, 3)
            points, triangles = np.unique(corners, axis=0, return_inverse=True)
            vertices, texcoords, normals = points.T
            name = self._materials[number] if number >= 0 else ""
            bare = Material(name or "clay", CLAY if colors is None else (1.0, 1.0, 1.0, 1.0))
            material = self._library_content[0].get(name, bare)
            uv = self._texcoords[texcoords] * [1, -1] + [0, 1] if (texcoords >= 0).all() else None
            rgba = None if colors is None else colors[vertices]
            vectors = self._normals[normals] if (normals >= 0).all() else None
            parts.append(Part(vertices, triangles.reshape(-1, 3), material, uv, rgba, vectors))
        return parts


def _corner(word: str, counts: tuple[int, ...], place: str) -> tuple[int, ...]:
    """Indices from 0 of a corner such as ``1/2/3`` or ``-1//-1``; -1 where there is none."""
    indices = [int(number) if number else None for number in (*word.split("/"), "", "")[:3]]
    if 0 in indices or indices[0] is None:
        raise MeshError(f"{place} has the index 0 (OBJ counts from 1) or a corner without a vertex")
    v, *others = [
        -1 if index is None else index - 1 if index > 0 else count + index
        for index, count in zip(indices, counts, strict=True)
    ]
    return v, *(max(index, -1) for index in others)


def obj_bytes(vertices: FloatArray, faces: IntArray, asset: Any = None) -> bytes:
    """An OBJ file of vertices and faces; repr() gives the fewest digits that read back as the same float64."""
    points = "".join(f"v {x!r} {y!r} {z!r}\n" for x, y, z in vertices.tolist())
    return (points + "".join(f"f {a} {b} {c}\n" for a, b, c in (faces + 1).tolist())).encode("ascii")
