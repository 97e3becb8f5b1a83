"""Modes of the surface itself: of sheets, thin and open bodies, of several pieces, and the choice of the method."""

import logging
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import trimesh
from helpers.bodies import sheet_surface
from helpers.sheets import rectangle

import torch_modal as tm
from torch_modal.data.samples import load_sample
from torch_modal.errors import ModalAnalysisError
from torch_modal.geometry.canonical import size
from torch_modal.geometry.connectivity import vertex_areas
from torch_modal.keyframes.check import MeshWarning
from torch_modal.modes import extract
from torch_modal.modes.extract import extract_bases, extract_modes, why_shell
from torch_modal.modes.sheet import sheet_body
from torch_modal.modes.surface import CanonicalSurface
from torch_modal.modes.tetrahedra import MesherError

Mesh = tuple[np.ndarray, np.ndarray]

pytestmark = pytest.mark.filterwarnings("ignore::torch_modal.keyframes.check.MeshWarning")


def strip(length: float = 10.0, width: float = 1.0, spacing: float = 0.125) -> Mesh:
    """A flat rectangle of irregular triangles in the plane z = 0."""
    return rectangle(length, width, spacing)


def lens(thickness: float) -> Mesh:
    """A sphere of 642 vertices, squashed."""
    ball = trimesh.creation.icosphere(subdivisions=3)
    return np.array(ball.vertices) * (1, 1, thickness), np.array(ball.faces)


def test_flat_strips_bend_like_beams() -> None:
    """Frequencies of a free beam: eigenvalues like 4.730⁴ : 7.853⁴ : 10.996⁴."""
    vertices, faces = strip()
    basis = extract_modes(vertices, faces, 8, method="shell", cache=False)
    assert np.ptp(vertices[:, 2]) == 0
    out_of_plane = basis.modes[:, :, 2].square().sum(1) / basis.modes.square().sum((1, 2))
    assert (out_of_plane > 0.999).all()
    x = torch.from_numpy(vertices[:, 0] - vertices[:, 0].mean())
    y = torch.from_numpy(vertices[:, 1] - vertices[:, 1].mean())
    twists = (basis.modes[:, :, 2] @ (x * y)).abs() > (basis.modes[:, :, 2] @ x.square()).abs()
    along = (basis.modes[:, :, 2] * y).sum(1).abs() < 0.2 * (basis.modes[:, :, 2].abs() * y.abs()).sum(1)
    bent = basis.eigenvalues[along & ~(twists & ~along)][:3]
    np.testing.assert_allclose(bent / bent[0], np.array([4.730, 7.853, 10.996]) ** 4 / 4.730**4, rtol=0.1)


@pytest.mark.parametrize("thickness", [0.1, 0.03, 0.01, 0.003, 0.001, 0.0])
@pytest.mark.parametrize("method", ["auto", "shell"])
def test_a_lens_of_any_thickness_has_modes(thickness: float, method: Any) -> None:
    """The solid fell into loose pieces at a hundredth, and was refused at a thousandth."""
    basis = extract_modes(*lens(thickness), 30, method=method, cache=False)
    assert basis.rigid_eigenvalues.abs().max() < 1e-6 * basis.eigenvalues[0]
    assert torch.isfinite(basis.modes).all()


def test_units_axes_and_order_of_faces() -> None:
    vertices, faces = load_sample("creature").keyframes[0].numpy(), load_sample("creature").faces.numpy()
    plain = extract_modes(vertices, faces, 8, method="shell", cache=False)
    turn = trimesh.transformations.random_rotation_matrix(np.random.default_rng(0).random(3))[:3, :3]
    order = np.random.default_rng(0).permutation(len(faces))
    moved = extract_modes(1e3 * vertices @ turn.T + 5.0, faces[order], 8, method="shell", cache=False)
    np.testing.assert_allclose(moved.eigenvalues * 1e6, plain.eigenvalues, rtol=1e-6)
    back = moved.modes @ torch.from_numpy(turn) * 1e3**1.5
    apart = torch.minimum((back - plain.modes).norm(dim=(1, 2)), (back + plain.modes).norm(dim=(1, 2)))
    assert (apart < 1e-4 * plain.modes.norm(dim=(1, 2))).all()


def test_modes_have_unit_mass() -> None:
    """Of the area times a hundredth of the size, at a density of 1."""
    vertices, faces = strip()
    basis = extract_modes(vertices, faces, 4, method="shell", cache=False)
    mass = torch.from_numpy(vertex_areas(vertices, faces))
    squares = (basis.modes.square().sum(2) @ mass) * 0.01 * size(vertices, faces)
    np.testing.assert_allclose(squares, 1, rtol=1e-6)


def test_rigid_motions_and_strains_are_carried_exactly() -> None:
    sample = load_sample("creature")
    surface = CanonicalSurface(sample.keyframes[0].numpy(), sample.faces.numpy())
    sheet = sheet_body(surface, 30)
    assert len(sheet.points) < 0.6 * len(surface.vertices)
    rng = np.random.default_rng(0)
    turn, shift = rng.normal(size=(3, 3)), rng.normal(size=3)
    turn = turn - turn.T
    coarse = (sheet.points @ turn.T + shift)[..., None]
    np.testing.assert_allclose(sheet.to_surface(coarse)[..., 0], surface.vertices @ turn.T + shift, atol=1e-9)
    surface = CanonicalSurface(*strip(spacing=0.035))
    flat = sheet_body(surface, 30)
    plane = np.diag([0.3, -0.1, 0.0])  # the normal turns with the faces, and has no strain of its own
    assert len(flat.points) < 0.6 * len(surface.vertices)
    np.testing.assert_allclose(
        flat.to_surface((flat.points @ plane)[..., None])[..., 0], surface.vertices @ plane, atol=1e-9
    )


def test_the_coarse_mesh_has_the_modes_of_the_fine_one(monkeypatch: pytest.MonkeyPatch) -> None:
    sample = load_sample("creature")
    coarse = extract_modes(sample.keyframes[0], sample.faces, 20, method="shell", cache=False)
    monkeypatch.setattr("torch_modal.modes.sheet.SHEET_FACES", 10**6)
    fine = extract_modes(sample.keyframes[0], sample.faces, 30, method="shell", cache=False)
    spans = [torch.linalg.qr(basis.modes.flatten(1).T).Q for basis in (coarse.truncate(10), fine)]
    assert torch.linalg.svdvals(spans[0].T @ spans[1]).min() > 0.95
    np.testing.assert_allclose(coarse.eigenvalues[:10], fine.eigenvalues[:10], rtol=0.35)


def test_edges_of_three_faces_are_stiff() -> None:
    """A page that stands on a sheet has no hinge with it in Eq. 5, and would turn freely."""
    vertices, faces = sheet_surface((20, 10), (2.0, 1.0))
    page, sides = sheet_surface((20, 5), (2.0, 0.5))
    page = page[:, [0, 2, 1]] + np.array([0.0, 0.25, 0.0])
    both = trimesh.util.concatenate(trimesh.Trimesh(vertices, faces), trimesh.Trimesh(page, sides))
    both.merge_vertices(digits_vertex=6)
    assert (trimesh.grouping.group_rows(both.edges_sorted, require_count=3).shape)[0] == 20
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        basis = extract_modes(np.array(both.vertices), np.array(both.faces), 10, cache=False)
    assert not any("loose pieces" in str(one.message) for one in said)
    assert basis.rigid_eigenvalues.abs().max() < 1e-6 * basis.eigenvalues[0]


def test_two_sheets_have_the_modes_of_each() -> None:
    """Their motions against each other have no energy, and are no modes."""
    vertices, faces = strip(2.0, 1.0, 0.1)
    both = np.concatenate([vertices, vertices + np.array([0.0, 0.0, 1.0])])
    with pytest.warns(MeshWarning, match="has 2 loose pieces"):
        basis = extract_modes(both, np.concatenate([faces, faces + len(vertices)]), 8, method="shell", cache=False)
    # The size of both is another, and with it the unit of the stiffness.
    values = basis.eigenvalues / basis.eigenvalues[0]
    each = extract_modes(vertices, faces, 4, method="shell", cache=False).eigenvalues
    np.testing.assert_allclose(values, np.repeat(each / each[0], 2), rtol=0.05)


def test_parts_that_hang_on_a_vertex_turn_about_it() -> None:
    """That has no energy either, but deforms the piece: such motions are modes."""
    first, faces = strip(2.0, 1.0, 0.1)
    joint = int(np.argmin(np.linalg.norm(first - first.max(axis=0), axis=1)))
    second = first - first.min(axis=0) + first[joint]
    own = int(np.argmin(np.linalg.norm(second - first[joint], axis=1)))
    second_faces = np.where(faces == own, joint, faces + len(first))
    basis = extract_modes(np.concatenate([first, second]), np.concatenate([faces, second_faces]), 9, cache=False)
    assert (basis.eigenvalues[:3] < 1e-6 * basis.eigenvalues[3]).all()
    assert basis.rigid_eigenvalues.abs().max() < 1e-6 * basis.eigenvalues[3]


def test_small_pieces_follow_and_unused_vertices_stay() -> None:
    vertices, faces = strip(spacing=0.0625)
    button = trimesh.creation.icosphere(subdivisions=1, radius=0.05)
    place = vertices.mean(axis=0) + np.array([2.0, 0.0, 0.1])
    whole = np.concatenate([[[9.0, 9.0, 9.0]], vertices, button.vertices + place])
    basis = extract_modes(
        whole, np.concatenate([faces + 1, np.array(button.faces) + 1 + len(vertices)]), 10, cache=False
    )
    assert (basis.modes[:, 0] == 0).all()
    near = np.argsort(np.linalg.norm(vertices - place, axis=1))[:4]
    body, own = basis.modes[:, 1:][:, near].mean(1), basis.modes[:, 1 + len(vertices) :].mean(1)
    assert (own - body).norm() < 0.3 * body.norm()


def test_a_triangle_has_three_modes() -> None:
    basis = extract_modes(np.eye(3), np.array([[0, 1, 2]]), 3, cache=False)
    assert (basis.eigenvalues > 0).all()


def test_the_choice(capsule: Mesh, data_dir: Path, caplog: pytest.LogCaptureFixture) -> None:
    """Solids where there is one to fill; a log line says why not."""
    slit = capsule[0], capsule[1][:-2]
    for mesh in (capsule, slit, lens(0.1)):
        assert why_shell([CanonicalSurface(*mesh)]) == ""
    face = tm.load_keyframes([data_dir / "ict-face" / "00-neutral.obj"])
    for mesh, reason in (
        (strip(), "open"),
        ((face.keyframes[0].numpy(), face.faces.numpy()), "open"),
        (lens(0.01), "thin"),
    ):
        assert f"the shape is {reason}: " in why_shell([CanonicalSurface(*mesh)])
    with caplog.at_level(logging.INFO, "torch_modal"):
        both = extract_bases(np.stack([lens(0.1)[0], lens(0.005)[0]]), lens(0.1)[1], 4, cache=False, progress=False)
    assert "modes of the surface itself, not of a solid: key-frame 1 is thin" in caplog.text
    shell = extract_modes(*lens(0.1), 4, method="shell", cache=False)
    torch.testing.assert_close(both[0].modes, shell.modes, rtol=0, atol=0)


def test_where_no_solid_can_be_had(capsule: Mesh, caplog: pytest.LogCaptureFixture) -> None:
    """The shell if a solid has no modes; an error if the mesher fails, which another attempt may not."""
    shell = extract_modes(*capsule, 4, method="shell", cache=False)

    class Failing:
        def __init__(self, error: Exception) -> None:
            self.error = error

        def key(self) -> dict[str, str]:
            return {"mesher": "none"}

        def fill(self, *_: object) -> None:
            raise self.error

    error = ModalAnalysisError("in pieces")
    with caplog.at_level(logging.INFO, "torch_modal"):
        found = extract_modes(*capsule, 4, mesher=Failing(error), cache=False)  # type: ignore[arg-type]
    assert str(error) in caplog.text
    torch.testing.assert_close(found.modes, shell.modes, rtol=0, atol=0)
    both = np.stack([capsule[0], capsule[0]])
    for one in extract_bases(both, capsule[1], 4, mesher=Failing(error), cache=False, progress=False):  # type: ignore[arg-type]
        torch.testing.assert_close(one.modes, shell.modes, rtol=0, atol=0)
    for method, failure in (("auto", MesherError("killed")), ("solid", ModalAnalysisError("in pieces"))):
        with pytest.raises(ModalAnalysisError, match=str(failure)):
            extract_modes(*capsule, 4, method=method, mesher=Failing(failure), cache=False)  # type: ignore[arg-type]


def test_the_cache_knows_the_method(capsule: Mesh, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = str(tmp_path)
    shell = extract_modes(*capsule, 4, method="shell", cache_dir=folder)
    assert len(list(tmp_path.iterdir())) == 1
    solid = extract_modes(*capsule, 4, method="solid", cache_dir=folder)
    assert not torch.equal(shell.modes, solid.modes)
    monkeypatch.setattr(extract, "lowest_modes", None)
    again = extract_modes(*capsule, 4, method="shell", cache_dir=folder, mesher=None)  # type: ignore[arg-type]
    torch.testing.assert_close(again.modes, shell.modes, rtol=0, atol=0)


def test_coincident_vertices_are_one() -> None:
    """An edge without a length has no stiffness: its ends would move against each other."""
    vertices, faces = sheet_surface((20, 10), (2.0, 1.0))
    split = int(np.argmin(np.linalg.norm(vertices - vertices.mean(axis=0), axis=1)))
    around = np.flatnonzero((faces == split).any(axis=1))
    new = len(vertices)
    half = around[: len(around) // 2]
    moved = faces.copy()
    moved[half] = np.where(moved[half] == split, new, moved[half])
    ends = np.intersect1d(moved[half].reshape(-1), np.delete(moved[around], range(len(half)), axis=0).reshape(-1))
    fill = [[split, new, int(end)] for end in ends if end not in (split, new)]
    double = np.concatenate([moved, fill])
    plain = extract_modes(vertices, faces, 6, method="shell", cache=False)
    same = extract_modes(
        np.concatenate([vertices, vertices[split : split + 1]]), double, 6, method="shell", cache=False
    )
    np.testing.assert_allclose(same.eigenvalues, plain.eigenvalues, rtol=1e-6)
    torch.testing.assert_close(same.modes[:, new], same.modes[:, split], rtol=0, atol=1e-12)
