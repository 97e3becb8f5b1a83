"""Vibration modes of a surface itself: those of Eq. 5 at rest, without tetrahedra.

The stiffness is the Gauss-Newton Hessian of edge lengths and dihedral angles at rest, the mass that of a sheet. Sheets,
thin and open bodies have such modes, as all surfaces do. The enclosed volume is left out: it hardly
changes in-betweens (docs/precompute.md).
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from torch_modal.arrays import BoolArray, FloatArray, IntArray
from torch_modal.energy.rest_hessian import rest_hessian
from torch_modal.energy.shell import BETA
from torch_modal.geometry.canonical import CANONICAL_SIZE
from torch_modal.geometry.connectivity import Connectivity, double_areas, vertex_areas
from torch_modal.io.cache import Arrays
from torch_modal.precompute.coarsening import Collapses, coarsen
from torch_modal.precompute.eigen import Scale
from torch_modal.precompute.surface import CanonicalSurface
from torch_modal.precompute.tetrahedra import small_pieces

THICKNESS = 0.01
"""Thickness of the sheet whose mass the modes have, in sizes of the surface."""
COARSE_FACES = 4000
"""Faces of the mesh that modes are computed on: with 2,000 or 8,000, in-betweens are as good."""
FACES_PER_MODE = 50
"""Where many modes are asked for, there are more faces."""
SHORTEST = 1e-6
"""Length of an edge over the mean up to which its ends are one vertex: it would have no stiffness."""
LEAST_MASS = 1e-3
"""Smallest mass of a vertex over the mean."""
MOST_ROUNDING = 0.1
"""Residual of the modes that is accepted if further steps do not help: it is rounding of ``K phi`` at slivers, which
are stiffer than the rest by many orders. Lanczos has bounded the error of the inverted problem by then."""
SPREAD = 1.5
"""Averages over neighbours that carry displacements from clusters to vertices, per radius of a cluster in edges."""


@dataclass(frozen=True)
class Sheet:
    """A surface as a thin elastic sheet.

    Vertices are clustered by edge collapses, and modes are computed on the mesh of the clusters, with stretching as
    stiff as that of the fine mesh: in Eq. 5 it grows as edges become shorter.

    Attributes:
        surface: The surface, of a size of 100.
        n_modes: Number of modes that the coarse mesh must resolve.
    """

    surface: CanonicalSurface
    n_modes: int

    @property
    def size(self) -> int:
        """About the number of vertices of the coarse mesh."""
        return min(self._n_faces, len(self.surface.faces)) // 2

    @property
    def _n_faces(self) -> int:
        return max(COARSE_FACES, FACES_PER_MODE * self.n_modes)

    def inputs(self) -> tuple[Arrays, dict[str, Any]]:
        """Everything that the modes depend on."""
        return {"points": self.surface.points, "faces": self.surface.faces}, {"form": "shell"}

    @cached_property
    def _fine(self) -> Connectivity:
        return Connectivity(self.surface.faces, len(self.surface.points))

    @cached_property
    def _clusters(self) -> IntArray:
        """Coarse vertex of each vertex, -1 in small pieces. *Shape:* ``(U,)``."""
        return self._coarse[0]

    @cached_property
    def _coarse(self) -> tuple[IntArray, FloatArray, Connectivity]:
        """Clusters, and the mesh that they make."""
        points, faces = self.surface.points, self.surface.faces
        piece = self._fine.vertex_pieces[faces[:, 0]]
        small = small_pieces(np.bincount(piece, double_areas(points, faces)), points[faces], piece)
        own = faces[~small[piece]]
        # Modes do not mind needles, for which `coarsen` would collapse several times.
        few = len(own) <= self._n_faces
        coarse = (
            coarsen(points[None], own, self._n_faces) if few else Collapses(own).of([0], points[None])(0, self._n_faces)
        )
        coarse = coarse.joined(points, SHORTEST)
        return coarse.clusters, coarse.restrict(points), Connectivity(coarse.faces, coarse.n_vertices)

    @property
    def points(self) -> FloatArray:
        """Vertices of the coarse mesh. *Shape:* ``(N, 3)``."""
        return self._coarse[1]

    @property
    def mesh(self) -> Connectivity:
        """Connectivity of the coarse mesh."""
        return self._coarse[2]

    @property
    def n_pieces(self) -> int:
        """Number of pieces of the coarse mesh."""
        return int(self.mesh.vertex_pieces.max()) + 1

    def stiffness(self) -> sp.csc_matrix:
        """Gauss-Newton Hessian of Eq. 5 at rest, without volume. *Shape:* ``(3N, 3N)``."""
        coarser = _mean_length(self.points, self.mesh) / _mean_length(self.surface.points, self._fine)
        first, second = self.mesh.adjacent_sides.T
        # Also at edges of three faces and more, which would be free to turn.
        hinges = [self.mesh.start[first], self.mesh.end[first], self.mesh.opposite[first], self.mesh.opposite[second]]
        return rest_hessian(self.points, self.mesh.edges, np.stack(hinges, axis=1), coarser)

    def mass(self) -> sp.csr_matrix:
        """Lumped mass of a density of 1. *Shape:* ``(N, N)``."""
        areas = vertex_areas(self.points, self.mesh.faces)
        return sp.diags(THICKNESS * CANONICAL_SIZE * np.maximum(areas, LEAST_MASS * areas.mean()), format="csr")

    @property
    def scale(self) -> Scale:
        """Orders of eigenvalues, by the lowest one of a flat sheet."""
        lowest = 100 * 2 * BETA / (CANONICAL_SIZE**4 * THICKNESS * CANONICAL_SIZE)
        return Scale(shift=50 * lowest, zero=5e-6 * lowest, enough=MOST_ROUNDING)

    def carried(self, motions: FloatArray) -> FloatArray:
        """Motions of the coarse mesh, at all points of the surface. *Shape:* ``(N, 3, k) -> (U, 3, k)``.

        Each cluster moves the vertices around it by its displacement and its gradient, as a smooth partition of unity
        blends them; rigid motions and uniform strains are exact.
        """
        if np.array_equal(self._clusters, np.arange(len(self.surface.points))):
            return motions
        n = len(self.points)
        weights = self._weights()
        arms = self.surface.points[weights.row] - self.points[weights.col]
        blend = sp.csr_matrix(
            (
                np.concatenate([weights.data, *(weights.data * arms.T)]),
                (np.tile(weights.row, 4), np.concatenate([weights.col + part * n for part in range(4)])),
            ),
            shape=(len(self.surface.points), 4 * n),
        )
        gradients = _vertex_gradients(motions, self.points, self.mesh.faces)
        local = np.concatenate([motions[None], gradients]).reshape(4 * n, -1)
        return (blend @ local).reshape(-1, *motions.shape[1:])

    def _weights(self) -> sp.coo_matrix:
        """Weights of the clusters that move each vertex; rows sum to one. *Shape:* ``(U, N)``.

        Membership, averaged over the neighbours on the surface a few times: weights are smooth, and do not reach from
        one finger to the next.
        """
        n_fine, n = len(self.surface.points), len(self.points)
        own = np.flatnonzero(self._clusters >= 0)
        weights = sp.csr_matrix((np.ones(len(own)), (own, self._clusters[own])), shape=(n_fine, n))
        averages = _averages(self._fine)
        for _ in range(round(SPREAD * (len(own) / n) ** 0.5)):
            weights = averages @ weights
        total = np.asarray(weights.sum(axis=1)).reshape(-1)
        weights = sp.diags(1 / np.where(total > 0, total, 1)) @ weights
        return sp.coo_matrix(weights + self._following(total == 0))

    def _following(self, loose: BoolArray) -> sp.csr_matrix:
        """Weights of vertices that no cluster reaches: those around the nearest one, for a whole piece the same.

        *Shape:* ``(U,) -> (U, N)``.
        """
        points, n = self.surface.points, len(self.points)
        found = sp.csr_matrix((len(points), n))
        if not loose.any():
            return found
        tree, averages = cKDTree(self.points), _averages(self.mesh)
        follows = np.zeros(len(points), dtype=np.int64)
        piece = self._fine.vertex_pieces
        for index in np.unique(piece[loose]):
            own = np.flatnonzero(loose & (piece == index))
            follows[own] = tree.query(points[own].mean(axis=0))[1]
        rows = np.flatnonzero(loose)
        nearest = sp.csr_matrix((np.ones(len(rows)), (rows, follows[rows])), shape=found.shape)
        return sp.csr_matrix(nearest @ averages)


def _mean_length(points: FloatArray, mesh: Connectivity) -> float:
    return float(np.linalg.norm(points[mesh.edges[:, 1]] - points[mesh.edges[:, 0]], axis=1).mean())


def _averages(mesh: Connectivity) -> sp.csr_matrix:
    """Means over a vertex and its neighbours. *Shape:* ``(V, V)``."""
    n = mesh.n_vertices
    ends = mesh.edges.T.reshape(-1), mesh.edges[:, ::-1].T.reshape(-1)
    around = sp.csr_matrix((np.ones(len(ends[0])), ends), shape=(n, n)) + sp.identity(n)
    return sp.diags(1 / np.asarray(around.sum(axis=1)).reshape(-1)) @ around


def _vertex_gradients(motions: FloatArray, points: FloatArray, faces: IntArray) -> NDArray[np.float64]:
    """Gradient of displacements around each vertex: the mean of its faces by area.

    In the plane of a face it is that of linear interpolation; its normal turns with the face.
    *Shape:* ``(N, 3, k), (N, 3), (F, 3) -> (3, N, 3, k)``, derivatives first.
    """
    corners = points[faces]
    one, other = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    normals = np.cross(one, other)
    doubled = np.linalg.norm(normals, axis=1)
    areas = np.maximum(doubled, 1e-9 * doubled.max())[:, None]
    normals /= areas
    hats = np.cross(other, normals) / areas, np.cross(normals, one) / areas
    n, k = len(points), motions.shape[2]
    share = sp.csr_matrix(
        (np.repeat(areas[:, 0], 3), faces.reshape(-1), np.arange(0, faces.size + 1, 3)), (len(faces), n)
    )
    total = np.asarray(share.sum(axis=0)).reshape(-1, 1)
    moves = [motions[faces[:, corner]] - motions[faces[:, 0]] for corner in (1, 2)]
    # How the normal turns, in the directions of the plane.
    lifts = [np.einsum("fck,fc->fk", move, normals) for move in moves]
    turned = -sum(hat[:, :, None] * lift[:, None] for hat, lift in zip(hats, lifts, strict=True))
    parts = [*moves, turned]
    found = np.empty((3, n, 3, k))
    for axis in range(3):
        along = (*(hat[:, axis] for hat in hats), normals[:, axis])
        gradient = sum(part * slope[:, None, None] for part, slope in zip(parts, along, strict=True))
        found[axis] = ((share.T @ gradient.reshape(len(faces), -1)) / total).reshape(n, 3, k)
    return found
