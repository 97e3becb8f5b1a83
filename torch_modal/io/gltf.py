"""glTF 2.0 documents, JSON and binary part: read from files, and written as GLB with frames as morph targets.

pygltflib would hold the JSON, but loses some of it (names of samplers, empty lists in extras) and takes 0.4 ms for each
accessor. It decodes no accessors, and neither joins buffers nor takes images into them, so that it would save little.
"""

from __future__ import annotations

import base64
import json
import struct
import warnings
from functools import cache
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import BPoly
from scipy.spatial.transform import Rotation, Slerp

from torch_modal.arrays import AnyArray, FloatArray
from torch_modal.errors import MeshWarning
from torch_modal.geometry.skin import WEIGHT_STEPS
from torch_modal.io.files import read_companion

Json = dict[str, Any]
Tracks = dict[tuple[int, str], FloatArray]
"""Values over time by node and property. *Shape of each:* ``(T, width)``."""

COMPONENTS = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}
ARRAY_BUFFER, ELEMENT_ARRAY_BUFFER = 34962, 34963
PICTURES = {b"\x89PNG": "image/png", b"\xff\xd8": "image/jpeg", b"RIFF": "image/webp"}
PICTURES |= {b"\xabKTX": "image/ktx2", b"DDS ": "image/vnd-ms.dds"}
"""Kinds of pictures, with those of extensions, by their first bytes."""
WHITE = base64.b64decode(
    "iVBORw0KGgoAAAANSUhEUgAAAAEAAAABCAAAAAA6fptVAAAACklEQVR42mP4DwABAQEAHLCMmQAAAABJRU5ErkJggg=="
)  # a PNG of one pixel


class Document:
    """A glTF document in memory: its JSON and the binary part of a GLB file. URIs are relative to the path."""

    def __init__(self, root: Json | None = None, path: Path = Path(), binary: bytes = b"") -> None:
        self.root: Json = {"asset": {"version": "2.0", "generator": "torch_modal"}} if root is None else root
        self.path = path
        resource = cache(self.resource)  # any number of buffers may name the same file
        #: A document that is written has one buffer, a bytearray.
        self.buffers: list[Any] = [
            resource(buffer["uri"]) if "uri" in buffer else binary for buffer in self.get("buffers")
        ] or [bytearray()]

    @classmethod
    def read(cls, path: Path) -> Document:
        """Read a GLB or GLTF file; raises ValueError for other files and other versions of glTF."""
        text, binary = path.read_bytes(), b""
        if text[:4] == b"glTF":  # a head of 12 bytes, and two chunks of a length, a kind and content
            data = text
            length = struct.unpack_from("<I", data, 12)[0]
            text, rest = data[20 : 20 + length], data[20 + length :]
            if rest:
                binary = rest[8 : 8 + struct.unpack_from("<I", rest)[0]]
        root = json.loads(text.decode("utf-8"))
        json.dumps(root, allow_nan=False)  # raises for NaN and infinite numbers, which Python reads
        if not isinstance(root, dict) or not str(root.get("asset", {}).get("version", "")).startswith("2"):
            raise ValueError("not glTF 2")
        return cls(root, path, binary)

    # --------------------------------------------------------------------------------------------------------- reading
    def get(self, kind: str, index: int | None = None) -> Any:
        """A list of the document, empty if it is missing; or the member at an index."""
        items = self.root.get(kind, [])
        if index is None:
            return items
        if not isinstance(index, int) or not 0 <= index < len(items):  # Python accepts negative ones
            raise ValueError(f"an index {index!r} of {len(items)} {kind}")
        return items[index]

    def resource(self, uri: str) -> bytes:
        """The data in a URI, or of the file that it names."""
        if uri.startswith("data:"):
            return base64.b64decode(uri.partition(",")[2])
        return read_companion(self.path, unquote(uri))[1]

    def view(self, index: int) -> bytes:
        """The bytes of a buffer view."""
        view = self.get("bufferViews", index)
        start, number = view.get("byteOffset", 0), view["buffer"]
        data = self.buffers[number][start : start + view["byteLength"]] if 0 <= number < len(self.buffers) else b""
        if start < 0 or len(data) < view["byteLength"]:
            raise ValueError("a buffer is too short")
        return bytes(data)

    def image(self, index: int) -> bytes:
        """The bytes of a picture; if they cannot be read or are no picture, a white one and a warning."""
        image = self.get("images", index)
        try:
            data = self.view(image["bufferView"]) if "bufferView" in image else self.resource(image.get("uri", ""))
            if not data.startswith(tuple(PICTURES)):
                raise ValueError("its content is no picture: neither PNG, JPEG, WebP, KTX 2 nor DDS")
            return data
        except (ValueError, TypeError, LookupError) as error:
            warnings.warn(f"{self.path.name} is without image {index}, now white: {error}", MeshWarning, stacklevel=6)
        return WHITE

    def accessor(self, index: int) -> AnyArray:
        """The numbers of an accessor, in its component type. *Shape:* ``(count, width)``."""
        accessor = self.get("accessors", index)
        kind, width, count = accessor["componentType"], WIDTHS[accessor["type"]], accessor["count"]
        array = self._rows(accessor, kind, count, width)
        if "sparse" in accessor:
            n, indices, values = (accessor["sparse"][key] for key in ("count", "indices", "values"))
            array = array.copy()
            array[self._rows(indices, indices["componentType"], n, 1)[:, 0]] = self._rows(values, kind, n, width)
        return array

    def _rows(self, place: Json, kind: int, count: int, width: int) -> AnyArray:
        """Numbers in a buffer view; zeros, if there is no view. *Shape:* ``(count, width)``."""
        dtype = np.dtype(COMPONENTS[kind])
        if "bufferView" not in place:
            # Other accessors of as many elements have their bytes in the file.
            if count * width > sum(map(len, self.buffers)):
                raise ValueError(f"an accessor of {count} elements")
            return np.zeros((count, width), dtype)
        data, offset, size = self.view(place["bufferView"]), place.get("byteOffset", 0), dtype.itemsize * width
        stride = self.get("bufferViews", place["bufferView"]).get("byteStride") or size
        if offset < 0 or stride < size:
            raise ValueError("an accessor with a wrong offset or stride")
        if count and offset + (count - 1) * stride + size > len(data):
            raise ValueError("a buffer view is too short")
        return np.ndarray((count, width), dtype, data, offset, (stride, dtype.itemsize))

    def floats(self, index: int) -> FloatArray:
        """The numbers of an accessor; normalised integers as fractions. *Shape:* ``(count, width)``."""
        array = self.accessor(index)
        numbers = array.astype(np.float64)
        if self.get("accessors", index).get("normalized") and array.dtype.kind in "iu":
            numbers = np.maximum(numbers / np.iinfo(array.dtype).max, -1.0)
        return numbers

    # --------------------------------------------------------------------------------------------------------- writing
    def append(self, kind: str, item: Json) -> int:
        """Append to a list of the document; returns the index."""
        items = self.root.setdefault(kind, [])
        items.append(item)
        return len(items) - 1

    def add_bytes(self, data: bytes, target: int | None = None) -> int:
        """Add bytes as a buffer view; returns its index."""
        (binary,) = self.buffers
        binary += bytes(-len(binary) % 4)  # views start at multiples of four bytes
        view: Json = {"buffer": 0, "byteOffset": len(binary), "byteLength": len(data)}
        if target is not None:
            view["target"] = target
        binary += data
        return self.append("bufferViews", view)

    def add_image(self, data: bytes) -> Json:
        """Add a picture; returns the JSON of an image."""
        mime = next(kind for start, kind in PICTURES.items() if data.startswith(start))
        return {"bufferView": self.add_bytes(data), "mimeType": mime}

    def add(
        self, array: AnyArray, kind: str, target: int | None = None, bounds: bool = False, normalized: bool = False
    ) -> int:
        """Add numbers ``(count,)`` or ``(count, width)`` as an accessor with a view of its own; returns its index.

        Positions and times need bounds. Normalized integers stand for fractions.
        """
        rows = np.ascontiguousarray(array).reshape(len(array), -1)
        view = self.add_bytes(rows.tobytes(), target)
        code = next(code for code, name in COMPONENTS.items() if np.dtype(name) == rows.dtype)
        accessor: Json = {"bufferView": view, "componentType": code, "count": len(rows), "type": kind}
        if normalized:
            accessor["normalized"] = True
        if bounds and np.isfinite(rows).all():  # texture coordinates may be NaN, JSON may not
            accessor |= {"min": rows.min(axis=0).tolist(), "max": rows.max(axis=0).tolist()}
        return self.append("accessors", accessor)

    def add_frames(self, shapes: FloatArray, normals: FloatArray | None) -> Json:
        """Add the points of a primitive; returns attributes for frame 0, and a morph target for each further frame.

        *Shape:* ``(N, P, 3)`` of both.
        """
        added: list[Json] = [{"POSITION": self.add(x, "VEC3", ARRAY_BUFFER, bounds=True)} for x in _differences(shapes)]
        if normals is not None:
            # Unit vectors, as glTF demands, which stay bit for bit; (0, 0, 1) instead of zero vectors.
            length = np.linalg.norm(normals, axis=-1, keepdims=True)
            units = np.where(np.abs(length - 1) < 1e-6, normals, normals / np.maximum(length, 1e-12))
            units = np.where(length > 1e-12, units, [0.0, 0.0, 1.0])
            for attributes, x in zip(added, _differences(units), strict=True):
                attributes["NORMAL"] = self.add(x, "VEC3", ARRAY_BUFFER)
        return {"attributes": added[0], **({"targets": added[1:]} if added[1:] else {})}

    def add_influences(self, weights: FloatArray) -> Json:
        """Add the four largest weights of bones at points; returns attributes. *Shape:* ``(P, J)``."""
        wide = np.pad(weights, ((0, 0), (0, max(0, 4 - weights.shape[1]))))
        joints = np.argsort(-wide, axis=1, kind="stable")[:, :4]
        parts = np.rint(np.take_along_axis(wide, joints, axis=1) * WEIGHT_STEPS).astype("<u2")
        joints = np.where(parts > 0, joints, 0).astype("<u1" if weights.shape[1] <= 256 else "<u2")
        added = self.add(parts, "VEC4", ARRAY_BUFFER, normalized=True)
        return {"JOINTS_0": self.add(joints, "VEC4", ARRAY_BUFFER), "WEIGHTS_0": added}

    def to_glb(self) -> bytes:
        """The document as a GLB file."""
        (data,) = self.buffers
        self.root["buffers"] = [{"byteLength": len(data)}]
        text = json.dumps(self.root, separators=(",", ":"), ensure_ascii=False, allow_nan=False).encode("utf-8")
        text += b" " * (-len(text) % 4)
        binary = bytes(data) + bytes(-len(data) % 4)
        head = struct.pack("<4sIII4s", b"glTF", 2, 28 + len(text) + len(binary), len(text), b"JSON")
        return b"".join([head, text, struct.pack("<I4s", len(binary), b"BIN\0"), binary])


def key_times(document: Document) -> FloatArray:
    """Times of all keys of the first animation, in seconds; none without one. *Shape:* ``(n,)``, ascending."""
    samplers = [sampler for animation in document.get("animations")[:1] for sampler in animation["samplers"]]
    return np.unique([time for sampler in samplers for time in document.floats(sampler["input"])])


def sample(document: Document, sampler: Json, times: FloatArray, quaternions: bool) -> FloatArray:
    """Values of a sampler, constant before the first key and after the last. *Shape:* ``(T,) -> (T, width)``."""
    keys, mode = document.floats(sampler["input"])[:, 0], sampler.get("interpolation", "LINEAR")
    # Cubics have a tangent before and after each value.
    values = document.floats(sampler["output"]).reshape(len(keys), 3 if mode == "CUBICSPLINE" else 1, -1)
    before, middle, after = values[:, 0], values[:, values.shape[1] // 2], values[:, -1]
    times = np.clip(times, keys[0], keys[-1])
    if mode == "STEP" or len(keys) == 1:
        return middle[np.searchsorted(keys, times, "right") - 1]
    if quaternions and mode == "LINEAR":
        return np.asarray(Slerp(keys, Rotation.from_quat(middle))(times).as_quat())
    controls = [middle[:-1], middle[1:]]
    if mode == "CUBICSPLINE":  # glTF 2.0, appendix C.5
        thirds = np.diff(keys)[:, None] / 3
        controls[1:1] = [middle[:-1] + thirds * after[:-1], middle[1:] - thirds * before[1:]]
    return np.asarray(BPoly(np.stack(controls), keys)(times))


def world_transforms(document: Document, moved: Tracks | None = None) -> dict[int, FloatArray]:
    """World transform of each node of the scene, parents first. *Shape of each:* ``(4, 4)``, or ``(T, 4, 4)``.

    ``moved`` holds values at T times by node and path, instead of the values of the nodes.
    """
    nodes = document.get("nodes")
    if document.get("scenes"):
        roots = document.get("scenes", document.root.get("scene", 0)).get("nodes", [])
    else:
        children = {child for node in nodes for child in node.get("children", [])}
        roots = [number for number in range(len(nodes)) if number not in children]
    worlds: dict[int, FloatArray] = {}
    waiting = [(number, np.eye(4)) for number in reversed(roots)]
    while waiting:
        number, parent = waiting.pop()
        if number in worlds:  # a node has one parent; in a damaged file it may be its own
            continue
        node = document.get("nodes", number)
        if "matrix" in node:
            local = np.array(node["matrix"], dtype=np.float64).reshape(4, 4).T
        else:
            values = {"translation": [0.0, 0, 0], "rotation": [0.0, 0, 0, 1], "scale": [1.0, 1, 1], **node}
            shift, turn, scale = (
                np.array((moved or {}).get((number, path), values[path]), dtype=np.float64)
                for path in ("translation", "rotation", "scale")
            )
            linear = Rotation.from_quat(turn).as_matrix() * scale[..., None, :]
            local = np.zeros((*np.broadcast_shapes(shift.shape[:-1], linear.shape[:-2]), 4, 4))
            local[..., :3, :3], local[..., :3, 3], local[..., 3, 3] = linear, shift, 1
        worlds[number] = parent @ local
        waiting += [(child, worlds[number]) for child in reversed(node.get("children", []))]
    return worlds


def _differences(frames: FloatArray) -> NDArray[np.float32]:
    """Frame 0 in single precision, then each other frame minus it, so that its rounding cancels."""
    first = frames[0].astype(np.float32)
    return np.concatenate([first[None], (frames[1:] - first).astype(np.float32)])
