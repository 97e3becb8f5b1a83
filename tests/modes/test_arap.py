"""Stiffness and mass against the energies they are the Hessians of."""

import itertools

import numpy as np
import pytest
import scipy.sparse as sp
import torch
from helpers.solids import box, element_hessian, lumped_mass, together

from torch_modal.modes.stiffness import HESSIAN_FORMS, WEIGHT_FLOOR, arap_hessian, mass_matrix
from torch_modal.modes.tetrahedra import Tetrahedra, tet_volumes


@pytest.fixture
def solid() -> Tetrahedra:
    return box((3, 2, 2), (1.5, 1.0, 0.8), jitter=0.2)


def edge_energy(u: torch.Tensor, solid: Tetrahedra) -> torch.Tensor:
    """sum_e vol_e |sym grad u_e|², the gradient averaged over the tetrahedra around each edge, one edge at a time."""
    x, tets = torch.from_numpy(solid.vertices), torch.from_numpy(solid.tets)
    rest = (x[tets[:, 1:]] - x[tets[:, :1]]).mT
    gradient = (u[tets[:, 1:]] - u[tets[:, :1]]).mT @ torch.linalg.inv(rest)
    volumes = torch.linalg.det(rest).abs() / 6
    around: dict[tuple[int, int], list[int]] = {}
    for number, tet in enumerate(solid.tets.tolist()):
        for edge in itertools.combinations(sorted(tet), 2):
            around.setdefault(edge, []).append(number)
    total = torch.zeros((), dtype=u.dtype)
    for numbers in around.values():
        volume = volumes[numbers].sum()
        mean = (volumes[numbers, None, None] * gradient[numbers]).sum(dim=0) / volume
        total = total + volume / 6 * (((mean + mean.T) / 2) ** 2).sum()
    return total


def test_edge_form_is_the_hessian_of_its_energy(solid: Tetrahedra) -> None:
    n = len(solid.vertices)
    u = torch.randn(3 * n, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    by_autograd = torch.autograd.functional.hessian(lambda u: edge_energy(u.reshape(n, 3), solid), u)
    np.testing.assert_allclose(arap_hessian(solid, "edge").toarray(), by_autograd.numpy(), atol=1e-12)


@pytest.mark.parametrize("cells", [(4, 3, 3), (5, 4, 4), (8, 2, 2)])
def test_edge_form_is_a_fifth_of_the_element_form_or_more(cells: tuple[int, int, int]) -> None:
    """However fine the mesh: so averaging hides no motion, as averaging around vertices does."""
    fine = box(cells, (cells[0] / 2, 1.0, 1.0), jitter=0.1)
    values, vectors = np.linalg.eigh(element_hessian(fine).toarray())
    assert values[5] < 1e-9 * values[6]
    relative = vectors[:, 6:] / np.sqrt(values[6:])
    ratios = np.linalg.eigvalsh(relative.T @ arap_hessian(fine, "edge") @ relative)
    assert ratios[0] > 0.15
    assert ratios[-1] < 1 + 1e-9


def cotangent_weights(solid: Tetrahedra) -> dict[tuple[int, int], float]:
    """A sixth of the opposite edge's length times the cotangent of its dihedral angle, over tetrahedra."""
    weights: dict[tuple[int, int], float] = {}
    for tet in solid.tets:
        for a, b, c, d in (
            (0, 1, 2, 3),
            (0, 2, 1, 3),
            (0, 3, 1, 2),
            (1, 2, 0, 3),
            (1, 3, 0, 2),
            (2, 3, 0, 1),
        ):
            i, j, k, m = solid.vertices[tet[[a, b, c, d]]]
            along = (m - k) / np.linalg.norm(m - k)
            p, q = ((v - k) - along * np.dot(v - k, along) for v in (i, j))  # the two faces, seen along the edge
            cotangent = np.dot(p, q) / np.linalg.norm(np.cross(p, q))
            key = tuple(sorted((int(tet[a]), int(tet[b]))))
            weights[key] = weights.get(key, 0.0) + np.linalg.norm(m - k) * cotangent / 6
    return weights


def test_vertex_form_is_the_energy_with_the_best_rotations(solid: Tetrahedra) -> None:
    n = len(solid.vertices)
    raw = cotangent_weights(solid)
    floor = WEIGHT_FLOOR * np.mean(np.abs(list(raw.values())))
    assert min(raw.values()) < -1e-3, "the mesh has to have weights that are clamped"
    u = np.random.default_rng(1).standard_normal((n, 3))
    best = 0.0
    for i in range(n):
        ring = [(j, max(c, floor)) for (a, b), c in raw.items() for s, j in ((a, b), (b, a)) if s == i]
        rows, right = [], []
        for j, c in ring:
            e = solid.vertices[i] - solid.vertices[j]
            rows.append(np.sqrt(c) * np.cross(np.eye(3), e).T)  # columns: (unit vector) × e
            right.append(np.sqrt(c) * (u[i] - u[j]))
        w = np.linalg.lstsq(np.concatenate(rows), np.concatenate(right), rcond=None)[0]
        best += 0.5 * np.sum((np.concatenate(right) - np.concatenate(rows) @ w) ** 2)
    k = arap_hessian(solid, "vertex")
    assert 0.5 * u.reshape(-1) @ (k @ u.reshape(-1)) == pytest.approx(best, rel=1e-12)


def test_inverted_tetrahedra_count_with_their_magnitude(solid: Tetrahedra) -> None:
    turned = Tetrahedra(solid.vertices, solid.tets.copy())
    turned.tets[::3] = turned.tets[::3][:, [1, 0, 2, 3]]
    np.testing.assert_allclose(lumped_mass(turned), lumped_mass(solid))
    np.testing.assert_allclose(mass_matrix(turned).toarray(), mass_matrix(solid).toarray())
    for form in HESSIAN_FORMS:
        np.testing.assert_allclose(
            arap_hessian(turned, form).toarray(), arap_hessian(solid, form).toarray(), atol=1e-12
        )


def test_mass_is_the_volume() -> None:
    two = together(box((2, 3, 2), (1.0, 2.0, 3.0)), box((1, 1, 1), (0.5, 0.5, 0.5)))
    assert (tet_volumes(two) > 0).all()
    mass = lumped_mass(two)
    assert mass.sum() == pytest.approx(6.125)
    assert (mass > 0).all()
    np.testing.assert_allclose(np.asarray(mass_matrix(two).sum(axis=1)).reshape(-1), mass)


def test_mass_matrix_is_half_consistent_and_half_lumped() -> None:
    brick = box((3, 2, 4), (1.0, 2.0, 3.0))
    x, y, z = brick.vertices.T
    m, lumped = mass_matrix(brick), lumped_mass(brick)
    # A consistent mass integrates products of linear functions exactly.
    assert x @ (m @ x) == pytest.approx(2.0 / 2 + lumped @ x**2 / 2)  # ∫ x² = 1/3 * 2 * 3
    assert y @ (m @ z) == pytest.approx(9.0 / 2 + lumped @ (y * z) / 2)
    half = Tetrahedra(brick.vertices, brick.tets, np.full(len(brick.tets), 0.5))
    np.testing.assert_allclose(mass_matrix(half).toarray(), m.toarray() / 2)
    assert sp.issparse(m) and abs(m - m.T).max() < 1e-15
