"""Material libraries of OBJ files (MTL) and the textures that they name."""

from __future__ import annotations

import re
import warnings
from pathlib import Path

from torch_modal.errors import MeshWarning
from torch_modal.io.asset import Material, as_png_or_jpeg

_OPTION = re.compile(r"-(?:[ost](?:\s+-?[\d.]+){1,3}|mm\s+\S+\s+\S+|\w+\s+\S+)\s+")
"""An option of a texture line with its values: those of coordinates have up to three numbers."""


def read_libraries(path: Path, names: list[str]) -> tuple[dict[str, Material], dict[str, bytes]]:
    """Read the material libraries that an OBJ file names.

    A copy has textures from outside the file's folder beside it, and the library names them there.

    Returns:
        The materials; the libraries and their textures, by their names beside a copy of the OBJ file.

    Warns:
        MeshWarning: A library or a texture is not there.
    """
    materials: dict[str, Material] = {}
    files: dict[str, bytes] = {}
    for line in names:
        # One name may hold blanks; blanks also separate several names.
        for name in [line] if (path.parent / line).is_file() else line.split():
            if (path.parent / name).is_file():
                files[_name_in_copy(name)] = _read_library(path.parent, name, materials, files)
            else:
                warnings.warn(f"{path.name} names the materials {name}, which are not there", MeshWarning, stacklevel=5)
    return materials, files


def _read_library(folder: Path, name: str, materials: dict[str, Material], files: dict[str, bytes]) -> bytes:
    """Add the materials and textures of a library; returns its content for a copy."""
    library = folder / name
    lines = library.read_bytes().decode("utf-8", errors="surrogateescape").splitlines()
    material = ""
    for number, line in enumerate(lines):
        key, *words = line.partition("#")[0].split() or [""]
        key = key.lower()
        if key == "newmtl":
            material = line.split(None, 1)[1].strip()
            materials[material] = Material(material, (0.8, 0.8, 0.8, 1.0))
        elif key.startswith("map_") or key in ("bump", "norm", "disp", "decal", "refl"):
            # The file stands after the options, and may hold blanks.
            written = "".join(line.strip().split(None, 1)[1:])
            while option := _OPTION.match(written):
                written = written[option.end() :]
            texture = written.replace("\\", "/")
            place = next((base / texture for base in (library.parent, folder) if (base / texture).is_file()), None)
            if place is None:
                if texture:
                    said = f"{library.name} names the texture {texture}, which is not there"
                    warnings.warn(said, MeshWarning, stacklevel=6)
                continue
            kept = _name_in_copy(texture)
            files[kept] = place.read_bytes()
            if kept != texture:
                lines[number] = line.rstrip().removesuffix(written) + kept
            if key == "map_kd" and material in materials:
                old = materials[material]
                # Exporters that paint by the texture alone leave black here, which would multiply it away.
                color = (1.0, 1.0, 1.0, old.color[3]) if not any(old.color[:3]) else old.color
                materials[material] = old._replace(texture=as_png_or_jpeg(files[kept]), color=color)
        elif material in materials:
            materials[material] = _with_property(materials[material], key, words)
    return ("\n".join(lines) + "\n").encode("utf-8", errors="surrogateescape")


def _with_property(material: Material, key: str, words: list[str]) -> Material:
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


def _name_in_copy(name: str) -> str:
    """Relative to the copy and inside of its folder."""
    place = Path(name)
    return place.name if place.is_absolute() or ".." in place.parts else place.as_posix()
