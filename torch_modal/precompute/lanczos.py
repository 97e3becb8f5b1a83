"""Lowest eigenvectors of ``K phi = lambda M phi`` by shift-invert block Lanczos, separately for each component."""

from collections.abc import Callable, Iterator

import numpy as np
import scipy.linalg
import scipy.sparse as sp
from scipy.sparse.csgraph import connected_components

from torch_modal.arrays import FloatArray, IntArray
from torch_modal.geometry.sparse import factorize
from torch_modal.precompute.stiffness import Mass

Pairs = tuple[FloatArray, FloatArray]
"""Eigenvalues ``(k,)`` and eigenvectors ``(n, k)``."""

DENSE_BELOW = 600
"""Number of unknowns below which LAPACK is as fast as Lanczos."""
BLOCK = 8
"""Block size: solves for several right-hand sides are three times as fast, and a block finds eigenvalues of the same
multiplicity; a single starting vector finds one of each."""
FLOOR = 1e-14
"""Relative residual of the inverted problem at the level of rounding."""


def lowest_spans(k: sp.csc_matrix, mass: Mass, n_pairs: int, shift: float, tolerance: float) -> Iterator[FloatArray]:
    """M-orthonormal bases of approximately the ``n_pairs`` lowest eigenvectors, with decreasing errors.

    The iteration controls residuals of the inverted problem. Their effect on ``K phi - lambda M phi`` depends on the
    worst tetrahedra, so the caller checks each basis and requests the next one if needed.

    Connected components are solved separately, because of their multiple eigenvalues (six zeros each).

    Args:
        k: Stiffness, symmetric positive semi-definite, three unknowns for each vertex. *Shape:* ``(3N, 3N)``.
        mass: M.
        n_pairs: Number of eigenvectors.
        shift: Positive, so that ``K + shift M`` is positive definite.
        tolerance: Relative residual of the inverted problem of the first basis.

    Yields:
        Bases by ascending eigenvalues, until rounding prevents further improvement.
        *Shape:* ``(3N, n_pairs)``.

    Raises:
        RuntimeError: Lanczos has not converged.
    """
    n_pieces, piece = connected_components(_vertex_graph(k), directed=False)
    if n_pieces == 1:
        yield from (vectors for _, vectors in _component_pairs(k, mass, n_pairs, shift, tolerance))
        return
    owned = [_unknowns(np.flatnonzero(piece == index)) for index in range(n_pieces)]
    rounds = [
        _component_pairs(
            sp.csc_matrix(k[own][:, own]),
            mass.of_vertices(own[::3] // 3),
            min(n_pairs, len(own)),
            shift,
            tolerance,
        )
        for own in owned
    ]
    # A converged component keeps its vectors while others continue.
    latest = [next(component) for component in rounds]
    improved = True
    while improved:
        yield _merged(latest, owned, k.shape[0], n_pairs)
        better = [next(component, None) for component in rounds]
        improved = any(found is not None for found in better)
        latest = [old if new is None else new for old, new in zip(latest, better, strict=True)]


def _merged(found: list[Pairs], owned: list[IntArray], n: int, n_pairs: int) -> FloatArray:
    """Lowest pairs of all components, as vectors of the whole mesh. *Shape:* ``(n, n_pairs)``."""
    whole = np.zeros((n, sum(len(values) for values, _ in found)))
    first = 0
    for (values, vectors), own in zip(found, owned, strict=True):
        whole[own, first : first + len(values)] = vectors
        first += len(values)
    order = np.argsort(np.concatenate([values for values, _ in found]), kind="stable")[:n_pairs]
    return whole[:, order]


def _component_pairs(k: sp.csc_matrix, mass: Mass, n_pairs: int, shift: float, tolerance: float) -> Iterator[Pairs]:
    """Iterates of the eigenvalues, ascending, and eigenvectors of a connected component."""
    n = k.shape[0]
    if n < DENSE_BELOW or 2 * n_pairs > n:
        yield scipy.linalg.eigh(k.toarray(), mass.for_coordinates().toarray(), subset_by_index=(0, n_pairs - 1))
        return
    vertices, solve = factored(k, mass, shift)
    order = _unknowns(vertices)
    for inverse, vectors in _block_lanczos(solve, mass.of_vertices(vertices), n_pairs, tolerance):
        restored = np.empty_like(vectors)
        restored[order] = vectors
        yield 1 / inverse - shift, restored


def factored(k: sp.csc_matrix, mass: Mass, shift: float) -> tuple[IntArray, Callable[[FloatArray], FloatArray]]:
    """Elimination order of the vertices, and a solver for ``K + shift M`` in that order, for several columns.

    Ordering vertices instead of their three unknowns gives a third less fill.
    """
    vertices = _elimination_order(_vertex_graph(k))
    order = _unknowns(vertices)
    # The transpose of the symmetric matrix has sorted indices, in a fraction of the time of sorting.
    permuted = k[order][:, order].tocsr().T
    factors = factorize(permuted + shift * mass.of_vertices(vertices).for_coordinates(), "NATURAL")
    return vertices, factors.solve


def _unknowns(vertices: IntArray) -> IntArray:
    """Indices of the unknowns of vertices. *Shape:* ``(N,) -> (3N,)``."""
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
        n_pairs: Number of eigenpairs.
        tolerance: Relative residual of the first iterate.
    """
    n = 3 * mass.matrix.shape[0]
    most = min(n // BLOCK, 40 + n_pairs) * BLOCK
    basis, weighted = np.empty((n, most), order="F"), np.empty((n, most), order="F")
    projected = np.zeros((most, most))
    # A fixed seed makes modes reproducible.
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
    """Vertex adjacency from the block structure of ``K``. *Shape:* ``(N, N)``."""
    blocks = k.T.tobsr((3, 3))
    n = k.shape[0] // 3
    return sp.csc_matrix((np.ones(len(blocks.indices)), blocks.indices, blocks.indptr), shape=(n, n))


def _elimination_order(graph: sp.csc_matrix) -> IntArray:
    """Minimum-degree ordering, from the factorisation of a well-conditioned matrix with the same pattern."""
    n = graph.shape[0]
    pattern = sp.csc_matrix((np.full(graph.nnz, -1.0), graph.indices, graph.indptr), shape=graph.shape)
    factors = factorize(pattern + sp.identity(n) * (1.0 + np.diff(graph.indptr).max()))
    return np.argsort(factors.perm_c)
