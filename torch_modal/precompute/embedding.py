"""A surface carried by the tetrahedra around it: linear-precise moving least squares."""

from typing import NamedTuple

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from torch_modal.precompute.stiffness import hat_gradients
from torch_modal.precompute.tetrahedra import Tetrahedra

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

N_NEIGHBOURS = 12
RINGS = 2
"""Rings of tetrahedra vertices around the four of the closest tetrahedron."""
MAX_RINGS = 6
PUSH = 0.005
"""How far points are moved inward for the search of the closest tetrahedron, in bounding-box diagonals: more
than the tolerance of the mesher (0.002), less than the thickness of a limb."""
MAX_AMPLIFICATION = 4.0
"""Largest sum of the magnitudes of a point's weights; 1 inside, larger where it extrapolates."""
_CANDIDATES = 32
_CHUNK = 4096


class Neighbours(NamedTuple):
    """The tetrahedra's vertices that each point hangs on, padded with kernels of zero.

    Attributes:
        vertex: *Shape:* ``(V, 12)``.
        kernel: How much each of them counts; falls to zero with the distance. *Shape:* ``(V, 12)``.
    """

    vertex: IntArray
    kernel: FloatArray


def embed_surface(points: FloatArray, tetrahedra: Tetrahedra, normals: FloatArray | None = None) -> sp.csr_matrix:
    """Weights that carry displacements of the tetrahedra's vertices to points on or near their surface.

    Each point takes a moving-least-squares fit of a linear function to the (about 12) nearest vertices. Constant and
    linear displacements are carried exactly (up to rounding), so rigid motions stay rigid; clamped barycentric
    weights, the usual choice, make modes rough.

    Args:
        points: Positions on the surface. *Shape:* ``(V, 3)``.
        tetrahedra: The mesh that carries them.
        normals: Outward unit normals at the points; without them the points are searched for where they are.
            *Shape:* ``(V, 3)``.

    Returns:
        Rows sum to one, and ``weights @ tetrahedra.vertices`` are the points. *Shape:* ``(V, N)``.
    """
    return fit_weights(points, tetrahedra.vertices, find_neighbours(points, tetrahedra, normals))


def fit_weights(points: FloatArray, vertices: FloatArray, neighbours: Neighbours) -> sp.csr_matrix:
    """Linear-precise weights of known neighbours, in whatever pose both now are.

    Args:
        points: Positions on the surface. *Shape:* ``(V, 3)``.
        vertices: Positions of the tetrahedra's vertices. *Shape:* ``(N, 3)``.
        neighbours: Those of each point, found in this pose or another.

    Returns:
        Rows sum to one, and ``weights @ vertices`` are the points. *Shape:* ``(V, N)``.
    """
    rows = np.repeat(np.arange(len(points)), N_NEIGHBOURS)
    weights = [
        _moving_least_squares(points[chunk], vertices, Neighbours(neighbours.vertex[chunk], neighbours.kernel[chunk]))
        for chunk in _chunks(np.arange(len(points)))
    ]
    entries = (np.concatenate(weights).reshape(-1), (rows, neighbours.vertex.reshape(-1)))
    return sp.coo_matrix(entries, shape=(len(points), len(vertices))).tocsr()


def find_neighbours(points: FloatArray, tetrahedra: Tetrahedra, normals: FloatArray | None = None) -> Neighbours:
    """The nearest vertices that are only a few edges away from the closest tetrahedron of each point.

    That tetrahedron is searched for slightly below the surface, so that limbs that touch do not mix.

    Args:
        points: Positions on the surface. *Shape:* ``(V, 3)``.
        tetrahedra: The mesh that carries them.
        normals: Outward unit normals at the points; without them the points are searched for where they are.
            *Shape:* ``(V, 3)``.
    """
    extent = np.ptp(tetrahedra.vertices, axis=0)
    below = points if normals is None else points - PUSH * np.linalg.norm(extent) * normals
    closest = closest_tetrahedra(below, tetrahedra)
    adjacency = _adjacency(tetrahedra)

    wanted = min(N_NEIGHBOURS, len(tetrahedra.vertices))
    found = Neighbours(np.zeros((len(points), N_NEIGHBOURS), dtype=np.int64), np.zeros((len(points), N_NEIGHBOURS)))
    left = np.arange(len(points))
    reached: sp.csr_matrix | None = None
    for rings in range(MAX_RINGS + 1):
        if rings > 0:
            reached = adjacency if reached is None else sp.csr_matrix(reached @ adjacency)
        if rings < RINGS or reached is None:
            continue
        last = rings == MAX_RINGS
        retry = []
        for chunk in _chunks(left):
            nearest, number = _nearest_reached(points[chunk], tetrahedra, closest[chunk], reached)
            fit = _moving_least_squares(points[chunk], tetrahedra.vertices, nearest)
            good = (number >= wanted) & (np.abs(fit).sum(axis=1) <= MAX_AMPLIFICATION) | last
            found.vertex[chunk[good]], found.kernel[chunk[good]] = nearest.vertex[good], nearest.kernel[good]
            retry.append(chunk[~good])
        left = np.concatenate(retry)
        if len(left) == 0:
            break
    return found


def closest_tetrahedra(points: FloatArray, tetrahedra: Tetrahedra) -> IntArray:
    """The tetrahedron around each point, or about the closest one where there is none. *Shape:* ``(V,)``.

    Among the tetrahedra with the nearest centroids, the one whose faces the point is least far outside of.
    """
    corners = tetrahedra.vertices[tetrahedra.tets]
    centroids = corners.mean(axis=1)
    gradients = hat_gradients(tetrahedra)
    heights = 1 / np.linalg.norm(gradients, axis=2)
    n_candidates = min(_CANDIDATES, len(centroids))
    candidates = cKDTree(centroids).query(points, k=n_candidates)[1].reshape(len(points), n_candidates)
    closest = np.empty(len(points), dtype=np.int64)
    for chunk in _chunks(np.arange(len(points))):
        tets = candidates[chunk]
        offset = points[chunk, None] - centroids[tets]
        barycentric = 0.25 + np.einsum("vci,vcai->vca", offset, gradients[tets])
        inside = (barycentric * heights[tets]).min(axis=2)  # signed distance to the face it is most outside of
        closest[chunk] = np.take_along_axis(tets, inside.argmax(axis=1)[:, None], axis=1)[:, 0]
    return closest


def _chunks(indices: IntArray) -> list[IntArray]:
    """Parts of at most 4096, so that the arrays of each stay small."""
    return np.array_split(indices, max(1, -(-len(indices) // _CHUNK)))


def _adjacency(tetrahedra: Tetrahedra) -> sp.csr_matrix:
    """Which vertices share a tetrahedron, each with itself. *Shape:* ``(N, N)``."""
    n, t = len(tetrahedra.vertices), len(tetrahedra.tets)
    incidence = sp.csr_matrix(
        (np.ones(4 * t, dtype=np.int32), tetrahedra.tets.reshape(-1), np.arange(0, 4 * t + 1, 4)),
        shape=(t, n),
    )
    return sp.csr_matrix(incidence.T @ incidence)


def _nearest_reached(
    points: FloatArray, tetrahedra: Tetrahedra, closest: IntArray, reached: sp.csr_matrix
) -> tuple[Neighbours, IntArray]:
    """The nearest vertices among those that ``reached`` connects with the closest tetrahedron's four; their number."""
    tets, row_of_point = np.unique(closest, return_inverse=True)
    seeds = sp.csr_matrix(
        (
            np.ones(4 * len(tets), dtype=np.int32),
            tetrahedra.tets[tets].reshape(-1),
            np.arange(0, 4 * len(tets) + 1, 4),
        ),
        shape=(len(tets), len(tetrahedra.vertices)),
    )
    around = sp.csr_matrix(seeds @ reached)
    sizes = np.diff(around.indptr)
    width = max(int(sizes.max()), N_NEIGHBOURS + 1)
    padded = np.full((len(tets), width), -1, dtype=np.int64)
    padded[np.arange(width) < sizes[:, None]] = around.indices

    index = padded[row_of_point.reshape(-1)]
    squared = ((points[:, None] - tetrahedra.vertices[index]) ** 2).sum(axis=2)
    squared[index < 0] = np.inf
    order = np.argpartition(squared, N_NEIGHBOURS, axis=1)[:, : N_NEIGHBOURS + 1]
    squared = np.take_along_axis(squared, order, axis=1)
    order = np.take_along_axis(order, np.argsort(squared, axis=1), axis=1)
    squared = np.sort(squared, axis=1)

    count = np.minimum(sizes[row_of_point.reshape(-1)], N_NEIGHBOURS)
    # The kernel falls to zero at the first vertex that is not taken, so that weights change smoothly from one
    # point to the next; where all are taken, somewhat beyond the last.
    last = np.take_along_axis(squared, count[:, None] - 1, axis=1)
    radius = np.where(np.isfinite(squared[:, -1:]), squared[:, -1:], 1.2 * last)
    kernel = np.clip(1 - np.where(np.isfinite(squared), squared, np.inf) / np.maximum(radius, 1e-300), 0, None) ** 2
    vertex = np.maximum(np.take_along_axis(index, order, axis=1)[:, :N_NEIGHBOURS], 0)
    return Neighbours(vertex, kernel[:, :N_NEIGHBOURS]), count


def _moving_least_squares(points: FloatArray, vertices: FloatArray, nearest: Neighbours) -> FloatArray:
    """Weights ``θ_j p_jᵀ (Σ θ p pᵀ)⁻¹ p(x)`` with ``p = (1, (x_j - x) / r)``. *Shape:* ``(·, 12)``."""
    offset = vertices[nearest.vertex] - points[:, None]
    used = nearest.kernel > 0
    radius = np.sqrt(((offset**2).sum(axis=2) * used).max(axis=1))
    basis = np.concatenate([np.ones((*offset.shape[:2], 1)), offset / radius[:, None, None]], axis=2)
    theta = nearest.kernel / nearest.kernel.sum(axis=1, keepdims=True)
    moments = np.einsum("vj,vja,vjb->vab", theta, basis, basis)
    # The pseudo-inverse, since neighbours in one plane fix no slope across it: none is taken then.
    solve = np.linalg.pinv(moments, rcond=1e-9, hermitian=True)
    weights = np.zeros_like(theta)
    target = np.array([1.0, 0.0, 0.0, 0.0])
    for _ in range(2):  # the second pass takes out the rounding of the first
        missing = target - np.einsum("vj,vja->va", weights, basis)
        weights = weights + theta * np.einsum("vja,vab,vb->vj", basis, solve, missing)
    return weights
