"""Connectivity against meshes small enough to read, and against trimesh on a larger one."""

import itertools

import numpy as np
import pytest
import trimesh

from torch_modal.geometry import connectivity

SQUARE = np.array([[0, 1, 2], [0, 2, 3]])  # open, one interior edge
TETRAHEDRON = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]])  # closed
FINS = np.array([[0, 1, 2], [1, 0, 3], [0, 1, 4]])  # three faces at the edge 01
AGAINST = np.array([[0, 1, 2], [0, 3, 2]])  # the second face winds against the first


def test_unique_edges() -> None:
    edges, counts = connectivity.unique_edges(SQUARE)
    assert edges.tolist() == [[0, 1], [0, 2], [0, 3], [1, 2], [2, 3]]
    assert counts.tolist() == [1, 2, 1, 1, 1]
    edges, counts = connectivity.unique_edges(TETRAHEDRON)
    assert edges.tolist() == [list(pair) for pair in itertools.combinations(range(4), 2)]
    assert counts.tolist() == [2] * 6
    edges, counts = connectivity.unique_edges(FINS)
    assert len(edges) == 7
    assert counts.tolist() == [3, 1, 1, 1, 1, 1, 1]


@pytest.mark.parametrize(("faces", "n_hinges"), [(SQUARE, 1), (TETRAHEDRON, 6), (FINS, 0)])
def test_hinges_follow_the_winding(faces: np.ndarray, n_hinges: int) -> None:
    rows = connectivity.hinges(faces)
    assert rows.shape == (n_hinges, 4)
    turned = {tuple(np.roll(face, shift).tolist()) for face in faces for shift in range(3)}
    for i, j, k, m in rows.tolist():
        assert (i, j, k) in turned
        assert (j, i, m) in turned
    assert len({tuple(sorted(row[:2])) for row in rows.tolist()}) == n_hinges


def test_hinge_of_faces_that_wind_against_each_other() -> None:
    ((i, j, k, m),) = connectivity.hinges(AGAINST).tolist()
    assert {i, j} == {0, 2}
    assert {k, m} == {1, 3}


def test_boundaries() -> None:
    assert connectivity.boundary_edges(SQUARE).tolist() == [[0, 1], [0, 3], [1, 2], [2, 3]]
    assert {tuple(e) for e in connectivity.boundary_chain(SQUARE).tolist()} == {(0, 1), (1, 2), (2, 3), (3, 0)}
    assert connectivity.boundary_edges(TETRAHEDRON).shape == (0, 2)
    assert connectivity.boundary_chain(TETRAHEDRON).shape == (0, 2)
    around_fins = {(1, 2), (2, 0), (0, 3), (3, 1), (1, 4), (4, 0)}
    # Two of the three faces run along 01 in its direction, one against it: one is left over.
    assert {tuple(e) for e in connectivity.boundary_chain(FINS).tolist()} == around_fins | {(0, 1)}
    assert {tuple(sorted(e)) for e in around_fins} == {tuple(e) for e in connectivity.boundary_edges(FINS).tolist()}


def test_edge_index() -> None:
    edges, _ = connectivity.unique_edges(TETRAHEDRON + 5)  # vertices 0 to 4 belong to no face
    order = np.random.default_rng(0).permutation(len(edges))
    i, j = edges[order].T
    assert connectivity.edge_index(edges, i, j).tolist() == order.tolist()
    assert connectivity.edge_index(edges, j, i).tolist() == order.tolist()


def test_face_index_tells_face_and_order() -> None:
    faces = np.concatenate([TETRAHEDRON, [[7, 3, 2]]])
    even = [(0, 1, 2), (1, 2, 0), (2, 0, 1)]
    for orders, sign in ((even, 1.0), ([order[::-1] for order in even], -1.0)):
        for order in orders:
            index, signs = connectivity.face_index(faces, *faces[:, order].T)
            assert index.tolist() == list(range(5))
            assert signs.tolist() == [sign] * 5


def test_vertex_areas() -> None:
    corner = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [9, 9, 9]])
    # Three right triangles of 1/2 at the origin and one of sqrt(3)/2 opposite; vertex 4 belongs to no face.
    tip = (1 + np.sqrt(3) / 2) / 3
    np.testing.assert_allclose(connectivity.vertex_areas(corner, TETRAHEDRON), [0.5, tip, tip, tip, 0], rtol=1e-14)


def test_agrees_with_trimesh(capsule: tuple[np.ndarray, np.ndarray]) -> None:
    vertices, faces = capsule
    closed = trimesh.Trimesh(vertices, faces, process=False)
    edges, counts = connectivity.unique_edges(faces)
    assert (counts == 2).all()
    assert len(vertices) - len(edges) + len(faces) == 2  # Euler, genus 0
    rows = connectivity.hinges(faces)
    key = np.lexsort(np.sort(rows[:, :2], 1).T)
    theirs = np.lexsort(closed.face_adjacency_edges.T)
    np.testing.assert_array_equal(np.sort(rows[key, :2], 1), closed.face_adjacency_edges[theirs])
    np.testing.assert_array_equal(np.sort(rows[key, 2:], 1), np.sort(closed.face_adjacency_unshared[theirs], 1))
    assert connectivity.vertex_areas(vertices, faces).sum() == pytest.approx(closed.area, rel=1e-12)


def test_neighbours_share_an_edge() -> None:
    fan = np.array([[0, 1, 2], [0, 2, 3], [4, 5, 6], [1, 0, 7], [0, 1, 8]])
    assert {tuple(pair) for pair in connectivity.face_neighbours(fan)} == {(0, 1), (0, 3), (3, 4)}


def test_spanning_forest_takes_what_is_cheap() -> None:
    pairs = np.array([[0, 1], [1, 2], [0, 2], [3, 4], [0, 1], [2, 5]])
    parents, piece = connectivity.spanning_forest(7, pairs, np.array([9.0, 1.0, 2.0, 1.0, 5.0, 1.0]))
    assert {tuple(sorted(pair)) for pair in enumerate(parents) if pair[0] != pair[1]} == {
        (1, 2),
        (0, 2),
        (3, 4),
        (2, 5),
    }
    assert len(set(piece[[0, 1, 2, 5]])) == 1
    assert len(set(piece)) == 3
    # The second connection of 0 and 1 is not added to the first: at 5 it would be taken if that of 0 and 2 were dearer.
    parents, _ = connectivity.spanning_forest(7, pairs, np.array([9.0, 1.0, 6.0, 1.0, 5.0, 1.0]))
    assert (0, 1) in {tuple(sorted(pair)) for pair in enumerate(parents)}
