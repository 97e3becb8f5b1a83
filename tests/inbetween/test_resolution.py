"""Coarse meshes get as many faces as thin limbs and small pieces need."""

from typing import Any

import fast_simplification
import numpy as np
import pytest
import torch
import trimesh
from conftest import Shapes, modal
from helpers.bodies import body
from helpers.shapes import edge_lengths

import torch_modal as tm
from torch_modal.elastic.term import Mesh
from torch_modal.geometry.connectivity import Connectivity, label_pieces
from torch_modal.inbetween import coarse as coarse_mesh
from torch_modal.inbetween.coarse import ENOUGH_FACES
from torch_modal.modes.coarsening import FACES_OF_PIECE, coarsen


@pytest.mark.parametrize("name, most", [("wire bent 60", 0.1), ("bar twisted 60", 0.05)])
def test_a_coarse_modal_solve_resolves_thin_limbs(name: str, most: float) -> None:
    """With 300 faces, the edges of a ball with a thin leg were 26 times as far off as by linear interpolation."""
    shape = body(name)
    first, middle, last = (torch.from_numpy(shape.pose(t)) for t in (0.0, 0.5, 1.0))
    faces = torch.tensor(shape.faces)

    def error(x: torch.Tensor) -> float:
        return float((edge_lengths(x, faces) - edge_lengths(middle, faces)).norm())

    bases = tm.extract_bases(torch.stack([first, last]), faces, 30, mesher="lattice", progress=False)
    layer = tm.InBetween(bases, faces, **modal(coarse_faces=300, anchor=30_000.0))
    with torch.no_grad():
        found = layer(first, last, 0.5)
    assert error(found) < most * error((first + last) / 2)
    n_faces = len(layer.core.space.coarse.mesh.faces)
    assert n_faces <= (ENOUGH_FACES if name.startswith("wire") else 300), "more than a body of one thickness needs"


def test_each_pose_is_collapsed_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """However many numbers of faces are tried."""
    calls, tried = [], []

    def counted(*given: Any, **named: Any) -> Any:
        calls.append(given)
        return simplify(*given, **named)

    def recorded(points: Any, faces: Any, n_faces: int, *others: Any) -> Any:
        tried.append(n_faces)
        return coarsen(points, faces, n_faces, *others)

    simplify = fast_simplification.simplify
    monkeypatch.setattr(fast_simplification, "simplify", counted)
    monkeypatch.setattr(coarse_mesh, "coarsen", recorded)
    monkeypatch.setattr(coarse_mesh, "spread", lambda fine, coarse: np.inf)
    shape = body("limb bent 120")
    shapes = torch.from_numpy(np.stack([shape.pose(0.0), shape.pose(1.0)]))
    whole = Mesh(Connectivity(np.array(shape.faces), shapes.shape[1]))
    coarse_mesh.coarsen_until_resolved(shapes, whole, 300, [torch.ones_like(shapes[:1])] * 2)
    assert tried == [300, 450, 675, 1000] and len(calls) == 2


@pytest.mark.parametrize(("most", "bound"), [(10**6, 1e-3), (200, 3.0)])
def test_stiffness_is_that_of_the_edges(most: int, bound: float, bars: Shapes, monkeypatch: pytest.MonkeyPatch) -> None:
    """Energy of small amplitudes by ``a' H a``; from some of the edges, about that."""
    monkeypatch.setattr(coarse_mesh, "MOST_EDGES", most)
    x, modes = bars.keyframes[1], bars.bases[1].modes
    mesh = Mesh(Connectivity(bars.faces.numpy(), len(x)))
    found = coarse_mesh.stretching_hessian(mesh, x, modes)
    a = 1e-5 * torch.randn(20, len(modes), dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    moved, rest = (edge_lengths(y, bars.faces) for y in (x + torch.tensordot(a, modes, 1), x))
    energies = ((moved - rest).square() / rest).sum(-1)
    ratios = torch.einsum("bi,ij,bj->b", a, found, a) / energies
    assert ratios.max() / ratios.min() < 1 + bound
    assert abs(ratios[0] - 1) < 1e-3 or most < len(mesh.edges)


def test_pieces_keep_faces() -> None:
    """Small pieces beside a large one vanished, and with them all that kept their shape."""
    ball = trimesh.creation.icosphere(subdivisions=4)
    parts = [ball]
    for i, scale in enumerate((0.05, 0.1, 0.2)):
        part = trimesh.creation.icosphere(subdivisions=2, radius=scale)
        parts.append(part.apply_translation([0, 0, 1.5 + i]))
    tetrahedron = trimesh.creation.icosahedron()
    parts.append(tetrahedron.apply_scale(0.02).apply_translation([2.0, 0, 0]))
    whole = trimesh.util.concatenate(parts)
    faces = np.asarray(whole.faces)
    coarse = coarsen(whole.vertices[None], faces, 200)
    piece = label_pieces(np.concatenate([coarse.faces[:, :2], coarse.faces[:, 1:]]), coarse.n_vertices)
    counts = np.bincount(piece[coarse.faces[:, 0]])
    assert len(counts) == len(parts)
    assert counts.min() >= FACES_OF_PIECE - 4
    assert (coarse.clusters >= 0).all()
    assert len(coarse.faces) <= 200 + 4 * FACES_OF_PIECE
