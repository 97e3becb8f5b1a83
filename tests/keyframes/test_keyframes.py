"""One test per row of docs/input.md."""

import json
import time
import warnings
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from bodies import twisted_plate

from torch_modal.geometry import inspect
from torch_modal.geometry.inspect import signed_volume
from torch_modal.geometry.rigid import looks_mirrored
from torch_modal.keyframes.check import Keyframes, MeshError, MeshWarning, check_keyframes, require_solid
from torch_modal.registration.load import load_keyframes

CUBE = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], dtype=np.float64)
CUBE_FACES = np.concatenate(
    [
        [[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1]],
        [[2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3]],
    ]
)
TWO = np.stack([CUBE, CUBE * [1, 2, 1.5] + 0.1])


@pytest.fixture(autouse=True)
def _no_unexpected_warning():
    """A warning that no test asks for is a failure."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        yield


def obj(vertices, faces) -> str:
    lines = [f"v {x!r} {y!r} {z!r}" for x, y, z in np.asarray(vertices, dtype=float).tolist()]
    return "\n".join(lines + ["f " + " ".join(str(i + 1) for i in face) for face in faces]) + "\n"


def ply(vertices, faces, n_vertices=None, n_faces=None) -> str:
    header = (
        f"ply\nformat ascii 1.0\nelement vertex {n_vertices or len(vertices)}\nproperty double x\n"
        f"property double y\nproperty double z\nelement face {n_faces or len(faces)}\n"
        "property list uchar int vertex_indices\nend_header\n"
    )
    body = [" ".join(map(repr, v)) for v in np.asarray(vertices, dtype=float).tolist()]
    body += [" ".join(map(str, [len(face), *face])) for face in faces]
    return header + "\n".join(body) + "\n"


def write(path: Path, text: str | bytes) -> Path:
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return path


def edge_directions_oppose(faces) -> bool:
    """Independent truth of a closed, consistently wound mesh: every directed edge once, its reverse once."""
    directed = [(int(f[i]), int(f[(i + 1) % 3])) for f in faces for i in range(3)]
    return len(set(directed)) == len(directed) and all((b, a) in set(directed) for a, b in directed)


# ---------------------------------------------------------------- files


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


def test_different_vertex_or_face_counts_are_refused(tmp_path):
    a = write(tmp_path / "a.obj", obj(CUBE, CUBE_FACES))
    b = write(tmp_path / "b.obj", obj([*CUBE.tolist(), [2, 2, 2]], CUBE_FACES))
    with pytest.raises(MeshError, match=r"b\.obj has 9 vertices, .*a\.obj has 8"):
        load_keyframes([a, a, b])
    b = write(tmp_path / "b.obj", obj(CUBE, CUBE_FACES[:-1]))
    with pytest.raises(MeshError, match=r"b\.obj has 11 faces, .*a\.obj has 12"):
        load_keyframes([a, b])


def test_different_faces_are_refused(tmp_path):
    other = CUBE_FACES.copy()
    other[4:6] = [[0, 4, 1], [4, 5, 1]]  # the same square, cut along the other diagonal
    a = write(tmp_path / "a.obj", obj(CUBE, CUBE_FACES))
    b = write(tmp_path / "b.obj", obj(CUBE, other))
    with pytest.raises(MeshError, match=r"face 4 of .*b\.obj, vertices \[0, 4, 1\].*\(2 of 12 faces.*diagonal"):
        load_keyframes([a, b])
    twice = CUBE_FACES.copy()
    twice[7] = twice[6]  # nothing strange in it, but one is missing
    b = write(tmp_path / "b.obj", obj(CUBE, twice))
    with pytest.raises(MeshError, match=r"face 7 of .*a\.obj, vertices \[2, 7, 6\], is not in .*b\.obj"):
        load_keyframes([a, b])


def test_stl_is_refused(tmp_path):
    trimesh.Trimesh(CUBE, CUBE_FACES).export(tmp_path / "a.stl")
    with pytest.raises(MeshError, match=r"a\.stl: STL stores loose triangles .* export OBJ"):
        load_keyframes([tmp_path / "a.stl"])


def test_unknown_extension_missing_file_and_folder(tmp_path):
    with pytest.raises(MeshError, match=r"a\.step: unknown extension '\.step'; supported are \.obj, \.ply"):
        load_keyframes([write(tmp_path / "a.step", "x")])
    with pytest.raises(FileNotFoundError, match=r"nowhere\.obj"):
        load_keyframes([tmp_path / "nowhere.obj"])
    (tmp_path / "folder.obj").mkdir()
    with pytest.raises(MeshError, match=r"folder\.obj: not a file"):
        load_keyframes([tmp_path / "folder.obj"])


def test_paths_must_be_a_list(tmp_path):
    with pytest.raises(MeshError, match=r"pass a list"):
        load_keyframes(str(tmp_path / "a.obj"))
    with pytest.raises(MeshError, match=r"paths is empty"):
        load_keyframes([])


@pytest.mark.parametrize("suffix", ["obj", "ply", "off", "glb", "gltf"])
def test_empty_file(tmp_path, suffix):
    with pytest.raises(MeshError, match=rf"a\.{suffix}: the file is empty"):
        load_keyframes([write(tmp_path / f"a.{suffix}", "")])


@pytest.mark.parametrize(
    ("name", "text", "match"),
    [
        ("a.obj", obj(CUBE, []), "point cloud of 8 vertices"),
        ("b.obj", "# nothing\n", "no faces"),
        ("a.ply", ply(CUBE, []), "no faces"),
        ("a.off", "OFF\n2 0 0\n0 0 0\n1 1 1\n", "no faces"),
        ("a.gltf", json.dumps({"asset": {"version": "2.0"}}), "no faces"),
    ],
)
def test_file_without_faces(tmp_path, name, text, match):
    with pytest.raises(MeshError, match=rf"{name}: .*{match}"):
        load_keyframes([write(tmp_path / name, text)])


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
        ("junk.obj", bytes(range(256)) * 9, "no faces"),
        ("word.obj", obj(CUBE, CUBE_FACES) + "f 1 2 x\n", "cannot be read as OBJ"),
        ("number.obj", "v 0 0 zero\n", "cannot be read as OBJ"),
        ("short.obj", "v 0 0\n", "fewer than three numbers: 'v 0 0'"),
        ("zero.obj", obj(CUBE, CUBE_FACES) + "f 0 1 2\n", "index 0"),
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
def test_damaged_file_is_one_line_with_its_name(tmp_path, name, text, match):
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


# ---------------------------------------------------------------- arrays: types and shapes


def test_good_input_passes_untouched_and_silently():
    positions = torch.tensor(TWO, requires_grad=True)
    result = check_keyframes(positions, torch.tensor(CUBE_FACES))
    assert isinstance(result, Keyframes)
    assert result.keyframes is positions
    assert result.faces.dtype == torch.int64
    np.testing.assert_array_equal(result.faces, CUBE_FACES)


@pytest.mark.parametrize("dtype", [np.float32, np.float64, ">f8"])
def test_numpy_positions(dtype):
    array = TWO.astype(dtype)
    array.setflags(write=False)
    result = check_keyframes(array, CUBE_FACES.tolist())
    assert result.keyframes.dtype == (torch.float32 if dtype == np.float32 else torch.float64)
    np.testing.assert_array_equal(result.keyframes, array)
    np.testing.assert_array_equal(check_keyframes(array[::-1], CUBE_FACES).keyframes, array[::-1])


def test_sequence_of_shapes():
    x = torch.tensor(CUBE, requires_grad=True)
    result = check_keyframes([x, 2 * x], CUBE_FACES)
    np.testing.assert_array_equal(result.keyframes.detach(), np.stack([CUBE, 2 * CUBE]))
    result.keyframes.sum().backward()
    assert torch.equal(x.grad, torch.full((8, 3), 3.0, dtype=torch.float64))
    with pytest.raises(MeshError, match=r"key-frame 1 has shape \(7, 3\), key-frame 0 has \(8, 3\)"):
        check_keyframes([CUBE, CUBE[:7]], CUBE_FACES)
    with pytest.raises(MeshError, match=r"key-frame 1 has dtype torch.float32, key-frame 0 has torch.float64"):
        check_keyframes([CUBE, CUBE.astype(np.float32)], CUBE_FACES)
    with pytest.raises(MeshError, match=r"keyframes is empty"):
        check_keyframes([], CUBE_FACES)


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16, torch.int64, torch.bool, torch.complex128])
def test_positions_of_other_types_are_refused(dtype):
    with pytest.raises(MeshError, match=rf"dtype {dtype}; .* float32 or float64.*\.double\(\)"):
        check_keyframes(torch.tensor(TWO).to(dtype), CUBE_FACES)


@pytest.mark.parametrize("value", [None, "abc", [["a", "b"]], object(), {"a": 1}, [None, None]])
def test_what_is_no_array_is_refused(value):
    with pytest.raises(MeshError, match=r"no array of numbers"):
        check_keyframes(value, CUBE_FACES)
    with pytest.raises(MeshError, match=r"faces is a .* no array of numbers"):
        check_keyframes(TWO, value)
    with pytest.raises(MeshError, match=r"dense tensor with values"):
        check_keyframes(torch.empty(2, 8, 3, device="meta"), CUBE_FACES)


@pytest.mark.parametrize("dtype", ["int8", "uint8", "int16", "uint16", "int32", "uint32", "int64", "uint64"])
def test_faces_of_any_integer_type(dtype):
    faces = check_keyframes(TWO, CUBE_FACES.astype(dtype)).faces
    assert faces.dtype == torch.int64
    np.testing.assert_array_equal(faces, CUBE_FACES)


def test_faces_of_other_types_are_refused():
    for dtype in (np.float64, np.bool_, np.complex128):
        with pytest.raises(MeshError, match=r"faces have dtype torch\.\w+; .* integers: convert with \.long"):
            check_keyframes(TWO, CUBE_FACES.astype(dtype))
    with pytest.raises(MeshError, match=r"must fit into int64"):
        check_keyframes(TWO, np.array([[0, 1, 2**64 - 1]], dtype=np.uint64))


def test_wrong_shapes_are_refused():
    with pytest.raises(MeshError, match=r"shape \(8, 3\), which is one shape; pass keyframes\[None\]"):
        check_keyframes(CUBE, CUBE_FACES)
    for bad in (TWO[..., :2], TWO[None], TWO[0, 0], np.float64(1)):
        with pytest.raises(MeshError, match=r"keyframes have shape .*; \(K, V, 3\) is needed"):
            check_keyframes(bad, CUBE_FACES)
    for bad in (CUBE_FACES[:, :2], CUBE_FACES[None], CUBE_FACES[0]):
        with pytest.raises(MeshError, match=r"faces have shape .*; \(F, 3\) is needed"):
            check_keyframes(TWO, bad)


def test_quads_are_refused():
    with pytest.raises(MeshError, match=r"\(6, 4\), which is quads .* along one diagonal"):
        check_keyframes(TWO, np.zeros((6, 4), dtype=int))


def test_no_vertices_and_no_faces_are_refused():
    with pytest.raises(MeshError, match=r"there are no vertices"):
        check_keyframes(np.zeros((2, 0, 3)), CUBE_FACES)
    for empty in ([], np.zeros((0, 3), dtype=int)):
        with pytest.raises(MeshError, match=r"there are no faces"):
            check_keyframes(TWO, empty)


def test_too_few_keyframes_are_refused():
    check_keyframes(TWO[:1], CUBE_FACES)
    with pytest.raises(MeshError, match=r"1 key-frame\(s\) arrived, at least 2 are needed"):
        check_keyframes(TWO[:1], CUBE_FACES, min_keyframes=2)
    with pytest.raises(MeshError, match=r"0 key-frame\(s\) arrived, at least 1"):
        check_keyframes(TWO[:0], CUBE_FACES, min_keyframes=0)


# ---------------------------------------------------------------- values


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_not_finite_is_refused(value):
    bad = TWO.copy()
    bad[1, 5, 2] = bad[1, 7, 0] = bad[1, 7, 1] = value
    with pytest.raises(MeshError, match=r"^2 vertices have NaN or infinite .* vertex 5 of key-frame 1"):
        check_keyframes(bad, CUBE_FACES)


@pytest.mark.parametrize("index", [8, -1, 2**62])
def test_index_out_of_range_is_refused(index):
    bad = CUBE_FACES.copy()
    bad[3, 1] = index
    with pytest.raises(MeshError, match=rf"^1 faces .* face 3, vertices \[4, {index}, 5\], with 8 vertices$"):
        check_keyframes(TWO, bad)


def test_indices_from_one_get_a_hint():
    with pytest.raises(MeshError, match=r"indices count from 0, not from 1"):
        check_keyframes(TWO, CUBE_FACES + 1)


# ---------------------------------------------------------------- faces


def test_degenerate_faces_are_dropped():
    faces = np.insert(CUBE_FACES, 2, [[4, 4, 1], [2, 3, 2]], axis=0)
    with pytest.warns(MeshWarning, match=r"^2 faces use a vertex twice .* face 2, \[4, 4, 1\]$") as caught:
        result = check_keyframes(TWO, faces)
    np.testing.assert_array_equal(result.faces, CUBE_FACES)
    assert len(caught) == 1 and caught[0].filename == __file__
    with pytest.raises(MeshError, match=r"all faces use a vertex twice"):
        check_keyframes(TWO, [[0, 0, 1], [1, 2, 2]])


def test_duplicate_faces_are_dropped():
    faces = np.concatenate([[[2, 2, 1]], CUBE_FACES, [[3, 0, 1], [3, 1, 0]]])
    with pytest.warns(MeshWarning) as caught:
        result = check_keyframes(TWO, faces)
    np.testing.assert_array_equal(result.faces, CUBE_FACES)
    assert [str(w.message).partition(";")[0] for w in caught] == [
        "1 faces use a vertex twice and were dropped",
        "2 faces have the same vertices as an earlier face and were dropped",
    ]
    assert str(caught[1].message).endswith("face 13, [3, 0, 1]")


def test_inconsistent_winding_is_repaired():
    ball = trimesh.creation.icosphere(subdivisions=2)
    faces = np.concatenate([ball.faces, ball.faces + len(ball.vertices)])
    vertices = np.concatenate([ball.vertices, ball.vertices + 5])[None]
    mixed = faces.copy()
    turned = np.random.default_rng(0).choice(len(faces), size=150, replace=False)
    mixed[turned] = mixed[turned, ::-1]
    with pytest.warns(MeshWarning, match=rf"^150 faces wind against .* face {turned.min()},"):
        repaired = check_keyframes(vertices, mixed).faces
    assert edge_directions_oppose(repaired)
    np.testing.assert_array_equal(np.sort(repaired), np.sort(faces))
    assert trimesh.Trimesh(vertices[0], repaired, process=False).volume == pytest.approx(2 * ball.volume)


def test_winding_tie_keeps_the_first_face():
    for faces in ([[0, 1, 3], [0, 2, 3]], [[0, 3, 1], [0, 3, 2]]):
        with pytest.warns(MeshWarning) as caught:
            repaired = check_keyframes(TWO, faces).faces.tolist()
        assert "1 faces wind against their neighbours" in str(caught[0].message)
        assert repaired == [faces[0], faces[1][::-1]]


def test_signed_volume_is_positive_outwards():
    assert signed_volume(CUBE + 3, CUBE_FACES) == pytest.approx(1)
    assert signed_volume(CUBE + 3, CUBE_FACES[:, ::-1]) == pytest.approx(-1)


def test_inward_winding_is_silent():
    np.testing.assert_array_equal(check_keyframes(TWO, CUBE_FACES[:, ::-1]).faces, CUBE_FACES[:, ::-1])


def moebius(n=12):
    angle = np.linspace(0, 2 * np.pi, n, endpoint=False)
    middle = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    across = 0.3 * np.stack(
        [np.cos(angle / 2) * np.cos(angle), np.cos(angle / 2) * np.sin(angle), np.sin(angle / 2)], axis=1
    )
    vertices = np.concatenate([middle - across, middle + across])
    i = np.arange(n)
    j = (i + 1) % n
    left, right = np.where(i < n - 1, j, j + n), np.where(i < n - 1, j + n, j)
    return vertices[None], np.concatenate([np.stack([i, i + n, left], 1), np.stack([i + n, right, left], 1)])


def test_non_orientable_is_warned_and_left():
    vertices, faces = moebius()
    with pytest.warns(MeshWarning, match=r"^24 faces belong to a surface that has no consistent winding"):
        with pytest.warns(MeshWarning, match=r"the surface is open"):
            result = check_keyframes(vertices, faces)
    np.testing.assert_array_equal(result.faces, faces)


def test_non_manifold_edges_are_warned():
    vertices = np.concatenate([CUBE, [[0.5, 0.5, 3]]])[None]
    faces = np.concatenate([CUBE_FACES, [[0, 1, 8]]])
    with pytest.warns(MeshWarning) as caught:
        result = check_keyframes(vertices, faces)
    assert "1 edges join three or more faces" in str(caught[0].message)
    assert "the first is edge [0, 1]" in str(caught[0].message) and "not bending" in str(caught[0].message)
    np.testing.assert_array_equal(result.faces, faces)


def test_open_surface_is_warned():
    with pytest.warns(MeshWarning, match=r"open: 3 edges belong to one face only") as caught:
        check_keyframes(TWO, CUBE_FACES[:-1])
    assert len(caught) == 1


def test_seams_are_named():
    vertices = np.concatenate([CUBE, CUBE[[1, 7, 3]]])[None]
    faces = CUBE_FACES.copy()
    faces[-1] = [8, 9, 10]  # was [1, 7, 3]
    with pytest.warns(MeshWarning, match=r"open: 6 edges .* 6 of its vertices lie exactly .*weld_seams joins them"):
        check_keyframes(vertices, faces)


def test_unreferenced_vertices_are_warned():
    stray = np.concatenate([TWO, np.full((2, 2, 3), 1e300)], axis=1)
    with pytest.warns(MeshWarning, match=r"^2 vertices belong to no face: they follow .* vertex 8$") as caught:
        result = check_keyframes(stray, CUBE_FACES)
    assert len(caught) == 1 and result.keyframes.shape == (2, 10, 3)


def test_several_components_are_silent():
    both = np.concatenate([TWO, TWO + 5], axis=1)
    assert len(check_keyframes(both, np.concatenate([CUBE_FACES, CUBE_FACES + 8])).faces) == 24


# ---------------------------------------------------------------- shape


def test_faces_without_area_are_warned():
    flat = TWO.copy()
    flat[1, 3] = (flat[1, 0] + flat[1, 1]) / 2
    with pytest.warns(MeshWarning, match=r"^1 faces have no area .* face \[0, 1, 3\] in key-frame 1$"):
        check_keyframes(flat, CUBE_FACES)


def test_faces_shrunk_to_a_point_have_no_area():
    joined = TWO.copy()
    joined[1, [1, 3]] = joined[1, 0]
    with pytest.warns(MeshWarning) as caught:
        check_keyframes(joined, CUBE_FACES)
    # The face 0, 1, 3 itself and, beside its edges, one face each.
    assert str(caught[1].message).startswith("4 faces have no area")


def test_edges_without_length_are_warned():
    joined = TWO.copy()
    joined[1, 3] = joined[1, 1]
    with pytest.warns(MeshWarning) as caught:
        check_keyframes(joined, CUBE_FACES)
    assert str(caught[0].message).endswith("the first is edge [1, 3] in key-frame 1")
    assert [str(w.message)[:25] for w in caught] == ["1 edges have no length, t", "2 faces have no area in s"]


def test_zero_size_is_refused():
    point = TWO.copy()
    point[1] = 3.0
    with pytest.raises(MeshError, match=r"key-frame 1 has zero size"):
        check_keyframes(point, CUBE_FACES)
    with pytest.raises(MeshError, match=r"key-frame 0 has zero size"):
        check_keyframes(0 * TWO, CUBE_FACES)
    with pytest.raises(MeshError, match=r"key-frame 0 has zero size: .* torch.float32 cannot resolve"):
        check_keyframes((TWO + 4e6).astype(np.float32), CUBE_FACES)
    with pytest.raises(MeshError, match=r"key-frame 0 has zero size: .* torch.float64 cannot resolve"):
        check_keyframes(TWO + 4e12, CUBE_FACES)
    stray = np.concatenate([point, TWO[:, :1] + 1], axis=1)  # a vertex of no face gives no size
    with pytest.raises(MeshError, match=r"key-frame 1 has zero size"):
        check_keyframes(stray, CUBE_FACES)


@pytest.mark.parametrize(("dtype", "factor"), [("f4", 1e-32), ("f4", 1e32), ("f8", 1e-300), ("f8", 1e300)])
def test_sizes_outside_the_number_range_are_refused(dtype, factor):
    with pytest.raises(MeshError, match=r"cannot compute with; choose another unit"):
        check_keyframes((TWO * factor).astype(dtype), CUBE_FACES)
    with pytest.raises(MeshError, match=r"cannot compute with; choose another unit"):
        check_keyframes((TWO[:1] - 0.5) * 2 * 1.5e308, CUBE_FACES)  # the extent overflows


@pytest.mark.parametrize("factor", [1e-20, 1e-3, 1e3, 1e20])
def test_any_unit_is_silent(factor):
    check_keyframes(TWO * factor, CUBE_FACES)
    check_keyframes((TWO * factor).astype(np.float32), CUBE_FACES)


def test_far_from_the_origin():
    check_keyframes(TWO + 1e6, CUBE_FACES)
    far = np.concatenate([TWO, TWO[:1] + 4096]).astype(np.float32)
    with pytest.warns(MeshWarning, match=r"^1 key-frames lie so far .* torch.float32 rounds .* key-frame 2 .* float64"):
        check_keyframes(far, CUBE_FACES)


def test_different_sizes_are_refused():
    check_keyframes(np.stack([CUBE, 99 * CUBE]), CUBE_FACES)
    with pytest.raises(MeshError, match=r"key-frame 2 .* key-frame 1 .* 100 times as large.*different units"):
        check_keyframes(np.stack([10 * CUBE, CUBE, 101 * CUBE]), CUBE_FACES)


def test_mirrored_pair_is_refused():
    mirrored = np.stack([CUBE, CUBE + 7, CUBE * [-1, 1, 1] + 3])
    with pytest.raises(MeshError, match=r"key-frame 2 is mirrored: .* key-frame 0.* mirror it back"):
        check_keyframes(mirrored, CUBE_FACES)
    rotated = np.stack([CUBE, CUBE * [-1, -1, 1] + 3])  # half a turn is no mirror
    check_keyframes(rotated, CUBE_FACES)


@pytest.mark.parametrize("thickness", [1e-4, 1e-3])
def test_a_thin_plate_whose_volume_turns_over_is_not_mirrored(thickness):
    flat, twisted, faces = twisted_plate(thickness)
    volumes = [signed_volume(x, faces) / inspect.diagonals(x[None])[0] ** 3 for x in (flat, twisted)]
    assert volumes[0] > 1e-6 and volumes[1] < -1e-6
    both = check_keyframes(np.stack([flat, twisted]), faces)
    assert not looks_mirrored(both.keyframes[:1], both.keyframes[1:], both.faces).any()


def test_mirrored_bodies_in_any_pose_are_refused(data_dir):
    """After the best motion, most normals of a hand and its mirror image agree: it is flat."""
    keyframes, faces = load_keyframes(sorted((data_dir / "mh-hand").glob("*.obj")))
    mirror = torch.tensor([-1.0, 1.0, 1.0], dtype=torch.float64)
    turn = torch.from_numpy(trimesh.transformations.rotation_matrix(2.0, [1, 2, 3])[:3, :3])
    i, j = torch.cartesian_prod(*2 * [torch.arange(len(keyframes))]).T
    assert looks_mirrored(keyframes[i], (5 * mirror * keyframes[j]) @ turn + 3, faces).all()
    assert not looks_mirrored(keyframes[i], (5 * keyframes[j]) @ turn + 3, faces).any()
    with pytest.raises(MeshError, match="key-frame 1 is mirrored"):
        check_keyframes(torch.stack([keyframes[0], mirror * keyframes[2]]), faces)


def test_mirrored_open_surface_is_not_seen():
    with pytest.warns(MeshWarning, match=r"open"):
        check_keyframes(np.stack([CUBE, CUBE * [-1, 1, 1]]), CUBE_FACES[:-1])


def test_flat_surface_is_refused_only_where_a_solid_is_needed():
    grid = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0.0]])
    faces = [[0, 1, 2], [0, 2, 3]]
    with pytest.warns(MeshWarning, match=r"open"):
        check_keyframes(grid[None], faces)
    turn = trimesh.transformations.rotation_matrix(1.0, [1, 2, 3])[:3, :3]
    stray = np.concatenate([grid @ turn.T + 5, [[0, 0, 9]]])  # a vertex of no face gives no thickness
    for flat in (grid, stray, torch.tensor(stray, requires_grad=True), grid * [1, 0, 0] + [0, 0, 1]):
        with pytest.raises(MeshError, match=r"the surface is flat: its extents are .* give it a thickness"):
            require_solid(flat, faces)
    with pytest.raises(MeshError, match="extents are 0, 0 and 0"):
        require_solid(0 * grid + 3, faces)
    require_solid(CUBE, CUBE_FACES)
    require_solid(torch.tensor(grid * 1e-9) + torch.tensor([[0, 0, 1e-12]] + [[0, 0, 0]] * 3), faces)


def test_warn_false_silences_warnings_but_not_errors():
    faces = np.concatenate([CUBE_FACES[:-1], [[2, 2, 1]]])
    np.testing.assert_array_equal(check_keyframes(TWO, faces, warn=False).faces, CUBE_FACES[:-1])
    with pytest.raises(MeshError, match=r"mirrored"):
        check_keyframes(np.stack([CUBE, -CUBE]), CUBE_FACES, warn=False)


def test_one_warning_per_kind():
    faces = np.concatenate([CUBE_FACES[:-3], [[2, 2, 1], [3, 3, 1]], CUBE_FACES[:2]])
    with pytest.warns(MeshWarning) as caught:
        check_keyframes(np.concatenate([TWO, TWO]), faces)
    assert [str(w.message).split()[0] for w in caught] == ["2", "2", "the"]


def test_callers_arrays_are_not_changed():
    faces = np.concatenate([CUBE_FACES, [[2, 2, 1]]])
    faces[0] = faces[0, ::-1]
    copy, positions = faces.copy(), TWO.copy()
    check_keyframes(positions, faces, warn=False)
    np.testing.assert_array_equal(faces, copy)
    np.testing.assert_array_equal(positions, TWO)


def test_a_second_check_finds_nothing():
    faces = np.concatenate([CUBE_FACES[::-1], [[2, 2, 1], [0, 1, 3]]])
    faces[0] = faces[0, ::-1]
    once = check_keyframes(TWO, faces, warn=False)
    assert torch.equal(check_keyframes(*once).faces, once.faces)


# ---------------------------------------------------------------- real data and size


@pytest.mark.parametrize(
    ("name", "n_files", "n_vertices", "warning"),
    [
        ("hyper-cube", 4, 1538, None),
        ("mh-hand", 5, 1597, None),
        ("mh-hand-path", 9, 1597, None),
        ("mh-woman", 3, 13380, None),
        ("ict-face", 4, 6706, "the surface is open: 296 edges"),
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
    require_solid(checked.keyframes[0], checked.faces)


def test_large_meshes_are_checked_quickly():
    ball = trimesh.creation.icosphere(subdivisions=6)
    keyframes = np.stack([ball.vertices * (1 + 0.1 * k) for k in range(6)])
    start = time.perf_counter()
    check_keyframes(keyframes, ball.faces)
    assert time.perf_counter() - start < 3  # 0.4 s; generous, as machines are shared
