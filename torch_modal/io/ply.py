"""PLY and OFF: the bytes or lines of the file, with other numbers in the place of positions and normals.

trimesh reads positions and triangles. It writes neither further elements and properties of PLY nor comments, and of OFF
neither polygons nor colours, so that files are patched here. plyfile could do so for PLY, but its license is the GPL.
"""

import re
from collections.abc import Mapping
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from torch_modal.arrays import FloatArray, IntArray
from torch_modal.errors import MeshError
from torch_modal.io.asset import Asset, Material, Part, as_image, linear
from torch_modal.io.normals import CarriedNormals

_TYPES = {"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4", "float": "f4"}
_TYPES |= {"double": "f8", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4"}
_TYPES |= {"float32": "f4", "float64": "f8"}
_UV_NAMES = (("s", "t"), ("u", "v"), ("texture_u", "texture_v"))


class _Property(NamedTuple):
    type: str
    count_type: str | None = None
    """Of a list."""


class _Element(NamedTuple):
    name: str
    length: int
    properties: dict[str, _Property]

    def row(self, order: str) -> np.dtype:
        return np.dtype([(name, order + prop.type) for name, prop in self.properties.items()])


class PlyAsset(Asset):
    """A PLY file, kept as bytes. Written again it differs in positions and normals alone, in the file's types."""

    suffix = ".ply"

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self.data = path.read_bytes()
        self._read_header()
        faces = [element for element in self._elements if element.name == "face"]
        n_faces = sum(element.length for element in faces)
        self.positions, self.faces = read_triangles(path, self._vertex.length, n_faces)
        self._describe(n_faces, {name for element in faces for name in element.properties})

    def _read_header(self) -> None:
        match = re.search(rb"end_header[^\n]*\n|end_header\r", self.data)
        if match is None:
            raise ValueError("no end_header")
        self._start = match.end()
        self._format, self._order, self._textures = "ascii", "", []
        self._elements: list[_Element] = []
        for line in re.split(r"\r\n|\n|\r", self.data[: self._start].decode("utf-8", errors="replace")):
            words = line.split()
            if line.lower().startswith("comment texturefile"):
                self._textures.append(line.split(None, 2)[2].strip())
            elif words[:1] == ["format"]:
                self._format = words[1]
                self._order = ">" if words[1] == "binary_big_endian" else "<"
            elif words[:1] == ["element"]:
                self._elements.append(_Element(words[1], int(words[2]), {}))
            elif words[:2] == ["property", "list"]:
                self._elements[-1].properties[words[4]] = _Property(_TYPES[words[3]], _TYPES[words[2]])
            elif words[:1] == ["property"]:
                self._elements[-1].properties[words[2]] = _Property(_TYPES[words[1]])
        vertices = [element for element in self._elements if element.name == "vertex"]
        if not vertices:
            raise ValueError("no vertices")
        self._vertex = vertices[0]
        names = self._vertex.properties.keys()
        self._uv_names = next((pair for pair in _UV_NAMES if names >= set(pair)), None)

    def _describe(self, n_faces: int, face_properties: set[str]) -> None:
        names = self._vertex.properties.keys()
        if len(self.faces) > n_faces:
            self.carries["polygons"] = "polygons"
        if {"nx", "ny", "nz"} <= names:
            self.carries["normals"] = "normals"
        if {"red", "green", "blue"} <= names:
            self.carries["colors"] = "vertex colours"
        if self._uv_names is not None:
            self.carries["texcoords"] = "texture coordinates"
        if self._textures:
            self.carries["materials"] = "texture"
        known = {"x", "y", "z", "nx", "ny", "nz", "red", "green", "blue", "alpha", *(self._uv_names or ())}
        further = sorted((names - known) | (face_properties - {"vertex_indices", "vertex_index"}))
        if further or len(self._elements) > 2:
            others = [e.name for e in self._elements if e.name not in ("vertex", "face")]
            self.carries["properties"] = "properties " + ", ".join(further + others)

    # ------------------------------------------------------------------------------------------------ the vertex rows
    @cached_property
    def _place(self) -> tuple[int, int]:
        """Start of the rows of the vertices, as a byte or in text as a line, and their size in bytes."""
        before = self._elements[: self._elements.index(self._vertex)]
        if self._format == "ascii":
            return sum(element.length for element in before), 0
        place = self._start
        for element in before:
            for _ in range(element.length):
                for prop in element.properties.values():
                    repeat = 1
                    if prop.count_type is not None:
                        count = np.dtype(self._order + prop.count_type)
                        repeat = int(np.frombuffer(self.data, count, 1, place)[0])
                        place += count.itemsize
                    place += repeat * np.dtype(prop.type).itemsize
        return place, self._vertex.length * self._vertex.row(self._order).itemsize

    @cached_property
    def _lines(self) -> list[bytes]:
        return self.data[self._start :].splitlines()

    @cached_property
    def _rows(self) -> NDArray[np.void]:
        """The vertices with all their properties. *Shape:* ``(V,)``."""
        if any(prop.count_type for prop in self._vertex.properties.values()):
            raise ValueError("vertices with properties that are lists")
        place, size = self._place
        row = self._vertex.row(self._order)
        if self._format != "ascii":
            return np.frombuffer(self.data[place : place + size], row).copy()
        lines = self._lines[place : place + self._vertex.length]
        words = [tuple(map(float, line.split())) for line in lines]
        return np.array(words, dtype=[(name, "f8") for name in row.names or ()])

    def _columns(self, *names: str) -> FloatArray:
        return np.stack([self._rows[name].astype(np.float64) for name in names], axis=1)

    @cached_property
    def _carried(self) -> CarriedNormals:
        return CarriedNormals(self._columns("nx", "ny", "nz"), self.positions, self.faces)

    def with_positions(self, positions: FloatArray) -> bytes:
        """The file with other positions."""
        new = dict(zip("xyz", positions.T, strict=True))
        if "normals" in self.carries:
            new |= dict(zip(("nx", "ny", "nz"), self._carried.at(positions).T, strict=True))
        return self.with_columns(new)

    def with_columns(self, new: Mapping[str, FloatArray]) -> bytes:
        """The file with other values of some properties of the vertices. *Shape of each:* ``(V,)``."""
        place, size = self._place
        if self._format != "ascii":
            rows = self._rows.copy()
            for name, column in new.items():
                rows[name] = column
            return self.data[:place] + rows.tobytes() + self.data[place + size :]
        lines = list(self._lines)
        properties = self._vertex.properties
        at = {name: number for number, name in enumerate(properties)}
        columns = {at[name]: _text(column, properties[name].type == "f4") for name, column in new.items()}
        for number in range(self._vertex.length):
            words = lines[place + number].split()
            for place_in_row, text in columns.items():
                words[place_in_row] = text[number]
            lines[place + number] = b" ".join(words)
        return self.data[: self._start] + b"\n".join(lines) + b"\n"

    @cached_property
    def companions(self) -> dict[str, bytes]:
        """Textures that the header names."""
        paths = {name: self.path.parent / name for name in self._textures if not Path(name).is_absolute()}
        return {name: path.read_bytes() for name, path in paths.items() if path.is_file() and ".." not in path.parts}

    def parts(self) -> list[Part]:
        """One part."""
        material = Material()
        if "colors" in self.carries or self._textures:
            image = as_image(next(iter(self.companions.values()))) if self.companions else None
            material = Material(self.path.stem, (1.0, 1.0, 1.0, 1.0), texture=image)
        colors = None
        if "colors" in self.carries:
            channels = ["red", "green", "blue"]
            channels += ["alpha"] if "alpha" in self._vertex.properties else []
            kind = np.dtype(self._vertex.properties["red"].type)
            scale = float(np.iinfo(kind).max) if kind.kind in "iu" else 1.0
            colors = linear(self._columns(*channels) / scale)
        texcoords = None
        if self._uv_names is not None:
            texcoords = self._columns(*self._uv_names) * [1, -1] + [0, 1]
        normals = self._columns("nx", "ny", "nz") if "normals" in self.carries else None
        everything = np.arange(len(self.positions))
        return [Part(everything, self.faces, material, texcoords, colors, normals)]


def _text(column: FloatArray, single: bool) -> list[bytes]:
    """The fewest digits that read back as the same number of the file's type."""
    numbers = column.astype(np.float32) if single else column
    return [str(number).encode() for number in (numbers if single else numbers.tolist())]


class OffAsset(Asset):
    """An OFF file, kept as lines: colours, polygons and further numbers of vertices stay."""

    suffix = ".off"

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        text = path.read_bytes().decode("utf-8", errors="surrogateescape")
        counts = re.sub(r"^\s*\w*OFF", "", re.sub(r"#[^\n]*", "", text[: 1 << 16])).split()[:2]
        known = len(counts) == 2 and all(word.isdigit() for word in counts)
        self.positions, self.faces = read_triangles(path, *map(int, counts if known else (0, 0)))
        self.lines = text.splitlines()
        content = [n for n, line in enumerate(self.lines) if line.partition("#")[0].strip()]
        # The header and the counts stand on one line or on two.
        header = self.lines[content[0]].partition("#")[0].split()
        first, kind = 1 if len(header) > 1 else 2, header[0]
        self._rows = content[first : first + len(self.positions)]
        words = [len(self.lines[n].partition("#")[0].split()) for n in self._rows]
        if len(words) < len(self.positions) or min(words, default=0) < 3:  # not a vertex a line: only the mesh stays
            self._rows, words = [], [3]
        self._colored = "N" not in kind and "4" not in kind and min(words) >= 6
        faces = content[first + len(self.positions) :]
        if len(self.faces) > len(faces):
            self.carries["polygons"] = "polygons"
        if self._colored:
            self.carries["colors"] = "vertex colours"
        elif min(words) > 3:
            self.carries["properties"] = "further numbers of vertices"

    def with_positions(self, positions: FloatArray) -> bytes:
        """The file with other positions."""
        if not self._rows:
            return off_bytes(positions, self.faces)
        lines = list(self.lines)
        for number, (x, y, z) in zip(self._rows, positions.tolist(), strict=True):
            lines[number] = " ".join([repr(x), repr(y), repr(z), *lines[number].split(None, 3)[3:]])
        return ("\n".join(lines) + "\n").encode("utf-8", errors="surrogateescape")

    def parts(self) -> list[Part]:
        """One part."""
        everything = np.arange(len(self.positions))
        if not self._colored:
            return [Part(everything, self.faces, Material())]
        rows = [[float(word) for word in self.lines[n].partition("#")[0].split()[3:7]] for n in self._rows]
        colors = np.array([row[: min(map(len, rows))] for row in rows])
        # Whole numbers go to 255, others to 1.
        whole = all("." not in self.lines[n].partition("#")[0].split()[3] for n in self._rows)
        white = Material(self.path.stem, (1.0, 1.0, 1.0, 1.0))
        return [Part(everything, self.faces, white, colors=linear(colors / (255 if whole else 1)))]


def read_triangles(path: Path, n_vertices: int, n_faces: int) -> tuple[FloatArray, IntArray]:
    """Vertices ``(V, 3)`` as they stand in the file, faces ``(F, 3)``.

    Args:
        path: The file.
        n_vertices: From its header.
        n_faces: From its header, polygons included; 0 if unknown.

    Raises:
        MeshError: The file was cut off, which trimesh accepts.
    """
    import trimesh

    # Without process=False vertices are merged; with fix_texture a PLY is split at texture seams.
    options = {"fix_texture": False} if path.suffix.lower() == ".ply" else {}
    mesh = trimesh.load_mesh(path, process=False, maintain_order=True, **options)
    vertices = np.array(mesh.vertices, dtype=np.float64).reshape(-1, 3)
    faces = np.array(mesh.faces, dtype=np.int64).reshape(-1, 3)
    if n_faces and (len(vertices) != n_vertices or len(faces) < n_faces):
        raise MeshError(
            f"{path}: the header promises {n_vertices} vertices and {n_faces} faces, the file holds {len(vertices)} "
            f"and {len(faces)}; it was cut off or is damaged"
        )
    return vertices, faces


def ply_bytes(vertices: FloatArray, faces: IntArray, asset: Any = None) -> bytes:
    """Binary, float32."""
    header = (
        "ply\nformat binary_little_endian 1.0\n"
        f"element vertex {len(vertices)}\nproperty float x\nproperty float y\nproperty float z\n"
        f"element face {len(faces)}\nproperty list uchar int vertex_indices\nend_header\n"
    )
    rows = np.empty(len(faces), dtype=[("count", "u1"), ("corners", "<i4", 3)])
    rows["count"], rows["corners"] = 3, faces
    return header.encode("ascii") + vertices.astype("<f4").tobytes() + rows.tobytes()


def off_bytes(vertices: FloatArray, faces: IntArray, asset: Any = None) -> bytes:
    """Text, float64."""
    points = "".join(f"{x!r} {y!r} {z!r}\n" for x, y, z in vertices.tolist())
    triangles = "".join(f"3 {a} {b} {c}\n" for a, b, c in faces.tolist())
    return f"OFF\n{len(vertices)} {len(faces)} 0\n{points}{triangles}".encode("ascii")
