"""Bisected tetrahedra share their sides, fill what they filled, and are as small as points in them want."""

import numpy as np
import pytest

from torch_modal.modes.bisection import bisect
from torch_modal.modes.tetrahedra import Tetrahedra, tet_volumes

Mesh = tuple[Tetrahedra, np.ndarray]
CUBES = np.argwhere(np.ones((5, 4, 3), dtype=bool))
RANDOM = np.random.default_rng(0)
POINTS = RANDOM.uniform(0, 1, (3000, 3)) * [5.0, 4.0, 3.0]
WANTED = np.clip(np.linalg.norm(POINTS - [2.2, 1.9, 1.4], axis=1) / 4, 0.15, 1.5)


def everything(places: np.ndarray) -> np.ndarray:
    return np.ones(len(places), dtype=bool)


@pytest.fixture(scope="module")
def graded() -> Mesh:
    return bisect(CUBES, POINTS, WANTED, everything, 10**6)


def test_sizes_are_those_that_are_wanted(graded: Mesh) -> None:
    volumes = tet_volumes(graded[0])
    sizes = np.cbrt(6 * volumes)
    assert (sizes[graded[1]] <= WANTED + 1e-12).all()
    assert volumes.sum() == pytest.approx(len(CUBES))
    # Large ones stay where nothing is asked for.
    assert sizes.max() > 0.6 and sizes.min() <= 0.15


def test_sides_fit(graded: Mesh) -> None:
    """A side belongs to two tetrahedra, or lies on the outside: no vertex hangs on a side or an edge of another."""
    vertices, tets, _ = graded[0]
    sides = np.sort(np.concatenate([tets[:, c] for c in ([1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2])]), axis=1)
    found, times = np.unique(sides, axis=0, return_counts=True)
    assert times.max() == 2
    corners = vertices[found[times == 1]]
    assert ((corners == 0) | (corners == [5, 4, 3])).all(axis=1).any(axis=1).all()


def test_points_lie_in_their_tetrahedra(graded: Mesh) -> None:
    corners = graded[0].vertices[graded[0].tets[graded[1]]]
    edges = (corners[:, 1:] - corners[:, :1]).transpose(0, 2, 1)
    shares = np.linalg.solve(edges, (POINTS - corners[:, 0])[..., None])[..., 0]
    assert shares.min() > -1e-12 and shares.sum(axis=1).max() < 1 + 1e-12


def test_the_worst_go_first_within_the_bound() -> None:
    few, owner = bisect(CUBES, POINTS, WANTED / 2, everything, 3000)
    assert 3000 <= len(few.tets) < 6000
    ratio = np.cbrt(6 * tet_volumes(few))[owner] / (WANTED / 2)
    assert ratio.max() < 5.0  # without any it is 13


def test_what_is_outside_is_left_out() -> None:
    left = POINTS[POINTS[:, 0] < 2]
    mesh, _ = bisect(CUBES, left, np.full(len(left), 0.7), lambda places: places[:, 0] < 2.0, 10**6)
    assert mesh.vertices[mesh.tets][..., 0].min(axis=1).max() < 2.0
    assert tet_volumes(mesh).sum() == pytest.approx(2 * 4 * 3, rel=0.2)
