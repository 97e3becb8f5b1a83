"""The lowest eigenvectors of ``K phi = lambda M phi`` by shift-invert block Lanczos, piece by piece."""

from collections.abc import Callable, Iterator

import numpy as np
import scipy.linalg
import scipy.sparse as sp
from scipy.sparse.csgraph import connected_components

from torch_modal.arrays import FloatArray, IntArray
from torch_modal.geometry.sparse import factorize
from torch_modal.precompute.mass import Mass

Pairs = tuple[FloatArray, FloatArray]
"""Eigenvalues ``(k,)`` and eigenvectors ``(n, k)``."""

DENSE_BELOW = 600
"""Number of unknowns under which LAPACK is as fast as a factorisation and Lanczos."""
BLOCK = 8
"""Vectors in one step. Solves for several at once are three times as fast, and an eigenvalue may have as many equal
ones; a single starting vector meets only one of each (and the rest by rounding)."""
FLOOR = 1e-14
"""Residual of the inverted problem, relative to its eigenvalue, where nothing is left to gain."""


def lowest_spans(k: sp.csc_matrix, mass: Mass, n_pairs: int, shift: float, tolerance: float) -> Iterator[FloatArray]:
    """M-orthonormal bases of about the ``n_pairs`` lowest eigenvectors, each nearer to them than the one before.

    The iteration sees residuals of the inverted problem. What they amount to in ``K phi - lambda M phi`` depends on the
    worst tetrahedra, so the caller decides when they are small enough, and asks for the next basis until then.

    Pieces that nothing connects are solved apart: their equal eigenvalues (six zeros each) would otherwise hide each
    other.

    Args:
        k: Stiffness, symmetric positive semi-definite, three unknowns for each vertex. *Shape:* ``(3N, 3N)``.
        mass: M.
        n_pairs: How many.
        shift: Positive; ``K + shift M`` is factored, which is positive definite, where ``K`` is singular.
        tolerance: Residual of the inverted problem, relative to its eigenvalue, at which the first is handed out.

    Yields:
        In ascending order of the eigenvalues; none after the one that rounding lets no further step improve.
        *Shape:* ``(3N, n_pairs)``.

    Raises:
        RuntimeError: Lanczos has not converged.
    """
    graph = _vertex_graph(k)
    n_pieces, piece = connected_components(graph, directed=False)
    if n_pieces == 1:
        yield from (vectors for _, vectors in _of_piece(k, graph, mass, n_pairs, shift, tolerance))
        return
    owned = [_of_coordinates(np.flatnonzero(piece == index)) for index in range(n_pieces)]
    rounds = [
        _of_piece(
            sp.csc_matrix(k[own][:, own]),
            sp.csc_matrix(graph[own[::3] // 3][:, own[::3] // 3]),
            mass.of_vertices(own[::3] // 3),
            min(n_pairs, len(own)),
            shift,
            tolerance,
        )
        for own in owned
    ]
    # A piece that has no better vectors keeps its last ones while others go on.
    latest = [next(of_piece) for of_piece in rounds]
    improved = True
    while improved:
        yield _merged(latest, owned, k.shape[0], n_pairs)
        better = [next(of_piece, None) for of_piece in rounds]
        improved = any(found is not None for found in better)
        latest = [old if new is None else new for old, new in zip(latest, better, strict=True)]


def _merged(found: list[Pairs], owned: list[IntArray], n: int, n_pairs: int) -> FloatArray:
    """The lowest of the pairs of all pieces, as vectors of the whole. *Shape:* ``(n, n_pairs)``."""
    whole = np.zeros((n, sum(len(values) for values, _ in found)))
    first = 0
    for (values, vectors), own in zip(found, owned, strict=True):
        whole[own, first : first + len(values)] = vectors
        first += len(values)
    order = np.argsort(np.concatenate([values for values, _ in found]), kind="stable")[:n_pairs]
    return whole[:, order]


def _of_piece(
    k: sp.csc_matrix, graph: sp.csc_matrix, mass: Mass, n_pairs: int, shift: float, tolerance: float
) -> Iterator[Pairs]:
    """Ever better eigenvalues, ascending, and eigenvectors of a connected piece."""
    n = k.shape[0]
    if n < DENSE_BELOW or 2 * n_pairs > n:
        yield scipy.linalg.eigh(k.toarray(), mass.for_coordinates().toarray(), subset_by_index=(0, n_pairs - 1))
        return
    vertices, solve = factored(k, graph, mass, shift)
    order = _of_coordinates(vertices)
    for inverse, vectors in _block_lanczos(solve, mass.of_vertices(vertices), n_pairs, tolerance):
        restored = np.empty_like(vectors)
        restored[order] = vectors
        yield 1 / inverse - shift, restored


def factored(
    k: sp.csc_matrix, graph: sp.csc_matrix, mass: Mass, shift: float
) -> tuple[IntArray, Callable[[FloatArray], FloatArray]]:
    """An order of the vertices, and the inverse of ``K + shift M`` in that order, for several columns at once.

    An ordering of the vertices serves their three unknowns: a third less fill than one of the unknowns.
    """
    vertices = _elimination_order(graph)
    order = _of_coordinates(vertices)
    # Symmetric, so it may be turned over: that sorts it, in a fraction of the time of sorting.
    permuted = k[order][:, order].tocsr().T
    factors = factorize(permuted + shift * mass.of_vertices(vertices).for_coordinates(), "NATURAL")
    return vertices, factors.solve


def _of_coordinates(vertices: IntArray) -> IntArray:
    """The unknowns of vertices. *Shape:* ``(N,) -> (3N,)``."""
    return (3 * vertices[:, None] + np.arange(3)).reshape(-1)


def _block_lanczos(
    solve: Callable[[FloatArray], FloatArray], mass: Mass, n_pairs: int, tolerance: float
) -> Iterator[Pairs]:
    """Largest eigenvalues of ``A⁻¹ M``, descending, and their M-orthonormal eigenvectors, ever better.

    All vectors are kept, and each block is made M-orthogonal to all before it: a few hundred of them cost less than
    the solves. As only the last two blocks have a part in a new one, but for rounding, those are taken out first.

    Args:
        solve: ``A⁻¹`` of several columns; ``A`` is symmetric positive definite.
        mass: M.
        n_pairs: How many.
        tolerance: Residual, relative to the eigenvalue, at which the first are handed out.
    """
    n = 3 * mass.matrix.shape[0]
    most = min(n // BLOCK, 40 + n_pairs) * BLOCK
    basis, weighted = np.empty((n, most), order="F"), np.empty((n, most), order="F")
    projected = np.zeros((most, most))
    # Fixed, so that equal input gives equal modes.
    block = mass.orthonormal(np.random.default_rng(0).standard_normal((n, BLOCK)))[0]
    check_at, worst = 5 * n_pairs // 2, np.inf
    for start in range(0, most, BLOCK):
        stop = start + BLOCK
        basis[:, start:stop] = block
        weighted[:, start:stop] = mass @ block
        image = solve(weighted[:, start:stop])
        for first in (max(start - BLOCK, 0), 0):
            part = weighted[:, first:stop].T @ image
            image -= basis[:, first:stop] @ part
            projected[first:stop, start:stop] += part
        block, coupling = mass.orthonormal(image)
        if stop < check_at and stop < most:
            continue
        values, rotation = np.linalg.eigh(projected[:stop, :stop], UPLO="U")
        values, rotation = values[::-1][:n_pairs], rotation[:, ::-1][:, :n_pairs]
        worst = (np.linalg.norm(coupling @ rotation[start:stop], axis=0) / np.abs(values)).max()
        if worst <= tolerance:
            yield values, basis[:, :stop] @ rotation
        if worst <= FLOOR:
            return
        check_at = stop + BLOCK
    if worst > tolerance:
        raise RuntimeError(f"block Lanczos has not converged with {most} vectors for {n_pairs} pairs of {n} unknowns")


def _vertex_graph(k: sp.csc_matrix) -> sp.csc_matrix:
    """Which vertices ``K`` couples, from its three unknowns for each. *Shape:* ``(N, N)``."""
    blocks = k.T.tobsr((3, 3))
    n = k.shape[0] // 3
    return sp.csc_matrix((np.ones(len(blocks.indices)), blocks.indices, blocks.indptr), shape=(n, n))


def _elimination_order(graph: sp.csc_matrix) -> IntArray:
    """A minimum-degree ordering, which SciPy only gives along with a factorisation: of a small, tame matrix."""
    n = graph.shape[0]
    pattern = sp.csc_matrix((np.full(graph.nnz, -1.0), graph.indices, graph.indptr), shape=graph.shape)
    factors = factorize(pattern + sp.identity(n) * (1.0 + np.diff(graph.indptr).max()))
    return np.argsort(factors.perm_c)
