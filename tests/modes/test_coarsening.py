"""Clusters of vertices: a total, linear restriction, and a coarse energy that means what the fine one does."""

from pathlib import Path

import numpy as np
import pytest
import torch
from conftest import Shapes
from helpers.bodies import body

from torch_modal.elastic.shell import ShellEnergy
from torch_modal.keyframes.check import Keyframes
from torch_modal.modes import coarsening
from torch_modal.modes.coarsening import Coarsening, coarsen


@pytest.fixture(scope="module")
def fine(bars: Shapes) -> tuple[np.ndarray, np.ndarray]:
    """Key-frames and faces; vertices 0 and 90 belong to no face."""
    keyframes, faces = bars.keyframes.numpy(), bars.faces.numpy()
    stray = np.full((len(keyframes), 1, 3), 1e3)
    keyframes = np.concatenate([stray, keyframes[:, :89], stray, keyframes[:, 89:]], 1)
    faces = faces + 1
    return keyframes, faces + (faces >= 90)


@pytest.fixture(scope="module")
def coarse(fine: tuple[np.ndarray, np.ndarray]) -> Coarsening:
    return coarsen(*fine, 100)


def test_partition_is_total(fine: tuple[np.ndarray, np.ndarray], coarse: Coarsening) -> None:
    assert coarse.clusters.shape == (fine[0].shape[1],)
    assert np.flatnonzero(coarse.clusters < 0).tolist() == [0, 90]
    assert np.unique(coarse.clusters[coarse.clusters >= 0]).tolist() == list(range(coarse.n_vertices))


def test_faces_are_triangles_of_the_fine_mesh(fine: tuple[np.ndarray, np.ndarray], coarse: Coarsening) -> None:
    assert 60 <= len(coarse.faces) <= 100
    assert (np.diff(np.sort(coarse.faces, 1), axis=1) > 0).all(), "a vertex twice in a face"
    assert len(np.unique(np.sort(coarse.faces, 1), axis=0)) == len(coarse.faces), "a face twice"
    assert np.unique(coarse.faces).tolist() == list(range(coarse.n_vertices))
    # Each comes from a fine face, with its winding: every turn of its corners is that of a fine face.
    lifted = {tuple(np.roll(face, turn)) for face in coarse.clusters[fine[1]] for turn in range(3)}
    assert {tuple(face) for face in coarse.faces} <= lifted


def test_averages_by_hand(fine: tuple[np.ndarray, np.ndarray], coarse: Coarsening) -> None:
    x = fine[0]
    by_hand = np.stack([x[:, coarse.clusters == i].mean(1) for i in range(coarse.n_vertices)], 1)
    np.testing.assert_allclose(coarse.restrict(x), by_hand, atol=1e-13)
    np.testing.assert_allclose(coarse.restrict(x[1]), by_hand[1], atol=1e-13)
    assert coarse.restrict(x[None, :, :]).shape == (1, 3, coarse.n_vertices, 3)


def test_small_mesh_stays_as_it_is(fine: tuple[np.ndarray, np.ndarray]) -> None:
    keyframes, faces = fine
    same = coarsen(keyframes, faces, len(faces))
    used = np.setdiff1d(np.arange(keyframes.shape[1]), [0, 90])
    np.testing.assert_array_equal(same.restrict(keyframes), keyframes[:, used])
    np.testing.assert_array_equal(used[same.faces], faces)
    assert same.clusters[[0, 90]].tolist() == [-1, -1]


def energy_ratio(coarse: Coarsening, keyframes: np.ndarray, faces: np.ndarray) -> float:
    """Coarse over fine energy between the first and the last shape."""
    on_fine, on_coarse = ShellEnergy(torch.from_numpy(faces)), ShellEnergy(torch.from_numpy(coarse.faces))
    restricted = coarse.restrict(keyframes)
    energies = [shell(*torch.from_numpy(x[[0, -1]])) for shell, x in ((on_coarse, restricted), (on_fine, keyframes))]
    return float(energies[0] / energies[1])


def test_slivers_of_a_straight_limb_are_avoided() -> None:
    """Collapses chosen on the straight limb leave slivers along it, which the other key-frame has not."""
    shape = body("limb bent 120")
    keyframes, faces = np.stack([shape.pose(0.0), shape.pose(1.0)]), np.array(shape.faces)
    keyframes *= 100 / np.linalg.norm(np.ptp(keyframes[0], axis=0))
    ratio = energy_ratio(coarsen(keyframes, faces, 500), keyframes, faces)
    alone = energy_ratio(coarsening.collapse(keyframes[0], faces, 500), keyframes, faces)
    assert alone > 10, "the limb does not show the danger any more"
    assert 0.2 < ratio < 5


def test_coarse_energy_of_a_hand_is_near_the_fine_one(hand_path: Keyframes) -> None:
    """Within a factor of 2.5; measured 0.48 to 0.68."""
    x, faces = hand_path.keyframes.numpy(), hand_path.faces.numpy()
    x = x * (100 / np.linalg.norm(np.ptp(x[0], axis=0)))
    coarse = coarsen(x, faces, 1000)
    assert len(coarse.faces) == 1000
    for pair in ([0, 4], [0, 2], [2, 4]):
        assert 0.4 < energy_ratio(coarse, x[pair], faces) < 2.5


def test_no_triangle_has_its_corners_on_a_line() -> None:
    """Regular bars, straight and bent: cluster averages of their flat sides may lie on one line."""
    for name in ("bar bent 90", "bar bent 180"):
        shape = body(name)
        keyframes, faces = np.stack([shape.pose(0.0), shape.pose(1.0)]), np.array(shape.faces)
        coarse = coarsen(keyframes, faces, 1000)
        corners = coarse.restrict(keyframes)[:, coarse.faces]
        sides = corners - np.roll(corners, 1, axis=2)
        area = 0.5 * np.linalg.norm(np.cross(sides[..., 0, :], sides[..., 1, :]), axis=-1)
        assert (area / (sides**2).sum(-1).max(-1)).min() > 1e-3


@pytest.mark.parametrize("n_faces", [1150, 1400, 1600, 1800])
def test_meshes_of_few_more_faces_than_wanted(data_dir: Path, n_faces: int) -> None:
    """Of 1,820 faces: where needles remain, more are tried, but never as many as there are."""
    with np.load(data_dir / "animals" / "trex.npz") as file:
        keyframes, faces = file["frames"][[0, 10]].astype(np.float64), file["faces"].astype(np.int64)
    for shapes in (keyframes, keyframes[:1]):
        assert n_faces / 2 < len(coarsen(shapes, faces, n_faces).faces) < len(faces)


def test_known_collapses_give_the_same_clusters(hand_path: Keyframes) -> None:
    """Those down to 300 faces begin with those down to more."""
    x, faces = hand_path.keyframes.numpy()[[0, 4]], hand_path.faces.numpy()
    known: dict[int, np.ndarray] = {}
    for n_faces in (300, 450, 675, 1000):
        found, alone = coarsen(x, faces, n_faces, None, known), coarsen(x, faces, n_faces)
        np.testing.assert_array_equal(found.clusters, alone.clusters)
        np.testing.assert_array_equal(found.faces, alone.faces)


def test_candidates_alone_are_tried(fine: tuple[np.ndarray, np.ndarray]) -> None:
    keyframes, faces = fine
    for index in range(len(keyframes)):
        found = coarsen(keyframes, faces, 100, [index])
        np.testing.assert_array_equal(found.clusters, coarsening.collapse(keyframes[index], faces, 100).clusters)
