"""The surface follows the tetrahedra: linear motions exactly, smooth ones closely, and only its own limb."""

import numpy as np
import pytest
from helpers.solids import box, embed_surface, surface

from torch_modal.modes.embedding import closest_tetrahedra
from torch_modal.modes.tetrahedra import Tetrahedra


def test_linear_displacements_are_carried_exactly(
    capsule: tuple[np.ndarray, np.ndarray], capsule_tetrahedra: Tetrahedra
) -> None:
    points = capsule[0]
    weights = embed_surface(points, capsule_tetrahedra)
    assert weights.shape == (len(points), len(capsule_tetrahedra.vertices))
    np.testing.assert_allclose(np.asarray(weights.sum(axis=1)).reshape(-1), 1, atol=1e-12)
    gradient, shift = np.random.default_rng(0).standard_normal((2, 3, 3))
    np.testing.assert_allclose(
        weights @ (capsule_tetrahedra.vertices @ gradient + shift[0]),
        points @ gradient + shift[0],
        atol=1e-11,
    )


def test_smooth_displacements_are_carried_closely() -> None:
    errors = []
    for n in (6, 12):
        solid = box((n, n, n), (1.0, 1.0, 1.0), jitter=0.1)
        points = np.random.default_rng(0).uniform(0.05, 0.95, (400, 3))
        points[:, 0] = np.where(points[:, 1] > 0.5, 0.99, 0.01)  # close to two sides
        wave = [np.sin(3 * x[:, 0] + 2 * x[:, 1]) * np.cos(2 * x[:, 2]) for x in (solid.vertices, points)]
        errors.append(np.abs(embed_surface(points, solid) @ wave[0] - wave[1]).max())
    assert errors[0] < 0.1
    assert errors[1] < 0.4 * errors[0]  # second order: a quarter


def test_touching_limbs_do_not_mix() -> None:
    """Two fingers, a hundredth of their thickness apart, joined at one end as on a hand."""
    solid = box((9, 20, 3), (2.25, 5.0, 0.75))
    corners = solid.vertices[solid.tets]
    middle = corners.mean(axis=1)
    slit = (middle[:, 0] > 1.0) & (middle[:, 0] < 1.25) & (middle[:, 1] > 1.0)
    kept = Tetrahedra(solid.vertices, solid.tets[~slit])
    right = kept.vertices[:, 0] > 1.1
    # The right finger moves to the left until it all but touches; the bridge is squeezed with it.
    vertices = kept.vertices.copy()
    vertices[right, 0] -= 0.24
    hand = Tetrahedra(vertices, kept.tets)

    y, z = (axis.reshape(-1) for axis in np.meshgrid(np.linspace(2.5, 4.9, 20), np.linspace(0.1, 0.7, 5)))
    left_side = np.stack([np.full_like(y, 1.0), y, z], axis=1)
    right_side = left_side + np.array([0.01, 0, 0])
    for points, normal, others in ((left_side, 1.0, right), (right_side, -1.0, ~right)):
        normals = np.broadcast_to([normal, 0.0, 0.0], points.shape)
        weights = embed_surface(points, hand, normals)
        assert abs(weights[:, others]).max() == 0
        assert abs(weights).max() > 0


@pytest.mark.parametrize("cells", [(1, 1, 1), (30, 1, 1), (6, 6, 1)])
def test_few_or_thin_neighbourhoods(cells: tuple[int, int, int]) -> None:
    solid = box(cells, (3.0, 1.0, 0.2))
    outside = solid.vertices[np.unique(surface(solid))]
    points = outside + 0.01 * np.random.default_rng(0).standard_normal(outside.shape)
    weights = embed_surface(points, solid)
    np.testing.assert_allclose(weights @ solid.vertices, points, atol=1e-12)
    assert abs(weights).sum(axis=1).max() < 6


def test_one_tetrahedron_gives_barycentric_coordinates() -> None:
    tet = Tetrahedra(np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]]), np.array([[0, 1, 2, 3]]))
    weights = embed_surface(np.array([[0.1, 0.2, 0.3], [0.5, 0.5, 0.5]]), tet)
    np.testing.assert_allclose(weights.toarray(), [[0.4, 0.1, 0.2, 0.3], [-0.5, 0.5, 0.5, 0.5]], atol=1e-12)


def test_closest_tetrahedron_holds_the_point(capsule_tetrahedra: Tetrahedra) -> None:
    random = np.random.default_rng(0)
    tets = random.integers(0, len(capsule_tetrahedra.tets), 200)
    inside = random.dirichlet(np.full(4, 2.0), 200)
    points = np.einsum("va,vai->vi", inside, capsule_tetrahedra.vertices[capsule_tetrahedra.tets[tets]])
    np.testing.assert_array_equal(closest_tetrahedra(points, capsule_tetrahedra), tets)
