"""Key-frames whose vertices were split along seams: one surface for the solve, no gap in the result."""

from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from helpers.textured import bend, split_at_seams, textured_glb, triangles_of_tube

import torch_modal as tm
from torch_modal.cli import main as cli
from torch_modal.geometry.connectivity import Connectivity, merge_seams

FAST = ["--modes", "6", "--levels", "2", "--mesher", "lattice", "--preset", "fast", "--quiet"]


def split_keyframes(turn: float = 0.9) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Straight and bent bar with split vertices: key-frames, faces, the original of each vertex, whole ones, faces."""
    x, faces = triangles_of_tube()
    original, split, _ = split_at_seams(faces)
    whole = np.stack([x, bend(x, turn)])
    return whole[:, original], split, original, whole, faces


def gap(frames: np.ndarray, original: np.ndarray) -> float:
    """How far copies of a vertex lie apart, in diagonals of the first frame."""
    first = np.unique(original, return_index=True)[1]
    apart = np.linalg.norm(frames - frames[:, first[original]], axis=-1).max()
    return float(apart / np.linalg.norm(np.ptp(frames[0], axis=0)))


def test_split_vertices_are_joined_and_scattered_back():
    keyframes, split, original, whole, faces = split_keyframes()
    assert len(Connectivity(split).boundary_edges) and not len(Connectivity(faces).boundary_edges)
    welded = tm.weld_seams(keyframes, split)
    assert welded.keyframes.shape == whole.shape and not len(Connectivity(welded.faces.numpy()).boundary_edges)
    assert welded.n_merged == len(original) - len(whole[0])
    assert torch.equal(welded.scatter(welded.keyframes), torch.from_numpy(keyframes))
    # The same grouping as the true one.
    pairs = np.unique(np.stack([welded.vertex_of.numpy(), original], axis=1), axis=0)
    assert len(pairs) == len(whole[0])
    single = tm.weld_seams(torch.from_numpy(keyframes).float(), split)
    assert single.keyframes.dtype == torch.float32 and single.n_merged == welded.n_merged


def test_what_is_not_a_seam_stays_apart():
    keyframes, split, original, whole, faces = split_keyframes()
    parting = keyframes.copy()
    parting[1, original == 5] += np.arange((original == 5).sum())[:, None]  # copies that part in a key-frame
    assert tm.weld_seams(parting, split).n_merged == tm.weld_seams(keyframes, split).n_merged - 1
    closed = np.concatenate([whole, whole], axis=1), np.concatenate([faces, faces + whole.shape[1]])
    assert tm.weld_seams(*closed).n_merged == 0  # two closed surfaces on each other
    plain = tm.weld_seams(whole, faces)
    assert plain.n_merged == 0 and torch.equal(plain.keyframes, torch.from_numpy(whole))
    np.testing.assert_array_equal(merge_seams(whole, faces), np.arange(whole.shape[1]))


def test_faces_that_lose_a_corner_are_left_out():
    """The pole of a sphere, once for each meridian."""
    x = np.array([[0, 0, 1], [0, 0, 1], [1, 0, 0], [0, 1, 0], [-1, -1, 0.0]])
    welded = tm.weld_seams(x[None], [[0, 2, 3], [1, 3, 4], [0, 1, 3]])
    assert welded.faces.tolist() == [[0, 1, 2], [0, 2, 3]] and welded.vertex_of.tolist() == [0, 0, 1, 2, 3]


def test_rounding_of_float32_does_not_part_copies():
    keyframes, split, _, _, _ = split_keyframes()
    noisy = keyframes + 1e-8 * np.random.default_rng(0).normal(size=keyframes.shape)
    assert tm.weld_seams(noisy, split).n_merged == tm.weld_seams(keyframes, split).n_merged


@pytest.mark.parametrize("keyframes", [np.zeros((2, 3)), np.full((1, 3, 3), np.nan), np.zeros((1, 2, 3))])
def test_bad_input_is_refused(keyframes):
    with pytest.raises(tm.MeshError):
        tm.weld_seams(keyframes, [[0, 1, 2]])


@pytest.mark.parametrize("suffix", ["obj", "ply", "glb"])
def test_no_gap_after_subdivide(tmp_path: Path, suffix: str) -> None:
    """A bar as exporters write it, through the command line and back."""
    keyframes, split, original, whole, _ = split_keyframes()
    files = []
    for number, shape in enumerate(keyframes):
        path = tmp_path / f"key-{number}.{suffix}"
        if suffix == "glb":
            textured_glb(path, whole[number])
        else:
            uv = split_at_seams(triangles_of_tube()[1])[2]
            trimesh.Trimesh(shape, split, process=False, visual=trimesh.visual.TextureVisuals(uv=uv)).export(path)
        files.append(path)
    assert cli.main(["subdivide", *map(str, files), "--out", str(tmp_path / "out"), *FAST]) == 0
    frames, faces = tm.load_keyframes(sorted((tmp_path / "out").glob(f"frame-*.{suffix}")))
    given, given_faces = tm.load_keyframes(files)
    assert len(frames) == 5 and torch.equal(faces, given_faces)
    np.testing.assert_allclose(frames[[0, 4]], given, rtol=0, atol=1e-6 if suffix == "glb" else 0)
    if suffix == "glb":  # the body's vertices, then those of the caps
        n_body = 2 * 12 * 7
        order = np.concatenate([np.unique(split[:n_body]), np.unique(split[n_body:])])
        original = original[order]
    assert gap(frames.numpy(), original) < 1e-9
    # Not merely closed: half-way, the bar is bent half as much.
    half = bend(whole[0], 0.45)[original]
    error = np.linalg.norm(frames[2].numpy() - fitted(half, frames[2].numpy()), axis=1)
    assert error.max() < 0.15


def fitted(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """The shape x, moved on to y."""
    u, _, vt = np.linalg.svd((y - y.mean(0)).T @ (x - x.mean(0)))
    return (x - x.mean(0)) @ (u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt).T + y.mean(0)
