"""Surface points embedded in tetrahedra by moving least squares with linear precision."""

import numpy as np
import scipy.sparse as sp
from scipy.spatial import cKDTree

from torch_modal.arrays import FloatArray, IntArray
from torch_modal.modes.stiffness import hat_gradients
from torch_modal.modes.tetrahedra import Tetrahedra
from torch_modal.threads import n_threads

N_NEIGHBOURS = 12
MAX_RINGS = 6
"""Vertex rings around the closest tetrahedron from which neighbours are taken: two, and more up to this if needed."""
PUSH = 0.005
"""Inward offset of points for the search of the closest tetrahedron, in bounding-box diagonals: above the tolerance
of the mesher (0.004), below the thickness of a limb."""
MAX_AMPLIFICATION = 4.0
"""Largest sum of the magnitudes of a point's weights; 1 inside, larger where it extrapolates."""
COPLANAR = 1e-7
"""Determinant of the neighbours' covariance over its cubed trace, below which they count as coplanar."""
N_CANDIDATES = (6, 32)
POINTS_PER_CHUNK = 4096
"""Points whose neighbours are found at once, to bound memory."""


def fit_weights(points: FloatArray, vertices: FloatArray, neighbours: IntArray, kernels: FloatArray) -> sp.csr_matrix:
    """Moving-least-squares weights that map displacements of the tetrahedra's vertices to surface points.

    A linear function is fitted to the displacements of the neighbours of each point. Constant and linear displacements
    are reproduced up to rounding, so rigid motions stay rigid. Clamped barycentric weights make modes rough.

    Args:
        points: Positions on the surface. *Shape:* ``(V, 3)``.
        vertices: Positions of the tetrahedra's vertices in the same pose. *Shape:* ``(N, 3)``.
        neighbours: Vertices in the support of each point, in this pose or another. *Shape:* ``(V, 12)``.
        kernels: Their weights in the fit, which fall to zero with the distance. *Shape:* ``(V, 12)``.

    Returns:
        Rows sum to one, and ``weights @ vertices`` are the points. *Shape:* ``(V, N)``.
    """
    weights = _moving_least_squares(points, vertices, neighbours, kernels)
    starts = np.arange(0, weights.size + 1, N_NEIGHBOURS)
    shape = len(points), len(vertices)
    return sp.csr_matrix((weights.reshape(-1), neighbours.reshape(-1), starts), shape=shape)


def find_neighbours(points: FloatArray, tetrahedra: Tetrahedra, normals: FloatArray) -> tuple[IntArray, FloatArray]:
    """Nearest vertices of each point within a few edges of its closest tetrahedron.

    The search for the closest tetrahedron starts slightly below the surface, so that touching limbs do not mix.

    Args:
        points: Positions on the surface. *Shape:* ``(V, 3)``.
        tetrahedra: The volume mesh.
        normals: Outward unit normals at the points, or zeros. *Shape:* ``(V, 3)``.

    Returns:
        Neighbours and kernels for :func:`fit_weights`, padded with zero kernels. *Shape:* ``(V, 12), (V, 12)``.
    """
    vertices, tets = tetrahedra.vertices, tetrahedra.tets
    push = PUSH * np.linalg.norm(np.ptp(vertices, axis=0))
    closest = closest_tetrahedra(points - push * normals, tetrahedra)
    ones, starts = np.ones(tets.size, dtype=np.int32), np.arange(0, tets.size + 1, 4)
    incidence = sp.csr_matrix((ones, tets.reshape(-1), starts), shape=(len(tets), len(vertices)))
    adjacency = reached = sp.csr_matrix(incidence.T @ incidence)  # of vertices, with a non-zero diagonal

    wanted = min(N_NEIGHBOURS, len(vertices))
    neighbours, kernels = np.zeros((len(points), N_NEIGHBOURS), np.int64), np.zeros((len(points), N_NEIGHBOURS))
    left = np.ones(len(points), dtype=bool)
    for rings in range(2, MAX_RINGS + 1):
        reached = sp.csr_matrix(reached @ adjacency)
        rows = np.flatnonzero(left)
        for chunk in np.array_split(rows, len(rows) // POINTS_PER_CHUNK + 1):
            nearest, kernel, number = _nearest_reached(points[chunk], vertices, closest[chunk], incidence, reached)
            fit = _moving_least_squares(points[chunk], vertices, nearest, kernel)
            good = (number >= wanted) & (np.abs(fit).sum(axis=1) <= MAX_AMPLIFICATION) | (rings == MAX_RINGS)
            neighbours[chunk[good]], kernels[chunk[good]], left[chunk[good]] = nearest[good], kernel[good], False
        if not left.any():
            break
    return neighbours, kernels


def closest_tetrahedra(points: FloatArray, tetrahedra: Tetrahedra) -> IntArray:
    """Tetrahedron that contains each point, or approximately the closest one. *Shape:* ``(V,)``.

    Among the tetrahedra with the nearest centroids, takes the one with the largest signed distance to its faces. Points
    outside of all candidates are tested against more of them.
    """
    centroids = tetrahedra.vertices[tetrahedra.tets].mean(axis=1)
    gradients = hat_gradients(tetrahedra)
    heights = 1 / np.linalg.norm(gradients, axis=2)
    tree = cKDTree(centroids)
    closest, left = np.empty(len(points), dtype=np.int64), np.arange(len(points))
    for n_candidates in N_CANDIDATES:
        nearest = np.arange(1, min(n_candidates, len(centroids)) + 1)
        tets = tree.query(points[left], nearest, workers=n_threads())[1]
        offset = points[left, None] - centroids[tets]
        barycentric = 0.25 + (gradients[tets] @ offset[..., None])[..., 0]
        inside = (barycentric * heights[tets]).min(axis=2)  # signed distance, positive inside
        closest[left] = np.take_along_axis(tets, inside.argmax(axis=1)[:, None], axis=1)[:, 0]
        left = left[inside.max(axis=1) < 0]
    return closest


def _nearest_reached(
    points: FloatArray, vertices: FloatArray, closest: IntArray, incidence: sp.csr_matrix, reached: sp.csr_matrix
) -> tuple[IntArray, FloatArray, IntArray]:
    """Nearest vertices that ``reached`` connects with the closest tetrahedron, their kernels, and their number."""
    tets, row_of_point = np.unique(closest, return_inverse=True)
    around = sp.csr_matrix(incidence[tets] @ reached)
    sizes = np.diff(around.indptr)
    width = max(int(sizes.max()), N_NEIGHBOURS + 1)
    padded = np.full((len(tets), width), -1, dtype=np.int64)
    padded[np.arange(width) < sizes[:, None]] = around.indices

    index = padded[row_of_point.reshape(-1)]
    squared = ((points[:, None] - vertices[index]) ** 2).sum(axis=2)
    squared[index < 0] = np.inf
    order = np.argsort(squared, axis=1)[:, : N_NEIGHBOURS + 1]
    squared = np.take_along_axis(squared, order, axis=1)

    count = np.minimum(sizes[row_of_point.reshape(-1)], N_NEIGHBOURS)
    # The kernel vanishes at the first vertex outside of the support, so that weights vary smoothly over the surface;
    # if there is none, somewhat beyond the last vertex.
    last = np.take_along_axis(squared, count[:, None] - 1, axis=1)
    radius = np.where(np.isfinite(squared[:, -1:]), squared[:, -1:], 1.2 * last)
    kernel = np.clip(1 - squared / np.maximum(radius, 1e-300), 0, None) ** 2
    vertex = np.maximum(np.take_along_axis(index, order, axis=1)[:, :N_NEIGHBOURS], 0)
    return vertex, kernel[:, :N_NEIGHBOURS], count


def _moving_least_squares(
    points: FloatArray, vertices: FloatArray, neighbours: IntArray, kernels: FloatArray
) -> FloatArray:
    """Weights ``θ_j p_jᵀ (Σ θ p pᵀ)⁻¹ p(x)`` with ``p = (1, (x_j - x) / r)``. *Shape:* ``(·, 12)``."""
    offset = vertices[neighbours] - points[:, None]
    squared = (offset**2).sum(axis=2)
    radius = np.sqrt((squared * (kernels > 0)).max(axis=1))
    offset /= radius[:, None, None]
    theta = kernels / kernels.sum(axis=1, keepdims=True)
    mean = (theta[:, None] @ offset)[:, 0]
    centered = offset - mean[:, None]
    covariance = (theta[..., None] * centered).transpose(0, 2, 1) @ centered
    # Coplanar neighbours determine no slope across their plane: a pseudo-inverse makes it zero.
    flat = np.linalg.det(covariance) <= COPLANAR * np.trace(covariance, axis1=1, axis2=2) ** 3
    inverse = np.empty_like(covariance)
    inverse[~flat] = np.linalg.inv(covariance[~flat])
    inverse[flat] = np.linalg.pinv(covariance[flat], rcond=1e-9, hermitian=True)
    # Eliminating the constant leaves 3 x 3: the weights are θ (a + s · (d - mean)) with a sum a and a moment C s.
    weights = np.zeros_like(theta)
    for _ in range(2):  # the second pass corrects the rounding of the first
        sum_missing = 1 - weights.sum(axis=1)
        moment_missing = -(weights[:, None] @ offset)[:, 0]
        slope = (inverse @ (moment_missing - sum_missing[:, None] * mean)[..., None])[..., 0]
        weights = weights + theta * (sum_missing[:, None] + (centered @ slope[..., None])[..., 0])
    return weights
