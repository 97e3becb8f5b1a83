"""What is a body of its own: far from all else in all shapes."""

import numpy as np
import pytest
import trimesh

from torch_modal.geometry.bodies import MOST_BODIES, bodies
from torch_modal.geometry.connectivity import Connectivity

BOX = trimesh.creation.box((1.0, 1.0, 1.0))
DIAGONAL = 3**0.5


def boxes(*places: tuple[float, float, float], sizes: tuple[float, ...] = ()) -> tuple[np.ndarray, Connectivity]:
    """Boxes with their centres at places: vertices ``(V, 3)`` and connectivity."""
    sizes = sizes or (1.0,) * len(places)
    points = [size * np.array(BOX.vertices) + place for place, size in zip(places, sizes, strict=True)]
    faces = [np.array(BOX.faces) + 8 * i for i in range(len(places))]
    return np.concatenate(points), Connectivity(np.concatenate(faces), 8 * len(places))


def parts(*shapes: np.ndarray, mesh: Connectivity) -> list[list[int]]:
    """Numbers of the boxes of each body."""
    found = bodies(np.stack(shapes), mesh)
    everything = np.arange(mesh.n_vertices)
    return [sorted({int(v) // 8 for v in everything[own]}) for own, _ in found]


@pytest.mark.parametrize("unit", [1e-60, 1.0, 1e60])
def test_far_is_beyond_the_mean_of_the_diagonals(unit: float) -> None:
    for gap, far in ((0.99 * DIAGONAL, False), (1.01 * DIAGONAL, True)):
        x, mesh = boxes((0, 0, 0), (0, 0, 1 + gap))
        assert parts(unit * x, mesh=mesh) == ([[0], [1]] if far else [[0, 1]])
    x, mesh = boxes((0, 0, 0), (3, 3, 3), sizes=(1.0, 3.0))  # 0.58 diagonals apart, along a diagonal
    assert parts(unit * x, mesh=mesh) == [[0, 1]]


def test_what_is_near_in_one_shape_is_one_body() -> None:
    far, mesh = boxes((0, 0, 0), (9, 0, 0))
    near, _ = boxes((0, 0, 0), (2, 0, 0))
    assert parts(far, far, mesh=mesh) == [[0], [1]]
    assert parts(far, near, far, mesh=mesh) == [[0, 1]]


def test_groups_are_as_large_as_all_of_their_pieces() -> None:
    """A chain is one body, in any order; what is near to the whole chain belongs to it, too."""
    chain = [(2.0 * i, 0.0, 0.0) for i in (3, 0, 4, 1, 2)]
    x, mesh = boxes(*chain, (4.0, 5.0, 0.0), (4.0, 40.0, 0.0))
    assert parts(x, mesh=mesh) == [[0, 1, 2, 3, 4, 5], [6]]
    x, mesh = boxes((4.0, 5.0, 0.0), (4.0, 40.0, 0.0))
    assert parts(x, mesh=mesh) == [[0], [1]]


def test_connectivity_of_each() -> None:
    x, mesh = boxes((0, 0, 0), (9, 0, 0))
    whole = bodies(x[None, :8], Connectivity(np.array(BOX.faces)))
    assert len(whole) == 1 and whole[0][0] == slice(None)
    order = np.random.default_rng(0).permutation(16)
    place = np.argsort(order)
    for own, part in bodies(x[None, order], Connectivity(place[mesh.faces])):
        points = x[order][own]
        np.testing.assert_allclose(np.ptp(points, axis=0), 1)
        assert len(part.faces) == 12 and part.n_vertices == 8 and len(part.boundary_edges) == 0
        volume = np.einsum("fi,fi->", points[part.faces[:, 0]], np.cross(*points[part.faces[:, 1:]].swapaxes(0, 1))) / 6
        assert abs(volume - 1) < 1e-12


def test_what_is_no_body_goes_with_the_nearest() -> None:
    """Vertices of no face, faces without an area, and what has vanished in one of the shapes."""
    x, mesh = boxes((0, 0, 0), (9, 0, 0), (8, 0, 50.0), (-1, 99.0, 0))
    three, truth = Connectivity(mesh.faces[:36], 32), [[0, 3], [1, 2]]
    assert parts(x, mesh=three) == [[0, 3], [1], [2]]
    assert parts(x, mesh=Connectivity(mesh.faces[:24], 32)) == truth
    for size in (0.0, 1e-4):
        small = x.copy()
        small[16:24] = small[16] + size * (small[16:24] - small[16])
        assert parts(small, small, mesh=three) == ([[0, 3], [1], [2]] if size else truth)
        assert parts(x, small, mesh=three) == truth


def test_swarms_are_one_body() -> None:
    places = [(9.0 * i, 0.0, 0.0) for i in range(MOST_BODIES + 1)]
    assert len(parts(boxes(*places)[0], mesh=boxes(*places)[1])) == 1
    x, mesh = boxes(*places[1:])
    assert len(parts(x, mesh=mesh)) == MOST_BODIES
