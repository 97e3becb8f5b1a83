"""What a mesh file carries comes back with other positions; read by trimesh and pygltflib, or by hand."""

import io
import json
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pygltflib
import pytest
import torch
import trimesh
from helpers import gltf_validator
from helpers.textured import BLUE, RED, bend, png, textured_glb, textured_obj, triangles_of_tube, tube
from PIL import Image
from scipy.spatial.transform import Rotation

import torch_modal as tm
from torch_modal.errors import MeshError, MeshWarning
from torch_modal.io.asset import Asset, as_png_or_jpeg
from torch_modal.io.gltf import Document
from torch_modal.io.obj import ObjAsset

TURN = Rotation.from_rotvec([0.4, -1.1, 0.7]).as_matrix()


def write(asset: Asset, path: Path, positions: Any, overwrite: bool = False) -> Path:
    return tm.save_mesh(positions, asset.faces, path, overwrite=overwrite, asset=asset)[0]


def lines_of(path: Path) -> list[str]:
    return path.read_text().splitlines()


def corners(path: Path) -> list[list[tuple[tuple[float, ...], ...]]]:
    """What each corner of each face of an OBJ names: texture coordinate and normal, as numbers."""
    vt, vn, faces = [], [], []
    for line in lines_of(path):
        for kind, found in (("vt ", vt), ("vn ", vn)):
            if line.startswith(kind):
                found.append(tuple(map(float, line.split()[1:])))
        if line.startswith("f "):
            words = [list(map(int, word.split("/"))) for word in line.split()[1:]]
            faces.append([(v, vt[t - 1], vn[n - 1]) for v, t, n in words])
    return faces


# --------------------------------------------------------------------------------------------------------------- OBJ
def test_obj_keeps_everything_but_positions(tmp_path):
    source = textured_obj(tmp_path / "in", "bar.obj")
    asset = tm.open_asset(source)
    assert isinstance(asset, ObjAsset)
    keyframes, faces = tm.load_keyframes([source])
    np.testing.assert_array_equal(asset.positions, keyframes[0])
    np.testing.assert_array_equal(asset.faces, faces)
    assert set(asset.carries) == {"polygons", "texcoords", "normals", "colors", "materials", "groups"}
    assert asset.carries["polygons"] == "quads" and asset.carries["materials"] == "2 materials"

    moved = bend(asset.positions)
    out = write(asset, tmp_path / "new" / "moved.obj", moved)
    before, after = lines_of(source), [line for line in lines_of(out) if line != "#"]
    others = [[x for x in text if not x.startswith(("v ", "vn ", "f "))] for text in (before, after)]
    assert others[0] == others[1]
    v_lines = [line for line in after if line.startswith("v ")]
    np.testing.assert_allclose([[float(word) for word in line.split()[1:4]] for line in v_lines], moved, rtol=1e-8)
    assert all(line.endswith(" 0.5 0.25 1.0") for line in v_lines)
    for old, new in zip(corners(source), corners(out), strict=True):
        assert [(v, t) for v, t, _ in old] == [(v, t) for v, t, _ in new]


def test_obj_comes_back_the_same_with_its_own_positions(tmp_path):
    source = textured_obj(tmp_path, "bar.obj")
    asset = tm.open_asset(source)
    again = write(asset, tmp_path / "again.obj", asset.positions)
    assert corners(source) == corners(again)  # normals bit for bit, though each vertex has its own now
    plain = tmp_path / "plain.obj"
    plain.write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nvn 0 0 1\nvn 1 0 0\nvn 0 1 0\nvn 0 0 -1\n# end\n"
                     "f 1//1 2//2 3//3\nf 1//1 3//3 -1//-1\n")  # fmt: skip
    asset = tm.open_asset(plain)
    assert lines_of(write(asset, tmp_path / "b.obj", asset.positions))[8:] == lines_of(plain)[8:]


def test_obj_normals_turn_with_the_surface(tmp_path):
    asset = tm.open_asset(textured_obj(tmp_path, "bar.obj"))
    out = write(asset, tmp_path / "turned.obj", torch.tensor(asset.positions @ TURN.T))
    for old, new in zip(corners(tmp_path / "bar.obj"), corners(out), strict=True):
        wanted = np.array([n for _, _, n in old]) @ TURN.T
        np.testing.assert_allclose([n for _, _, n in new], wanted, atol=1e-12)


def files_of(folder: Path) -> set[str]:
    return {path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file()}


def test_what_an_obj_names_below_its_folder_keeps_its_place_in_a_copy(tmp_path):
    """Libraries and textures of one file name in two folders, absolute names, names relative to the OBJ file."""
    source = textured_obj(tmp_path / "in", "bar.obj")
    for place, color in (("skins/a.png", RED), ("caps/a.png", BLUE), ("a.png", BLUE)):
        (tmp_path / "in" / place).parent.mkdir(exist_ok=True)
        (tmp_path / "in" / place).write_bytes(png(color))
    (tmp_path / "in" / "skins" / "x.mtl").write_bytes(b"newmtl skin\r\nmap_Kd a.png\r\nbump ../a.png\r\n")
    caps = f"newmtl cap\nmap_Kd -s 1 1 1 {tmp_path}/in/caps/a.png\nbump blue.png"
    (tmp_path / "in" / "caps" / "x.mtl").write_text(caps)
    source.write_text(source.read_text().replace("mtllib my bar.mtl", "mtllib skins/x.mtl caps/x.mtl"))
    asset = tm.open_asset(source)
    out = write(asset, tmp_path / "out" / "b.obj", asset.positions)
    wanted = {"skins/x.mtl", "caps/x.mtl", "skins/a.png", "caps/a.png", "a.png", "blue.png"}
    assert files_of(out.parent) == {"b.obj", *wanted}
    for name in wanted:
        assert (out.parent / name).read_bytes() == (source.parent / name).read_bytes()
    for part, color in zip(asset.parts(), (RED, BLUE), strict=True):
        assert Image.open(io.BytesIO(part.material.texture)).getpixel((4, 4)) == color


def test_a_copy_does_not_take_the_name_of_a_texture(tmp_path):
    source = textured_obj(tmp_path / "in", "bar.obj")
    (tmp_path / "in" / "frame-000.obj").write_bytes(png(BLUE))
    (tmp_path / "in" / "my bar.mtl").write_text("newmtl cap\nmap_Kd frame-000.obj\n")
    asset = tm.open_asset(source)
    for out in ("out", "in"):
        with pytest.raises(ValueError, match=r"frame-000\.obj is the name of a texture or library of bar\.obj"):
            tm.save_mesh(asset.positions[None], asset.faces, tmp_path / out, asset=asset, overwrite=True)
    assert (tmp_path / "in" / "frame-000.obj").read_bytes() == png(BLUE) and not (tmp_path / "out").exists()


def test_companions_are_not_overwritten_unasked(tmp_path):
    asset = tm.open_asset(textured_obj(tmp_path / "in", "bar.obj"))
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "blue.png").write_text("mine")
    with pytest.raises(FileExistsError, match=r"blue\.png exists"):
        write(asset, tmp_path / "out" / "a.obj", asset.positions)
    assert [p.name for p in (tmp_path / "out").iterdir()] == ["blue.png"]
    write(asset, tmp_path / "out" / "a.obj", asset.positions, overwrite=True)
    write(asset, tmp_path / "out" / "b.obj", asset.positions)  # the same content is no obstacle


@pytest.mark.parametrize(
    ("lines", "wanted"),
    [
        ("Kd 0.1 0.2 0.3\nd 0.25", {"color": (0.1, 0.2, 0.3, 0.25)}),
        ("Kd 0.1 0.2 0.3\nTr 0.25", {"color": (0.1, 0.2, 0.3, 0.75)}),
        ("d -3", {"color": (0.8, 0.8, 0.8, 0.0)}),
        ("Tr -3", {"color": (0.8, 0.8, 0.8, 1.0)}),
        ("Ns 30", {"roughness": 0.5}),  # (2 / 32) ** (1 / 4)
        ("Ns -1", {"roughness": 1.0}),
        ("Pr 0.3\nPm 7", {"roughness": 0.3, "metallic": 1.0}),
        ("Kd nan 0 0\nd nan\nNs inf\nPr -inf\nPm nan\nKd x y z", {"color": (0.8, 0.8, 0.8, 1.0), "roughness": 0.85}),
        ("map_Kd red.png\nKd 0 0 0", {"color": (0.0, 0.0, 0.0, 1.0)}),
        (
            "Kd 0 0 0\nd 0.5\nmap_Kd -clamp on -o 1 2 -mm 0 1 red.png",
            {"color": (1.0, 1.0, 1.0, 0.5), "texture": png(RED)},
        ),
    ],
)
def test_lines_of_a_material(tmp_path, lines, wanted):
    source = textured_obj(tmp_path, "bar.obj")
    (tmp_path / "red.png").write_bytes(png(RED))
    (tmp_path / "my bar.mtl").write_text(f"newmtl skin\n{lines}\n")
    material = tm.open_asset(source).parts()[0].material
    for name, value in wanted.items():
        assert getattr(material, name) == (value if name == "texture" else pytest.approx(value))


# --------------------------------------------------------------------------------------------------------- PLY, OFF
@pytest.mark.parametrize("order", ["ascii", "binary_little_endian", "binary_big_endian"])
def test_ply_keeps_its_further_properties(tmp_path, order):
    rng = np.random.default_rng(0)
    x, faces = triangles_of_tube()
    end = ">" if "big" in order else "<"
    types = {"x": "f4", "quality": "f8", "y": "f4", "z": "f4", "nx": "f4", "ny": "f4", "nz": "f4"}
    types |= {"red": "u1", "green": "u1", "blue": "u1", "alpha": "u1", "part": "i4"}
    rows = np.zeros(len(x), [(name, end + kind) for name, kind in types.items()])
    normals = trimesh.Trimesh(x, faces, process=False).vertex_normals
    for name, column in zip(("x", "y", "z", "nx", "ny", "nz"), [*x.T, *normals.T], strict=True):
        rows[name] = column
    rows["quality"] = rng.normal(size=len(x))
    for name in ("red", "green", "blue", "alpha", "part"):
        rows[name] = rng.integers(0, 256, len(x))
    cells = np.zeros(len(faces), [("n", "u1"), ("f", end + "i4", 3), ("heat", end + "f4")])
    cells["n"], cells["f"], cells["heat"] = 3, faces, rng.normal(size=len(faces))
    names = {"f4": "float", "f8": "double", "u1": "uchar", "i4": "int"}
    header = f"ply\nformat {order} 1.0\ncomment made by hand\n"
    header += f"element vertex {len(x)}\n" + "".join(f"property {names[kind]} {n}\n" for n, kind in types.items())
    header += f"element face {len(faces)}\nproperty list uchar int vertex_indices\nproperty float heat\n"
    header += "element camera 1\nproperty list uchar float lens\nend_header\n"
    if order == "ascii":
        text = [" ".join(map(str, row)) for row in rows.tolist()]
        text += [f"{n} {a} {b} {c} {heat}" for n, (a, b, c), heat in cells.tolist()] + ["2 0.5 35.0"]
        data = ("\n".join(text) + "\n").encode()
    else:
        data = rows.tobytes() + cells.tobytes() + b"\x02" + np.array([0.5, 35], end + "f4").tobytes()
    source = tmp_path / "bar.ply"
    source.write_bytes(header.encode() + data)

    asset = tm.open_asset(source)
    assert set(asset.carries) == {"normals", "colors", "properties"}
    assert asset.carries["properties"] == "properties heat, part, quality, camera"
    moved = bend(asset.positions) @ TURN.T
    out = write(asset, tmp_path / "out.ply", moved)
    assert out.read_bytes().startswith(header.encode())
    read = trimesh.load_mesh(out, process=False, maintain_order=True)
    np.testing.assert_array_equal(read.vertices, moved.astype("f4"))
    np.testing.assert_array_equal(read.faces, faces)
    for old, new in zip(*(raw_ply(path) for path in (source, out)), strict=True):
        for name in old.dtype.names:
            if name not in ("x", "y", "z", "nx", "ny", "nz"):
                np.testing.assert_array_equal(old[name], new[name])
    if order == "ascii":
        assert out.read_text().splitlines()[-1] == "2 0.5 35.0"
    true = trimesh.Trimesh(moved, faces, process=False).vertex_normals
    turned = np.stack([raw_ply(out)[0][name] for name in ("nx", "ny", "nz")], axis=1)
    assert np.degrees(np.arccos(np.clip((turned * true).sum(axis=1), -1, 1))).max() < 5
    # With its own positions, all is as it was.
    again = write(asset, tmp_path / "again.ply", asset.positions)
    for old, new in zip(*(raw_ply(path) for path in (source, again)), strict=True):
        np.testing.assert_array_equal(old.astype(new.dtype), new)


def raw_ply(path: Path) -> list[np.ndarray]:
    """Vertices and faces with all their properties, as trimesh parsed them."""
    raw = trimesh.load_mesh(path, process=False).metadata["_ply_raw"]
    vertex, face = raw["vertex"]["data"], raw["face"]["data"]
    if isinstance(vertex, dict):
        vertex = np.rec.fromarrays([np.squeeze(v) for v in vertex.values()], names=list(vertex))
    heat = face["heat"]
    return [vertex, np.rec.fromarrays([np.squeeze(heat)], names=["heat"])]


def test_ply_quads_and_texture_stay(tmp_path):
    x, quads, angle = tube()
    (tmp_path / "skin.png").write_bytes(png(RED))
    uv = np.column_stack([np.append(np.tile(angle / 7, 8), [0, 0]), x[:, 2] / 7])
    text = "ply\nformat ascii 1.0\ncomment TextureFile skin.png\n" + f"element vertex {len(x)}\n"
    text += "".join(f"property double {n}\n" for n in "xyzst") + f"element face {len(quads)}\n"
    text += "property list uchar int vertex_indices\nend_header\n"
    text += "".join(" ".join(map(repr, row)) + "\n" for row in np.column_stack([x, uv]).tolist())
    text += "".join("4 " + " ".join(map(str, quad)) + "\n" for quad in quads.tolist())
    (tmp_path / "a.ply").write_text(text)
    asset = tm.open_asset(tmp_path / "a.ply")
    assert asset.carries == {"polygons": "polygons", "texcoords": "texture coordinates", "materials": "texture"}
    out = write(asset, tmp_path / "new" / "b.ply", bend(x))
    old, new = text.splitlines(), out.read_text().splitlines()
    assert old[-len(quads) :] == new[-len(quads) :] and (out.parent / "skin.png").read_bytes() == png(RED)
    rows = np.array([line.split() for line in new[old.index("end_header") + 1 :][: len(x)]], dtype=float)
    np.testing.assert_array_equal(rows, np.column_stack([bend(x), uv]))  # double: exact
    glb = tm.save_animation(bend(x)[None], asset.faces, tmp_path / "b.glb", asset=asset)
    mesh = next(iter(trimesh.load(glb, process=False).geometry.values()))
    np.testing.assert_allclose(mesh.visual.uv, uv, atol=1e-6)
    assert mesh.visual.material.baseColorTexture.convert("RGB").getpixel((4, 4)) == RED


def test_off_keeps_the_triangles_alone(tmp_path):
    x, quads, _ = tube()
    lines = ["COFF # by hand", f"{len(x)} {len(quads)} 0"]
    lines += [f"{a!r} {b!r} {c!r} {i % 256} 20 30 255" for i, (a, b, c) in enumerate(x.tolist())]
    lines += ["4 " + " ".join(map(str, quad)) + " 255 0 0" for quad in quads.tolist()]
    (tmp_path / "a.off").write_text("\n".join(lines) + "\n")
    asset = tm.open_asset(tmp_path / "a.off")
    with pytest.warns(MeshWarning, match=r"without the polygons of a\.off"):
        (out,) = tm.save_mesh(bend(x)[None], asset.faces, tmp_path / "out", asset=asset)
    again = tm.open_asset(out)
    np.testing.assert_array_equal(again.positions, bend(x))
    np.testing.assert_array_equal(again.faces, asset.faces)
    assert not again.carries


# --------------------------------------------------------------------------------------------------------------- GLB
def test_glb_keeps_materials_textures_nodes_and_coordinates(tmp_path):
    source = textured_glb(tmp_path / "in.glb")
    asset = tm.open_asset(source)
    keyframes, _ = tm.load_keyframes([source])
    np.testing.assert_array_equal(asset.positions, keyframes[0])
    assert set(asset.carries) == {"texcoords", "normals", "materials"}
    moved = bend(asset.positions)
    out = write(asset, tmp_path / "out.glb", moved)
    assert not gltf_validator.issues(out)
    np.testing.assert_allclose(tm.open_asset(out).positions, moved, atol=2e-6)
    old, new = (pygltflib.GLTF2().load(path) for path in (source, out))
    assert [m.to_json() for m in old.materials] == [m.to_json() for m in new.materials]
    assert [n.name for n in old.nodes] == [n.name for n in new.nodes]
    assert [n.matrix for n in old.nodes] == [n.matrix for n in new.nodes]
    before, after = (trimesh.load_scene(path, process=False) for path in (source, out))
    assert list(before.geometry) == list(after.geometry) == ["body", "caps"]
    for name, color in (("body", RED), ("caps", BLUE)):
        a, b = before.geometry[name], after.geometry[name]
        np.testing.assert_array_equal(a.visual.uv, b.visual.uv)
        np.testing.assert_array_equal(a.faces, b.faces)
        assert a.visual.material.baseColorTexture.tobytes() == b.visual.material.baseColorTexture.tobytes()
        assert b.visual.material.baseColorTexture.convert("RGB").getpixel((4, 4)) == color
    same = tm.open_asset(write(asset, tmp_path / "same.glb", asset.positions))
    np.testing.assert_allclose(same.positions, asset.positions, atol=1e-6)


def test_glb_animation_plays_on_the_users_materials(tmp_path):
    asset = tm.open_asset(textured_glb(tmp_path / "in.glb"))
    frames = np.stack([bend(asset.positions, turn) for turn in (0.01, 0.5, 0.9)])
    out = tm.save_animation(frames, asset.faces, tmp_path / "out.glb", asset=asset)
    assert not gltf_validator.issues(out)
    gltf = pygltflib.GLTF2().load(out)
    assert [channel.target.node for channel in gltf.animations[0].channels] == [
        number for number, node in enumerate(gltf.nodes) if node.mesh is not None
    ]
    assert len(gltf.materials) == len(gltf.images) == 2
    assert all(len(primitive.targets) == 2 for mesh in gltf.meshes for primitive in mesh.primitives)
    assert all(primitive.material is not None for mesh in gltf.meshes for primitive in mesh.primitives)
    np.testing.assert_allclose(tm.load_sequence(out).frames, frames, atol=5e-6)
    again = tm.save_animation(frames, asset.faces, tmp_path / "again.glb", asset=tm.open_asset(out))
    assert len(pygltflib.GLTF2().load(again).animations) == 1


def test_gltf_with_files_beside_it_becomes_a_whole_glb(tmp_path):
    textured_glb(tmp_path / "in.glb")
    scene = trimesh.load_scene(tmp_path / "in.glb", process=False)
    for name, data in scene.export(file_type="gltf").items():
        (tmp_path / name).write_bytes(data)
    source = tmp_path / "model.gltf"
    asset = tm.open_asset(source)
    with pytest.raises(ValueError, match=r"out must end in .*\.glb"):
        write(asset, tmp_path / "a.gltf", asset.positions)
    out = write(asset, tmp_path / "moved" / "a.glb", bend(asset.positions))
    assert not gltf_validator.issues(out)
    images = [g.visual.material.baseColorTexture for g in trimesh.load_scene(out, process=False).geometry.values()]
    assert {image.convert("RGB").getpixel((4, 4)) for image in images} == {RED, BLUE}


@pytest.mark.parametrize("mime", ["image/png", None])
def test_a_picture_that_is_none_does_not_go_into_a_glb(tmp_path, mime):
    textured_glb(tmp_path / "in.glb")
    scene = trimesh.load_scene(tmp_path / "in.glb", process=False)
    for name, data in scene.export(file_type="gltf").items():
        (tmp_path / name).write_bytes(data)
    source = tmp_path / "model.gltf"
    root = json.loads(source.read_text())
    root["images"][0] = {"uri": "notes.png"} | ({} if mime is None else {"mimeType": mime})
    source.write_text(json.dumps(root))
    (tmp_path / "notes.png").write_bytes(b"no picture")
    asset = tm.open_asset(source)
    with pytest.warns(MeshWarning, match="without image 0, now white: its content is no picture"):
        out = write(asset, tmp_path / "out.glb", bend(asset.positions))
    assert not gltf_validator.issues(out)
    assert b"no picture" not in out.read_bytes()


@pytest.mark.parametrize("line", ["v 1_0 0 0", "f 1 2 0_3", "vt 0.1_5 0", "vn 0 0 1_0"])
def test_numbers_of_an_obj_have_no_underscores(tmp_path, line):
    """Python reads 1_0 as 10."""
    path = tmp_path / "a.obj"
    path.write_text(f"v 0 0 0\nv 1 0 0\nv 0 1 0\n# 1_0\no part_1\n{line}\nf 1 2 3\n")
    with pytest.raises(MeshError, match=f"underscore in a number.*{line[2:].strip()}"):
        tm.open_asset(path)
    path.write_text(path.read_text().replace(line, ""))
    assert len(tm.open_asset(path).positions) == 3


def accessor_document() -> tuple[dict, bytes]:
    """Two triangles with interleaved attributes, sparse positions, tangents, and a mirrored second node."""
    points = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [9, 9, 9]], "<f4")
    normals = np.tile(np.array([0, 0, 1], "<f4"), (4, 1))
    rows = np.concatenate([points, normals], axis=1).tobytes()
    tangents = np.tile(np.array([1, 0, 0, -1], "<f4"), (4, 1)).tobytes()
    indices, sparse_at = np.array([0, 1, 2, 1, 3, 2], "<u2").tobytes(), np.array([3, 0], "<u2").tobytes()
    sparse_values = np.array([1, 1, 0.5], "<f4").tobytes()
    weights = bytes(range(0, 96, 8))
    views, binary = [], b""
    for data in (rows, tangents, indices, sparse_at, sparse_values, weights):
        views.append({"buffer": 0, "byteOffset": len(binary), "byteLength": len(data)})
        binary += data + bytes(-len(data) % 4)
    views[0]["byteStride"], views[5]["byteStride"] = 24, 4
    root = {
        "asset": {"version": "2.0"},
        "buffers": [{"byteLength": len(binary), "uri": "mesh.bin"}],
        "bufferViews": views,
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "count": 4, "type": "VEC3",
             "sparse": {"count": 1, "indices": {"bufferView": 3, "componentType": 5123}, "values": {"bufferView": 4}}},
            {"bufferView": 0, "byteOffset": 12, "componentType": 5126, "count": 4, "type": "VEC3"},
            {"bufferView": 1, "componentType": 5126, "count": 4, "type": "VEC4"},
            {"bufferView": 2, "componentType": 5123, "count": 6, "type": "SCALAR"},
            {"bufferView": 5, "componentType": 5121, "normalized": True, "count": 3, "type": "VEC3"},
        ],
        "meshes": [
            {"primitives": [{"attributes": {"POSITION": 0, "NORMAL": 1, "TANGENT": 2}, "indices": 3}]},
        ],
        "nodes": [{"mesh": 0, "translation": [5, 0, 0], "children": [1]}, {"mesh": 0, "scale": [-1, 1, 1]}],
        "scenes": [{"nodes": [0]}],
    }  # fmt: skip
    return root, binary


def test_glb_accessors_of_all_kinds(tmp_path):
    """Interleaved and sparse accessors, a mesh in two nodes of which one mirrors, tangents."""
    root, binary = accessor_document()
    (tmp_path / "mesh.bin").write_bytes(binary)
    (tmp_path / "a.gltf").write_text(json.dumps(root))
    asset = tm.open_asset(tmp_path / "a.gltf")
    one = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0.5]])
    np.testing.assert_array_equal(
        asset.positions, np.concatenate([one + np.array([5, 0, 0]), one * [-1, 1, 1] + np.array([5, 0, 0])])
    )
    assert asset.faces.tolist() == [[0, 1, 2], [1, 3, 2], [6, 5, 4], [6, 7, 5]]
    moved = asset.positions @ TURN.T + [0, 0, 1]
    moved[:4] += 1  # the two nodes go their own ways
    out = write(asset, tmp_path / "b.glb", moved)
    np.testing.assert_allclose(tm.open_asset(out).positions, moved, atol=2e-6)
    assert not gltf_validator.issues(out)
    new = trimesh.load_scene(out, process=False)
    assert len(new.geometry) == 2


@pytest.mark.parametrize(("code", "dtype"), [(5120, "i1"), (5121, "u1"), (5122, "i2"), (5123, "u2")])
def test_normalised_integers_are_fractions(code, dtype):
    """glTF 2.0, 3.6.2.2: the least number of a signed type, too, is -1."""
    most, least = np.iinfo(dtype).max, np.iinfo(dtype).min
    document = Document()
    document.add(np.array([most, 0, least], dtype), "SCALAR", normalized=True)
    assert document.get("accessors", 0)["componentType"] == code
    np.testing.assert_array_equal(document.floats(0)[:, 0], [1, 0, -1 if least else 0])


def test_glb_keeps_what_this_package_does_not_know(tmp_path):
    root, binary = accessor_document()
    own = {
        "samplers": [{"name": "soft", "magFilter": 9729}],
        "materials": [{"name": "flat", "extensions": {"KHR_materials_unlit": {}}, "extras": {"tags": []}}],
        "cameras": [{"type": "perspective", "perspective": {"yfov": 0.7, "znear": 0.1}}],
        "extensions": {"KHR_lights_punctual": {"lights": [{"type": "point"}]}},
        "extensionsUsed": ["KHR_materials_unlit", "KHR_lights_punctual"],
    }
    root["nodes"][0] |= {"extensions": {"KHR_lights_punctual": {"light": 0}}, "extras": {"rig": None}}
    (tmp_path / "mesh.bin").write_bytes(binary)
    (tmp_path / "a.gltf").write_text(json.dumps(root | own))
    asset = tm.open_asset(tmp_path / "a.gltf")
    data = write(asset, tmp_path / "b.glb", asset.positions).read_bytes()
    written = json.loads(data[20 : 20 + int.from_bytes(data[12:16], "little")])
    assert {name: written[name] for name in own} == own
    assert all(written["nodes"][0][name] == root["nodes"][0][name] for name in ("extensions", "extras", "translation"))


def test_glb_vertex_attributes_of_three_bytes_become_floats(tmp_path):
    """Each vertex starts at a multiple of four bytes."""
    root, binary = accessor_document()
    root["accessors"][0].pop("sparse")
    for number in (0, 1):
        root["accessors"][number]["count"] = 3
    root["meshes"] = [{"primitives": [{"attributes": {"POSITION": 0, "NORMAL": 1, "COLOR_0": 4}}]}]
    root["nodes"] = [{"mesh": 0}]
    (tmp_path / "mesh.bin").write_bytes(binary)
    (tmp_path / "a.gltf").write_text(json.dumps(root))
    asset = tm.open_asset(tmp_path / "a.gltf")
    out = tm.open_asset(write(asset, tmp_path / "b.glb", asset.positions))
    assert not gltf_validator.issues(tmp_path / "b.glb")
    (part,), (old,) = out.parts(), asset.parts()
    np.testing.assert_allclose(part.colors, old.colors, rtol=1e-7)
    np.testing.assert_allclose(part.colors[0, :3], np.array([0, 8, 16]) / 255)


@pytest.mark.parametrize(
    ("change", "match"),
    [
        ({"extensionsRequired": ["KHR_draco_mesh_compression"]}, "compressed"),
        ({"asset": {"version": "1.0"}}, "not glTF 2"),
        ({"nodes": [{"mesh": -1}]}, "an index -1"),
        ({"meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "mode": 5}]}]}, "strips or fans"),
        ({"nodes": [{"mesh": 0, "scale": [0, 1, 1]}]}, None),
    ],
)
def test_glb_that_cannot_work(tmp_path, change, match):
    root, binary = accessor_document()
    (tmp_path / "mesh.bin").write_bytes(binary)
    (tmp_path / "a.gltf").write_text(json.dumps(root | change))
    if match is None:
        asset = tm.open_asset(tmp_path / "a.gltf")
        with pytest.raises(MeshError, match="flattens its mesh"):
            write(asset, tmp_path / "b.glb", asset.positions)
    else:
        with pytest.raises(MeshError, match=match):
            tm.open_asset(tmp_path / "a.gltf")


# ------------------------------------------------------------------------------------------------- between formats
def test_obj_becomes_a_textured_glb(tmp_path):
    asset = tm.open_asset(textured_obj(tmp_path, "bar.obj"))
    frames = np.stack([asset.positions, bend(asset.positions)])
    with pytest.warns(MeshWarning, match=r"a\.glb is without the quads and groups of bar\.obj"):
        out = tm.save_animation(frames, asset.faces, tmp_path / "a.glb", asset=asset)
    assert not gltf_validator.issues(out)
    body, caps = trimesh.load_scene(out, process=False).geometry.values()
    for mesh, color, name in ((body, RED, "skin"), (caps, BLUE, "cap")):
        material = mesh.visual.material
        assert material.name == name and material.baseColorTexture.convert("RGB").getpixel((4, 4)) == color
    # Each corner has the place and the texture coordinate that it has in the OBJ.
    found = set(map(tuple, np.column_stack([body.vertices, body.visual.uv]).round(4).tolist()))
    wanted = set()
    for face in corners(tmp_path / "bar.obj")[: 12 * 7]:
        wanted |= {(*asset.positions[v - 1].round(4).tolist(), *np.round(t, 4).tolist()) for v, t, _ in face}
    assert {tuple(np.round(row, 3)) for row in found} == {tuple(np.round(row, 3)) for row in wanted}


def test_what_a_format_cannot_hold_is_said(tmp_path):
    asset = tm.open_asset(textured_obj(tmp_path, "bar.obj"))
    frames = asset.positions[None]
    lost = "quads, texture coordinates, normals, vertex colours, 2 materials and groups of bar.obj"
    with pytest.warns(MeshWarning, match=f"frame-000.ply is without the {lost}"):
        tm.save_mesh(frames, asset.faces, tmp_path / "out", "ply", asset=asset)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        paths = tm.save_mesh(frames, asset.faces, tmp_path / "same", asset=asset)
        tm.save_mesh(frames, asset.faces, tmp_path / "bare", "ply")
    assert [p.name for p in paths] == ["frame-000.obj"]
    with pytest.raises(ValueError, match="98 vertices, the frames have 99"):
        tm.save_mesh(np.zeros((1, 99, 3)), asset.faces, tmp_path / "no", asset=asset)


def test_pictures_of_other_formats_become_png():
    stream = io.BytesIO()
    Image.new("RGB", (4, 4), RED).save(stream, format="BMP")
    data = as_png_or_jpeg(stream.getvalue())
    assert data is not None and data.startswith(b"\x89PNG")
    assert Image.open(io.BytesIO(data)).getpixel((1, 1)) == RED
    assert as_png_or_jpeg(b"no picture") is None
