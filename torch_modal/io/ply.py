"""PLY and OFF. A PLY file is written as its own bytes, in which positions and normals are replaced.

trimesh reads positions and triangles. It writes neither further elements and properties of PLY nor comments, so that
files are patched here. plyfile could do so, but its license is the GPL. trimesh writes OFF
with ten digits.
"""

import re
from collections.abc import Mapping
from functools import cached_property
from pathlib import Path

import numpy as np

from torch_modal.arrays import AnyArray, FloatArray, IntArray
from torch_modal.errors import MeshError
from torch_modal.io.asset import Asset, Material, Part, as_png_or_jpeg, linear_rgba
from torch_modal.io.files import try_companion
from torch_modal.io.normals import CarriedNormals

_TYPES = {"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4", "float": "f4"}
_TYPES |= {"double": "f8", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4"}
_TYPES |= {"float32": "f4", "float64": "f8"}
_UV_NAMES = (("s", "t"), ("u", "v"), ("texture_u", "texture_v"))
_NORMALS, _COLORS = ("nx", "ny", "nz"), ("red", "green", "blue")


class PlyFile:
    """A PLY file in memory: its header, and the numbers of its vertices.

    Raises a ValueError if it has no header, no vertices, or fewer bytes than the header promises.
    """

    def __init__(self, path: Path) -> None:
        self.data = path.read_bytes()
        match = re.search(rb"end_header[^\n]{0,99}\n|end_header\r", self.data)
        if match is None:
            raise ValueError("no end_header")
        self._start = match.end()
        self._order, self.textures = "", []
        #: Number and properties of each element. A property is ``[type]``, a list ``[type of its length, type]``.
        self.elements: dict[str, tuple[int, dict[str, list[str]]]] = {}
        properties: dict[str, list[str]] = {}
        for line in re.split(r"\r\n|\n|\r", self.data[: self._start].decode("utf-8", errors="replace")):
            words = line.split()
            if line.lower().startswith("comment texturefile"):
                self.textures.append(line.split(None, 2)[2].strip())
            elif words[:1] == ["format"]:
                self._order = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}[words[1]]
            elif words[:1] == ["element"]:
                properties = {}
                self.elements[words[1]] = int(words[2]), properties
            elif words[:1] == ["property"]:
                properties[words[-1]] = [_TYPES[word] for word in words[1:-1] if word != "list"]
        if "vertex" not in self.elements:
            raise ValueError("no vertices")
        self.n_vertices, self.properties = self.elements["vertex"]
        for name, (length, properties) in self.elements.items():  # in text, a number has one byte or more
            row = sum(np.dtype(kinds[0]).itemsize if self._order else 1 for kinds in properties.values())
            if not 0 <= length * max(row, 1) <= len(self.data) - self._start:
                raise ValueError(f"the header promises {length} of {name[:40]!r}; it was cut off or is damaged")

    @cached_property
    def _content(self) -> tuple[bytes, AnyArray, bytes]:
        """The vertices with all their properties (words, if the file is text), and the bytes before and after them."""
        if next(iter(self.elements)) != "vertex" or any(len(types) > 1 for types in self.properties.values()):
            raise ValueError("vertices are not its first element, or have properties that are lists")
        header, body = self.data[: self._start], self.data[self._start :]
        if not self._order:
            lines = body.splitlines(keepends=True)
            row = np.dtype([(name, object) for name in self.properties])
            words = np.array([tuple(line.split()) for line in lines[: self.n_vertices]], row)
            return header, words, b"".join(lines[self.n_vertices :])
        row = np.dtype([(name, self._order + kind) for name, (kind,) in self.properties.items()])
        rows = np.frombuffer(body, row, self.n_vertices)
        return header, rows, body[rows.nbytes :]

    def columns(self, *names: str) -> FloatArray:
        """Properties of the vertices. *Shape:* ``(V, n)``."""
        _, rows, _ = self._content
        return np.stack([rows[name].astype(np.float64) for name in names], axis=1)

    def with_columns(self, new: Mapping[str, FloatArray]) -> bytes:
        """The file with other values of some properties of the vertices. *Shape of each:* ``(V,)``."""
        before, rows, after = self._content
        rows = rows.copy()
        for name, column in new.items():
            if self._order:
                rows[name] = column
            else:  # the fewest digits that read back as the same number of the file's type
                numbers = column.astype(np.float32) if self.properties[name] == ["f4"] else column.tolist()
                rows[name] = [str(number).encode() for number in numbers]
        body = rows.tobytes() if self._order else b"".join(b" ".join(row) + b"\n" for row in rows.tolist())
        return before + body + after


class PlyAsset(Asset):
    """A PLY file, kept as bytes. Written again it differs in positions and normals only, in the file's types."""

    suffix = ".ply"

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self._file = PlyFile(path)
        n_faces, face_properties = self._file.elements.get("face", (0, {}))
        self.positions, self.faces = read_triangles(path, self._file.n_vertices, n_faces)
        names = self._file.properties.keys()
        self._uv_names = next((pair for pair in _UV_NAMES if names >= set(pair)), None)
        self._note("polygons", "polygons", len(self.faces) > n_faces)
        self._note("normals", "normals", names >= {*_NORMALS})
        self._note("colors", "vertex colours", names >= {*_COLORS})
        self._note("texcoords", "texture coordinates", self._uv_names)
        self._note("materials", "texture", self._file.textures)
        known = {*"xyz", *_NORMALS, *_COLORS, "alpha", *(self._uv_names or ()), "vertex_indices", "vertex_index"}
        others = [name for name in self._file.elements if name not in ("vertex", "face")]
        further = [*sorted((names | face_properties.keys()) - known), *others]
        self._note("properties", "properties " + ", ".join(further), further)

    @cached_property
    def _normals_carrier(self) -> CarriedNormals:
        return CarriedNormals(self._file.columns(*_NORMALS), self.positions, self.faces)

    def with_positions(self, positions: FloatArray) -> bytes:
        """The file with other positions."""
        new = dict(zip("xyz", positions.T, strict=True))
        if "normals" in self.carries:
            new |= dict(zip(_NORMALS, self._normals_carrier.at(positions).T, strict=True))
        return self._file.with_columns(new)

    @cached_property
    def companions(self) -> dict[str, bytes]:
        """Textures that the header names."""
        return dict(filter(None, [try_companion(self.path, name, "its texture") for name in self._file.textures]))

    def parts(self) -> list[Part]:
        """One part."""
        material = Material()
        if "colors" in self.carries or self._file.textures:
            image = as_png_or_jpeg(next(iter(self.companions.values()))) if self.companions else None
            material = Material(self.path.stem, (1.0, 1.0, 1.0, 1.0), texture=image)
        colors = None
        if "colors" in self.carries:
            kind = np.dtype(self._file.properties["red"][0])
            scale = float(np.iinfo(kind).max) if kind.kind in "iu" else 1.0
            alpha = ["alpha"] if "alpha" in self._file.properties else []
            colors = linear_rgba(self._file.columns(*_COLORS, *alpha) / scale)
        texcoords = self._file.columns(*self._uv_names) * [1, -1] + [0, 1] if self._uv_names else None
        normals = self._file.columns(*_NORMALS) if "normals" in self.carries else None
        everything = np.arange(len(self.positions))
        return [Part(everything, self.faces, material, texcoords, colors, normals)]


class OffAsset(Asset):
    """An OFF file. Written again it has triangles alone, neither colours nor polygons."""

    suffix = ".off"
    keeps = frozenset()

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        text = re.sub(r"#[^\n]*", "", path.read_text(encoding="utf-8", errors="replace"))
        n_vertices, n_faces = map(int, re.sub(r"^\s*\w*OFF", "", text).split()[:2])
        self.positions, self.faces = read_triangles(path, n_vertices, n_faces)
        self._note("polygons", "polygons", len(self.faces) > n_faces)

    def with_positions(self, positions: FloatArray) -> bytes:
        """The mesh with other positions."""
        return off_bytes(positions, self.faces)


def read_triangles(path: Path, n_vertices: int, n_faces: int) -> tuple[FloatArray, IntArray]:
    """Read vertices ``(V, 3)`` in the order of the file, and faces ``(F, 3)``; the header gives their numbers."""
    import trimesh

    # Without process=False vertices are merged; with fix_texture a PLY is split at seams. It needs no textures here.
    options = {"fix_texture": False, "skip_materials": True} if path.suffix.lower() == ".ply" else {}
    mesh = trimesh.load_mesh(path, process=False, maintain_order=True, **options)
    vertices = np.array(mesh.vertices, dtype=np.float64).reshape(-1, 3)
    faces = np.array(mesh.faces, dtype=np.int64).reshape(-1, 3)
    # trimesh accepts files that were cut off.
    if n_faces and (len(vertices) != n_vertices or len(faces) < n_faces):
        raise MeshError(
            f"{path}: the header promises {n_vertices} vertices and {n_faces} faces, the file holds {len(vertices)} "
            f"and {len(faces)}; it was cut off or is damaged"
        )
    return vertices, faces


def ply_bytes(vertices: FloatArray, faces: IntArray, asset: object = None) -> bytes:
    """A binary PLY file of vertices and faces, float32."""
    header = (
        "ply\nformat binary_little_endian 1.0\n"
        f"element vertex {len(vertices)}\nproperty float x\nproperty float y\nproperty float z\n"
        f"element face {len(faces)}\nproperty list uchar int vertex_indices\nend_header\n"
    )
    rows = np.empty(len(faces), dtype=[("count", "u1"), ("corners", "<i4", 3)])
    rows["count"], rows["corners"] = 3, faces
    return header.encode("ascii") + vertices.astype("<f4").tobytes() + rows.tobytes()


def off_bytes(vertices: FloatArray, faces: IntArray, asset: object = None) -> bytes:
    """An OFF file of vertices and faces, text, float64."""
    points = "".join(f"{x!r} {y!r} {z!r}\n" for x, y, z in vertices.tolist())
    triangles = "".join(f"3 {a} {b} {c}\n" for a, b, c in faces.tolist())
    return f"OFF\n{len(vertices)} {len(faces)} 0\n{points}{triangles}".encode("ascii")
