"""Skins and principal shapes in GLB files: by the letter of glTF, and in other programs where these are installed."""

import tracemalloc
from pathlib import Path

import numpy as np
import pygltflib
import pytest
from helpers import gltf_validator
from helpers.gltf_validator import accessor
from helpers.textured import bend, textured_glb, textured_obj, triangles_of_tube
from scipy.spatial.transform import Rotation, Slerp

import torch_modal as tm
from torch_modal.cli.main import main
from torch_modal.data.sequence import read_shapes

X, FACES = triangles_of_tube()
SPIN = Rotation.from_rotvec(np.radians(np.linspace(0, 500, 9))[:, None] * [0, 1, 0])  # beyond a full turn
FRAMES = np.stack([turn.apply(bend(X, 0.01 + 0.2 * n)) + n for n, turn in enumerate(SPIN)])
DIAGONAL = float(np.linalg.norm(np.ptp(FRAMES[0], axis=0)))
TOLERANCE = 1e-4  # of the diagonal


def skinned(path: Path, time: float) -> list[np.ndarray]:
    """Positions of each primitive at a time, in the order of the nodes (section 3.7.3.3)."""
    gltf = pygltflib.GLTF2().load(str(path))
    local = []
    for node in gltf.nodes:  # those of the file that are moved aside may have a matrix; no joint has
        local.append([node.translation or [0, 0, 0], node.rotation or [0, 0, 0, 1]])
    (animation,) = gltf.animations
    for channel in animation.channels:
        sampler = animation.samplers[channel.sampler]
        times, values = accessor(gltf, sampler.input), accessor(gltf, sampler.output)
        if channel.target.path == "rotation":
            assert ((values[1:] * values[:-1]).sum(1) > 0).all(), "a rotation flips its sign"
            np.testing.assert_allclose(np.linalg.norm(values, axis=1), 1, atol=1e-4)
            local[channel.target.node][1] = Slerp(times, Rotation.from_quat(values))(time).as_quat()
        else:
            local[channel.target.node][0] = [np.interp(time, times, column) for column in values.T]
    joint_nodes = {joint for skin in gltf.skins for joint in [*skin.joints, skin.skeleton]}
    assert all(gltf.nodes[joint].matrix is None for joint in joint_nodes)
    parents = {child: number for number, node in enumerate(gltf.nodes) for child in node.children or []}

    def world(number: int) -> np.ndarray:
        own = np.eye(4)
        own[:3, :3], own[:3, 3] = Rotation.from_quat(local[number][1]).as_matrix(), local[number][0]
        return world(parents[number]) @ own if number in parents else own

    shapes = []
    for node in gltf.nodes:
        if node.skin is None:
            continue
        skin = gltf.skins[node.skin]
        inverse = accessor(gltf, skin.inverseBindMatrices).reshape(-1, 4, 4).transpose(0, 2, 1)
        assert {parents[joint] for joint in skin.joints} == {skin.skeleton}  # flat, below one root
        bones = np.stack([world(joint) for joint in skin.joints]) @ inverse
        for primitive in gltf.meshes[node.mesh].primitives:
            read = primitive.attributes
            weights, joints = accessor(gltf, read.WEIGHTS_0), accessor(gltf, read.JOINTS_0).astype(int)
            np.testing.assert_allclose(weights.sum(1), 1, atol=1e-12)
            assert not joints[weights == 0].any()
            points = np.pad(accessor(gltf, read.POSITION), ((0, 0), (0, 1)), constant_values=1)
            shapes.append(np.einsum("pk,pkab,pb->pa", weights, bones[joints], points)[:, :3])
    return shapes


@pytest.mark.parametrize(
    "options", [{}, {"cyclic": True}, {"ping_pong": True, "ease": True}, {"times": np.arange(9) ** 2}]
)
def test_a_skin_by_the_letter(tmp_path, options):
    skin = tm.bake(FRAMES, FACES, 6)
    path = tm.save_animation(FRAMES, FACES, tmp_path / "a.glb", bones=6, keyframe_indices=[0, 8], duration=2, **options)
    assert not gltf_validator.issues(path)
    gltf = pygltflib.GLTF2().load(str(path))
    times = accessor(gltf, gltf.animations[0].samplers[0].input)
    shown = [*range(9), *{"cyclic": [0], "ping_pong": range(7, -1, -1)}.get(next(iter(options), ""), [])]
    assert len(times) == len(shown) and len(gltf.skins[0].joints) == skin.weights.shape[1]
    shapes = skin.shapes().numpy()
    for time, n in zip(times, shown, strict=True):
        (found,) = skinned(path, time)
        assert np.abs(found - shapes[n]).max() < TOLERANCE * DIAGONAL
    frames, faces, said = read_shapes([path])
    assert np.abs(frames - shapes).max() < TOLERANCE * DIAGONAL and said["keyframe_indices"] == [0, 8]
    np.testing.assert_array_equal(faces, FACES)
    # Between frames, bones turn instead of cutting the corner.
    middle = skinned(path, 0.5 * (times[0] + times[1]))[0]
    length = np.linalg.norm(np.ptp(middle, axis=0))
    assert length > 0.9 * DIAGONAL > np.linalg.norm(np.ptp(0.5 * (FRAMES[0] + FRAMES[1]), axis=0)) * 0.9


def test_bones_are_where_their_weights_are(tmp_path):
    skin = tm.bake(FRAMES, FACES, 6)
    gltf = pygltflib.GLTF2().load(str(tm.save_animation(FRAMES, FACES, tmp_path / "a.glb", bones=skin)))
    binds = accessor(gltf, gltf.skins[0].inverseBindMatrices).reshape(-1, 4, 4).transpose(0, 2, 1)
    centres = (skin.weights.T @ skin.rest / skin.weights.sum(0)[:, None]).numpy()
    np.testing.assert_allclose(np.linalg.inv(binds)[:, :3, 3], centres, atol=1e-5)
    # The file at rest, without its animation, is the rest shape.
    root = np.array(gltf.nodes[gltf.skins[0].skeleton].translation)
    rest = [np.array(gltf.nodes[joint].translation) + root for joint in gltf.skins[0].joints]
    np.testing.assert_allclose(rest, centres, atol=1e-5)
    # The root turns with the body.
    (turns,) = [
        accessor(gltf, gltf.animations[0].samplers[channel.sampler].output)
        for channel in gltf.animations[0].channels
        if channel.target.node == gltf.skins[0].skeleton and channel.target.path == "rotation"
    ]
    for turn, shape in zip(turns, skin.shapes().numpy(), strict=True):
        best, _ = Rotation.align_vectors(shape - shape.mean(0), FRAMES[0] - FRAMES[0].mean(0))
        assert (Rotation.from_quat(turn).inv() * best).magnitude() < 1e-3


@pytest.mark.parametrize("suffix", ["obj", "glb"])
def test_materials_and_nodes_stay(tmp_path, suffix):
    asset = tm.open_asset(textured_obj(tmp_path, "bar.obj") if suffix == "obj" else textured_glb(tmp_path / "bar.glb"))
    moved = np.stack([bend(asset.positions, turn) for turn in (0.01, 0.4, 0.8)])
    skin = tm.bake(moved, asset.faces, 5)
    plain, path = (
        tm.save_animation(moved, asset.faces, tmp_path / f"{name}.glb", asset=asset, bones=bones)
        for name, bones in (("plain", None), ("skin", skin))
    )
    assert not gltf_validator.issues(path)
    one, two = (pygltflib.GLTF2().load(str(file)) for file in (plain, path))
    for kind in ("materials", "images", "textures"):
        assert getattr(one, kind) == getattr(two, kind) or kind == "images"
    assert len(one.images) == len(two.images) > 0
    uvs = [
        [p.attributes.TEXCOORD_0 is not None for mesh in gltf.meshes for p in mesh.primitives] for gltf in (one, two)
    ]
    assert uvs[0] == uvs[1]
    shapes = skin.shapes().numpy()
    for time, frame in zip((0, 1, 2), shapes, strict=True):
        expected = [frame[part.vertices] for part in asset.parts()]
        for found, own in zip(skinned(path, time), expected, strict=True):
            assert np.abs(found - own).max() < TOLERANCE * np.linalg.norm(np.ptp(shapes[0], axis=0))


def test_principal_shapes(tmp_path):
    path = tm.save_animation(FRAMES, FACES, tmp_path / "a.glb", targets=3)
    assert not gltf_validator.issues(path)
    gltf = pygltflib.GLTF2().load(str(path))
    primitive = gltf.meshes[0].primitives[0]
    assert len(primitive.targets) == 3 and gltf.meshes[0].extras["targetNames"][0] == "principal-1"
    # Blender clamps weights to this range.
    weights = accessor(gltf, gltf.animations[0].samplers[0].output).reshape(9, 3)
    np.testing.assert_allclose([weights.min(0), weights.max(0)], [[0] * 3, [1] * 3], atol=1e-6)
    np.testing.assert_allclose(gltf.meshes[0].weights, weights[0], atol=1e-6)
    # The error is the rest of the singular values.
    values = np.linalg.svd((FRAMES - FRAMES.mean(0)).reshape(9, -1), compute_uv=False)
    off = read_shapes([path])[0] - FRAMES
    assert np.sum(off**2) == pytest.approx(np.sum(values[3:] ** 2), rel=1e-3)
    exact = tm.save_animation(FRAMES[:4], FACES, tmp_path / "b.glb", targets=3)
    np.testing.assert_allclose(read_shapes([exact])[0], FRAMES[:4], atol=1e-5)
    still = tm.save_animation(FRAMES[[0, 0]], FACES, tmp_path / "c.glb", targets=1)
    np.testing.assert_allclose(read_shapes([still])[0], FRAMES[[0, 0]], atol=1e-5)
    few = FRAMES[:, ::40]  # more frames than coordinates
    path = tm.save_animation(few[:, :2], [[0, 1, 1]], tmp_path / "d.glb", targets=6)
    np.testing.assert_allclose(read_shapes([path])[0], few[:, :2], atol=1e-5)


@pytest.mark.parametrize("form", [{"bones": 2}, {"targets": 2}])
def test_memory_does_not_grow_with_the_square_of_the_frames(tmp_path, form):
    frames = np.stack(
        [turn.apply(X[::20]) for turn in Rotation.from_rotvec(np.linspace(0, 9, 4000)[:, None] * [0, 0, 1])]
    )
    tracemalloc.start()
    tm.save_animation(frames, [[0, 1, 2], [2, 3, 4]], tmp_path / "a.glb", **form)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 8 * 4000**2 / 4  # a quarter of such a matrix


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"frames": FRAMES[:1]}, "2 frames and 4 vertices"),
        ({"frames": FRAMES[:, :2], "faces": [[0, 1, 1]]}, "2 frames and 4 vertices"),
        ({"frames": FRAMES * np.nan}, "finite numbers"),
        ({"bones": 99}, "bones must be a whole number from 1 to"),
        ({"bones": "40"}, "bones must be a whole number"),
        *(({"name": name}, "two forms of a .glb file") for name in ("a.obj", "a.stl", "a.mp4", "a.usdc")),
        ({"targets": 3}, "two forms of a .glb file"),
        ({"bones": None, "targets": 9}, "targets must be a whole number, 1 to 8 of these frames; got 9"),
        ({"bones": None, "targets": 0}, "targets must be"),
        ({"bones": tm.bake(FRAMES[:5], FACES, 2)}, "a skin of 5 other frames than these 9"),
        ({"bones": tm.bake(FRAMES[:, :90], FACES[(FACES < 90).all(1)], 2)}, "other frames than these 9"),
    ],
)
def test_what_cannot_be_written(tmp_path, options, message):
    given = {"frames": FRAMES, "faces": FACES, "bones": 4, "name": "a.glb"} | options
    with pytest.raises(ValueError, match=message):
        tm.save_animation(given.pop("frames"), given.pop("faces"), tmp_path / given.pop("name"), **given)
    assert not list(tmp_path.iterdir())


def test_subdivide_command_writes_bones_and_targets(tmp_path, capsys):
    keys = tm.save_mesh(FRAMES[:3], FACES, tmp_path / "keys", fmt="obj")
    common = ["subdivide", *map(str, keys), "--levels", "2", "--quiet", "--out"]
    assert main([*common, str(tmp_path / "a.glb"), "--bones", "6"]) == 0
    assert main([*common, str(tmp_path / "b.glb"), "--targets", "4"]) == 0
    assert (tmp_path / "a.glb").stat().st_size > 0 and len(skinned(tmp_path / "a.glb", 0.3)) == 1
    assert main([*common, str(tmp_path / "c.gif"), "--bones", "6"]) == 1
    assert "two forms of a .glb file" in capsys.readouterr().err
    assert main(["view", str(tmp_path / "a.glb"), "--page", str(tmp_path / "a.html"), "--quiet"]) == 0


def test_blender_plays_the_frames(tmp_path):
    bpy = pytest.importorskip("bpy", reason="bpy is not installed")
    path = tm.save_animation(FRAMES, FACES, tmp_path / "a.glb", fps=24, bones=6)
    bpy.ops.wm.read_factory_settings(use_empty=True)
    bpy.ops.import_scene.gltf(filepath=str(path))
    scene = bpy.context.scene
    (own,) = [each for each in scene.objects if each.type == "MESH" and len(each.data.vertices) == len(X)]
    start = round(min(action.frame_range[0] for action in bpy.data.actions))
    for n, shape in enumerate(read_shapes([path])[0]):
        scene.frame_set(start + n)
        posed = own.evaluated_get(bpy.context.evaluated_depsgraph_get())
        points = np.array([posed.matrix_world @ vertex.co for vertex in posed.data.vertices])
        x, y, z = shape.T  # Blender's Z is up
        assert np.abs(points - np.stack([x, -z, y], 1)).max() < TOLERANCE * DIAGONAL
