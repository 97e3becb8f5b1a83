"""Size, axes and order follow from the shape: turned axes and shuffled faces give the same, up to the modes."""

from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from helpers.sheets import cylinder, folded, rectangle
from scipy.spatial.transform import Rotation

import torch_modal as tm
from torch_modal.geometry.canonical import QUANTUM, in_order, size, to_canonical
from torch_modal.geometry.decimation import decimate
from torch_modal.registration.load import load_keyframes

Mesh = tuple[np.ndarray, np.ndarray]
TURN = Rotation.from_rotvec([0.7, -1.1, 0.4]).as_matrix()


@pytest.fixture(scope="module")
def hand() -> tuple[np.ndarray, np.ndarray]:
    """Two key-frames of the sample of a hand, and its faces."""
    folder = Path(tm.__file__).parent / "samples" / "hand"
    shapes, faces = load_keyframes(sorted(folder.glob("key-*.ply")))
    return shapes.double().numpy(), faces.numpy()


def shuffled(faces: np.ndarray) -> np.ndarray:
    return np.random.default_rng(0).permutation(faces)


def test_size_of_a_ball_and_of_a_rod_is_the_diagonal_of_the_box() -> None:
    ball = trimesh.creation.icosphere(subdivisions=4, radius=3.0)
    assert size(ball.vertices, ball.faces) == pytest.approx(6 * 3**0.5, rel=2e-3)
    rod = trimesh.creation.cylinder(radius=0.001, height=5.0)
    assert size(rod.vertices, rod.faces) == pytest.approx(5.0, rel=1e-3)


@pytest.mark.parametrize("unit", [1e-200, 1.0, 1e200])
def test_size_does_not_depend_on_axes_and_goes_with_the_unit(hand: Mesh, unit: float) -> None:
    points, faces = hand[0][0], hand[1]
    moved = (points @ TURN.T + [3.0, -1.0, 2.0]) * unit
    assert size(moved, shuffled(faces)) == pytest.approx(size(points, faces) * unit, rel=1e-12)


def test_of_no_area_the_size_is_the_diagonal() -> None:
    line = np.array([[0.0, 0, 0], [1, 0, 0], [4, 0, 0]])
    assert size(line, np.array([[0, 1, 2]])) == 4.0


def test_placed_points_are_those_of_the_caller(hand: Mesh) -> None:
    points, faces = hand[0][0], hand[1]
    own, axes, centre, scale = to_canonical(points, faces)
    np.testing.assert_allclose(own @ axes / scale + centre, points, atol=QUANTUM / scale)
    assert np.linalg.det(axes) == pytest.approx(1.0)
    turned = to_canonical(points @ TURN.T * 7.0 + 5.0, shuffled(faces))[0]
    assert np.abs(turned - own).max() <= QUANTUM
    assert (turned == own).mean() > 0.999


def test_axes_of_symmetric_shapes_are_the_callers() -> None:
    """Where moments leave them open: a cube keeps its axes, though rounding differs with the order of its faces."""
    cube = trimesh.creation.box((1.0, 1.0, 1.0)).subdivide()
    for seed in range(5):
        faces = np.random.default_rng(seed).permutation(cube.faces)
        np.testing.assert_allclose(to_canonical(cube.vertices + 0.1, faces)[1], np.eye(3), atol=1e-9)
    bar = trimesh.creation.box((1.0, 4.0, 1.0))
    np.testing.assert_allclose(np.abs(to_canonical(bar.vertices, bar.faces)[1][0]), [0, 1, 0], atol=1e-9)


def test_order_of_faces_follows_from_the_points(hand: Mesh) -> None:
    points, faces = to_canonical(hand[0][0], hand[1])[0], hand[1]
    order, expected = in_order(points, faces)
    found = {tuple(np.roll(f, -f.argmin())) for f in order[expected]}
    assert {tuple(np.roll(f, -f.argmin())) for f in faces} == found
    random = np.random.default_rng(1)
    rolled = np.stack([np.roll(face, random.integers(3)) for face in random.permutation(faces)])
    np.testing.assert_array_equal(in_order(points, rolled)[1], expected)
    shuffle = random.permutation(len(points))
    own, shuffled_faces = in_order(points[shuffle], np.argsort(shuffle)[faces])
    np.testing.assert_array_equal(shuffle[own[shuffled_faces]], order[expected])


def test_collapses_do_not_depend_on_axes_and_order(hand: Mesh) -> None:
    points, faces = hand[0][0], hand[1]
    found, other = decimate(points, faces, 300), decimate(points @ TURN.T * 0.3 + 1.0, shuffled(faces), 300)
    np.testing.assert_array_equal(other[2], found[2])
    np.testing.assert_allclose((other[0] - 1.0) / 0.3 @ TURN, found[0], atol=1e-9)


def test_bases_and_in_betweens_do_not_depend_on_axes_and_order(hand: Mesh) -> None:
    shapes, faces = hand

    def half_way(x: np.ndarray, triangles: np.ndarray) -> torch.Tensor:
        keyframes, indices = torch.from_numpy(x.copy()), torch.from_numpy(triangles.copy())
        bases = tm.extract_bases(keyframes, indices, 10, cache=False, progress=False)
        with torch.no_grad():
            return tm.InBetween(bases, indices)(*keyframes, 0.5)

    expected = half_way(shapes, faces)
    diagonal = np.linalg.norm(np.ptp(shapes[0], axis=0))
    for found in (half_way(shapes, shuffled(faces)), half_way(shapes @ TURN.T, faces) @ torch.from_numpy(TURN)):
        assert (found - expected).norm(dim=-1).max() < 1e-6 * diagonal


def test_decimation_of_flat_parts_that_lie_obliquely() -> None:
    """The optimal positions of exactly flat parts are those of rounding errors."""
    flat, faces = rectangle(1.4, 1.0, 0.05)
    page = cylinder(flat, 1.0, lambda s: folded(s, 0.7, 0.2, np.radians(170)))
    found = decimate(page, faces, 200)
    assert len(found[1]) <= 200
    np.testing.assert_array_equal(decimate(page, faces, 200)[2], found[2])
