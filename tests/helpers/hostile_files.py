"""Crafted mesh files, each read and written again, in a process that runs ``python -m helpers.hostile_files FOLDER``.

Prints a line of JSON for each: what came of it, seconds, megabytes of memory beyond those of the package, and the files
that were opened outside of the mesh's folder. A file of another's stands beside that folder.
"""

import contextlib
import json
import os
import resource
import signal
import struct
import sys
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from torch_modal.io.mtl import LARGEST_LIBRARY

SECRET = b"\x89PNG of another's " * 40
TRIANGLE = "v 0 0 0\nv 1 0 0\nv 0 1 0\n"
MOST = 10**12
LONG = "n" * 5000
Craft = Callable[[Path], Path]


def gltf(
    *places: tuple[str, ...], image: str | None = "x.png", buffer: str = "mesh.bin", numbers: Any = None, **new: Any
) -> Craft:
    """A textured triangle; some of its JSON replaced, named by keys and indices with the value last."""
    points = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], "<f4") if numbers is None else numbers
    data = points.tobytes() + np.array([0, 1, 2, 0], "<u2").tobytes() + np.zeros((3, 2), "<f4").tobytes()
    root: dict[str, Any] = {
        "asset": {"version": "2.0"},
        "buffers": [{"byteLength": len(data), "uri": buffer}],
        "bufferViews": [
            {"buffer": 0, "byteLength": 36},
            {"buffer": 0, "byteOffset": 36, "byteLength": 8},
            {"buffer": 0, "byteOffset": 44, "byteLength": 24},
        ],
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3"},
            {"bufferView": 1, "componentType": 5123, "count": 3, "type": "SCALAR"},
            {"bufferView": 2, "componentType": 5126, "count": 3, "type": "VEC2", "min": [0, 0], "max": [0, 0]},
        ],
        "images": [{"uri": image}],
        "textures": [{"source": 0}],
        "materials": [{"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}],
        "meshes": [
            {"primitives": [{"attributes": {"POSITION": 0, "TEXCOORD_0": 2}, "indices": 1, "material": 0}]},
        ],
        "nodes": [{"mesh": 0}],
    }
    for *keys, last, value in places:
        part: Any = root
        for key in keys:
            part = part[key]
        part[last] = value
    root |= new

    def craft(folder: Path) -> Path:
        if not os.path.lexists(folder / "mesh.bin") and buffer == "mesh.bin":
            (folder / "mesh.bin").write_bytes(data)
        if not os.path.lexists(folder / "x.png"):
            (folder / "x.png").write_bytes(b"\x89PNG")
        path = folder / "a.gltf"
        path.write_text(json.dumps(root).replace('"FOLDER', f'"{folder}'))
        return path

    return craft


def ply(header: str, data: bytes = b"", order: str = "binary_little_endian") -> Craft:
    """A PLY file of a header and numbers."""

    def craft(folder: Path) -> Path:
        path = folder / "a.ply"
        path.write_bytes(f"ply\nformat {order} 1.0\n{header}end_header\n".encode() + data)
        return path

    return craft


def obj(mtl: str = "", library: str = "x.mtl") -> Craft:
    """A textured triangle with a material library of this text, if any, named by this line."""

    def craft(folder: Path) -> Path:
        if mtl:
            (folder / "x.mtl").write_text(mtl.replace("FOLDER", str(folder)))
        path = folder / "a.obj"
        library_line = f"mtllib {library}\n".replace("FOLDER", str(folder))
        path.write_text(library_line + TRIANGLE + "vt 0 0\nusemtl m\nf 1/1 2/1 3/1\n")
        return path

    return craft


def text(name: str, content: str) -> Craft:
    """A file of this text."""

    def craft(folder: Path) -> Path:
        (folder / name).write_text(content)
        return folder / name

    return craft


def beside(name: str, make: Callable[[Path], object], craft: Craft) -> Craft:
    """Make something of this name in the folder first."""

    def both(folder: Path) -> Path:
        make(folder / name)
        return craft(folder)

    return both


def endless(path: Path) -> None:
    path.symlink_to("/dev/zero")


def outside(path: Path) -> None:
    path.symlink_to("../secret.png")


def loop(path: Path) -> None:
    path.symlink_to(path.name)


def huge(path: Path) -> None:
    """A terabyte that takes no room on the disk."""
    with path.open("wb") as file:
        file.truncate(2**40)


XYZ = "property float x\nproperty float y\nproperty float z\n"
FACES = "property list uchar int vertex_indices\n"
SMALL = np.eye(3, dtype="<f4").tobytes() + struct.pack("<B3i", 3, 0, 1, 2)
SMALL_PLY = f"element vertex 3\n{XYZ}element face 1\n{FACES}"
UV_PLY = f"comment TextureFile x.png\nelement vertex 3\n{XYZ}element face 1\n{FACES}"
KINDS: dict[str, Callable[[Path], object]] = {"fifo": os.mkfifo, "endless": endless, "outside": outside}
KINDS |= {"loop": loop, "huge": huge, "folder": Path.mkdir}
PLACES = {"above": "../secret.png", "absolute": "FOLDER/../secret.png", "long": LONG, "zero": "a\0b", "missing": "no"}
PRIMITIVE = ("meshes", 0, "primitives", 0)

CASES: dict[str, Craft] = {
    "ply: further elements": ply(f"element cell {MOST}\nproperty int i\n{SMALL_PLY}", SMALL),
    "ply: further elements in text": ply(f"element cell {MOST}\nproperty int i\n{SMALL_PLY}", b"1\n2\n", "ascii"),
    "ply: lists": ply(f"element cell {MOST}\nproperty list uchar int i\n{SMALL_PLY}", SMALL),
    "ply: no properties": ply(f"element cell {MOST}\n{SMALL_PLY}", SMALL),
    "ply: vertices": ply(f"element vertex {MOST}\n{XYZ}element face 1\n{FACES}", SMALL),
    "ply: some more vertices": ply(f"element vertex {10**9}\n{XYZ}element face 1\n{FACES}", SMALL),
    "ply: vertices in text": ply(f"element vertex {MOST}\n{XYZ}element face 1\n{FACES}", b"0 0 0\n3 0 0 0\n", "ascii"),
    "ply: faces": ply(f"element vertex 3\n{XYZ}element face {MOST}\n{FACES}", SMALL),
    "ply: faces in text": ply(f"element vertex 3\n{XYZ}element face {MOST}\n{FACES}", b"0 0 0\n" * 3, "ascii"),
    "ply: below zero": ply(f"element cell -1\nproperty int i\n{SMALL_PLY}", SMALL),
    "ply: ends of headers": text("a.ply", "ply\n" + "end_header " * 100_000),
    "ply: corners": ply(
        f"element vertex 3\n{XYZ}element face 1\nproperty list uint int vertex_indices\n",
        SMALL[:36] + struct.pack("<I3i", 2**31 - 1, 0, 1, 2),
    ),
    "off: vertices": text("a.off", f"OFF\n{MOST} 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n"),
    "off: faces": text("a.off", f"OFF\n3 {MOST} 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n"),
    "gltf: zeros": gltf(("accessors", 0, {"componentType": 5126, "count": 2 * 10**8, "type": "VEC3"})),
    "gltf: zero indices": gltf(("accessors", 1, {"componentType": 5125, "count": 2 * 10**9, "type": "SCALAR"})),
    "gltf: count": gltf(("accessors", 0, "count", MOST)),
    "gltf: sparse count": gltf(
        ("accessors", 0, "sparse", {"count": 10**8, "indices": {"componentType": 5125}, "values": {}})
    ),
    "gltf: buffer": gltf(("buffers", 0, "byteLength", MOST), ("bufferViews", 0, "byteLength", MOST)),
    "gltf: NaN": gltf(("materials", 0, "pbrMetallicRoughness", "baseColorFactor", [float("nan")] * 4)),
    "gltf: infinite": gltf(("nodes", 0, "translation", [float("inf"), 0, 0])),
    "gltf: NaN in a buffer": gltf(numbers=np.array([[0, 0, np.nan], [1, 0, 0], [0, 1, 0]], "<f4")),
    "gltf: attribute": gltf((*PRIMITIVE, "attributes", "TEXCOORD_0", 99)),
    "gltf: attributes": gltf(("accessors", 2, "count", 2)),
    "gltf: indices": gltf((*PRIMITIVE, "indices", 99)),
    "gltf: stride": gltf(("bufferViews", 0, "byteStride", 4)),
    "gltf: view of no buffer": gltf(("bufferViews", 0, "buffer", 99)),
    "gltf: mesh": gltf(("nodes", 0, "mesh", 99)),
    "gltf: image, without data": gltf(("images", 0, {})),
    "gltf: another's vertices": gltf(
        ("accessors", 2, {"bufferView": 1, "componentType": 5123, "count": 3, "type": "SCALAR"}),
        ("accessors", 1, {"bufferView": 0, "componentType": 5126, "count": 2, "type": "VEC3"}),
        ("meshes", [{"primitives": [{"attributes": {"POSITION": 1}, "indices": 2}, {"attributes": {"POSITION": 0}}]}]),
    ),
    "obj: newmtl alone": obj("newmtl\nKd 1 0 0\n"),
    "obj: NaN": obj("newmtl m\nKd nan inf 1\nd nan\nNs nan\nPr nan\nPm inf\n"),
    "obj: options": obj("newmtl m\nmap_Kd " + "-o 1 " * 100_000 + "x.png\n"),
    "obj: materials": text("a.obj", TRIANGLE + "".join(f"usemtl {n}\nf 1 2 3\n" for n in range(5_000))),
    "obj: no picture": beside("x.png", lambda path: path.write_bytes(b"text"), obj("newmtl m\nmap_Kd x.png\n")),
    "obj: library of a loop": beside("y", loop, obj(library="y")),
    "mesh of a loop": lambda folder: (loop(folder / "a.obj"), folder / "a.obj")[1],
    "mesh of a long name": lambda folder: folder / f"{LONG}.obj",
    "mesh that is a fifo": lambda folder: (os.mkfifo(folder / "a.obj"), folder / "a.obj")[1],
}
for kind, make in KINDS.items():
    CASES[f"ply: texture, {kind}"] = beside("x.png", make, ply(UV_PLY, SMALL))
    CASES[f"gltf: image, {kind}"] = beside("x.png", make, gltf())
    CASES[f"gltf: buffer, {kind}"] = beside("mesh.bin", make, gltf(("buffers", 0, "byteLength", MOST)))
    CASES[f"obj: texture, {kind}"] = beside("x.png", make, obj("newmtl m\nmap_Kd x.png\n"))
    CASES[f"obj: library, {kind}"] = beside("y.mtl", make, obj(library="y.mtl"))
for kind, place in PLACES.items():
    if kind != "zero":
        CASES[f"ply: texture, {kind}"] = ply(UV_PLY.replace("x.png", place), SMALL)
    CASES[f"gltf: image, {kind}"] = gltf(image=place)
    CASES[f"gltf: buffer, {kind}"] = gltf(buffer=place)
    CASES[f"obj: texture, {kind}"] = obj(f"newmtl m\nmap_Kd {place}\nbump {place}\n")
    CASES[f"obj: library, {kind}"] = obj(library=place)

CASES["obj: library, too large"] = beside(
    "y.mtl", lambda path: path.write_bytes(bytes(LARGEST_LIBRARY + 1)), obj(library="y.mtl")
)

RIGHT = {name for name in CASES if name.startswith(("obj: ", "ply: texture", "gltf: image, "))}
"""The mesh is there, though some of its appearance is not."""


def read_and_write(path: Path, out: Path) -> str:
    """Read a file, and write it as its own format and as GLB."""
    import torch_modal as tm
    from torch_modal.io.points import PointFile

    try:
        asset = tm.open_asset(path)
        tm.save_mesh(asset.positions, asset.faces, out / f"b{asset.suffix}", asset=asset)
        tm.save_mesh(asset.positions, asset.faces, out / "c.glb", asset=asset)
        if path.suffix == ".ply":
            still = np.tile(np.eye(3), (len(asset.positions), 1, 1))
            PointFile(path).move(asset.positions, still, still)
    except (ValueError, FileNotFoundError) as error:
        if path.suffix == ".ply":
            with contextlib.suppress(ValueError):
                PointFile(path)
        return f"error: {type(error).__name__}: {error}"
    return "right"


def run(name: str, folder: Path) -> None:
    """One case, whose numbers are printed."""
    inside = folder / "mesh"
    inside.mkdir(parents=True)
    (folder / "secret.png").write_bytes(SECRET)
    path, opened = CASES[name](inside), set()

    def watch(event: str, arguments: tuple[Any, ...]) -> None:
        if event == "open" and isinstance(arguments[0], str | Path):
            place = os.path.realpath(arguments[0])
            there = place.startswith(str(folder.resolve())) or place.startswith("/dev/z")
            if there and not place.startswith((str(inside.resolve()), str(folder.resolve() / "out"))):
                opened.add(place)

    sys.addaudithook(watch)
    signal.alarm(20)
    limit = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize() + 8 * 2**30
    resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
    before, started = resource.getrusage(resource.RUSAGE_SELF), time.process_time()
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        result = read_and_write(path, folder / "out")
    found = {
        "name": name,
        "result": result,
        "warnings": [str(warning.message) for warning in said],
        "seconds": time.process_time() - started,
        "megabytes": (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before.ru_maxrss) / 1024,
        "opened": sorted(opened),
        "embedded": [file.name for file in folder.glob("out/**/*") if file.is_file() and SECRET in file.read_bytes()],
    }
    print(json.dumps(found), flush=True)


def main(folder: Path) -> None:
    """All cases, one after the other, each in a fork of this process, which has the package."""
    read_and_write(text("a.off", "OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n")(folder), folder / "first")
    read_and_write(obj()(folder), folder / "second")
    for number, name in enumerate(CASES):
        child = os.fork()
        if not child:
            try:
                run(name, folder / str(number))
            except BaseException as error:
                print(json.dumps({"name": name, "result": f"{type(error).__name__}: {error}"[:300]}), flush=True)
            os._exit(0)
        _, status = os.waitpid(child, 0)
        if status:
            print(json.dumps({"name": name, "result": f"signal {os.WTERMSIG(status)}"}), flush=True)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
