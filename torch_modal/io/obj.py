"""Wavefront OBJ: the lines of the file, in which positions and normals are replaced."""

import re
from collections import defaultdict
from functools import cached_property
from pathlib import Path

import numpy as np

from torch_modal.arrays import FloatArray, IntArray
from torch_modal.errors import MeshError
from torch_modal.io.asset import CLAY, Asset, Material, Part, fans, linear_rgba
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
        #: Line numbers and contents of each kind of line.
        self._line_of: dict[str, list[int]] = defaultdict(list)
        contents: dict[str, list[str]] = defaultdict(list)
        for number, line in enumerate(self.lines):
            kind, *rest = line.partition("#")[0].split(None, 1) or [""]
            self._line_of[kind].append(number)
            contents[kind].append(rest[0].rstrip() if rest else "")
        rows = {kind: [row.split() for row in contents[kind]] for kind in ("v", "vt", "vn", "f")}
        if wrong := next((row for kind in rows for row in contents[kind] if "_" in row), ""):
            raise MeshError(f"{path}: a line with an underscore in a number: {wrong[:60]!r}")  # Python reads 1_0 as 10
        self.positions = _numbers([row[:3] for row in rows["v"]], 3)
        self._texcoords = _numbers([[*row, "0", "0"][:2] for row in rows["vt"]], 2)
        self._normals = _numbers([row[:3] for row in rows["vn"]], 3)
        colored = bool(rows["v"]) and min(map(len, rows["v"])) >= 6
        self._colors = _numbers([row[3:6] for row in rows["v"]], 3) if colored else None
        self._sizes = np.array([len(row) for row in rows["f"]], dtype=np.int64)
        if self._sizes.min(initial=3) < 3:
            raise MeshError(f"{path}: a face line with fewer than three corners")
        self._starts = np.cumsum(self._sizes) - self._sizes
        #: Vertex, texture coordinate and normal of each corner of the polygons; -1 where there is none.
        self._corners = self._read_corners(rows["f"])
        self._triangles = fans(self._sizes)
        self.faces = self._corners[self._triangles, 0]
        # Faces have the material of the last line before them.
        self._materials = list(dict.fromkeys(["", *contents["usemtl"]]))
        numbers = np.array([self._materials.index(name) for name in ["", *contents["usemtl"]]])
        of_polygons = numbers[np.searchsorted(self._line_of["usemtl"], self._line_of["f"])]
        self._material_of = np.repeat(of_polygons, self._sizes - 2)
        n_materials, groups = len({*contents["usemtl"]}), {(kind, row) for kind in "gos" for row in contents[kind]}
        self._libraries = contents["mtllib"]
        self._note("polygons", "quads" if (self._sizes <= 4).all() else "polygons", (self._sizes > 3).any())
        self._note("texcoords", "texture coordinates", (self._corners[:, 1] >= 0).any())
        self._note("normals", "normals", (self._corners[:, 2] >= 0).any())
        self._note("colors", "vertex colours", self._colors is not None)
        self._note("materials", f"{n_materials} material{'s' * (n_materials > 1)}", n_materials)
        self._note("groups", "groups", len(groups) > 1)

    def _read_corners(self, faces: list[list[str]]) -> IntArray:
        """Indices from 0 of corners such as ``1/2/3`` or ``-1//-1``; -1 where there is none. *Shape:* ``(C, 3)``."""
        unique: dict[str, int] = {}
        which = [unique.setdefault(word, len(unique)) for row in faces for word in row]
        table = [[int(index or 0) for index in f"{word}//".split("/")[:3]] for word in unique]
        corners = np.array(table, dtype=np.int64).reshape(-1, 3)[np.array(which, dtype=np.int64)]
        # Negative indices count back from the line.
        before = [np.searchsorted(self._line_of[kind], self._line_of["f"]) for kind in ("v", "vt", "vn")]
        corners = np.where(corners < 0, corners + np.repeat(before, self._sizes, axis=1).T, corners - 1)
        # Faces may name texture coordinates and normals that the file does not have.
        there = [len(self.positions), len(self._texcoords), len(self._normals)]
        corners[:, 1:][(corners < 0)[:, 1:] | (corners >= there)[:, 1:]] = -1
        return corners

    # ------------------------------------------------------------------------------------------------ the file again
    def with_positions(self, positions: FloatArray) -> bytes:
        """The file with other positions."""
        lines = list(self.lines)
        for number, (x, y, z) in zip(self._line_of["v"], positions.tolist(), strict=True):
            lines[number] = " ".join([f"v {x:.9g} {y:.9g} {z:.9g}", *lines[number].split(None, 4)[4:]])
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
    def _library_content(self) -> tuple[dict[str, Material], dict[str, bytes]]:
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
            name = self._materials[number]
            bare = Material(name or "clay", CLAY if colors is None else (1.0, 1.0, 1.0, 1.0))
            material = self._library_content[0].get(name, bare)
            uv = self._texcoords[texcoords] * [1, -1] + [0, 1] if (texcoords >= 0).all() else None
            rgba = None if colors is None else colors[vertices]
            vectors = self._normals[normals] if (normals >= 0).all() else None
            parts.append(Part(vertices, triangles.reshape(-1, 3), material, uv, rgba, vectors))
        return parts


def _numbers(rows: list[list[str]], width: int) -> FloatArray:
    for row in rows:
        if len(row) < width:
            raise ValueError(f"a line has fewer than {width} numbers: {' '.join(row)[:60]!r}")
    return np.array(rows, dtype=np.float64).reshape(-1, width)


def obj_bytes(vertices: FloatArray, faces: IntArray, asset: object = None) -> bytes:
    """An OBJ file of vertices and faces; with nine digits, float32 reads back as it was."""
    points = "".join(f"v {x:.9g} {y:.9g} {z:.9g}\n" for x, y, z in vertices.tolist())
    return (points + "".join(f"f {a} {b} {c}\n" for a, b, c in (faces + 1).tolist())).encode("ascii")
