"""BisectedMesh tetrahedra share their sides, fill what they filled, and are as small as points in them want."""

import numpy as np
import pytest

from torch_modal.precompute.bisection import BisectedMesh, bisected

CUBES = np.argwhere(np.ones((5, 4, 3), dtype=bool))
RANDOM = np.random.default_rng(0)
POINTS = RANDOM.uniform(0, 1, (3000, 3)) * [5.0, 4.0, 3.0]
WANTED = np.clip(np.linalg.norm(POINTS - [2.2, 1.9, 1.4], axis=1) / 4, 0.15, 1.5)


def everything(places: np.ndarray) -> np.ndarray:
    return np.ones(len(places), dtype=bool)


@pytest.fixture(scope="module")
def graded() -> BisectedMesh:
    return bisected(CUBES, POINTS, WANTED, everything, 10**6)


def volumes(mesh: BisectedMesh) -> np.ndarray:
    corners = mesh.vertices[mesh.tets]
    return np.linalg.det(corners[:, 1:] - corners[:, :1]) / 6


def test_sizes_are_those_that_are_wanted(graded: BisectedMesh) -> None:
    assert (graded.sizes[graded.owner] <= WANTED).all()
    np.testing.assert_allclose(volumes(graded), graded.sizes**3 / 6, atol=1e-15)
    assert volumes(graded).sum() == pytest.approx(len(CUBES))
    # Large ones stay where nothing is asked for.
    assert graded.sizes.max() > 0.6 and graded.sizes.min() <= 0.15


def test_sides_fit(graded: BisectedMesh) -> None:
    """A side belongs to two tetrahedra, or lies on the outside: no vertex hangs on a side or an edge of another."""
    sides = np.sort(np.concatenate([graded.tets[:, c] for c in ([1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2])]), axis=1)
    found, times = np.unique(sides, axis=0, return_counts=True)
    assert times.max() == 2
    corners = graded.vertices[found[times == 1]]
    assert ((corners == 0) | (corners == [5, 4, 3])).all(axis=1).any(axis=1).all()


def test_points_lie_in_their_tetrahedra(graded: BisectedMesh) -> None:
    corners = graded.vertices[graded.tets[graded.owner]]
    edges = (corners[:, 1:] - corners[:, :1]).transpose(0, 2, 1)
    shares = np.linalg.solve(edges, (POINTS - corners[:, 0])[..., None])[..., 0]
    assert shares.min() > -1e-12 and shares.sum(axis=1).max() < 1 + 1e-12


def test_no_halving_is_six_for_each_cube() -> None:
    mesh = bisected(CUBES, POINTS, np.full(len(POINTS), 2.0), everything, 10**6)
    assert len(mesh.tets) == 6 * len(CUBES) and len(mesh.vertices) == 6 * 5 * 4


def test_the_worst_go_first_within_the_bound() -> None:
    few = bisected(CUBES, POINTS, WANTED / 2, everything, 3000)
    assert 3000 <= len(few.tets) < 6000
    ratio = few.sizes[few.owner] / (WANTED / 2)
    assert ratio.max() < 5.0  # without any it is 13


def test_what_is_outside_is_left_out() -> None:
    left = POINTS[POINTS[:, 0] < 2]
    mesh = bisected(CUBES, left, np.full(len(left), 0.7), lambda places: places[:, 0] < 2.0, 10**6)
    low = mesh.vertices[mesh.tets][..., 0].min(axis=1)
    assert low.max() < 2.0
    assert volumes(mesh).sum() == pytest.approx(2 * 4 * 3, rel=0.2)
