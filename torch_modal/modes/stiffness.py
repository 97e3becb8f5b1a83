"""Stiffness and mass matrices of as-rigid-as-possible deformation on tetrahedra."""

from typing import Literal

import numpy as np
import scipy.sparse as sp

from torch_modal.arrays import FloatArray
from torch_modal.modes.tetrahedra import EDGES, Tetrahedra, solid_volumes

HessianForm = Literal["edge", "vertex"]
HESSIAN_FORMS: tuple[HessianForm, ...] = ("edge", "vertex")

WEIGHT_FLOOR = 1e-3
"""Smallest edge weight of the vertex form, as a fraction of the mean magnitude."""


def arap_hessian(tetrahedra: Tetrahedra, form: HessianForm = "edge") -> sp.csc_matrix:
    """Hessian of the as-rigid-as-possible energy at rest, in the displacements ``u`` of the vertices.

    Both forms measure ``min_W ∫ |∇u - W|²`` over infinitesimal rotations ``W`` (skew matrices), with one rotation for
    each edge or vertex; both are positive semi-definite, with the rigid motions in the null space. Their modes are
    alike, their eigenvalues are not: the vertex form has 1.9 to 5.6 times the eigenvalues of the others on lattices.

    - ``"edge"``: ``sum_e vol_e |sym ∇u_e|²``, where ``∇u_e`` is the mean of ``∇u`` over the tetrahedra around an edge
      and ``vol_e`` a sixth of their volume (edge-based smoothed finite elements; Cazes and Meschke 2013 for
      tetrahedra). Linear tetrahedra are too stiff in bending, by half or more with one or two across a limb; smoothing
      removes most of this error. The energy is at least a fifth of that of linear tetrahedra: no mode is spurious.
      Couples vertices whose tetrahedra share an edge.
    - ``"vertex"`` (Huang, Wicke, Adams and Guibas 2009): ``½ sum_i sum_{j in N(i)} c_ij |u_i - u_j - w_i ×
      (x_i - x_j)|²`` with the rotations ``w_i`` eliminated, ``K = L ⊗ I - Bᵀ C⁻¹ B``. Couples vertices two
      edges apart. The weights ``c_ij`` are the cotangent weights of the tetrahedra, **clamped from below** to
      a small positive number: on meshes of fTetWild many raw weights are negative, so that ``K`` is indefinite and
      its lowest modes are spurious. A positive floor keeps all vertices connected.

    Args:
        tetrahedra: The mesh at rest. Inverted tetrahedra have the magnitude of their volume.
        form: Form of the Hessian.

    Returns:
        Symmetric matrix; row ``3 i + c`` is coordinate ``c`` of vertex ``i``. *Shape:* ``(3N, 3N)``.
    """
    return _edge_hessian(tetrahedra) if form == "edge" else _vertex_hessian(tetrahedra)


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


def _edge_hessian(tetrahedra: Tetrahedra) -> sp.csc_matrix:
    """Blocks ``K_ab = sum_e vol_e ((g_a · g_b) I + g_b g_aᵀ)`` with the mean hat gradients ``g`` around each edge.

    They follow from ``|sym G|² = ½ (|G|² + tr G²)`` with ``G = ∇u = Σ u_a g_aᵀ``.
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


def _vertex_hessian(tetrahedra: Tetrahedra) -> sp.csc_matrix:
    """``K = Dᵀ D - Bᵀ C⁻¹ B``: differences ``D`` along edges in both directions, ``B = Sᵀ D`` and ``C = Sᵀ S``.

    Rows of ``D u + S w`` are ``√c_ij (u_i - u_j - w_i × (x_i - x_j))``, so the least squares over all ``w`` give ``K``.
    """
    n = len(tetrahedra.vertices)
    # Cotangent weights c_ij = -Σ_t vol_t g_i · g_j.
    upper = sp.triu(-dirichlet_matrix(tetrahedra, hat_gradients(tetrahedra)).tocsr(), 1).tocoo()
    tail, head = np.append(upper.row, upper.col), np.append(upper.col, upper.row)
    number = np.arange(len(tail))
    roots = np.sqrt(np.tile(np.maximum(upper.data, WEIGHT_FLOOR * np.abs(upper.data).mean()), 2))
    edges = roots[:, None] * (tetrahedra.vertices[tail] - tetrahedra.vertices[head])
    crosses = np.cross(edges[:, None], np.eye(3)).transpose(0, 2, 1)  # the matrix of e ×
    spins = sp.bsr_matrix((crosses, tail, np.append(number, len(tail))), shape=(3 * len(tail), 3 * n))
    ends = np.tile(number, 2), np.append(tail, head)
    differences = sp.kron(sp.csr_matrix((np.append(roots, -roots), ends)), sp.identity(3), format="csr")
    moments, inertia = spins.T @ differences, (spins.T @ spins).tobsr((3, 3))
    inertia.data = np.linalg.inv(inertia.data)
    k = differences.T @ differences - moments.T @ inertia @ moments
    return sp.csc_matrix((k + k.T) / 2)
