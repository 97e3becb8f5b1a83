"""Written files, read back with other libraries' readers."""

import json
import os
import re
import struct
from pathlib import Path

import numpy as np
import pygltflib
import pytest
import torch
import trimesh
from helpers.gltf_validator import accessor
from helpers.textured import textured_obj

from torch_modal.io.read import open_asset
from torch_modal.io.write import save_mesh
from torch_modal.view.animation import save_animation

FACES = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]])


def tetrahedra(n=5):
    """A tetrahedron far from the origin that changes in every frame; no number of it is exact in float32."""
    rng = np.random.default_rng(3)
    first = np.array([[10.1, -3.3, 0.7]] * 4) + np.eye(4, 3, -1)
    return first + np.cumsum(rng.normal(scale=0.2, size=(n, 4, 3)), axis=0)


def played(gltf, time):
    """Vertices and normals as a player shows them: base + sum of weight * target, weights interpolated."""
    primitive = gltf.meshes[0].primitives[0]
    sampler = gltf.animations[0].samplers[0]
    times, weights = accessor(gltf, sampler.input), accessor(gltf, sampler.output)
    weights = weights.reshape(len(times), len(primitive.targets))
    now = [np.interp(time, times, column) for column in weights.T]
    result = []
    for name in ("POSITION", "NORMAL"):
        base = accessor(gltf, getattr(primitive.attributes, name))
        moved = [accessor(gltf, target[name]) for target in primitive.targets]
        result.append(base + np.tensordot(now, np.array(moved), 1))
    return result


@pytest.mark.parametrize(("fmt", "tolerance"), [("ply", None), ("obj", 1e-8), ("off", 0.0)])
def test_frames_read_back(tmp_path, fmt, tolerance):
    frames = tetrahedra()
    paths = save_mesh(frames, FACES, tmp_path / "new" / "folder", fmt=fmt, stem="shape")
    assert sorted(paths[0].parent.iterdir()) == paths
    assert [path.name for path in paths] == [f"shape-{n:03d}.{fmt}" for n in range(5)]
    for path, frame in zip(paths, frames, strict=True):
        mesh = trimesh.load_mesh(path, process=False, maintain_order=True)
        expected = frame.astype(np.float32) if tolerance is None else frame
        np.testing.assert_allclose(mesh.vertices, expected, rtol=tolerance or 0)
        np.testing.assert_array_equal(np.float32(mesh.vertices), np.float32(frame))
        np.testing.assert_array_equal(mesh.faces, FACES)


def test_torch_and_numpy_give_the_same_files(tmp_path):
    frames = tetrahedra()
    tensor = torch.tensor(frames, requires_grad=True)
    a = save_mesh(frames, FACES, tmp_path / "a", fmt="obj")
    a += [save_animation(frames, FACES, tmp_path / "a" / "x.glb")]
    b = save_mesh(tensor, torch.tensor(FACES), tmp_path / "b", fmt="obj")
    b += [save_animation(tensor, torch.tensor(FACES), tmp_path / "b" / "x.glb")]
    assert [path.read_bytes() for path in a] == [path.read_bytes() for path in b]
    half = tensor.bfloat16()  # which NumPy does not have
    (path, *_) = save_mesh(half, FACES, tmp_path / "half")
    np.testing.assert_array_equal(trimesh.load_mesh(path, process=False).vertices, half.detach()[0].float().numpy())


def test_existing_files_stay_if_asked(tmp_path):
    frames = tetrahedra(3)
    kept = tmp_path / "frame-002.ply"
    kept.write_text("mine")
    message = re.escape(str(kept)) + r" exists.*\(--overwrite\)"
    with pytest.raises(FileExistsError, match=message) as error:
        save_mesh(frames, FACES, tmp_path, overwrite=False)
    assert "\n" not in str(error.value)
    assert kept.read_text() == "mine" and list(tmp_path.iterdir()) == [kept]  # none of the others either
    save_mesh(frames, FACES, tmp_path)  # as torch.save and savefig do
    assert kept.read_bytes().startswith(b"ply") and len(list(tmp_path.iterdir())) == 3

    animation = tmp_path / "a.glb"
    animation.write_text("mine")
    save_animation(frames, FACES, animation)
    assert animation.read_bytes().startswith(b"glTF")


@pytest.mark.parametrize("with_asset", [False, True])
def test_a_full_disk_leaves_no_part_of_a_sequence(tmp_path, monkeypatch, with_asset):
    """The disk is full at the fourth frame: those before it are not there either, and older ones stay."""
    out = tmp_path / "out"
    asset = open_asset(textured_obj(tmp_path / "source", "a.obj")) if with_asset else None
    frames, faces = (np.repeat(asset.positions[None], 5, 0), asset.faces) if with_asset else (tetrahedra(), FACES)
    out.mkdir()
    (out / "frame-001.obj").write_text("old")
    write = Path.write_bytes

    def full(self, data):
        if "frame-003" in self.name:
            write(self, data[:10])
            raise OSError(28, "No space left on device", str(self))
        return write(self, data)

    monkeypatch.setattr(Path, "write_bytes", full)
    with pytest.raises(OSError, match=r"No space left on device: '[^']*out/frame-003\.obj'"):
        save_mesh(frames, faces, out, "obj", overwrite=True, asset=asset)
    assert [path.name for path in out.rglob("*") if path.is_file()] == ["frame-001.obj"]
    assert (out / "frame-001.obj").read_text() == "old"
    monkeypatch.undo()
    assert len(save_mesh(frames, faces, out, "obj", overwrite=True, asset=asset)) == 5
    assert len(list(out.glob("*.obj"))) == 5 and (out / "frame-001.obj").read_text() != "old"


@pytest.mark.skipif(os.name != "posix", reason="file modes are a POSIX matter")
def test_files_get_the_usual_mode(tmp_path):
    (tmp_path / "plain").write_text("")
    (path,) = save_mesh(tetrahedra(1), FACES, tmp_path)
    assert path.stat().st_mode == (tmp_path / "plain").stat().st_mode


@pytest.mark.parametrize(
    ("frames", "faces", "message"),
    [
        (np.zeros((2, 4, 2)), FACES, r"\(N, V, 3\).*\(2, 4, 2\)"),
        (np.zeros((0, 4, 3)), FACES, r"\(0, 4, 3\)"),
        (np.zeros((2, 4, 3)), FACES[:, :2], r"faces.*\(4, 2\)"),
        (np.zeros((2, 4, 3)), FACES.astype(float), "integers, got float64"),
        (np.zeros((2, 4, 3)), FACES + 1, "from 1 to 4"),
        (np.zeros((2, 4, 3)), FACES - 1, "from -1 to 2"),
        (np.stack([np.zeros((4, 3)), np.full((4, 3), np.nan)]), FACES, "1 of 2 .*number 1"),
        (np.full((1, 4, 3), 1e39), FACES, "within float32"),
    ],
)
def test_wrong_input_is_refused_before_anything_is_written(tmp_path, frames, faces, message):
    with pytest.raises(ValueError, match=message):
        save_mesh(frames, faces, tmp_path / "folder")
    with pytest.raises(ValueError, match=message):
        save_animation(frames, faces, tmp_path / "a.glb")
    assert not list(tmp_path.iterdir())


def test_wrong_animation_options(tmp_path):
    for wrong in ([0, 5], [-1]):
        with pytest.raises(ValueError, match=rf"0 to 4.*{re.escape(str(wrong))}"):
            save_animation(tetrahedra(), FACES, tmp_path / "a.glb", keyframe_indices=wrong)
    (tmp_path / "a.glb").mkdir()
    with pytest.raises(IsADirectoryError, match="is a folder"):
        save_animation(tetrahedra(), FACES, tmp_path / "a.glb")
    with pytest.raises(OSError, match="file"):
        (tmp_path / "file").write_text("")
        save_mesh(tetrahedra(), FACES, tmp_path / "file")


def test_animation_plays_the_frames(tmp_path):
    frames = tetrahedra()
    gltf = pygltflib.GLTF2().load(save_animation(frames, FACES, tmp_path / "a.glb", fps=10, keyframe_indices=[4, 0]))
    for n, frame in enumerate(frames):
        positions, normals = played(gltf, n / 10)
        np.testing.assert_allclose(positions, frame, atol=2 * np.spacing(np.float32(11)))
        expected = trimesh.Trimesh(frame, FACES, process=False)
        weighted = np.zeros((4, 3))
        for corner in range(3):
            np.add.at(weighted, FACES[:, corner], expected.face_normals * expected.area_faces[:, None])
        weighted /= np.linalg.norm(weighted, axis=1, keepdims=True)
        np.testing.assert_allclose(normals, weighted, atol=1e-5)
    np.testing.assert_allclose(played(gltf, 0.13)[0], 0.7 * frames[1] + 0.3 * frames[2], atol=1e-5)
    animation = gltf.animations[0]
    assert animation.samplers[0].interpolation == "LINEAR"
    assert (animation.channels[0].target.node, animation.channels[0].target.path) == (0, "weights")
    assert animation.extras == {"fps": 10.0, "frames": [0, 1, 2, 3, 4], "keyframes": [0, 4]}
    primitive = gltf.meshes[0].primitives[0]
    np.testing.assert_array_equal(accessor(gltf, primitive.indices), FACES.reshape(-1))
    assert gltf.accessors[primitive.attributes.POSITION].min and gltf.accessors[animation.samplers[0].input].max
    assert all(gltf.accessors[target["POSITION"]].min for target in primitive.targets)
    assert gltf.meshes[0].extras["targetNames"] == ["frame-001", "frame-002", "frame-003", "frame-004"]
    material = gltf.materials[primitive.material]
    assert material.doubleSided and material.pbrMetallicRoughness.metallicFactor == 0


def test_glb_container(tmp_path):
    """Header, chunk lengths and alignment, by the letter of glTF 2.0 section 4.4."""
    data = save_animation(tetrahedra(), FACES, tmp_path / "a.glb").read_bytes()
    magic, version, length = struct.unpack_from("<4sII", data)
    assert (magic, version, length) == (b"glTF", 2, len(data))
    json_length, kind = struct.unpack_from("<I4s", data, 12)
    assert kind == b"JSON" and json_length % 4 == 0
    document = json.loads(data[20 : 20 + json_length])
    binary_length, kind = struct.unpack_from("<I4s", data, 20 + json_length)
    assert kind == b"BIN\0" and 28 + json_length + binary_length == len(data)
    assert 0 <= binary_length - document["buffers"][0]["byteLength"] < 4
    assert all(view["byteOffset"] % 4 == 0 for view in document["bufferViews"])
    assert len(document["meshes"][0]["primitives"][0]["targets"]) == 4


def test_cyclic_returns_to_frame_zero(tmp_path):
    frames = tetrahedra()
    gltf = pygltflib.GLTF2().load(save_animation(frames, FACES, tmp_path / "a.glb", fps=10, cyclic=True))
    np.testing.assert_allclose(accessor(gltf, gltf.animations[0].samplers[0].input), np.arange(6) / 10)
    np.testing.assert_allclose(played(gltf, 0.45)[0], 0.5 * (frames[4] + frames[0]), atol=1e-5)
    gltf = pygltflib.GLTF2().load(save_animation(tetrahedra(1), FACES, tmp_path / "one.glb", cyclic=True))
    assert not gltf.animations and not gltf.meshes[0].primitives[0].targets
    closed = np.concatenate([frames, frames[:1]])  # ends where it began: no second step of zero length
    gltf = pygltflib.GLTF2().load(save_animation(closed, FACES, tmp_path / "b.glb", fps=10, cyclic=True))
    assert gltf.accessors[gltf.animations[0].samplers[0].input].count == 6


def test_many_targets_are_warned_of(tmp_path):
    frames = tetrahedra(1) + np.linspace(0, 2, 101)[:, None, None]
    with pytest.warns(UserWarning, match=r"a\.glb has 100 morph targets"):
        path = save_animation(frames, FACES, tmp_path / "a.glb", fps=10)
    gltf = pygltflib.GLTF2().load(path)
    assert len(gltf.meshes[0].primitives[0].targets) == 100
    np.testing.assert_allclose(played(gltf, 1.234)[0], frames[12] + 0.34 * (frames[13] - frames[12]), atol=1e-5)


@pytest.mark.parametrize(
    ("n_vertices", "component"), [(65535, pygltflib.UNSIGNED_SHORT), (65536, pygltflib.UNSIGNED_INT)]
)
def test_index_type(tmp_path, n_vertices, component):
    """65535 is uint16's restart mark, so 65535 vertices (last index 65534) are the most it can name."""
    frames = np.random.default_rng(0).normal(size=(1, n_vertices, 3))
    faces = np.array([[0, 1, n_vertices - 1]])
    gltf = pygltflib.GLTF2().load(save_animation(frames, faces, tmp_path / "a.glb"))
    number = gltf.meshes[0].primitives[0].indices
    assert gltf.accessors[number].componentType == component
    assert accessor(gltf, number).tolist() == [0, 1, n_vertices - 1]


def test_normals_have_unit_length_everywhere(tmp_path):
    """A vertex without a face, a face without an area, a tiny shape: GLB wants unit normals all the same."""
    frames = np.concatenate([tetrahedra(1)[0] - [10, -3, 0], [[5, 5, 5], [6, 6, 6], [7, 7, 7.0]]])[None]
    faces = np.concatenate([FACES, [[5, 6, 6]]])
    for scale in (1.0, 1e-30):
        path = save_animation(frames * scale, faces, tmp_path / "a.glb")
        gltf = pygltflib.GLTF2().load(path)
        normals = accessor(gltf, gltf.meshes[0].primitives[0].attributes.NORMAL)
        np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1, atol=1e-6)
        np.testing.assert_array_equal(normals[4:], [[0, 0, 1]] * 3)
        assert np.abs(normals[:4] - [0, 0, 1]).max() > 0.5  # the others are not the stand-in
