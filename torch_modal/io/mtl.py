"""Material libraries of OBJ files (MTL) and the textures that they name."""

from __future__ import annotations

import re
import warnings
from pathlib import Path
from typing import NamedTuple

from torch_modal.errors import MeshWarning
from torch_modal.io.asset import Material, as_image

_OPTION = re.compile(r"-(?:[ost](?:\s+-?[\d.]+){1,3}|mm\s+\S+\s+\S+|\w+\s+\S+)\s+")
"""An option of a texture line with its values: those of coordinates have up to three numbers."""


class Libraries(NamedTuple):
    """Materials and files of the material libraries of an OBJ file."""

    materials: dict[str, Material]
    files: dict[str, bytes]
    """Libraries and textures, by their names beside a copy of the OBJ file."""


def read_libraries(path: Path, names: list[str]) -> Libraries:
    """Read material libraries.

    A copy has textures from outside the file's folder beside it, and the library names them there.

    Args:
        path: The OBJ file.
        names: From its ``mtllib`` lines.

    Warns:
        MeshWarning: A library or a texture is not there.
    """
    found = Libraries({}, {})
    for line in names:
        # One name may hold blanks; blanks also separate several names.
        each = [line] if (path.parent / line).is_file() else line.split()
        for name in each:
            library = path.parent / name
            if library.is_file():
                _read_library(path, library, name, found)
            else:
                warnings.warn(f"{path.name} names the materials {name}, which are not there", MeshWarning, stacklevel=4)
    return found


def _read_library(path: Path, library: Path, name: str, found: Libraries) -> None:
    lines = library.read_bytes().decode("utf-8", errors="surrogateescape").splitlines()
    material = ""
    for number, line in enumerate(lines):
        words = line.partition("#")[0].split()
        if not words:
            continue
        key = words[0].lower()
        if key == "newmtl":
            material = line.split(None, 1)[1].strip()
            found.materials[material] = Material(material, (0.8, 0.8, 0.8, 1.0))
        elif key.startswith("map_") or key in ("bump", "norm", "disp", "decal", "refl"):
            lines[number] = _take_texture(path, library, line, key, material, found)
        elif material in found.materials:
            found.materials[material] = _property(found.materials[material], key, words[1:])
    found.files[_name_in_copy(name)] = ("\n".join(lines) + "\n").encode("utf-8", errors="surrogateescape")


def _property(material: Material, key: str, words: list[str]) -> Material:
    try:
        numbers = [float(word) for word in words]
    except ValueError:
        return material
    *rgb, alpha = material.color
    match key, numbers:
        case "kd", [r, g, b, *_]:
            return material._replace(color=(r, g, b, alpha))
        case (("d" | "tr"), [x, *_]):
            return material._replace(color=(*rgb, min(max(x if key == "d" else 1 - x, 0.0), 1.0)))
        case "ns", [x, *_]:  # of a Blinn-Phong exponent, the roughness whose highlight has the same width
            return material._replace(roughness=min(1.0, (2 / (max(x, 0.0) + 2)) ** 0.25))
        case "pr", [x, *_]:
            return material._replace(roughness=min(max(x, 0.0), 1.0))
        case "pm", [x, *_]:
            return material._replace(metallic=min(max(x, 0.0), 1.0))
    return material


def _take_texture(path: Path, library: Path, line: str, key: str, material: str, found: Libraries) -> str:
    """Record a texture; returns its line for a copy of the library."""
    name = _texture_name(line)
    if not name:
        return line
    texture = next((base / name for base in (library.parent, path.parent) if (base / name).is_file()), None)
    if texture is None:
        warnings.warn(f"{library.name} names the texture {name}, which is not there", MeshWarning, stacklevel=6)
        return line
    data = texture.read_bytes()
    kept = _name_in_copy(name)
    found.files[kept] = data
    if key == "map_kd" and material in found.materials:
        old = found.materials[material]
        # Exporters that paint by the texture alone leave black here, which would multiply it away.
        color = (1.0, 1.0, 1.0, old.color[3]) if not any(old.color[:3]) else old.color
        found.materials[material] = old._replace(texture=as_image(data), color=color)
    return line if kept == name else line[: line.rindex(name)] + kept


def _texture_name(line: str) -> str:
    """The file that a texture line names, after its options; it may hold blanks."""
    text = "".join(line.strip().split(None, 1)[1:])
    while option := _OPTION.match(text):
        text = text[option.end() :]
    return text.replace("\\", "/").strip()


def _name_in_copy(name: str) -> str:
    """Relative to the copy and inside of its folder."""
    place = Path(name)
    return place.name if place.is_absolute() or ".." in place.parts else place.as_posix()
