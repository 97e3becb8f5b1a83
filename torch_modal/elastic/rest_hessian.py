"""The stiffness of a shell at rest, as a sparse matrix."""

import numpy as np
import scipy.sparse as sp
import torch

from torch_modal.arrays import FloatArray, IntArray
from torch_modal.elastic.bend import SquaredBend
from torch_modal.elastic.shell import ALPHA, BETA
from torch_modal.elastic.stretch import Stretch
from torch_modal.elastic.term import Term

STIFFEST = 1e4
"""Largest stiffness of an edge or a hinge over the median: slivers would take the digits of all others."""


def rest_hessian(points: FloatArray, edges: IntArray, hinges: IntArray, stretch: float = 1.0) -> sp.csc_matrix:
    """Hessian of edge lengths and dihedral angles in Eq. 5 at rest, where it equals the Gauss-Newton Hessian.

    Args:
        points: Shape of a size of 100. *Shape:* ``(N, 3)``.
        edges: *Shape:* ``(E, 2)``.
        hinges: Rows as in :attr:`~torch_modal.geometry.connectivity.Connectivity.hinges`. *Shape:* ``(H, 4)``.
        stretch: Factor of the stretching stiffness.

    Returns:
        Symmetric positive semi-definite; row ``3 i + c`` is coordinate ``c`` of vertex ``i``. *Shape:* ``(3N, 3N)``.
    """
    parts = (Stretch(stretch * ALPHA), edges), (SquaredBend(BETA), hinges)
    return sp.csc_matrix(sum(_of_term(term, elements, points) for term, elements in parts))


def _of_term(term: Term, elements: IntArray, points: FloatArray) -> sp.csc_matrix:
    """``sum_m 2 k w_m ∇q_m ∇q_mᵀ`` of the measures of a term. *Shape:* ``(M, n), (N, 3) -> (3N, 3N)``."""
    corners = torch.from_numpy(points[elements]).permute(1, 2, 0)
    edge_vectors = corners[1:] - corners[:1]
    measures, gradients = term.linearise(edge_vectors)
    rows = torch.cat([-gradients.sum(0, keepdim=True), gradients])
    stiffness = 2 * term.stiffness * term.weights(edge_vectors, measures)
    rows = (rows * stiffness.sqrt()).permute(2, 0, 1).flatten(1)
    norms = rows.norm(dim=1)
    if len(norms):
        most = STIFFEST**0.5 * norms.median()
        rows = torch.where(norms > most, most / norms, 1)[:, None] * rows
    columns = (3 * elements[:, :, None] + np.arange(3)).reshape(-1)
    starts = np.arange(0, columns.size + 1, rows.shape[1])
    jacobian = sp.csr_matrix((rows.numpy().reshape(-1), columns, starts), shape=(len(elements), points.size))
    return jacobian.T @ jacobian
