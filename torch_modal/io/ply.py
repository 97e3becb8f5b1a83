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
_NORMALS, _COLORS = ("nx", "ny", "nz"), ("red", "green", "blue")


class _Property(NamedTuple):
    type: str
    count_type: str | None = None
    """Type of the count of a list."""


class _Element(NamedTuple):
    name: str
    length: int
    properties: dict[str, _Property]


class PlyFile:
    """A PLY file in memory: its header, and the numbers of its vertices.

    Args:
        path: The file.

    Raises:
        ValueError: It has no header, or no vertices.
    """

    def __init__(self, path: Path) -> None:
        self.data = path.read_bytes()
        match = re.search(rb"end_header[^\n]*\n|end_header\r", self.data)
        if match is None:
            raise ValueError("no end_header")
        self._start = match.end()
        self._order, self.textures = "", []
        self.elements: list[_Element] = []
        for line in re.split(r"\r\n|\n|\r", self.data[: self._start].decode("utf-8", errors="replace")):
            words = line.split()
            if line.lower().startswith("comment texturefile"):
                self.textures.append(line.split(None, 2)[2].strip())
            elif words[:1] == ["format"]:
                self._order = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}[words[1]]
            elif words[:1] == ["element"]:
                self.elements.append(_Element(words[1], int(words[2]), {}))
            elif words[:2] == ["property", "list"]:
                self.elements[-1].properties[words[4]] = _Property(_TYPES[words[3]], _TYPES[words[2]])
            elif words[:1] == ["property"]:
                self.elements[-1].properties[words[2]] = _Property(_TYPES[words[1]])
        vertices = [element for element in self.elements if element.name == "vertex"]
        if not vertices:
            raise ValueError("no vertices")
        self.vertex = vertices[0]

    @cached_property
    def _content(self) -> tuple[bytes, NDArray[Any], bytes]:
        """The vertices with all their properties, and the bytes before and after them.

        *Shape:* ``(V,)``, structured; of text ``(V, n)`` words.
        """
        if any(prop.count_type for prop in self.vertex.properties.values()):
            raise ValueError("vertices with properties that are lists")
        before = self.elements[: self.elements.index(self.vertex)]
        if not self._order:
            lines = self.data[self._start :].splitlines(keepends=True)
            first = sum(element.length for element in before)
            last = first + self.vertex.length
            words = np.array([line.split() for line in lines[first:last]], dtype=object)
            head = self.data[: self._start] + b"".join(lines[:first])
            return head, words.reshape(-1, len(self.vertex.properties)), b"".join(lines[last:])
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
        row = np.dtype([(name, self._order + prop.type) for name, prop in self.vertex.properties.items()])
        rows = np.frombuffer(self.data, row, self.vertex.length, place)
        return self.data[:place], rows, self.data[place + rows.nbytes :]

    def columns(self, *names: str) -> FloatArray:
        """Properties of the vertices. *Shape:* ``(V, n)``."""
        _, rows, _ = self._content
        at = list(self.vertex.properties)
        found = [rows[name] if self._order else rows[:, at.index(name)] for name in names]
        return np.stack([column.astype(np.float64) for column in found], axis=1)

    def with_columns(self, new: Mapping[str, FloatArray]) -> bytes:
        """The file with other values of some properties of the vertices. *Shape of each:* ``(V,)``."""
        before, rows, after = self._content
        rows = rows.copy()
        if self._order:
            for name, column in new.items():
                rows[name] = column
            return before + rows.tobytes() + after
        properties = self.vertex.properties
        for name, column in new.items():
            # The fewest digits that read back as the same number of the file's type.
            numbers = column.astype(np.float32) if properties[name].type == "f4" else column.tolist()
            rows[:, list(properties).index(name)] = [str(number).encode() for number in numbers]
        return before + b"".join(b" ".join(row) + b"\n" for row in rows.tolist()) + after


class PlyAsset(Asset):
    """A PLY file, kept as bytes. Written again it differs in positions and normals alone, in the file's types."""

    suffix = ".ply"

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self._file = PlyFile(path)
        faces = [element for element in self._file.elements if element.name == "face"]
        n_faces = sum(element.length for element in faces)
        self.positions, self.faces = read_triangles(path, self._file.vertex.length, n_faces)
        names = self._file.vertex.properties.keys()
        self._uv_names = next((pair for pair in _UV_NAMES if names >= set(pair)), None)
        if len(self.faces) > n_faces:
            self.carries["polygons"] = "polygons"
        if names >= {*_NORMALS}:
            self.carries["normals"] = "normals"
        if names >= {*_COLORS}:
            self.carries["colors"] = "vertex colours"
        if self._uv_names is not None:
            self.carries["texcoords"] = "texture coordinates"
        if self._file.textures:
            self.carries["materials"] = "texture"
        of_vertices = names - {"x", "y", "z", *_NORMALS, *_COLORS, "alpha", *(self._uv_names or ())}
        of_faces = {name for element in faces for name in element.properties} - {"vertex_indices", "vertex_index"}
        others = [element.name for element in self._file.elements if element.name not in ("vertex", "face")]
        if further := [*sorted(of_vertices | of_faces), *others]:
            self.carries["properties"] = "properties " + ", ".join(further)

    @cached_property
    def _carried(self) -> CarriedNormals:
        return CarriedNormals(self._file.columns(*_NORMALS), self.positions, self.faces)

    def with_positions(self, positions: FloatArray) -> bytes:
        """The file with other positions."""
        new = dict(zip("xyz", positions.T, strict=True))
        if "normals" in self.carries:
            new |= dict(zip(_NORMALS, self._carried.at(positions).T, strict=True))
        return self._file.with_columns(new)

    @cached_property
    def companions(self) -> dict[str, bytes]:
        """Textures that the header names."""
        paths = {name: self.path.parent / name for name in self._file.textures if not Path(name).is_absolute()}
        return {name: path.read_bytes() for name, path in paths.items() if path.is_file() and ".." not in path.parts}

    def parts(self) -> list[Part]:
        """One part."""
        material = Material()
        if "colors" in self.carries or self._file.textures:
            image = as_image(next(iter(self.companions.values()))) if self.companions else None
            material = Material(self.path.stem, (1.0, 1.0, 1.0, 1.0), texture=image)
        colors = texcoords = normals = None
        if "colors" in self.carries:
            properties = self._file.vertex.properties
            kind = np.dtype(properties["red"].type)
            scale = float(np.iinfo(kind).max) if kind.kind in "iu" else 1.0
            colors = linear(self._file.columns(*_COLORS, *(["alpha"] if "alpha" in properties else [])) / scale)
        if self._uv_names is not None:
            texcoords = self._file.columns(*self._uv_names) * [1, -1] + [0, 1]
        if "normals" in self.carries:
            normals = self._file.columns(*_NORMALS)
        everything = np.arange(len(self.positions))
        return [Part(everything, self.faces, material, texcoords, colors, normals)]


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
        kind, *rest = self.lines[content[0]].partition("#")[0].split()
        first = 1 if rest else 2
        last = first + len(self.positions)
        self._rows = content[first:last]
        words = [self.lines[n].partition("#")[0].split() for n in self._rows]
        width = min(map(len, words), default=0)
        if len(words) < len(self.positions) or width < 3:  # not a vertex a line: only the mesh stays
            self._rows, width = [], 3
        self._colors: FloatArray | None = None
        if width >= 6 and "N" not in kind and "4" not in kind:
            numbers = np.array([row[3 : min(width, 7)] for row in words], dtype=np.float64)
            whole = all("." not in row[3] for row in words)  # whole numbers go to 255, others to 1
            self._colors = linear(numbers / (255 if whole else 1))
            self.carries["colors"] = "vertex colours"
        elif width > 3:
            self.carries["properties"] = "further numbers of vertices"
        if len(self.faces) > len(content[last:]):
            self.carries["polygons"] = "polygons"

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
        material = Material() if self._colors is None else Material(self.path.stem, (1.0, 1.0, 1.0, 1.0))
        return [Part(np.arange(len(self.positions)), self.faces, material, colors=self._colors)]


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
