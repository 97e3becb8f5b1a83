"""Material libraries of OBJ files (MTL) and the textures that they name."""

import math
import os
import posixpath
import re
import warnings
from collections.abc import Callable
from functools import cache, partial
from pathlib import Path

from torch_modal.errors import MeshWarning
from torch_modal.io.asset import Material, as_png_or_jpeg
from torch_modal.io.files import try_companion

_OPTIONS = re.compile(r"(?:-(?:[ost](?:\s+-?[\d.]+){1,3}|mm\s+\S+\s+\S+|\w+\s+\S+)\s+)*")
"""Options of a texture line with their values: options of coordinates have up to three numbers."""
LARGEST_LIBRARY = 2**24  # bytes
Read = Callable[..., tuple[str, bytes] | None]


def read_libraries(path: Path, lines: list[str]) -> tuple[dict[str, Material], dict[str, bytes]]:
    """Read the material libraries that lines of an OBJ file name; warn of libraries and textures that are not read.

    Returns the materials; the libraries and their textures, by their paths below the folder of the file or of a copy.
    """
    materials: dict[str, Material] = {}
    files: dict[str, bytes] = {}
    read = cache(partial(try_companion, path))  # materials share textures
    for line in lines:
        # One name may contain blanks; blanks also separate several names.
        for name in [line] if os.path.isfile(path.parent / line) else line.split():
            if companion := read(name, "a material library", LARGEST_LIBRARY):
                files |= [companion]
                _read_library(path, *companion, read, materials, files)
    return materials, files


def _read_library(
    path: Path, library: str, data: bytes, read: Read, materials: dict[str, Material], files: dict[str, bytes]
) -> None:
    """Add the materials and textures of a library to the results."""
    folder = posixpath.dirname(library)
    material = ""
    for line in re.split(r"\r\n|\n|\r", data.decode("utf-8", errors="surrogateescape")):
        key, *words = line.partition("#")[0].split() or [""]
        key = key.lower()
        if key == "newmtl":
            material = line.strip()[len(key) :].strip()
            materials[material] = Material(material, (0.8, 0.8, 0.8, 1.0))
        elif words and (key.startswith("map_") or key in ("bump", "norm", "disp", "decal", "refl")):
            # The file name follows the options, and may contain blanks.
            texture = _OPTIONS.sub("", line.strip().split(None, 1)[1], count=1).replace("\\", "/")
            base = folder if os.path.isfile(path.parent / folder / texture) else ""
            if not (companion := read(posixpath.join(base, texture), f"a texture of {library}")):
                continue
            files |= [companion]
            if key == "map_kd" and material in materials:
                old = materials[material]
                # Exporters that paint by the texture alone leave black here, which would multiply it away.
                color = (1.0, 1.0, 1.0, old.color[3]) if not any(old.color[:3]) else old.color
                image = as_png_or_jpeg(companion[1])
                if image is None:
                    message = f"{path.name} is without a texture: {companion[0]} is no picture"
                    warnings.warn(message, MeshWarning, stacklevel=6)
                materials[material] = old._replace(texture=image, color=color)
        elif material in materials:
            materials[material] = _with_property(materials[material], key, words)


def _with_property(material: Material, key: str, words: list[str]) -> Material:
    try:
        numbers = [number for number in map(float, words) if math.isfinite(number)]
    except ValueError:
        return material
    *rgb, alpha = material.color
    match key, numbers:
        case "kd", [r, g, b, *_]:
            return material._replace(color=(r, g, b, alpha))
        case (("d" | "tr"), [x, *_]):
            alpha = min(max(x if key == "d" else 1 - x, 0.0), 1.0)
            return material._replace(color=(*rgb, alpha), alpha="BLEND" if alpha < 1 else "OPAQUE")
        case "ns", [x, *_]:  # of a Blinn-Phong exponent, the roughness whose highlight has the same width
            return material._replace(roughness=min(1.0, (2 / (max(x, 0.0) + 2)) ** 0.25))
        case "pr", [x, *_]:
            return material._replace(roughness=min(max(x, 0.0), 1.0))
        case "pm", [x, *_]:
            return material._replace(metallic=min(max(x, 0.0), 1.0))
    return material
