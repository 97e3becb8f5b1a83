"""Modes with quadratic tetrahedra: slow, and hardly too stiff, so they serve as truth for others."""

import itertools
from typing import NamedTuple

import numpy as np
import scipy.sparse as sp
import scipy.sparse.linalg as spla

from torch_modal.geometry.sparse import factorize
from torch_modal.modes.stiffness import hat_gradients
from torch_modal.modes.tetrahedra import Tetrahedra, tet_volumes

EDGES = tuple(itertools.combinations(range(4), 2))
N_RIGID = 6
SPARE = 8


class QuadraticModes(NamedTuple):
    """Elastic modes, the six rigid ones left out.

    Attributes:
        eigenvalues: Ascending. *Shape:* ``(k,)``.
        modes: M-orthonormal, three unknowns for each node. *Shape:* ``(3P, k)``.
        nodes: Four corners and six edge middles of each tetrahedron. *Shape:* ``(T, 10)``.
    """

    eigenvalues: np.ndarray
    modes: np.ndarray
    nodes: np.ndarray


def quadratic_modes(solid: Tetrahedra, n_modes: int) -> QuadraticModes:
    """Lowest modes of ``∫ |sym ∇u|²`` with a consistent mass of density 1."""
    corners = solid.tets
    ends = np.sort(np.concatenate([corners[:, pair] for pair in EDGES]), axis=1)
    unique, edge = np.unique(ends, axis=0, return_inverse=True)
    nodes = np.concatenate([corners, len(solid.vertices) + edge.reshape(6, -1).T], axis=1)
    n = len(solid.vertices) + len(unique)
    volumes = np.abs(tet_volumes(solid))

    mass_rule, rule = _rule(3), _rule(2)
    shapes = [_shapes(point) for point in mass_rule.points]
    per_volume = sum(w * np.outer(values, values) for w, values in zip(mass_rule.weights, shapes, strict=True))
    mass = _assembled((volumes[:, None, None] * per_volume)[..., None, None] * np.eye(3), nodes, n)

    g = hat_gradients(solid)
    blocks = np.zeros((len(corners), 10, 10, 3, 3))
    for weight, point in zip(rule.weights, rule.points, strict=True):
        d = np.einsum("pa,tai->tpi", _slopes(point), g)
        one = np.einsum("t,tqi,tpj->tpqij", weight * volumes, d, d)
        one += np.einsum("t,tpk,tqk->tpq", weight * volumes, d, d)[..., None, None] * np.eye(3)
        blocks += one
    stiffness = _assembled(blocks, nodes, n)

    shift = 1.0 / float((np.ptp(solid.vertices, axis=0) ** 2).sum())
    shifted = sp.csc_matrix(stiffness + shift * mass)
    factors = factorize(shifted)
    inverse = spla.LinearOperator(shifted.shape, matvec=factors.solve)
    # More than are wanted, from a start that is the same every time: of equal eigenvalues, as the rigid ones and those
    # of symmetric shapes are, ARPACK may miss one and take the next for it.
    start = np.random.default_rng(0).standard_normal(len(shifted.indptr) - 1)
    n_pairs = n_modes + N_RIGID + SPARE
    values, vectors = spla.eigsh(stiffness, n_pairs, mass, sigma=-shift, OPinv=inverse, tol=1e-9, v0=start)
    order = np.argsort(values)[N_RIGID : N_RIGID + n_modes]
    assert np.abs(values[np.argsort(values)[:N_RIGID]]).max() < 1e-6 * values[order[0]], "a rigid motion was missed"
    return QuadraticModes(values[order], vectors[:, order], nodes)


class _Rule(NamedTuple):
    points: np.ndarray  # barycentric, (Q, 4)
    weights: np.ndarray  # their sum is 1


def _rule(n: int) -> _Rule:
    """Gauss points of a cube, n each way, pushed together to a tetrahedron: exact to degree ``2 n - 3`` at least."""
    x, w = np.polynomial.legendre.leggauss(n + 1)
    x, w = (x + 1) / 2, w / 2
    u, v, s = (a.reshape(-1) for a in np.meshgrid(x, x, x, indexing="ij"))
    weights = np.einsum("i,j,k->ijk", w, w, w).reshape(-1) * (1 - u) ** 2 * (1 - v)
    points = np.stack([u, (1 - u) * v, (1 - u) * (1 - v) * s], axis=1)
    return _Rule(np.column_stack([points, 1 - points.sum(axis=1)]), 6 * weights)


def _shapes(b: np.ndarray) -> np.ndarray:
    """The ten shape functions. *Shape:* ``(4,) -> (10,)``."""
    return np.concatenate([b * (2 * b - 1), [4 * b[i] * b[j] for i, j in EDGES]])


def _slopes(b: np.ndarray) -> np.ndarray:
    """Their derivatives with respect to the barycentric coordinates. *Shape:* ``(4,) -> (10, 4)``."""
    slopes = np.zeros((10, 4))
    slopes[:4] = np.diag(4 * b - 1)
    for row, (i, j) in enumerate(EDGES):
        slopes[4 + row, i], slopes[4 + row, j] = 4 * b[j], 4 * b[i]
    return slopes


def _assembled(blocks: np.ndarray, nodes: np.ndarray, n: int) -> sp.csc_matrix:
    """Sum of the blocks ``(T, 10, 10, 3, 3)`` of all tetrahedra. *Shape:* ``(3n, 3n)``."""
    axis = np.arange(3)
    rows = np.broadcast_to(3 * nodes[:, :, None, None, None] + axis[:, None], blocks.shape)
    columns = np.broadcast_to(3 * nodes[:, None, :, None, None] + axis, blocks.shape)
    matrix = sp.coo_matrix((blocks.reshape(-1), (rows.reshape(-1), columns.reshape(-1))), shape=(3 * n, 3 * n))
    return matrix.tocsc()
