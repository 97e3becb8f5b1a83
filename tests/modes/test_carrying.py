"""Carried tetrahedra: exact where the truth is known, refused where they are no good, and chosen well."""

import numpy as np
import pytest
import torch
from helpers.bodies import bend
from helpers.solids import as_mesh, box, eigenmodes

from torch_modal.errors import ModalAnalysisError
from torch_modal.geometry.surface import Surface
from torch_modal.modes import carrying
from torch_modal.modes.carrying import Carrier, nearest_rotations
from torch_modal.modes.eigen import lowest_modes
from torch_modal.modes.embedding import find_neighbours
from torch_modal.modes.extract import extract_bases
from torch_modal.modes.solid import Solid
from torch_modal.modes.stiffness import arap_hessian, mass_matrix
from torch_modal.modes.surface import CanonicalSurface, clearances, self_proximity
from torch_modal.modes.tetrahedra import Tetrahedra, tet_volumes
from torch_modal.modes.tetwild import TetWild

BAR = box((16, 4, 4), (8.0, 1.0, 1.0))
POINTS, COMPACT = as_mesh(BAR)
TURN = np.linalg.qr(np.array([[1.0, 2, 3], [0, 1, 4], [5, 6, 0]]))[0]
TURN = TURN * np.sign(np.linalg.det(TURN))


def bent(points: np.ndarray, angle: float) -> np.ndarray:
    """Points of the bar, its axis bent to an arc of ``angle`` radians. *Shape:* ``(V, 3)``."""
    return bend(points - [0, 0.5, 0], 1.0, angle, 0, points[:, 0].max())


@pytest.fixture(scope="module")
def carrier() -> Carrier:
    bar = Surface(POINTS, COMPACT)
    return Carrier(Solid(bar, BAR, *find_neighbours(POINTS, BAR, bar.vertex_normals)))


def carried(carrier: Carrier, points: np.ndarray) -> np.ndarray | None:
    """Vertices of the carried tetrahedra."""
    solid = carrier.carry(Surface(points, COMPACT))
    return None if solid is None else solid.tetrahedra.vertices


def test_rigid_motions_and_scale_are_carried_exactly(carrier: Carrier) -> None:
    found = carried(carrier, POINTS @ TURN.T * 7.0 + 3.0)
    np.testing.assert_allclose(found, BAR.vertices @ TURN.T * 7.0 + 3.0, atol=1e-10)


def test_a_bent_bar_is_filled_as_it_bends(carrier: Carrier) -> None:
    """Bent by 270 degrees, further than any interpolation of positions or of single rotations can follow."""
    angle = 1.5 * np.pi
    found = carried(carrier, bent(POINTS, angle))
    assert found is not None
    assert np.linalg.norm(found - bent(BAR.vertices, angle), axis=1).max() < 0.1
    assert (tet_volumes(Tetrahedra(found, BAR.tets)) > 0).all()


def test_modes_of_the_carried_bar_are_those_of_the_bent_one(carrier: Carrier) -> None:
    points = bent(POINTS, np.pi)
    solid = carrier.carry(Surface(points, COMPACT))
    assert solid is not None
    truth = Tetrahedra(bent(BAR.vertices, np.pi), BAR.tets)
    found = lowest_modes(solid.body("edge"), 8)
    wanted = eigenmodes(arap_hessian(truth), mass_matrix(truth), truth.vertices, 8)
    np.testing.assert_allclose(found.eigenvalues, wanted.eigenvalues, rtol=0.05)
    np.testing.assert_allclose(solid.weights() @ solid.tetrahedra.vertices, points, atol=1e-10)
    assert solid.body("edge").mass.sum() == pytest.approx(np.abs(tet_volumes(truth)).sum(), rel=0.01)


def test_what_cannot_be_followed_is_seen(carrier: Carrier) -> None:
    assert carried(carrier, POINTS * (1.0, 1.0, -1.0)) is None  # mirrored
    assert carried(carrier, POINTS + np.random.default_rng(0).normal(size=POINTS.shape)) is None  # crumpled


def test_nearest_rotations_against_singular_values() -> None:
    random = np.random.default_rng(0)
    matrices = random.normal(size=(3000, 3, 3)) * random.uniform(1e-9, 1e9, (3000, 1, 1))
    matrices[:10], matrices[10:20, :, 0] = 0.0, 0.0  # of no and of two dimensions
    u, _, vt = np.linalg.svd(matrices)
    u[:, :, 2] *= np.sign(np.linalg.det(u @ vt))[:, None]
    np.testing.assert_allclose(nearest_rotations(matrices), u @ vt, atol=1e-12)


def test_clearances_of_a_plate_and_of_a_gap() -> None:
    """A plate of 8 by 4 by 0.4, and another 0.3 above it: a diagonal of 9."""
    one, faces = as_mesh(box((40, 20, 2), (8.0, 4.0, 0.4)))
    above = one + np.array([0, 0, 0.7])
    whole = CanonicalSurface(np.concatenate([one, above]), np.concatenate([faces, faces + len(one)]))
    thickness, gap = clearances(whole)
    middle = whole.vertices[whole.faces].mean(axis=1)
    flat = (np.ptp(whole.vertices[whole.faces][..., 2], axis=1) == 0) & (np.abs(middle[:, :2]) < [30.0, 12.0]).all(
        axis=1
    )
    np.testing.assert_allclose(thickness[flat], 0.4 * whole.scale, rtol=0.02)
    facing = flat & (np.abs(middle[:, 2]) < 0.2 * whole.scale)
    np.testing.assert_allclose(gap[facing], 0.3 * whole.scale, rtol=0.02)
    assert np.isinf(gap[flat & ~facing]).all()
    # Corners of a box are no thin parts.
    assert np.isinf(clearances(CanonicalSurface(*as_mesh(box((20, 20, 20), (1.0, 1.0, 1.0)))))[0]).all()


def test_self_proximity_grows_as_the_ends_meet() -> None:
    """Of a horseshoe."""
    points, faces = as_mesh(box((48, 6, 6), (16.0, 1.0, 1.0)))
    nearly_closed, half, straight = (
        self_proximity(CanonicalSurface(bent(points, angle), faces)) for angle in (1.98 * np.pi, 1.0, 0.0)
    )
    assert nearly_closed > half
    assert straight == 0


# --------------------------------------------------------------------------------------- a set of key-frames


@pytest.fixture
def meshed(monkeypatch: pytest.MonkeyPatch) -> list[np.ndarray]:
    """A mesher that knows the bar; it keeps the surfaces that it was asked to fill."""
    asked: list[np.ndarray] = []

    def fill(mesher: TetWild, surface: Surface, stop: object) -> Tetrahedra:
        asked.append(surface.vertices)
        low, high = BAR.vertices.min(axis=0), BAR.vertices.max(axis=0)
        return Tetrahedra((BAR.vertices - (low + high) / 2) * (100 / np.linalg.norm(high - low)), BAR.tets)

    monkeypatch.setattr(TetWild, "fill", fill)
    return asked


def test_the_mesher_runs_once_for_a_set(meshed: list[np.ndarray]) -> None:
    poses = np.stack([bent(POINTS, 1.0), POINTS, bent(POINTS, 2.0)])
    bases = extract_bases(poses[[1, 0, 2]], COMPACT, 5, mesher="tetwild", cache=False)
    assert len(meshed) == 1
    for basis, pose in zip(bases, poses[[1, 0, 2]], strict=True):
        np.testing.assert_array_equal(basis.reference, pose)


def test_equal_poses_have_equal_modes(meshed: list[np.ndarray]) -> None:
    """The same key-frame twice, the second turned: the same modes, turned."""
    first, second = extract_bases(np.stack([POINTS, POINTS @ TURN.T]), COMPACT, 6, mesher="tetwild", cache=False)
    torch.testing.assert_close(first.eigenvalues, second.eigenvalues, rtol=1e-6, atol=0)
    a = (first.modes @ torch.from_numpy(TURN).T).flatten(1)
    b = second.modes.flatten(1)
    overlap = torch.linalg.svdvals(torch.linalg.qr(a.T).Q.T @ torch.linalg.qr(b.T).Q)
    assert overlap.min() > 0.999


@pytest.mark.parametrize("reason", ["no fit", "singular matrix", "no modes"])
def test_a_keyframe_that_cannot_be_carried_to_has_its_own(
    reason: str, meshed: list[np.ndarray], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Progress counts it once."""

    def fail(*_: object) -> None:
        raise RuntimeError("Factor is exactly singular")

    def fails_if_carried(solid: Solid, form: str) -> object:
        if solid.meshed is not None:
            raise ModalAnalysisError("the mesh is degenerate")
        return body(solid, form)

    body, counted = Solid.body, []
    if reason == "no fit":
        monkeypatch.setattr(carrying, "MAX_FIT", -1.0)
    elif reason == "singular matrix":
        monkeypatch.setattr(carrying, "factorize", fail)
    else:
        monkeypatch.setattr(Solid, "body", fails_if_carried)
    monkeypatch.setattr("torch_modal.progress.ProgressReport.update", lambda self: counted.append(1))
    bases = extract_bases(np.stack([POINTS, POINTS + 1.0]), COMPACT, 5, mesher="tetwild", cache=False)
    assert len(meshed) == 2
    assert len(counted) == 2
    assert all(torch.isfinite(basis.modes).all() for basis in bases)
