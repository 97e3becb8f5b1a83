"""Vibration modes of a surface itself: modes of Eq. 5 at rest, without tetrahedra.

The stiffness is the Gauss-Newton Hessian of edge lengths and dihedral angles at rest, the mass is lumped areas. Sheets,
thin and open bodies have such modes, as all surfaces do. The enclosed volume is left out: it hardly
changes in-betweens (docs/precompute.md).
"""

import numpy as np
import scipy.sparse as sp
from scipy.spatial import cKDTree

from torch_modal.arrays import FloatArray, IntArray
from torch_modal.elastic.rest_hessian import rest_hessian
from torch_modal.elastic.shell import BETA
from torch_modal.geometry.canonical import CANONICAL_SIZE
from torch_modal.geometry.connectivity import Connectivity, neighbour_means, vertex_areas
from torch_modal.geometry.surface import Surface
from torch_modal.modes.coarsening import collapse, join_clusters
from torch_modal.modes.eigen import ElasticBody
from torch_modal.modes.tetrahedra import small_pieces

THICKNESS = 0.01
"""Thickness of the sheet whose mass the modes have, in sizes of the surface."""
SHEET_FACES = 4000
"""Faces of the mesh that modes are computed on: with 2,000 or 8,000, in-betweens are as good."""
FACES_PER_MODE = 50
"""Faces for each requested mode, where there are many."""
SHORTEST_EDGE = 1e-6
"""Length of an edge over the mean up to which its ends are one vertex: it would have no stiffness."""
LEAST_MASS = 1e-3
"""Smallest mass of a vertex over the mean."""
LARGEST_SHEET_RESIDUAL = 0.1
"""Largest residual of a mode: rounding of ``K phi`` at slivers, which are stiffer than the rest by many orders."""
SHIFT = 50 * 100 * 2 * BETA / (CANONICAL_SIZE**4 * THICKNESS * CANONICAL_SIZE)
"""Shift of the eigenproblem: 50 times the lowest eigenvalue of a flat sheet."""
AVERAGES_PER_RADIUS = 1.5
"""Averages over neighbours that carry displacements from clusters to vertices, per radius of a cluster in edges."""


def n_coarse_faces(n_modes: int) -> int:
    """Faces of the mesh that a number of modes is computed on."""
    return max(SHEET_FACES, FACES_PER_MODE * n_modes)


def sheet_body(surface: Surface, n_modes: int) -> ElasticBody:
    """A surface as a thin elastic sheet.

    Vertices are clustered by edge collapses, and modes are computed on the mesh of the clusters, with stretching as
    stiff as the fine mesh: in Eq. 5 it grows as edges become shorter. Small loose pieces follow the rest.
    """
    fine = surface.connectivity
    piece = fine.vertex_pieces[surface.faces[:, 0]]
    amounts = np.bincount(piece, surface.face_areas)
    large = surface.faces[~small_pieces(amounts, surface.vertices[surface.faces], piece)[piece]]
    # Modes do not mind needles, for which `coarsen` would collapse several times.
    coarsening = collapse(surface.vertices, large, n_coarse_faces(n_modes))
    coarsening = join_clusters(surface.vertices, large, coarsening, SHORTEST_EDGE)
    points, mesh = coarsening.restrict(surface.vertices), Connectivity(coarsening.faces, coarsening.n_vertices)

    coarser = _mean_length(points, mesh) / _mean_length(surface.vertices, fine)
    first, second = mesh.adjacent_sides.T
    # Also at edges of three faces and more, which would be free to turn.
    hinges = [mesh.start[first], mesh.end[first], mesh.opposite[first], mesh.opposite[second]]
    stiffness = rest_hessian(points, mesh.edges, np.stack(hinges, axis=1), coarser)
    areas = vertex_areas(points, mesh.faces)
    mass = sp.diags(THICKNESS * CANONICAL_SIZE * np.maximum(areas, LEAST_MASS * areas.mean()), format="csr")

    def to_surface(motions: FloatArray) -> FloatArray:
        # Each cluster moves the vertices around it by its displacement and its gradient, blended by a smooth partition
        # of unity; rigid motions and uniform strains are exact.
        if np.array_equal(coarsening.clusters, np.arange(len(surface.vertices))):
            return motions
        size = np.count_nonzero(coarsening.clusters >= 0) / len(points)
        weights = coarsening.weights(fine, round(AVERAGES_PER_RADIUS * size**0.5))
        rows = np.flatnonzero(np.asarray(weights.sum(axis=1)).reshape(-1) == 0)
        if len(rows):  # pieces that no cluster reaches follow the clusters around the nearest one
            nearest = cKDTree(points).query(surface.vertices[rows])[1]
            follows = sp.csr_matrix((np.ones(len(rows)), (rows, nearest)), shape=weights.shape)
            weights = weights + follows @ neighbour_means(mesh)
        weights = sp.coo_matrix(weights)
        entries = weights.row, weights.col
        arms = (surface.vertices[weights.row] - points[weights.col]).T
        slopes = [sp.coo_matrix((weights.data * along, entries), weights.shape) for along in arms]
        local = np.concatenate([motions[None], _vertex_gradients(motions, points, mesh.faces)])
        blend = sp.hstack([weights, *slopes], format="csr")
        return (blend @ local.reshape(blend.shape[1], -1)).reshape(-1, *motions.shape[1:])

    return ElasticBody(points, stiffness, mass, to_surface, SHIFT, LARGEST_SHEET_RESIDUAL)


def _mean_length(points: FloatArray, mesh: Connectivity) -> float:
    return float(np.linalg.norm(points[mesh.edges[:, 1]] - points[mesh.edges[:, 0]], axis=1).mean())


def _vertex_gradients(motions: FloatArray, points: FloatArray, faces: IntArray) -> FloatArray:
    """Gradient of displacements at vertices, a mean of their faces by area. *Shape:* ``(N, 3, k) -> (3, N, 3, k)``."""
    sides = points[faces[:, 1:]] - points[faces[:, :1]]
    normals = np.cross(sides[:, 0], sides[:, 1])
    areas = np.linalg.norm(normals, axis=1)
    areas = np.maximum(areas, 1e-9 * areas.max())
    normals /= areas[:, None]
    hats = np.stack([np.cross(sides[:, 1], normals), np.cross(normals, sides[:, 0])], axis=1) / areas[:, None, None]
    moves = motions[faces[:, 1:]] - motions[faces[:, :1]]
    gradients = np.einsum("fpa,fpck->fack", hats, moves)
    # The normal turns with the plane.
    gradients -= np.einsum("fa,fcbk,fb->fack", normals, gradients, normals)
    corners = np.arange(0, faces.size + 1, 3)
    share = sp.csr_matrix((np.repeat(areas, 3), faces.reshape(-1), corners), (len(faces), len(points)))
    means = share.T @ gradients.reshape(len(faces), -1) / np.asarray(share.sum(axis=0)).T
    return np.moveaxis(means.reshape(len(points), 3, *motions.shape[1:]), 1, 0)
