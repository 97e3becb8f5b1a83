"""The lattice fills what is inside, the same way each time, whatever the surface is like."""

import os
import subprocess
import sys
import threading
from pathlib import Path

import numpy as np
import pytest
import trimesh
from helpers.bodies import body
from helpers.solids import as_mesh, box, eigenmodes, lumped_mass, surface
from scipy.spatial import cKDTree

from torch_modal.modes import lattice as lattice_module
from torch_modal.modes.extract import extract_modes
from torch_modal.modes.lattice import Lattice, lattice
from torch_modal.modes.stiffness import arap_hessian, mass_matrix
from torch_modal.modes.surface import CanonicalSurface, clearances
from torch_modal.modes.tetrahedra import (
    face_connected_pieces,
    solid_volumes,
    tet_volumes,
)

Mesh = tuple[np.ndarray, np.ndarray]


@pytest.mark.parametrize("cell", [0.08, 0.04])
def test_volume_and_place(capsule: Mesh, cell: float) -> None:
    whole = CanonicalSurface(*capsule)
    filled = lattice(whole, cell)
    assert (tet_volumes(filled) > 0).all()
    exact = trimesh.Trimesh(whole.vertices, whole.faces)
    assert solid_volumes(filled).sum() == pytest.approx(exact.volume, rel=cell)
    mass = lumped_mass(filled)
    center = (mass[:, None] * filled.vertices).sum(axis=0) / mass.sum()
    np.testing.assert_allclose(center, exact.center_mass, atol=0.3)  # of a diagonal of 100
    low, high = filled.vertices.min(axis=0), filled.vertices.max(axis=0)
    np.testing.assert_allclose(low, whole.vertices.min(axis=0), atol=50 * cell)
    np.testing.assert_allclose(high, whole.vertices.max(axis=0), atol=50 * cell)


def test_outer_vertices_lie_on_the_surface(capsule: Mesh) -> None:
    whole = CanonicalSurface(*capsule)
    filled = lattice(whole, 0.05)
    outer = filled.vertices[np.unique(surface(filled))]
    corners = whole.vertices[whole.faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    # Of a convex body: the distance to the plane that a point is most outside of.
    distance = np.abs(((outer[:, None] - corners[:, 0]) * normals).sum(axis=2).max(axis=1))
    assert np.median(distance) < 0.1  # of facets: the nearest sample may be on the next one
    assert distance.max() < 10.0  # one of the cubes that all come from


THREADS = """
import hashlib, sys
import numpy as np
import trimesh
from torch_modal.modes.extract import extract_bases
mesh = trimesh.creation.capsule(height=3.0, radius=0.6, count=(24, 24))
keyframes = np.stack([mesh.vertices, mesh.vertices * [1.0, 1.1, 1.0]])
total = hashlib.sha256()
for basis in extract_bases(keyframes, mesh.faces, 12, mesher="lattice", cache=False):
    total.update(basis.modes.numpy().tobytes() + basis.eigenvalues.numpy().tobytes())
print(total.hexdigest())
"""


@pytest.mark.slow
def test_the_same_in_every_process_with_any_threads() -> None:
    """Bit by bit; the capsule's modes come in pairs of nearly equal eigenvalues, which rounding would turn."""
    root = str(Path(lattice_module.__file__).parents[2])
    found = set()
    for threads in ("1", "4"):
        variables = {**os.environ, "OMP_NUM_THREADS": threads, "OPENBLAS_NUM_THREADS": threads, "PYTHONPATH": root}
        run = subprocess.run([sys.executable, "-c", THREADS], check=True, capture_output=True, text=True, env=variables)
        found.add(run.stdout.strip())
    assert len(found) == 1


@pytest.mark.parametrize("thickness", [0.05, 0.005, 0.0005])
def test_thin_plates_are_filled(thickness: float) -> None:
    """By tetrahedra in one piece, all over; their flat sides lie along sides of the lattice's cubes."""
    vertices, faces = as_mesh(box((20, 15, 1), (4.0, 3.0, thickness)))
    whole = CanonicalSurface(vertices, faces)
    filled = Lattice().fill(whole, threading.Event())
    assert face_connected_pieces(filled.tets).max() == 0
    assert cKDTree(filled.vertices).query(whole.vertices)[0].max() < 4.0
    basis = extract_modes(vertices, faces, 6, cache=False)
    across = (basis.modes[0, :, 2] ** 2).sum() / (basis.modes[0] ** 2).sum()
    assert across > 0.9


def test_too_fine_cubes_become_larger(capsule: Mesh) -> None:
    """What fTetWild could still fill, the lattice fills with as many cubes as it may have."""
    ball = trimesh.creation.icosphere(subdivisions=2)
    whole = CanonicalSurface(ball.vertices, ball.faces)
    filled = lattice(whole, 0.009)
    assert len(filled.tets) < 40 * lattice_module.MOST_CUBES
    assert solid_volumes(filled).sum() == pytest.approx(trimesh.Trimesh(whole.vertices, whole.faces).volume, rel=0.02)


def of_body(name: str) -> CanonicalSurface:
    shape = body(name)
    return CanonicalSurface(shape.pose(0.0), shape.faces)


@pytest.mark.parametrize("name", ["limb bent 120", "wire bent 120", "rod bent 180"])
def test_thin_limbs_have_small_tetrahedra(name: str) -> None:
    """In a number that is bounded, in one piece, and with the volume that the body has."""
    whole = of_body(name)
    filled = lattice(whole, 0.03)
    assert face_connected_pieces(filled.tets).max() == 0
    assert len(filled.tets) < 1.2 * lattice_module.MOST_TETRAHEDRA
    exact = trimesh.Trimesh(whole.vertices, whole.faces)
    assert solid_volumes(filled).sum() == pytest.approx(exact.volume, rel=0.15)
    thickness, _ = clearances(whole)
    sizes = np.cbrt(6 * tet_volumes(filled))
    assert np.median(sizes[filled.vertices[filled.tets].mean(axis=1)[:, 0] > 30]) < thickness.min()


def test_lowest_mode_of_a_rod() -> None:
    """A free beam: lambda = (4.730 / L)^4 E r² / 4 with E = 2, the modulus of ``|sym ∇u|²``."""
    shape = body("rod bent 180")
    found = extract_modes(shape.pose(0.0), shape.faces, 4, mesher="lattice", cache=False).eigenvalues[:2]
    np.testing.assert_allclose(found, (4.730 / 4.0) ** 4 * 2 * 0.04**2 / 4, rtol=0.5)


def test_modes_of_a_bar_against_its_own_tetrahedra() -> None:
    """The bar fills its cells by a third only; a lattice that counted cells as full would be far too stiff."""
    solid = box((30, 6, 6), (10.0, 1.0, 1.3))
    vertices, faces = as_mesh(solid)
    bar = CanonicalSurface(vertices @ np.linalg.qr(np.arange(9.0).reshape(3, 3) + np.eye(3))[0], faces)
    filled = lattice(bar, 0.025)
    found = eigenmodes(arap_hessian(filled), mass_matrix(filled), filled.vertices, 5).eigenvalues
    wanted = eigenmodes(arap_hessian(solid), mass_matrix(solid), solid.vertices, 5).eigenvalues / bar.scale**2
    np.testing.assert_allclose(found, wanted, rtol=0.35)


def test_open_and_half_flipped_surfaces(capsule: Mesh) -> None:
    """A hole is closed: with an eighth of the faces missing the volume stays."""
    vertices, faces = capsule
    centers = vertices[faces].mean(axis=1)
    far = centers[:, 2] > np.quantile(centers[:, 2], 0.875)
    whole, opened = CanonicalSurface(vertices, faces), CanonicalSurface(vertices, faces[~far])
    share = solid_volumes(lattice(opened, 0.05)).sum() / opened.scale**3
    assert share == pytest.approx(solid_volumes(lattice(whole, 0.05)).sum() / whole.scale**3, rel=0.25)
