"""Stiffness and mass matrices of as-rigid-as-possible deformation on tetrahedra."""

import numpy as np
import scipy.sparse as sp

from torch_modal.arrays import FloatArray
from torch_modal.modes.tetrahedra import EDGES, Tetrahedra, solid_volumes


def arap_hessian(tetrahedra: Tetrahedra) -> sp.csc_matrix:
    """Hessian of the as-rigid-as-possible energy at rest, in the displacements ``u`` of the vertices.

    It measures ``min_W ∫ |∇u - W|²`` over infinitesimal rotations ``W`` (skew matrices), one for each edge:
    ``sum_e vol_e |sym ∇u_e|²``, where ``∇u_e`` is the mean of ``∇u`` over the tetrahedra around an edge and ``vol_e``
    a sixth of their volume (edge-based smoothed finite elements; Cazes and Meschke 2013 for tetrahedra). It is positive
    semi-definite, with the rigid motions in the null space. Linear tetrahedra are too stiff in bending, by half or more
    with one or two across a limb; smoothing removes most of this error. The energy is at least a fifth of that of
    linear tetrahedra: no mode is spurious. Huang et al. (2009) take one rotation for each vertex, with cotangent
    weights; on meshes of fTetWild many of these are negative, and the lowest modes spurious.

    The blocks are ``K_ab = sum_e vol_e ((g_a · g_b) I + g_b g_aᵀ)`` with the mean hat gradients ``g`` around each edge,
    from ``|sym G|² = ½ (|G|² + tr G²)`` with ``G = ∇u = Σ u_a g_aᵀ``.

    Args:
        tetrahedra: The mesh at rest. Inverted tetrahedra have the magnitude of their volume.

    Returns:
        Symmetric matrix; row ``3 i + c`` is coordinate ``c`` of vertex ``i``. *Shape:* ``(3N, 3N)``.
    """
    n, t = len(tetrahedra.vertices), len(tetrahedra.tets)
    columns = 3 * tetrahedra.tets[:, :, None] + np.arange(3)
    starts = 12 * np.arange(t + 1)
    gradients = sp.csr_matrix((hat_gradients(tetrahedra).reshape(-1), columns.reshape(-1), starts), shape=(t, 3 * n))

    ends = np.sort(np.concatenate([tetrahedra.tets[:, pair] for pair in EDGES]), axis=1)
    edge = np.unique(ends[:, 0] * n + ends[:, 1], return_inverse=True)[1].reshape(-1)
    shares = np.tile(solid_volumes(tetrahedra) / 6, 6)
    volumes = np.bincount(edge, shares)
    # Scaled by the root of the edge's volume, which weights the product below.
    means = sp.csr_matrix((shares / np.sqrt(volumes[edge]), (edge, np.tile(np.arange(t), 6))), shape=(len(volumes), t))
    averaged = means @ gradients
    averaged.sort_indices()  # fixes the order of summation: the product is exactly symmetric
    products = (averaged.T @ averaged).tobsr((3, 3))
    blocks = products.data.transpose(0, 2, 1) + np.trace(products.data, axis1=1, axis2=2)[:, None, None] * np.eye(3)
    k = sp.bsr_matrix((blocks, products.indices, products.indptr), shape=products.shape).tocsr()
    k.sort_indices()
    return k.T  # the symmetric matrix in column format


def mass_matrix(tetrahedra: Tetrahedra) -> sp.csr_matrix:
    """Mass of linear displacements at a density of 1, half lumped: entries for vertices. *Shape:* ``(N, N)``.

    The mean of the consistent mass ``∫ h_i h_j``, which overestimates frequencies on coarse tetrahedra, and the lumped
    mass, which underestimates them. Most of both errors cancel. Row sums are the lumped masses.
    """
    # For each tetrahedron: (1 + δ) / 20 if consistent, δ / 4 if lumped.
    entries = solid_volumes(tetrahedra)[:, None, None] * (np.full((4, 4), 1 / 40) + np.eye(4) * (1 / 40 + 1 / 8))
    return _assemble(entries, tetrahedra).tocsr()


def dirichlet_matrix(tetrahedra: Tetrahedra, gradients: FloatArray) -> sp.coo_matrix:
    """Matrix of ``∫ |∇f|²`` for a scalar at each vertex, entries ``Σ_t vol_t g_i · g_j`` of its hat gradients ``g``.

    *Shape:* ``(T, 4, 3) -> (N, N)``.
    """
    products = np.einsum("tak,tbk->tab", gradients, gradients)
    return _assemble(products * solid_volumes(tetrahedra)[:, None, None], tetrahedra)


def _assemble(entries: FloatArray, tetrahedra: Tetrahedra) -> sp.coo_matrix:
    """Entries of pairs of corners at their vertices; duplicates are summed on conversion. *Shape:* ``(T, 4, 4)``."""
    n = len(tetrahedra.vertices)
    rows, columns = np.repeat(tetrahedra.tets, 4, axis=1), np.tile(tetrahedra.tets, 4)
    return sp.coo_matrix((entries.reshape(-1), (rows.reshape(-1), columns.reshape(-1))), shape=(n, n))


def hat_gradients(tetrahedra: Tetrahedra) -> FloatArray:
    """Gradients of the four piecewise linear hat functions in each tetrahedron. *Shape:* ``(T, 4, 3)``."""
    corners = tetrahedra.vertices[tetrahedra.tets]
    edges = corners[:, 1:] - corners[:, :1]  # rows e_a with g_a · e_b = δ_ab
    gradients = np.linalg.inv(edges).transpose(0, 2, 1)
    return np.concatenate([-gradients.sum(axis=1, keepdims=True), gradients], axis=1)
