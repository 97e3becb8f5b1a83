"""Coarse meshes get as many faces as thin limbs and small pieces need."""

import numpy as np
import pytest
import torch
import trimesh
from bodies import body
from shapes import edge_lengths

import torch_modal as tm
from torch_modal.geometry.connectivity import connected_pieces
from torch_modal.inbetween.coarse import ENOUGH_FACES
from torch_modal.modes.coarsening import FACES_OF_PIECE, coarsen


@pytest.mark.parametrize("name, most", [("wire bent 60", 0.1), ("bar twisted 60", 0.05)])
def test_fast_resolves_thin_limbs(name: str, most: float) -> None:
    """With 300 faces, the edges of a ball with a thin leg were 26 times as far off as by linear interpolation."""
    shape = body(name)
    first, middle, last = (torch.from_numpy(shape.pose(t)) for t in (0.0, 0.5, 1.0))
    faces = torch.tensor(shape.faces)

    def error(x: torch.Tensor) -> float:
        return float((edge_lengths(x, faces) - edge_lengths(middle, faces)).norm())

    bases = tm.extract_bases(torch.stack([first, last]), faces, 30, mesher="lattice", progress=False)
    layer = tm.InBetween(bases, faces, "fast")
    with torch.no_grad():
        found = layer(first, last, 0.5)
    assert error(found) < most * error((first + last) / 2)
    n_faces = len(layer.core.space.coarse.mesh.faces)
    assert n_faces <= (ENOUGH_FACES if name.startswith("wire") else 300), "more than a body of one thickness needs"


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
    piece = connected_pieces(np.concatenate([coarse.faces[:, :2], coarse.faces[:, 1:]]), coarse.n_vertices)
    counts = np.bincount(piece[coarse.faces[:, 0]])
    assert len(counts) == len(parts)
    assert counts.min() >= FACES_OF_PIECE - 4
    assert (coarse.clusters >= 0).all()
    assert len(coarse.faces) <= 200 + 4 * FACES_OF_PIECE
