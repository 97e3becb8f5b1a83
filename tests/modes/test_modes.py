"""Modes: the eigenproblem against independent truth, and the way from key-frames to bases."""

import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.linalg
import scipy.sparse as sp
import torch
from benchmarks.quadratic_tetrahedra import quadratic_modes
from conftest import COARSE
from helpers.solids import as_mesh, box, eigenmodes, lumped_mass, surface, together

from torch_modal import threads
from torch_modal.errors import ModalAnalysisError
from torch_modal.geometry.canonical import to_canonical
from torch_modal.keyframes.check import MeshError, MeshWarning
from torch_modal.modes import eigen, extract
from torch_modal.modes import lattice as lattice_module
from torch_modal.modes.eigen import ElasticModes
from torch_modal.modes.extract import extract_bases, extract_modes
from torch_modal.modes.stiffness import HESSIAN_FORMS, arap_hessian, mass_matrix
from torch_modal.modes.tetrahedra import Tetrahedra
from torch_modal.modes.tetwild import TetWild

Mesh = tuple[np.ndarray, np.ndarray]
BOX = box((6, 3, 2), (3.0, 1.5, 1.0), jitter=0.1)


def solve(solid: Tetrahedra, n_modes: int, form: str = "edge") -> ElasticModes:
    return eigenmodes(arap_hessian(solid, form), mass_matrix(solid), solid.vertices, n_modes)


def inertia(solid: Tetrahedra) -> sp.csr_matrix:
    return sp.kron(mass_matrix(solid), sp.identity(3), format="csr")


# ------------------------------------------------------------------------------------------- the eigenproblem


@pytest.mark.parametrize("form", HESSIAN_FORMS)
def test_modes_of_a_meshed_surface(form: str, capsule_tetrahedra: Tetrahedra) -> None:
    """The numbers that everything later leans on, on the mesher's own tetrahedra."""
    result = solve(capsule_tetrahedra, 20, form)
    k, m = arap_hessian(capsule_tetrahedra, form), inertia(capsule_tetrahedra)
    assert m.shape[0] > eigen.DENSE_BELOW
    phi, lam = result.modes, result.eigenvalues
    assert np.abs(result.rigid_eigenvalues).max() < 1e-8 * lam[0]
    assert result.n_zero == 6
    np.testing.assert_allclose(phi.T @ (m @ phi), np.eye(20), atol=1e-12)
    force = (m @ phi) * lam
    residual = np.linalg.norm(k @ phi - force, axis=0) / np.linalg.norm(force, axis=0)
    assert residual.max() < 1e-6
    assert (np.diff(lam) >= 0).all()
    x = capsule_tetrahedra.vertices
    for axis in np.eye(3):
        for motion in (np.broadcast_to(axis, x.shape), np.cross(axis, x)):
            momentum = m @ motion.reshape(-1)
            assert np.abs(momentum @ phi).max() < 1e-12 * np.sqrt(momentum @ motion.reshape(-1))


@pytest.mark.parametrize("cells", [(4, 3, 2), (10, 4, 4)])  # a dense and a sparse solve
def test_agrees_with_dense_eigh(cells: tuple[int, int, int]) -> None:
    # A square cross-section, so that bending modes come in pairs of equal eigenvalues.
    solid = box(cells, (5.0, 1.0, 1.0))
    k = arap_hessian(solid)
    assert (k.shape[0] > eigen.DENSE_BELOW) == (cells[0] == 10)
    for mass in (mass_matrix(solid), sp.diags(lumped_mass(solid))):
        m = sp.kron(mass, sp.identity(3)).toarray()
        values, vectors = scipy.linalg.eigh(k.toarray(), m)
        result = eigenmodes(k, mass, solid.vertices, 25)
        np.testing.assert_allclose(result.eigenvalues, values[6:31], rtol=1e-9)
        # The same space, up to the last eigenvalue that stands alone.
        last = int(np.flatnonzero(values[7:31] - values[6:30] > 1e-3 * values[30])[-1])
        overlap = vectors[:, 6 : 7 + last].T @ (m @ result.modes[:, : last + 1])
        np.testing.assert_allclose(np.linalg.svd(overlap)[1], 1, atol=1e-9)


def test_vibrations_of_a_bar() -> None:
    """Euler-Bernoulli and wave equation: Young's modulus 2, no lateral contraction, density 1."""
    length, side = 10.0, 1.0
    stretch_1 = 2 * (np.pi / length) ** 2
    bend_1 = 2 * side**2 / 12 * (4.730041 / length) ** 4
    # Euler-Bernoulli knows no shear, with which the bar bends 6 % more easily.
    truth = quadratic_modes(box((20, 2, 2), (length, side, side)), 1).eigenvalues[0]
    assert truth / bend_1 == pytest.approx(0.94, abs=0.01)
    for n in (2, 4):
        bar = box((10 * n, n, n), (length, side, side))
        m = mass_matrix(bar)
        result = solve(bar, 8)
        # the two lowest bend it: hardly any motion along the axis, opposite at the middle and the ends
        along = np.array([phi[::3] @ (m @ phi[::3]) for phi in result.modes.T])
        assert (along[:2] < 0.1).all()
        assert result.eigenvalues[0] == pytest.approx(truth, rel=0.05)
        stretch = int(along.argmax())
        assert along[stretch] > 0.95
        assert result.eigenvalues[stretch] == pytest.approx(stretch_1, rel=0.02)
        wave = np.cos(np.pi * bar.vertices[:, 0] / length)
        assert abs(wave @ (m @ result.modes[::3, stretch])) / np.sqrt(wave @ (m @ wave)) > 0.99


@pytest.mark.parametrize(("cells", "size"), [((40, 40, 1), (10.0, 10.0, 0.1)), ((200, 3, 3), (100.0, 1.0, 1.0))])
def test_thin_bodies_pass_the_check_of_residuals(cells: tuple[int, int, int], size: tuple[float, float, float]) -> None:
    """Their residuals are small only where the inverted problem is solved exactly."""
    solid = box(cells, size, jitter=0.1)
    result = solve(solid, 5)
    force = inertia(solid) @ result.modes * result.eigenvalues
    residual = arap_hessian(solid) @ result.modes - force
    assert (np.linalg.norm(residual, axis=0) / np.linalg.norm(force, axis=0)).max() < 1e-6


def test_deterministic_in_sign_too() -> None:
    solid = box((10, 5, 3), (5.0, 1.3, 1.0), jitter=0.1)
    first, second = solve(solid, 10), solve(solid, 10)
    np.testing.assert_array_equal(first.modes, second.modes)
    assert (np.take_along_axis(first.modes, np.abs(first.modes).argmax(axis=0)[None], axis=0) > 0).all()


def test_pieces_add_zero_modes() -> None:
    pieces = (box((3, 3, 3), (1.0, 1.0, 1.0)), box((4, 3, 3), (1.4, 1.0, 1.0)))
    two = together(*pieces)
    two.vertices[64:] += (3.0, 0.0, 0.0)
    result = solve(two, 4)
    assert (result.n_zero, result.n_pieces) == (12, 2)
    k, m = arap_hessian(two), inertia(two)
    np.testing.assert_allclose(result.modes.T @ (m @ result.modes), np.eye(4), atol=1e-11)
    np.testing.assert_allclose(result.modes.T @ (k @ result.modes), np.diag(result.eigenvalues), atol=1e-9)
    each = np.sort(np.concatenate([solve(piece, 4).eigenvalues for piece in pieces]))
    np.testing.assert_allclose(result.eigenvalues, each[:4], rtol=1e-9)


def test_stiffness_that_resists_rigid_motions_is_refused() -> None:
    solid = box((4, 2, 2), (2.0, 1.0, 1.0))
    k, mass = arap_hessian(solid), lumped_mass(solid)
    anchored = k + sp.diags(np.r_[np.ones(3), np.zeros(k.shape[0] - 3)])
    with pytest.raises(ModalAnalysisError, match="the rigid motions"):
        eigenmodes(sp.csc_matrix(anchored), sp.diags(mass), solid.vertices, 4)


# -------------------------------------------------------------------------------- from key-frames to bases


@pytest.fixture
def boxed(monkeypatch: pytest.MonkeyPatch) -> Mesh:
    """A box as a surface, and meshers that fill it."""
    mesh = as_mesh(BOX)
    filled_with(monkeypatch, BOX, mesh)
    monkeypatch.setattr(TetWild, "fill", lambda *_: lattice_module.lattice())
    return mesh


def test_modes_at_the_surface_in_the_callers_units(boxed: Mesh) -> None:
    vertices, faces = boxed
    basis = extract_modes(vertices, faces, 5, cache=False)
    truth = solve(BOX, 5)
    np.testing.assert_allclose(basis.eigenvalues, truth.eigenvalues, rtol=1e-9)
    used = np.unique(surface(BOX))
    at_surface = truth.modes.reshape(-1, 3, 5)[used].transpose(2, 0, 1)
    # Moving least squares smooth a little on so coarse a mesh; a wrong unit or order is off by far more.
    signs = np.sign((basis.modes.numpy() * at_surface).sum(axis=(1, 2)))[:, None, None]  # those are arbitrary
    error = np.linalg.norm(basis.modes.numpy() - signs * at_surface) / np.linalg.norm(at_surface)
    assert error < 0.2
    np.testing.assert_array_equal(basis.reference, vertices)
    for factor in (1e-6, 4.0, 1e9):
        scaled = extract_modes(vertices * factor + 10 * factor, faces, 5, cache=False)
        np.testing.assert_allclose(scaled.eigenvalues * factor**2, basis.eigenvalues, rtol=1e-9)
        np.testing.assert_allclose(scaled.modes * factor**1.5, basis.modes, atol=1e-7)


def test_tensors_arrays_and_single_precision(boxed: Mesh) -> None:
    vertices, faces = boxed
    wanted = extract_modes(vertices, faces, 4, cache=False)
    tracked = torch.tensor(vertices, requires_grad=True)
    for given in (tracked, tracked.detach().float(), vertices.tolist()):
        basis = extract_modes(given, torch.from_numpy(faces).int(), 4, cache=False)
        assert basis.modes.dtype == torch.float64
        assert not basis.modes.requires_grad and not basis.reference.requires_grad
        np.testing.assert_allclose(basis.modes, wanted.modes, atol=1e-5)


def test_cached_modes_are_the_same_and_not_recomputed(
    boxed: Mesh, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    keyframes = np.stack([boxed[0], boxed[0] * (1.0, 1.0, 1.01)])
    first = extract_bases(keyframes, boxed[1], 4, cache_dir=str(tmp_path))
    assert len(list(tmp_path.iterdir())) == 3  # tetrahedra, and modes of both
    monkeypatch.setattr(extract, "lowest_modes", None)
    monkeypatch.setattr(lattice_module, "lattice", None)
    for basis, again in zip(first, extract_bases(keyframes, boxed[1], 4, cache_dir=str(tmp_path)), strict=True):
        np.testing.assert_array_equal(basis.modes, again.modes)
        np.testing.assert_array_equal(basis.eigenvalues, again.eigenvalues)
    with pytest.raises(TypeError):  # another number of modes is another entry
        extract_bases(keyframes, boxed[1], 5, cache_dir=str(tmp_path))


def filled_with(monkeypatch: pytest.MonkeyPatch, solid: Tetrahedra, like: Mesh) -> None:
    """Have the lattice give these tetrahedra, placed as this surface is."""
    _, axes, centre, scale = to_canonical(*like)
    vertices = ((solid.vertices - centre) * scale) @ axes.T
    monkeypatch.setattr(lattice_module, "lattice", lambda *_: solid._replace(vertices=vertices))


def test_loose_pieces_are_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    """Their motions against each other cost nothing, whatever their size: they are no modes."""
    piece = box((4, 2, 2), (2.0, 1.0, 1.0), jitter=0.1)
    two = together(piece, piece)
    two.vertices[45:, 2] += 3.0
    vertices, faces = as_mesh(two)
    filled_with(monkeypatch, two, (vertices, faces))
    with pytest.warns(MeshWarning, match=r"has 2 loose pieces.* left to the interpolation") as said:
        basis = extract_bases(np.stack([vertices, vertices + 1.0]), faces, 8, cache=False)[0]
    assert len(said) == 1
    each = solve(piece, 4).eigenvalues
    np.testing.assert_allclose(basis.eigenvalues, np.repeat(each, 2), rtol=1e-6)


def test_a_small_piece_goes_along(monkeypatch: pytest.MonkeyPatch) -> None:
    """A button of a body: as the body moves beside it, and without modes of its own."""
    button = box((1, 1, 1), (0.1, 0.1, 0.1))
    button.vertices[:] += [1.5, 1.6, 0.5]
    both = together(BOX, button)
    vertices, faces = as_mesh(both)
    filled_with(monkeypatch, both, (vertices, faces))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        basis = extract_modes(vertices, faces, 10, cache=False)
    np.testing.assert_allclose(basis.eigenvalues, solve(BOX, 10).eigenvalues, rtol=1e-6)
    near = np.linalg.norm(vertices - [1.5, 1.5, 0.5], axis=1).argsort()
    body = basis.modes[:, near[near < len(vertices) - 8][:4]].mean(dim=1)
    own = basis.modes[:, -8:].mean(dim=1)
    # The lowest, which change little over the distance.
    assert (own - body)[:4].norm() < 0.5 * body[:4].norm()
    assert basis.modes[:, -8:].abs().max() < 2 * basis.modes[:, :-8].abs().max()


def test_tetrahedra_without_surface_are_dropped(monkeypatch: pytest.MonkeyPatch) -> None:
    """However many they are."""
    far = box((4, 2, 2), (2.0, 1.0, 1.0))
    far.vertices[:] += 30.0
    vertices, faces = as_mesh(BOX)
    filled_with(monkeypatch, together(BOX, far), (vertices, faces))
    keyframes = np.stack([vertices, vertices * (1.0, 1.1, 1.0)])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        bases = extract_bases(keyframes, faces, 6, cache=False)
    np.testing.assert_allclose(bases[0].eigenvalues, solve(BOX, 6).eigenvalues, rtol=1e-6)


@pytest.mark.parametrize(
    "error", [RuntimeError("Factor is exactly singular"), np.linalg.LinAlgError("Singular matrix")]
)
def test_errors_of_libraries_become_own_ones(boxed: Mesh, monkeypatch: pytest.MonkeyPatch, error: Exception) -> None:
    def fail(*_: object) -> None:
        raise error

    for name in ("solid.arap_hessian", "extract.lowest_modes"):
        with monkeypatch.context() as patch:
            patch.setattr(f"torch_modal.modes.{name}", fail)
            with pytest.raises(ModalAnalysisError, match=f"{error}.*check the surface"):
                extract_modes(*boxed, 4, method="solid", cache=False)


def test_errors_name_the_keyframe(boxed: Mesh, monkeypatch: pytest.MonkeyPatch) -> None:
    vertices, faces = boxed

    def fail(*args: object, **kwargs: object) -> None:
        raise ModalAnalysisError("no luck")

    with pytest.raises(MeshError, match=r"key-frame 1: the surface is flat"):
        extract_bases(np.stack([vertices, vertices * (1, 1, 0)]), faces, 4, method="solid", cache=False)
    monkeypatch.setattr(TetWild, "fill", fail)
    with pytest.raises(ModalAnalysisError, match=r"key-frame [01]: no luck"):
        extract_bases(np.stack([vertices, vertices]), faces, 4, method="solid", mesher="tetwild", cache=False)
    with pytest.raises(ModalAnalysisError, match=r"^no luck"):
        extract_modes(vertices, faces, 4, method="solid", mesher="tetwild", cache=False)


def test_threads_change_nothing(boxed: Mesh, monkeypatch: pytest.MonkeyPatch) -> None:
    """Bit by bit: carried and solved one after another, or four at a time with one factorisation for all."""
    vertices, faces = boxed
    keyframes = np.stack([vertices * (1.0, 1.0, 1.0 + 0.02 * i) for i in range(6)])
    found = []
    for cpus in (1, 4, 4):
        monkeypatch.setattr(threads, "n_threads", lambda cpus=cpus: cpus)
        found.append(extract_bases(keyframes, faces, 5, cache=False))
    for alone, one, other in zip(*found, strict=True):
        np.testing.assert_array_equal(alone.modes, one.modes)
        np.testing.assert_array_equal(one.modes, other.modes)
        np.testing.assert_array_equal(alone.reference, one.reference)


@pytest.mark.parametrize(
    ("name", "value", "says"),
    [
        *(("n_modes", n, "n_modes is .*ways to deform; give .* 1 to 216") for n in (0, -1, 2.5, True, 10_000)),
        ("form", "spokes", "the Hessian form is 'spokes'; give"),
        *((name, "spokes", f"the {what} is 'spokes'; give") for name, what in (("mesher",) * 2, ("method",) * 2)),
    ],
)
def test_impossible_options(boxed: Mesh, name: str, value: Any, says: str) -> None:
    with pytest.raises(ValueError, match=says):
        extract_modes(*boxed, cache=False, **{name: value})


def test_the_bar_shows_only_on_request(boxed: Mesh, capsys: pytest.CaptureFixture[str]) -> None:
    extract_bases([boxed[0]], boxed[1], 4, cache=False)
    assert capsys.readouterr().err == ""
    extract_bases([boxed[0], boxed[0]], boxed[1], 4, cache=False, progress=True)
    assert "key-frame 2/2: modes" in capsys.readouterr().err


def test_with_the_real_mesher(capsule: Mesh) -> None:
    """The whole way; the mesher is not deterministic, so only what does not depend on it is asked."""
    vertices, faces = capsule
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        basis = extract_modes(vertices, faces, 12, mesher=COARSE)
    assert basis.rigid_eigenvalues.abs().max() < 1e-8 * basis.eigenvalues[0]
    assert torch.isfinite(basis.modes).all()
    # A body of revolution: its lowest two modes bend it, with equal eigenvalues (up to the meshing).
    assert basis.eigenvalues[1] == pytest.approx(float(basis.eigenvalues[0]), rel=0.1)
    along = (basis.modes[:2, :, 2] ** 2).sum(dim=1) / (basis.modes[:2] ** 2).sum(dim=(1, 2))
    assert along.max() < 0.25
    # Restricted and elastic modes stay independent of each other and of the rigid motions.
    columns = torch.cat([basis.rigid_modes, basis.modes]).flatten(1)
    columns = columns / columns.norm(dim=1, keepdim=True)
    assert torch.linalg.svdvals(columns).min() > 0.03
