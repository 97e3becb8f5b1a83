"""Connectivity against meshes small enough to read, and against trimesh on a larger one."""

import itertools
import pickle

import numpy as np
import pytest

from torch_modal.geometry import connectivity
from torch_modal.geometry.connectivity import Connectivity, label_pieces

SQUARE = np.array([[0, 1, 2], [0, 2, 3]])  # open, one interior edge
TETRAHEDRON = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]])  # closed
FINS = np.array([[0, 1, 2], [1, 0, 3], [0, 1, 4]])  # three faces at the edge 01
AGAINST = np.array([[0, 1, 2], [0, 3, 2]])  # the second face winds against the first


def random_faces(seed: int) -> np.ndarray:
    """Few vertices, many faces: edges of three and more, windings of all kinds."""
    faces = np.random.default_rng(seed).integers(0, 12, (30, 3))
    return faces[(faces != np.roll(faces, 1, axis=1)).all(axis=1)]


def by_hand(faces: np.ndarray) -> dict[tuple[int, int], list[tuple[int, int]]]:
    """The sides along each edge: their number, and their direction."""
    found: dict[tuple[int, int], list[tuple[int, int]]] = {}
    for side, (i, j) in enumerate((face[c], face[c - 2]) for c in range(3) for face in faces.tolist()):
        found.setdefault((min(i, j), max(i, j)), []).append((side, 1 if i < j else -1))
    return found


@pytest.mark.parametrize(
    ("seed", "offset"),
    [*((seed, 0) for seed in range(5)), pytest.param(0, 2**30, id="too many vertices to pack")],
)
def test_everything_by_hand(seed: int, offset: int) -> None:
    faces = random_faces(seed)
    mesh, truth = Connectivity(faces + offset), by_hand(faces + offset)
    edges = sorted(truth)
    assert mesh.edges.tolist() == [list(edge) for edge in edges]
    assert mesh.counts.tolist() == [len(truth[edge]) for edge in edges]
    for number, edge in enumerate(edges):
        for side, sign in truth[edge]:
            assert (mesh.sides[side], mesh.signs[side]) == (number, sign)
            assert {mesh.start[side], mesh.end[side]} == set(edge)
            assert {*edge, int(mesh.opposite[side])} == set(mesh.faces[side % len(faces)].tolist())
    pairs = [[side for side, _ in truth[edge]] for edge in edges if len(truth[edge]) == 2]
    assert mesh.hinge_sides.tolist() == pairs
    assert mesh.boundary_edges.tolist() == [list(edge) for edge in edges if len(truth[edge]) == 1]
    neighbours = [
        sorted(side % len(faces) for side, _ in pair) for edge in edges for pair in itertools.pairwise(truth[edge])
    ]
    assert mesh.face_neighbours.tolist() == neighbours
    left = {edge: sum(sign for _, sign in truth[edge]) for edge in edges}
    chain = [[*(edge if net > 0 else edge[::-1])] for edge, net in left.items() for _ in range(abs(net))]
    assert mesh.boundary_chain.tolist() == chain


def test_cardinality_and_types() -> None:
    mesh = Connectivity(FINS.astype(np.int32), n_vertices=9)
    expected = {
        **dict.fromkeys(("start", "end", "opposite", "sides", "signs"), (9,)),
        **{"edges": (7, 2), "counts": (7,), "hinges": (0, 4), "hinge_sides": (0, 2), "face_neighbours": (2, 2)},
        **{"boundary_edges": (6, 2), "boundary_chain": (7, 2), "vertex_pieces": (9,)},
    }
    for name, shape in expected.items():
        assert getattr(mesh, name).shape == shape, name
        assert getattr(mesh, name).dtype == (np.float64 if name == "signs" else np.int64), name
    nothing = Connectivity(np.zeros((0, 3), dtype=np.int64))
    assert nothing.edges.shape == nothing.boundary_edges.shape == (0, 2)
    assert nothing.hinges.shape == (0, 4) and nothing.vertex_pieces.shape == (0,)


def test_what_is_shared_cannot_be_written_to() -> None:
    faces = TETRAHEDRON.copy()
    mesh = Connectivity(faces)
    with pytest.raises(ValueError, match="read-only"):
        mesh.edges[0] = 7
    faces[0] = 9
    assert mesh.faces.tolist() == TETRAHEDRON.tolist()
    pickled = pickle.dumps(mesh)
    assert len(pickled) < 500  # what follows from the faces is not pickled
    np.testing.assert_array_equal(pickle.loads(pickled).hinges, mesh.hinges)


@pytest.mark.parametrize(("faces", "n_hinges"), [(SQUARE, 1), (TETRAHEDRON, 6), (FINS, 0)])
def test_hinges_follow_the_winding(faces: np.ndarray, n_hinges: int) -> None:
    rows = Connectivity(faces).hinges
    assert rows.shape == (n_hinges, 4)
    turned = {tuple(np.roll(face, shift).tolist()) for face in faces for shift in range(3)}
    for i, j, k, m in rows.tolist():
        assert (i, j, k) in turned
        assert (j, i, m) in turned
    assert len({tuple(sorted(row[:2])) for row in rows.tolist()}) == n_hinges


def test_hinge_of_faces_that_wind_against_each_other() -> None:
    ((i, j, k, m),) = Connectivity(AGAINST).hinges.tolist()
    assert {i, j} == {0, 2}
    assert {k, m} == {1, 3}


def test_vertices_are_grouped_by_connected_pieces() -> None:
    mesh = Connectivity(np.concatenate([TETRAHEDRON + 1, SQUARE + 6]), n_vertices=11)
    assert mesh.vertex_pieces.tolist() == [0, 1, 1, 1, 1, 2, 3, 3, 3, 3, 4]
    assert label_pieces(np.zeros((0, 2), dtype=np.int64), 3).tolist() == [0, 1, 2]


def test_vertex_areas() -> None:
    corner = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [9, 9, 9]])
    # Three right triangles of 1/2 at the origin and one of sqrt(3)/2 opposite; vertex 4 belongs to no face.
    tip = (1 + np.sqrt(3) / 2) / 3
    np.testing.assert_allclose(connectivity.vertex_areas(corner, TETRAHEDRON), [0.5, tip, tip, tip, 0], rtol=1e-14)


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
