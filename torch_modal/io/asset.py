"""Mesh files with all their content: positions, faces, materials, texture coordinates, groups and more."""

import io
import warnings
from abc import ABC, abstractmethod
from collections.abc import Collection
from pathlib import Path
from typing import NamedTuple

import numpy as np

from torch_modal.arrays import FloatArray, IntArray
from torch_modal.errors import MeshWarning

FEATURES = ("polygons", "texcoords", "normals", "colors", "materials", "groups", "properties", "posing")
"""Content of mesh files besides positions and triangles."""
CLAY = (0.66, 0.52, 0.42, 1.0)  # colour of surfaces without one, linear RGBA


def as_png_or_jpeg(data: bytes) -> bytes | None:
    """Return PNG and JPEG files as they are, other pictures as PNG, and None for data that is no picture."""
    if data.startswith((b"\x89PNG", b"\xff\xd8")):
        return data
    from PIL import Image

    stream = io.BytesIO()
    try:
        picture = Image.open(io.BytesIO(data))
        if picture.width * picture.height > 2**26:  # a small file may promise any size
            return None
        picture.save(stream, format="PNG")
    except Exception:  # damaged pictures may raise any exception
        return None
    return stream.getvalue()


def linear_rgba(colors: FloatArray) -> FloatArray:
    """Linear RGBA of sRGB colours in [0, 1]. *Shape:* ``(n, 3)`` or ``(n, 4)`` to ``(n, 4)``."""
    clipped = np.clip(colors, 0.0, 1.0)
    rgb = clipped[:, :3]
    rgb = np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)
    alpha = clipped[:, 3:] if colors.shape[1] > 3 else np.ones((len(colors), 1))
    return np.concatenate([rgb, alpha], axis=1)


def fans(sizes: IntArray) -> IntArray:
    """Corners of the triangles that polygons are cut into, from the first corner of each: the same in all frames.

    Corners are numbered one polygon after the other. *Shape:* numbers of corners ``(P,)`` to ``(F, 3)``.
    """
    counts = np.maximum(sizes - 2, 0)
    polygon = np.repeat(np.arange(len(sizes)), counts)
    first = (np.cumsum(sizes) - sizes)[polygon]
    second = first + 1 + np.arange(len(polygon)) - (np.cumsum(counts) - counts)[polygon]
    return np.stack([first, second, second + 1], axis=1)


class Material(NamedTuple):
    """Appearance of a surface, in the terms of glTF."""

    name: str = "clay"
    color: tuple[float, ...] = CLAY  # linear RGBA; multiplies the texture and the vertex colours
    metallic: float = 0.0
    roughness: float = 0.85
    texture: bytes | None = None  # a PNG or JPEG file
    alpha: str = "OPAQUE"  # glTF's alphaMode: alpha is ignored; MASK: cut out below one half; BLEND: translucent


class Part(NamedTuple):
    """Triangles of one material. A point is a vertex with one texture coordinate and one normal."""

    vertices: IntArray  # (P,) the vertex of each point
    triangles: IntArray  # (F, 3) indices of points
    material: Material
    texcoords: FloatArray | None = None  # (P, 2) origin at the upper left, as in glTF
    colors: FloatArray | None = None  # (P, 4) linear RGBA, or (P, 3)
    normals: FloatArray | None = None  # (P, 3) as the file has them


class Asset(ABC):
    """A mesh file: positions and triangles for the solve, the rest for writing it with other positions."""

    positions: FloatArray
    """In the file's units, transforms of a scene applied. *Shape:* ``(V, 3)``."""
    faces: IntArray
    """Polygons are triangulated. *Shape:* ``(F, 3)``."""
    carries: dict[str, str]
    """Further content of the file: some of :data:`FEATURES`, each with a description for messages."""
    keeps = frozenset(FEATURES) - {"posing"}
    """Features that :meth:`with_positions` keeps."""

    suffix: str
    """Ending of such a file, as ``".obj"``; it is GLB of a GLTF file, and VTP of a VTU file."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.carries = {}

    def _note(self, feature: str, name: str, there: object) -> None:
        """Add a feature to :attr:`carries`, if the file has it."""
        if there:
            self.carries[feature] = name

    @property
    def is_painted(self) -> bool:
        """True for a file with materials or vertex colours."""
        return bool({"materials", "colors"} & self.carries.keys())

    @abstractmethod
    def with_positions(self, positions: FloatArray) -> bytes:
        """The file with other positions ``(V, 3)``. Its normals rotate with the surface; everything else stays."""

    def parts(self) -> list[Part]:
        """The surface with its materials, for other formats."""
        return [Part(np.arange(len(self.positions)), self.faces, Material())]

    def polygons(self) -> tuple[IntArray, IntArray, FloatArray | None]:
        """Polygons for formats that hold them; triangles, if the file's polygons are not known.

        Returns:
            Number of corners of each; vertices of the corners, one polygon after the other; their texture coordinates,
            origin at the lower left, where all have them. *Shape:* ``(P,), (n,), (n, 2)``.
        """
        return np.full(len(self.faces), 3), self.faces.reshape(-1), None

    @property
    def companions(self) -> dict[str, bytes]:
        """Files that a copy needs in its folder, by their names there: material libraries, textures."""
        return {}

    def check(self, shapes: FloatArray, path: Path, holds: Collection[str]) -> None:
        """Check that shapes can be written to a file with this asset, and warn of its features that the file lacks.

        *Shape:* ``(N, V, 3)``. ``holds`` has the features that the file's format takes from assets of other formats.

        Raises:
            ValueError: Shapes do not have as many vertices as this mesh.
        """
        if shapes.shape[1] != len(self.positions):
            raise ValueError(
                f"{self.path} has {len(self.positions)} vertices, the frames have {shapes.shape[1]}; an asset takes "
                "frames of its own mesh"
            )
        holds = self.keeps if path.suffix.lower() == self.suffix else holds
        lost = [name for feature, name in self.carries.items() if feature not in holds]
        if lost:
            listed = ", ".join(lost[:-1]) + " and " * (len(lost) > 1) + lost[-1]
            warnings.warn(f"{path.name} is without the {listed} of {self.path.name}", MeshWarning, stacklevel=4)
