"""A test for each row of docs/input.md on files; test_keyframes.py has those on arrays."""

import json

import numpy as np
import pytest
import torch
import trimesh
from helpers.cube import CUBE, CUBE_FACES, TWO, edge_directions_oppose, obj, ply, write

from torch_modal import open_asset, save_animation
from torch_modal.keyframes.check import MeshError, MeshWarning, check_keyframes
from torch_modal.registration.load import load_keyframes

pytestmark = pytest.mark.filterwarnings("error")  # a warning that no test asks for is a failure


@pytest.mark.parametrize("suffix", ["obj", "ply", "off", "glb", "gltf"])
def test_formats_keep_order_and_number_of_vertices(tmp_path, suffix):
    rng = np.random.default_rng(0)
    vertices = rng.normal(size=(9, 3)).astype(np.float32).astype(np.float64)
    vertices[8] = vertices[0]  # of no face, and at the place of another vertex
    mesh = trimesh.Trimesh(vertices, CUBE_FACES, process=False)
    path = tmp_path / f"a.{suffix}"
    if suffix == "gltf":
        for name, content in mesh.export(file_type="gltf").items():
            write(tmp_path / name, content)
        path = tmp_path / "model.gltf"
    else:
        mesh.export(path)
    keyframes, faces = load_keyframes([path, path])
    assert keyframes.dtype == torch.float64 and faces.dtype == torch.int64
    assert keyframes.shape == (2, 9, 3)
    np.testing.assert_allclose(keyframes[1], vertices, rtol=0, atol=1e-6)
    np.testing.assert_array_equal(faces, CUBE_FACES)


@pytest.mark.parametrize("corner", ["{v}/{t}/{n}", "{v}/{t}", "{v}//{n}", "{v}"])
def test_obj_seams_groups_and_materials_leave_vertices_alone(tmp_path, corner):
    """Trimesh splits, drops, repeats or reorders here; the v lines must stay as they are."""
    vertices = [*CUBE.tolist(), [9, 9, 9]]
    lines = ["mtllib none.mtl"] + ["v {} {} {} 0.5 0.5 0.5".format(*v) for v in vertices]
    lines += [f"vt 0.{i} 0.5" for i in range(9)] + [f"vn 0 0 {i}" for i in range(1, 10)]
    for i, face in enumerate(CUBE_FACES):
        lines += [f"o part{i % 3}", f"g group{i % 2}", f"usemtl material{i % 2}", "s 1"]
        lines += ["f " + " ".join(corner.format(v=v + 1, t=(i + v) % 9 + 1, n=i % 9 + 1) for v in face) + " # face"]
    keyframes, faces = load_keyframes([write(tmp_path / "a.obj", "\r\n".join(lines))])
    np.testing.assert_array_equal(keyframes[0], vertices)
    np.testing.assert_array_equal(faces, CUBE_FACES)


def test_obj_negative_indices_count_from_the_line(tmp_path):
    text = "v 0 0 0\nv 1 0 0\nv 0 1 0\nf -3 -2 -1\nv 0 0 1\nv 1 0 1\nv 0 1 1\nf -3 \\\n-2 -1\n"
    faces = load_keyframes([write(tmp_path / "a.obj", text)]).faces
    assert faces.tolist() == [[0, 1, 2], [3, 4, 5]]


def test_polygons_are_cut_into_triangles(tmp_path):
    quads = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]
    for path in (write(tmp_path / "a.obj", obj(CUBE, quads)), write(tmp_path / "a.ply", ply(CUBE, quads))):
        keyframes, faces = check_keyframes(*load_keyframes([path]))
        assert faces.shape == (12, 3) and edge_directions_oppose(faces)
        np.testing.assert_array_equal(keyframes[0], CUBE)


def test_ply_texture_seams_leave_vertices_alone(tmp_path):
    text = ply(CUBE, CUBE_FACES).replace("end_header", "property list uchar float texcoord\nend_header")
    lines = text.splitlines()
    start = lines.index("end_header") + 1 + len(CUBE)
    lines[start:] = [f"{line} 6 0 0 .{i} 0 0 .{i}" for i, line in enumerate(lines[start:])]
    keyframes, faces = load_keyframes([write(tmp_path / "a.ply", "\n".join(lines) + "\n")])
    np.testing.assert_array_equal(keyframes[0], CUBE)
    np.testing.assert_array_equal(faces, CUBE_FACES)


def test_glb_transforms_are_applied_and_meshes_joined(tmp_path):
    scene = trimesh.Scene()
    for name, x in (("left", 0), ("right", 5)):
        transform = np.diag([2.0, 1, 1, 1])
        transform[0, 3] = x
        mesh = trimesh.Trimesh(CUBE, CUBE_FACES, process=False)
        scene.add_geometry(mesh, node_name=name, geom_name=name, transform=transform)
    scene.export(tmp_path / "a.glb")
    keyframes, faces = check_keyframes(*load_keyframes([tmp_path / "a.glb"]))
    halves = keyframes[0].reshape(2, 8, 3)
    offset = halves[:, :1] - torch.tensor([0.0, 0, 0])
    np.testing.assert_allclose(halves - offset, np.stack([CUBE * [2, 1, 1]] * 2), atol=1e-6)
    assert sorted(offset[:, 0, 0].tolist()) == [0, 5]
    np.testing.assert_array_equal(faces, np.concatenate([CUBE_FACES, CUBE_FACES + 8]))


def test_order_corner_and_winding_of_faces_may_differ(tmp_path):
    shuffled = np.roll(CUBE_FACES[::-1], 1, axis=1).copy()
    shuffled[3] = shuffled[3, ::-1]
    a = write(tmp_path / "a.obj", obj(CUBE, CUBE_FACES))
    b = write(tmp_path / "b.ply", ply(2 * CUBE, shuffled))
    keyframes, faces = load_keyframes([a, b])
    np.testing.assert_array_equal(faces, CUBE_FACES)
    np.testing.assert_array_equal(keyframes, np.stack([CUBE, 2 * CUBE]))


OTHER_DIAGONAL, TWICE = CUBE_FACES.copy(), CUBE_FACES.copy()
OTHER_DIAGONAL[4:6] = [[0, 4, 1], [4, 5, 1]]  # the same square, cut along the other diagonal
TWICE[7] = TWICE[6]  # nothing strange in it, but one is missing


@pytest.mark.parametrize(
    ("vertices", "faces", "match"),
    [
        ([*CUBE.tolist(), [2, 2, 2]], CUBE_FACES, r"b\.obj has 9 vertices, .*a\.obj has 8"),
        (CUBE, CUBE_FACES[:-1], r"b\.obj has 11 faces, .*a\.obj has 12"),
        (
            CUBE,
            OTHER_DIAGONAL,
            r"vertices \[0, 1, 4\] is in one of .* \(so are 4 faces\).*diagonal",
        ),
        (CUBE, TWICE, r"the face with the vertices \[2, 6, 7\] is in one"),
    ],
)
def test_files_of_different_meshes_are_refused(tmp_path, vertices, faces, match):
    a, b = write(tmp_path / "a.obj", obj(CUBE, CUBE_FACES)), write(tmp_path / "b.obj", obj(vertices, faces))
    with pytest.raises(MeshError, match=match):
        load_keyframes([a, a, b])


def test_paths_that_are_refused(tmp_path):
    (tmp_path / "folder.obj").mkdir()
    for paths, error, match in (
        ([tmp_path / "nowhere.obj"], FileNotFoundError, r"nowhere\.obj"),
        ([tmp_path / "folder.obj"], MeshError, r"folder\.obj: not a file"),
        (str(tmp_path / "a.obj"), MeshError, "pass a list"),
        ([], MeshError, "paths is empty"),
    ):
        with pytest.raises(error, match=match):
            load_keyframes(paths)


def test_a_glb_that_moves_by_itself_is_said_once(tmp_path):
    scene = trimesh.Scene(trimesh.Trimesh(CUBE, CUBE_FACES, process=False))
    still = write(tmp_path / "still.glb", scene.export(file_type="glb"))
    asset = open_asset(still)
    moving = save_animation(TWO, asset.faces, tmp_path / "moving.glb", asset=asset)
    text = r"moving\.glb has animations and morph targets: .*at rest.*bake the pose.*\(2 such key-frames\)"
    with pytest.warns(MeshWarning, match=text) as said:
        keyframes, _ = load_keyframes([still, moving, moving])
    assert len(said) == 1
    np.testing.assert_allclose(keyframes, np.stack([CUBE] * 3), atol=1e-6)


CYCLE = {"asset": {"version": "2.0"}, "nodes": [{"children": [0]}], "scenes": [{"nodes": [0]}], "scene": 0}
HUGE = {
    "asset": {"version": "2.0"},
    "accessors": [{"componentType": 5126, "count": 10**12, "type": "VEC3"}],
    "meshes": [{"primitives": [{"attributes": {"POSITION": 0}}]}],
    "nodes": [{"mesh": 0}],
    "scenes": [{"nodes": [0]}],
}


@pytest.mark.parametrize(
    ("name", "text", "match"),
    [
        *((f"empty.{suffix}", "", "the file is empty") for suffix in ("obj", "ply", "off", "glb", "gltf")),
        ("a.stl", "solid\n", "no faces"),
        ("junk.stl", "hello", "no faces"),
        ("a.step", "x", r"unknown extension '\.step'; supported are \.obj, \.ply"),
        ("cloud.obj", obj(CUBE, []), "point cloud of 8 vertices"),
        ("nothing.obj", "# nothing\n", "no faces"),
        ("cloud.ply", ply(CUBE, []), "no faces"),
        ("cloud.off", "OFF\n2 0 0\n0 0 0\n1 1 1\n", "no faces"),
        ("nothing.gltf", json.dumps({"asset": {"version": "2.0"}}), "no faces"),
        ("junk.obj", bytes(range(256)) * 9, "no faces"),
        ("word.obj", obj(CUBE, CUBE_FACES) + "f 1 2 x\n", "cannot be read as OBJ"),
        ("number.obj", "v 0 0 zero\n", "cannot be read as OBJ"),
        ("short.obj", "v 0 0\n", "fewer than 3 numbers: '0 0'"),
        ("zero.obj", obj(CUBE, CUBE_FACES) + "f 0 1 2\n", r"face 12 uses the vertices \[-1, 0, 1\]"),
        ("line.obj", obj(CUBE, CUBE_FACES) + "f 1 2\n", "fewer than three corners"),
        ("range.obj", obj(CUBE, [*CUBE_FACES.tolist(), [0, 1, 8]]), r"face 12 uses the vertices \[0, 1, 8\]"),
        ("under.obj", obj(CUBE, CUBE_FACES) + "f 1 2 -9\n", "face 12 uses"),
        ("big.obj", obj(CUBE, CUBE_FACES) + f"f 1 2 {10**40}\n", "cannot be read as OBJ"),
        ("range.ply", ply(CUBE, [[0, 1, 8]]), r"face 0 uses the vertices \[0, 1, 8\]"),
        ("junk.ply", b"\x00\xff" * 50, "cannot be read as PLY"),
        ("cut.ply", ply(CUBE, CUBE_FACES, n_faces=13), "promises 8 vertices and 13 faces.* holds 8 and 12"),
        ("huge.ply", ply(CUBE, CUBE_FACES, n_vertices=10**12), "huge.ply: "),
        ("cut.off", "OFF\n4 4 0\n0 0 0\n1 0 0\n0 1 0\n0 0 1\n3 0 1 2\n", "promises 4 vertices and 4 faces"),
        ("huge.off", f"OFF\n{10**12} 1 0\n0 0 0\n", "cannot be read as OFF"),
        ("junk.off", "hello", "cannot be read as OFF"),
        ("junk.glb", b"glTF" + bytes(100), "cannot be read as GLB"),
        ("junk.gltf", "{", "cannot be read as GLTF"),
        ("cycle.gltf", json.dumps(CYCLE), "no faces"),
        ("huge.gltf", json.dumps(HUGE), "cannot be read as GLTF"),
    ],
)
def test_files_that_are_refused_in_one_line_with_their_name(tmp_path, name, text, match):
    with pytest.raises(MeshError, match=match) as caught:
        load_keyframes([write(tmp_path / name, text)])
    assert name in str(caught.value) and "\n" not in str(caught.value) and len(str(caught.value)) < 500


@pytest.mark.parametrize("suffix", ["ply", "off", "glb", "obj"])
def test_any_damage_to_a_file_ends_in_a_mesh_or_in_a_mesh_error(tmp_path, suffix):
    path = tmp_path / f"a.{suffix}"
    trimesh.Trimesh(CUBE, CUBE_FACES, process=False).export(path)
    whole = path.read_bytes()
    rng = np.random.default_rng(1)
    refused = 0
    for _ in range(60):
        damaged = bytearray(whole)
        for place in rng.integers(len(whole), size=3):
            damaged[place] = rng.integers(256)
        path.write_bytes(bytes(damaged[: rng.integers(len(whole) // 2, len(whole) + 1)]))
        try:
            check_keyframes(*load_keyframes([path]), warn=False)
        except MeshError as error:
            refused += 1
            assert "\n" not in str(error)
    assert refused > 5


# ---------------------------------------------------------------- real data and size


@pytest.mark.parametrize(
    ("name", "n_files", "n_vertices", "warning"),
    [
        ("hyper-cube", 4, 1538, None),
        ("mh-hand", 5, 1597, None),
        ("mh-hand-path", 9, 1597, None),
        ("mh-woman", 3, 13380, None),
        ("ict-face", 4, 6706, "296 edges belong to one face only: the surface is open"),
    ],
)
def test_real_data(data_dir, name, n_files, n_vertices, warning):
    paths = sorted((data_dir / name).glob("*.obj"))
    loaded = load_keyframes(paths)
    assert loaded.keyframes.shape == (n_files, n_vertices, 3)
    lines = [line.split()[1:4] for line in paths[-1].read_text().splitlines() if line.startswith("v ")]
    np.testing.assert_array_equal(loaded.keyframes[-1], np.array(lines, dtype=float))
    if warning:
        with pytest.warns(MeshWarning, match=warning) as caught:
            checked = check_keyframes(*loaded)
        assert len(caught) == 1
    else:
        checked = check_keyframes(*loaded)
    assert torch.equal(checked.faces, loaded.faces)
