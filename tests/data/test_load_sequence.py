"""Sequences from files: folders, patterns, NPZ, and animations of others, by the letter of glTF."""

from pathlib import Path

import numpy as np
import pytest
import torch
from helpers.textured import bend, triangles_of_tube
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

import torch_modal as tm
from torch_modal.data.sequence import sequence_files
from torch_modal.io.gltf import Document

X, FACES = triangles_of_tube()
FRAMES = np.stack([bend(X, turn) for turn in np.linspace(0.01, 0.8, 6)])


def test_files_folders_and_patterns_are_the_same_sequence(tmp_path: Path) -> None:
    shown = [tmp_path / f"mesh_{n}.obj" for n in (9, 10, 11)]
    for path, x in zip(shown, FRAMES, strict=False):
        tm.save_mesh(x, FACES, path)
    (tmp_path / "notes.txt").write_text("no mesh")
    tm.save_animation(FRAMES[:3], FACES, tmp_path / "animated_mesh.glb")
    for paths, first in [
        (shown, 0),
        (tmp_path, 0),
        ([tmp_path], 0),
        (tmp_path / "m*.obj", 0),
        (tmp_path / "*_??.*", 1),
    ]:
        frames, faces, fps = tm.load_sequence(paths)
        torch.testing.assert_close(frames, torch.tensor(FRAMES[first:3]), rtol=1e-8, atol=1e-12)  # nine digits
        assert torch.equal(faces, torch.tensor(FACES)) and fps == 24
    assert sequence_files(tmp_path / "*.obj") == shown
    assert tm.load_sequence(tmp_path, 30).fps == 30
    with pytest.raises(FileNotFoundError, match="no file fits"):
        tm.load_sequence(tmp_path / "*.ply")
    with pytest.raises(ValueError, match="fps must be a positive number"):
        tm.load_sequence(tmp_path, fps=0)


def test_arrays(tmp_path: Path) -> None:
    path = tm.save_animation(FRAMES, FACES, tmp_path / "a.npz", fps=12)
    frames, faces, fps = tm.load_sequence(path)
    np.testing.assert_array_equal(frames, FRAMES)
    np.testing.assert_array_equal(faces, FACES)
    assert fps == pytest.approx(12)
    np.savez(path, frames=FRAMES.astype(np.float32), faces=FACES.astype(np.int32))
    assert tm.load_sequence(str(path)).fps == 24 and tm.load_sequence(path).frames.dtype == torch.float64
    np.savez(path, vertices=FRAMES, faces=FACES)
    with pytest.raises(tm.MeshError, match=r"a\.npz: needs arrays frames .*frames is not a file"):
        tm.load_sequence(path)


def moving_file(path: Path) -> None:
    """A node that turns carries a node with morph targets that moves, and joints of a skin with a fifth bone."""
    document = Document()
    square = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], np.float32)

    def mesh(**attributes: int) -> int:
        triangles = document.add(np.array([0, 1, 2, 0, 2, 3], np.uint16), "SCALAR")
        points = {"POSITION": document.add(square, "VEC3", bounds=True), **attributes}
        lifted = document.add(np.array([[0, 0, 1]] * 4, np.float32), "VEC3", bounds=True)
        targets = {} if attributes else {"targets": [{"POSITION": lifted}, {}]}
        return document.append("meshes", {"primitives": [{"attributes": points, "indices": triangles, **targets}]})

    weights = np.full((4, 8), 0.2, np.float32) * (np.arange(8) < 5)
    joints = np.tile(np.minimum(np.arange(8), 4), (4, 1)).astype(np.uint8)
    influences = {
        f"{name}_{k}": document.add(values[:, 4 * k : 4 * k + 4], "VEC4")
        for name, values in (("JOINTS", joints), ("WEIGHTS", weights))
        for k in (0, 1)
    }
    binds = np.tile(np.eye(4, dtype=np.float32).reshape(-1), (5, 1))
    binds[:, 14] = 2  # columns first: moved along z
    inverse = document.add(binds, "MAT4")
    document.append("nodes", {"name": "arm", "children": [1, 3]})
    document.append("nodes", {"mesh": mesh(), "scale": [2, 1, 1], "weights": [0, 0]})
    document.append("nodes", {"mesh": mesh(**influences), "skin": 0, "translation": [9, 9, 9]})
    document.append("nodes", {"name": "bone"})
    document.append("skins", {"joints": [3, 0, 0, 0, 0], "inverseBindMatrices": inverse})
    document.append("scenes", {"nodes": [0, 2]})
    turns = Rotation.from_rotvec([[0, 0, 0], [0, 0, 2.0], [0, 0, 2.0]]).as_quat().astype(np.float32)
    turns[1] *= -1  # the same rotation; players take the short way
    tracks = [
        (0, "rotation", [0, 1, 2], turns, "VEC4", "LINEAR"),
        (1, "weights", [0, 1], np.array([0, 0, 1, 1], np.float32), "SCALAR", "LINEAR"),
        (1, "translation", [0.5, 1.5], np.array([[0, 0, 0], [0, 0, 7]], np.float32), "VEC3", "STEP"),
        # Cubic: tangent before, value, tangent after.
        (3, "translation", [0, 2], np.eye(6, 3, k=-2, dtype=np.float32) * 4, "VEC3", "CUBICSPLINE"),
    ]
    samplers, channels = [], []
    for node, kind, times, values, shape, mode in tracks:
        inputs = document.add(np.array(times, np.float32), "SCALAR", bounds=True)
        channels.append({"sampler": len(samplers), "target": {"node": node, "path": kind}})
        samplers.append({"input": inputs, "output": document.add(values, shape), "interpolation": mode})
    document.append("animations", {"samplers": samplers, "channels": channels})
    path.write_bytes(document.to_glb())


def test_an_animation_of_others_by_hand(tmp_path: Path) -> None:
    moving_file(tmp_path / "a.glb")
    frames, faces, fps = tm.load_sequence(tmp_path / "a.glb", fps=4)
    assert fps == 4 and frames.shape == (9, 8, 3) and faces.tolist()[2:] == [[4, 5, 6], [4, 6, 7]]
    square = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0.0]])
    for time, frame in zip(np.arange(9) / 4, frames.numpy(), strict=True):
        turn = Rotation.from_rotvec([0, 0, 2 * min(time, 1)])
        lift = min(time, 1) + 7 * (time >= 1.5)
        np.testing.assert_allclose(frame[:4], turn.apply(square * [2, 1, 1] + [0, 0, lift]), atol=1e-6)
        # Keys are two seconds apart: Hermite weights of the tangent after the first (row 2) and of the others.
        u = time / 2
        values = 4 * np.eye(6, 3, k=-2)
        p = (1 + 2 * u) * (1 - u) ** 2 * values[1] + u**2 * (3 - 2 * u) * values[4]
        p = p + 2 * (u * (1 - u) ** 2 * values[2] + u**2 * (u - 1) * values[3])
        # A fifth of the bone that moves in the arm, four fifths of the arm: both turn, and ignore the mesh's own node.
        np.testing.assert_allclose(frame[4:], turn.apply(square + [0, 0, 2] + 0.2 * p), atol=1e-6)
    assert tm.load_sequence(tmp_path / "a.glb").fps == 2  # keys are half a second apart


def test_own_skins_and_shapes_as_animations_of_others(tmp_path: Path) -> None:
    for form in ({"bones": 6}, {"targets": 4}, {}):
        path = tm.save_animation(FRAMES, FACES, tmp_path / "a.glb", fps=10, **form)
        own = tm.load_sequence(path)
        path.write_bytes(path.read_bytes().replace(b'"generator":"torch_modal"', b'"generator":"other_thing"'))
        other = tm.load_sequence(path)
        torch.testing.assert_close(own.frames, other.frames, atol=1e-6, rtol=0)
        assert own.fps == pytest.approx(10) and other.fps == 10


@pytest.mark.parametrize("form", [{"bones": 6}, {}])
def test_what_blender_exports_is_read(tmp_path: Path, form: dict[str, int]) -> None:
    bpy = pytest.importorskip("bpy", reason="bpy is not installed")
    path = tm.save_animation(FRAMES, FACES, tmp_path / "a.glb", fps=24, **form)
    bpy.ops.wm.read_factory_settings(use_empty=True)
    bpy.ops.import_scene.gltf(filepath=str(path))
    bpy.ops.export_scene.gltf(filepath=str(tmp_path / "b.glb"))
    own, (frames, _, fps) = tm.load_sequence(path).frames.numpy(), tm.load_sequence(tmp_path / "b.glb")
    assert fps == 24 and len(frames) == len(own)
    same = cKDTree(own[0]).query(frames[0].numpy())[1]
    diagonal = np.linalg.norm(np.ptp(own[0], axis=0))
    assert np.abs(frames.numpy() - own[:, same]).max() < 1e-4 * diagonal
