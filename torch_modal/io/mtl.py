"""Material libraries of OBJ files (MTL) and the textures that they name."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import NamedTuple

from torch_modal.errors import MeshWarning
from torch_modal.io.asset import Material, as_image

# Options of a texture line, with the number of words that follow; up to three for those of coordinates.
_OPTIONS = {"-blendu": 1, "-blendv": 1, "-boost": 1, "-mm": 2, "-o": 3, "-s": 3, "-t": 3, "-texres": 1, "-clamp": 1}
_OPTIONS |= {"-bm": 1, "-imfchan": 1, "-type": 1, "-cc": 1, "-colorspace": 1}


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
    if key == "kd" and len(numbers) >= 3:
        return material._replace(color=(*numbers[:3], material.color[3]))
    if key in ("d", "tr") and numbers:
        opacity = numbers[0] if key == "d" else 1 - numbers[0]
        return material._replace(color=(*material.color[:3], min(max(opacity, 0.0), 1.0)))
    if key == "ns" and numbers:
        # Of a Blinn-Phong exponent, the roughness whose highlight has the same width.
        return material._replace(roughness=min(1.0, (2 / (max(numbers[0], 0.0) + 2)) ** 0.25))
    if key in ("pr", "pm") and numbers:
        value = min(max(numbers[0], 0.0), 1.0)
        return material._replace(roughness=value) if key == "pr" else material._replace(metallic=value)
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
    rest = line.strip().split(None, 1)[1:]
    text = rest[0] if rest else ""
    while text.startswith("-"):
        option, _, text = text.partition(" ")
        for _ in range(_OPTIONS.get(option, 1)):
            word, _, after = text.lstrip().partition(" ")
            if option in ("-o", "-s", "-t") and not word.replace(".", "").lstrip("-").isdigit():
                break  # one or two numbers are enough for these
            text = after
        text = text.lstrip()
    return text.replace("\\", "/").strip()


def _name_in_copy(name: str) -> str:
    """Relative to the copy and inside of its folder."""
    place = Path(name)
    return place.name if place.is_absolute() or ".." in place.parts else place.as_posix()
