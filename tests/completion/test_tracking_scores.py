"""The benchmark of tracked motions, on a folder in its layout."""

from pathlib import Path

import pytest
import torch
import tracking
import trimesh
from test_completion import bending_tube
from test_read import write_cloud

import torch_modal as tm


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three frames of a bending tube, and clouds of all of its surface."""
    folder = tmp_path_factory.mktemp("tracking")
    x, faces, _ = bending_tube(24, 12)
    tm.save_mesh(x[:3], faces, folder / "tube", "obj")
    for i, one in enumerate(x[:3].numpy()):
        mesh = trimesh.Trimesh(one, faces.numpy(), process=False)
        points, face = trimesh.sample.sample_surface(mesh, 1500, seed=i)
        write_cloud(folder / f"tube{i:02d}.ply", points, mesh.face_normals[face])
    return folder


def test_a_folder_is_tracked_and_scored(folder: Path) -> None:
    n, (chamfer, consistency, f, correspondence, mean, first, last, _) = tracking.track(folder, "tube")
    x, _, diagonal = bending_tube(24, 12)
    still = float((x[1:3] - x[0]).norm(dim=-1).mean())
    assert n == 3 and chamfer < 1e-5 and consistency > 0.98 and f > 0.9
    assert correspondence < 0.1 * still
    assert mean == pytest.approx((first + last) / 2) and mean < 10 * still / diagonal


def test_scores_of_the_truth_and_of_a_moved_shape() -> None:
    """Samples of both are drawn alike, so that a move is the distance of each pair."""
    x, faces, diagonal = bending_tube(24, 12)
    moved = x + 0.3 * torch.tensor([0.0, 0.0, 1e-3])
    chamfer, consistency, f, correspondence, mean, first, last = tracking.scores(moved, x, faces)
    assert chamfer < 1e-6 and consistency > 0.98 and f > 0.99
    assert correspondence == pytest.approx(3e-4, rel=1e-6)
    assert [mean, first, last] == pytest.approx(3 * [3e-2 / diagonal], rel=1e-3)


def test_clouds_without_their_meshes_are_named(folder: Path) -> None:
    with pytest.raises(SystemExit, match="has 0 meshes"):
        tracking.track(folder, "none")
