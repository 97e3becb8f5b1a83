"""The solid inside a surface: its tetrahedra, and the surface embedded in them."""

import threading
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from torch_modal.arrays import FloatArray, IntArray
from torch_modal.io.cache import Cache
from torch_modal.modes.eigen import ElasticBody
from torch_modal.modes.embedding import N_NEIGHBOURS, find_neighbours, fit_weights
from torch_modal.modes.stiffness import HessianForm, arap_hessian, mass_matrix
from torch_modal.modes.surface import CanonicalSurface
from torch_modal.modes.tetrahedra import Mesher, Tetrahedra, loose_pieces, small_pieces, solid_volumes, submesh

REACH = 2.0
"""Radius of the region that a small piece follows, relative to its distance from the body or its own size."""


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

    surface: CanonicalSurface
    tetrahedra: Tetrahedra
    neighbours: IntArray
    kernel: FloatArray
    meshed: "Solid | None" = None

    @classmethod
    def from_surface(cls, surface: CanonicalSurface, mesher: Mesher, cache: Cache, stop: threading.Event) -> "Solid":
        """Mesh a surface, unless the cache has its tetrahedra; raises as :meth:`Mesher.fill`."""

        def compute() -> dict[str, NDArray[Any]]:
            tetrahedra = mesher.fill(surface, stop)
            neighbours, kernel = find_neighbours(surface.points, tetrahedra, surface.normals)
            piece = loose_pieces(tetrahedra)
            bears = np.bincount(piece[neighbours[kernel > 0]], minlength=piece.max() + 1) > 0
            if not bears.all():  # pieces without any point of the surface
                tetrahedra = submesh(tetrahedra, bears[piece[tetrahedra.tets[:, 0]]])
                neighbours, kernel = find_neighbours(surface.points, tetrahedra, surface.normals)
            return {**tetrahedra.arrays(), "neighbours": neighbours, "kernel": kernel}

        inputs = {"points": surface.points, "faces": surface.faces}
        arrays = cache.get("solid", inputs, mesher.key(), compute)
        tetrahedra = Tetrahedra(arrays["vertices"], arrays["tets"], arrays.get("inside"))
        return cls(surface, tetrahedra, arrays["neighbours"], arrays["kernel"])

    def weights(self) -> sp.csr_matrix:
        """Displacements of the surface from displacements of the tetrahedra. *Shape:* ``(U, N)``."""
        return fit_weights(self.surface.points, self.tetrahedra.vertices, self.neighbours, self.kernel)

    def body(self, form: HessianForm) -> ElasticBody:
        """Stiffness of the larger pieces, and their mass at a density of 1."""
        tetrahedra, vertices, following = larger_pieces(self.tetrahedra)
        weights = sp.csr_matrix(self.weights() @ following)
        rest = (self.meshed or self).tetrahedra
        mass = mass_matrix(rest) * (solid_volumes(self.tetrahedra).sum() / solid_volumes(rest).sum())
        return ElasticBody(
            tetrahedra.vertices,
            arap_hessian(tetrahedra, form),
            mass[vertices][:, vertices],
            lambda motions: (weights @ motions.reshape(len(motions), -1)).reshape(-1, *motions.shape[1:]),
        )


def larger_pieces(tetrahedra: Tetrahedra) -> tuple[Tetrahedra, IntArray, sp.csr_matrix]:
    """Tetrahedra without small loose pieces, which follow the nearest part of the others.

    Small pieces have little mass, so their rigid motions of unit mass would be larger than other modes by orders of
    magnitude. Returns the larger pieces, the indices of their vertices, *shape* ``(M,)``, and weights that extend their
    displacements to all vertices, exact for linear fields, *shape* ``(N, M)``.
    """
    n, piece = len(tetrahedra.vertices), loose_pieces(tetrahedra)
    of_tets = piece[tetrahedra.tets[:, 0]]
    volumes = np.bincount(of_tets, solid_volumes(tetrahedra))
    small = small_pieces(volumes, tetrahedra.vertices[tetrahedra.tets], of_tets)
    stays = np.flatnonzero(~small[piece])
    if len(stays) == n:
        return tetrahedra, stays, sp.identity(n, format="csr")
    kept = submesh(tetrahedra, ~small[of_tets])
    rows, weights = [stays], [sp.identity(len(stays), format="csr")]
    for members in (np.flatnonzero(piece == index) for index in np.flatnonzero(small)):
        points = tetrahedra.vertices[members]
        around = np.tile(_around(points, kept.vertices, piece[stays]), (len(members), 1))
        rows.append(members)
        weights.append(fit_weights(points, kept.vertices, around, np.ones(around.shape)))
    order = np.argsort(np.concatenate(rows))
    return kept, stays, sp.csr_matrix(sp.vstack(weights, format="csr")[order])


def _around(points: FloatArray, vertices: FloatArray, piece: IntArray) -> IntArray:
    """Vertices of the nearest piece, spread over a region as large as its distance. *Shape:* ``(12,)``."""
    center = points.mean(axis=0)
    nearest = int(np.linalg.norm(vertices - center, axis=1).argmin())
    reach = REACH * max(np.linalg.norm(vertices[nearest] - center), np.linalg.norm(np.ptp(points, axis=0)))
    distance = np.linalg.norm(vertices - vertices[nearest], axis=1)
    distance[piece != piece[nearest]] = np.inf
    n_near = max(int((distance <= reach).sum()), min(N_NEIGHBOURS, int(np.isfinite(distance).sum())))
    return np.argsort(distance, kind="stable")[np.linspace(0, n_near - 1, N_NEIGHBOURS).astype(np.int64)]
