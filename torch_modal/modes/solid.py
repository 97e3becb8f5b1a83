"""The solid inside a surface: its tetrahedra, and the surface embedded in them."""

import threading
from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp

from torch_modal.arrays import AnyArray, FloatArray, IntArray
from torch_modal.geometry.surface import Surface
from torch_modal.io.cache import Cache
from torch_modal.modes.eigen import ElasticBody
from torch_modal.modes.embedding import find_neighbours, fit_weights
from torch_modal.modes.stiffness import HessianForm, arap_hessian, mass_matrix
from torch_modal.modes.tetrahedra import Mesher, Tetrahedra, loose_pieces, small_pieces, solid_volumes, submesh


@dataclass(frozen=True)
class Solid:
    """Tetrahedra in the pose of a key-frame: its own, or carried from another.

    Mass and embedding come from the pose that was meshed, in which no tetrahedron is inverted and no point is closer to
    another limb than to its own.

    Attributes:
        surface: The key-frame.
        tetrahedra: The volume mesh, in the units of the surface.
        neighbours: Embedding of the surface in the pose that was meshed
            (:func:`~torch_modal.modes.embedding.find_neighbours`). *Shape:* ``(U, 12)``.
        kernel: Likewise. *Shape:* ``(U, 12)``.
        meshed: The key-frame that the tetrahedra were carried from; None if they are its own.
    """

    surface: Surface
    tetrahedra: Tetrahedra
    neighbours: IntArray
    kernel: FloatArray
    meshed: "Solid | None" = None

    @classmethod
    def from_surface(cls, surface: Surface, mesher: Mesher, cache: Cache, stop: threading.Event) -> "Solid":
        """Mesh a surface, unless the cache has its tetrahedra; raises as :meth:`Mesher.fill`."""

        def embed(tetrahedra: Tetrahedra) -> tuple[Tetrahedra, IntArray, FloatArray]:
            return tetrahedra, *find_neighbours(surface.vertices, tetrahedra, surface.vertex_normals)

        def compute() -> dict[str, AnyArray]:
            tetrahedra, neighbours, kernel = embed(without_small_pieces(mesher.fill(surface, stop)))
            piece = loose_pieces(tetrahedra)
            bears = np.bincount(piece[neighbours[kernel > 0]], minlength=piece.max() + 1) > 0
            if not bears.all():  # pieces without any point of the surface
                tetrahedra, neighbours, kernel = embed(submesh(tetrahedra, bears[piece[tetrahedra.tets[:, 0]]]))
            return {**tetrahedra.arrays(), "neighbours": neighbours, "kernel": kernel}

        inputs = {"points": surface.vertices, "faces": surface.faces}
        arrays = cache.get("solid", inputs, mesher.key(), compute)
        tetrahedra = Tetrahedra(arrays["vertices"], arrays["tets"], arrays.get("inside"))
        return cls(surface, tetrahedra, arrays["neighbours"], arrays["kernel"])

    def weights(self) -> sp.csr_matrix:
        """Displacements of the surface from displacements of the tetrahedra. *Shape:* ``(U, N)``."""
        return fit_weights(self.surface.vertices, self.tetrahedra.vertices, self.neighbours, self.kernel)

    def body(self, form: HessianForm) -> ElasticBody:
        """Stiffness, and mass at a density of 1."""
        weights, rest = self.weights(), (self.meshed or self).tetrahedra
        return ElasticBody(
            self.tetrahedra.vertices,
            arap_hessian(self.tetrahedra, form),
            mass_matrix(rest) * (solid_volumes(self.tetrahedra).sum() / solid_volumes(rest).sum()),
            lambda motions: (weights @ motions.reshape(len(motions), -1)).reshape(-1, *motions.shape[1:]),
        )


def without_small_pieces(tetrahedra: Tetrahedra) -> Tetrahedra:
    """Tetrahedra without small loose pieces: the surface there follows the nearest part of the others."""
    piece = loose_pieces(tetrahedra)[tetrahedra.tets[:, 0]]
    volumes = np.bincount(piece, solid_volumes(tetrahedra))
    small = small_pieces(volumes, tetrahedra.vertices[tetrahedra.tets], piece)
    return submesh(tetrahedra, ~small[piece])
