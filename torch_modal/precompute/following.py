"""Loose pieces of tetrahedra: small ones follow the body, rigid motions of large ones are removed from the modes."""

from typing import NamedTuple

import numpy as np
import scipy.sparse as sp

from torch_modal.arrays import FloatArray, IntArray
from torch_modal.geometry.connectivity import connected_pieces
from torch_modal.precompute.embedding import N_NEIGHBOURS, Neighbours, fit_weights
from torch_modal.precompute.surface import CanonicalSurface
from torch_modal.precompute.tetrahedra import Tetrahedra, is_small, kept_tetrahedra, loose_pieces

DEFORMS = 1e-6
"""Norm of the non-rigid part of a motion, relative to the motion, above which it is a deformation."""
REACH = 2.0
"""Radius of the region that a piece follows, relative to its distance from the body or its own size."""


class Larger(NamedTuple):
    """Tetrahedra without small loose pieces.

    Attributes:
        tetrahedra: The larger pieces.
        vertices: Indices of their vertices in the whole mesh. *Shape:* ``(M,)``.
        weights: Displacements of all vertices from these, exact for linear fields. *Shape:* ``(N, M)``.
    """

    tetrahedra: Tetrahedra
    vertices: IntArray
    weights: sp.csr_matrix


def larger_pieces(tetrahedra: Tetrahedra) -> Larger:
    """Remove small loose pieces and express their displacements by those of the others.

    Small pieces have little mass, so their rigid motions of unit mass would be larger than other modes by orders of
    magnitude.
    """
    n, piece = len(tetrahedra.vertices), loose_pieces(tetrahedra)
    of_tets = piece[tetrahedra.tets[:, 0]]
    small = is_small(tetrahedra, of_tets)
    stays = np.flatnonzero(~small[piece])
    if len(stays) == n:
        return Larger(tetrahedra, stays, sp.identity(n, format="csr"))
    kept = kept_tetrahedra(tetrahedra, ~small[of_tets])
    rows, weights = [stays], [sp.identity(len(stays), format="csr")]
    for own in (np.flatnonzero(piece == index) for index in np.flatnonzero(small)):
        points = tetrahedra.vertices[own]
        around = np.tile(_around(points, kept.vertices, piece[stays]), (len(own), 1))
        rows.append(own)
        weights.append(fit_weights(points, kept.vertices, Neighbours(around, np.ones(around.shape))))
    order = np.argsort(np.concatenate(rows))
    return Larger(kept, stays, sp.csr_matrix(sp.vstack(weights, format="csr")[order]))


def _around(points: FloatArray, vertices: FloatArray, piece: IntArray) -> IntArray:
    """Vertices of the nearest piece, spread by farthest-point sampling over a region as large as its distance.

    *Shape:* ``(n, 3), (N, 3), (N,) -> (12,)``.
    """
    center = points.mean(axis=0)
    nearest = int(np.linalg.norm(vertices - center, axis=1).argmin())
    reach = REACH * max(np.linalg.norm(vertices[nearest] - center), np.linalg.norm(np.ptp(points, axis=0)))
    distance = np.linalg.norm(vertices - vertices[nearest], axis=1)
    distance[piece != piece[nearest]] = np.inf
    near = np.argsort(distance, kind="stable")
    near = near[: max(int((distance <= reach).sum()), min(N_NEIGHBOURS, int(np.isfinite(distance).sum())))]
    # Farthest-point sampling.
    found, to_found = [0], distance[near]
    while len(found) < N_NEIGHBOURS:
        found.append(int(to_found.argmax()))
        to_found = np.minimum(to_found, np.linalg.norm(vertices[near] - vertices[near[found[-1]]], axis=1))
    return near[found]


def deforming(motions: FloatArray, surface: CanonicalSurface) -> FloatArray:
    """Linear combinations of motions that deform a surface, without rigid motions of its pieces.

    Relative rigid motions of pieces have no energy, so their amplitudes would be undetermined; the interpolation of the
    key-frames determines them. A piece of the surface that spans several pieces of tetrahedra is deformed by their
    rigid motions.

    Args:
        motions: Displacements, M-orthonormal in the volume. *Shape:* ``(k, U, 3)``.
        surface: The surface, with ``U`` points.

    Returns:
        *Shape:* ``(m, U, 3)`` with ``m <= k``.
    """
    if len(motions) == 0:
        return motions
    pairs = np.concatenate([surface.faces[:, :2], surface.faces[:, 1:]])
    piece = connected_pieces(pairs, len(surface.points))
    left = motions.copy()
    for own in (np.flatnonzero(piece == index) for index in range(piece.max() + 1)):
        arms = surface.points[own] - surface.points[own].mean(axis=0)
        turns = np.cross(np.eye(3)[:, None], arms[None])
        rigid = np.concatenate([np.broadcast_to(np.eye(3)[:, None], turns.shape), turns]).reshape(2 * 3, -1)
        flat = motions[:, own].reshape(len(motions), -1)
        left[:, own] = (flat - flat @ np.linalg.pinv(rigid) @ rigid).reshape(len(motions), -1, 3)
    size = np.linalg.norm(motions)
    mixes, sizes, _ = np.linalg.svd(left.reshape(len(motions), -1), full_matrices=False)
    return np.tensordot(mixes[:, sizes > DEFORMS * size].T, motions, 1)
