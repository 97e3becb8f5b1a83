"""Lowest vibration modes: the generalised eigenproblem ``K phi = lambda M phi``."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import scipy.linalg
import scipy.sparse as sp
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import LinearOperator, eigsh

from torch_modal.arrays import BoolArray, FloatArray
from torch_modal.errors import ModalAnalysisError
from torch_modal.geometry.sparse import factorize

N_RIGID = 6
DENSE_BELOW = 600
"""Number of unknowns below which LAPACK is as fast as Lanczos."""
MORE_VECTORS = 20
"""Lanczos vectors in addition to the requested modes."""
RIGID_TOLERANCE = 1e-5
"""Largest eigenvalue of a rigid motion relative to the first elastic one: typically 1e-13, and 1e-7 for a wire with
aspect ratio 300."""
ZERO = 1e-7
"""Largest eigenvalue that counts as zero, in shifts: rounding leaves 1e-12, and the first mode of a rod of aspect ratio
10,000 is near 1e-6."""
LARGEST_RESIDUAL = 1e-3
"""Largest residual of a mode; typically 1e-11. For wires and flat tetrahedra it is the rounding of ``K phi``."""


class ElasticBody(NamedTuple):
    """The eigenproblem ``K phi = lambda M phi`` of an elastic body with ``N`` vertices, of a surface with ``U`` points.

    Attributes:
        points: Vertices at rest. *Shape:* ``(N, 3)``.
        stiffness: ``K``, symmetric positive semi-definite; row ``3 i + c`` is coordinate ``c`` of vertex ``i``.
            *Shape:* ``(3N, 3N)``.
        mass: ``M``, entries for vertices. *Shape:* ``(N, N)``.
        to_surface: Displacements of the surface from displacements of the body. *Shape:* ``(N, 3, k) -> (U, 3, k)``.
        shift: Positive shift of the eigenproblem, near the lowest eigenvalues of slender bodies. None: for a
            solid, the inverse square of the diagonal of the bounding box.
        largest_residual: Largest residual ``|K phi - lambda M phi| / (lambda |M phi|)`` of a mode.
    """

    points: FloatArray
    stiffness: sp.csc_matrix
    mass: sp.csr_matrix
    to_surface: Callable[[FloatArray], FloatArray]
    shift: float | None = None
    largest_residual: float = LARGEST_RESIDUAL


class ElasticModes(NamedTuple):
    """Lowest elastic modes of a mesh, M-orthonormal and M-orthogonal to the rigid motions, by ascending eigenvalues.

    ``n_zero`` eigenvalues are zero, with six of each connected piece. *Shape:* ``(k,), (3N, k), (6,)``.
    """

    eigenvalues: FloatArray
    modes: FloatArray
    rigid_eigenvalues: FloatArray
    n_zero: int
    n_pieces: int


def lowest_modes(body: ElasticBody, n_modes: int) -> ElasticModes:
    """Lowest elastic modes of a body, M-orthogonal to the rigid motions of each connected piece.

    Shift-invert Lanczos with a negative shift: ``K + shift M`` is positive definite and has the modes of ``K``. Rigid
    motions of the pieces are known and projected out, so that Lanczos need not find as many equal eigenvalues. Small
    problems are solved densely. The first of the largest components of each mode is positive.

    Raises:
        ModalAnalysisError: There are fewer modes, rigid motions have energy, all modes are zero modes, or a
            residual is too large.
        RuntimeError, LinAlgError: Of SuperLU, ARPACK or LAPACK, where a matrix is singular.
    """
    positions, k, mass, _, shift, largest_residual = body
    if shift is None:
        shift = 1 / float((np.ptp(positions, axis=0) ** 2).sum())
    inertia = sp.kron(mass, sp.identity(3), format="csr")
    n_pieces, piece = connected_components(_vertex_graph(k), directed=False)
    rigid = np.hstack([rigid_motions(positions, inertia, piece == index) for index in range(n_pieces)])
    if n_modes > k.shape[0] - rigid.shape[1]:
        raise ModalAnalysisError(
            f"only {k.shape[0] - rigid.shape[1]} modes deform the {n_pieces} loose pieces, {n_modes} are requested; "
            "request fewer, or give a finer mesher"
        )
    momentum = inertia @ rigid
    if k.shape[0] < DENSE_BELOW or 2 * n_modes > k.shape[0]:
        complement = scipy.linalg.qr(momentum)[0][:, rigid.shape[1] :]
        matrices = (complement.T @ (matrix @ complement) for matrix in (k, inertia))
        span = complement @ scipy.linalg.eigh(*matrices, subset_by_index=(0, n_modes - 1))[1]
    else:
        span = _lanczos(k, inertia, sp.csr_matrix(rigid), sp.csr_matrix(momentum), n_modes, shift)

    # Rayleigh-Ritz, after which modes are orthonormal up to rounding.
    span = _orthonormal(span - rigid @ (momentum.T @ span), inertia)
    forces = k @ span
    restricted = span.T @ forces
    eigenvalues, rotation = np.linalg.eigh((restricted + restricted.T) / 2)
    modes, forces = span @ rotation, forces @ rotation
    rigid_eigenvalues = np.linalg.eigvalsh(rigid.T @ (k @ rigid))

    n_zero = int((eigenvalues < ZERO * shift).sum())
    if n_zero == n_modes:
        raise ModalAnalysisError(
            f"all of the lowest {n_zero} modes are motions without deformation: the mesh consists of parts that hang "
            "together on vertices or edges; join them, or request more modes"
        )
    first_elastic, not_rigid = eigenvalues[n_zero], np.abs(rigid_eigenvalues).max()
    if not not_rigid < RIGID_TOLERANCE * first_elastic:
        raise ModalAnalysisError(
            f"the rigid motions have eigenvalues up to {not_rigid:.2e}, which is not zero compared with the "
            f"first elastic one, {first_elastic:.2e}; the mesh is degenerate"
        )
    impulses = inertia @ modes
    residuals = np.linalg.norm(forces - impulses * eigenvalues, axis=0)
    residual = (residuals / (np.maximum(eigenvalues, first_elastic) * np.linalg.norm(impulses, axis=0))).max()
    if not residual < largest_residual:
        raise ModalAnalysisError(
            f"the modes leave a relative residual of {residual:.2e} (allowed: {largest_residual:g}); the mesh is "
            "likely degenerate"
        )
    # Zero eigenvalues of hinges may be -1e-13; their roots must exist.
    eigenvalues, n_zero = np.maximum(eigenvalues, 0.0), rigid.shape[1] + n_zero
    return ElasticModes(eigenvalues, modes * _signs(modes), rigid_eigenvalues[-N_RIGID:], n_zero, n_pieces)


def rigid_motions(positions: FloatArray, inertia: sp.csr_matrix, moves: BoolArray) -> FloatArray:
    """M-orthonormal translations and infinitesimal rotations of some points, which are not all on one line.

    *Shape:* ``(N, 3), (3N, 3N), (N,) -> (3N, 6)``, with the mass matrix of coordinates.
    """
    centered = positions[moves] - positions[moves].mean(axis=0)
    # Scaled to order 1 like the translations, for a well-conditioned factorisation.
    centered = centered / np.sqrt((centered**2).sum(axis=1).mean())
    motions = np.zeros((len(positions), 3, N_RIGID))
    motions[moves, :, :3] = np.eye(3)
    motions[moves, :, 3:] = np.cross(centered[:, None], np.eye(3))  # row c has coordinate c of the three rotations
    return _orthonormal(motions.reshape(-1, N_RIGID), inertia)


def _lanczos(
    k: sp.csc_matrix, inertia: sp.csr_matrix, rigid: sp.csr_matrix, momentum: sp.csr_matrix, n_modes: int, shift: float
) -> FloatArray:
    """Lowest eigenvectors that are M-orthogonal to the rigid motions, by ARPACK. *Shape:* ``(3N, n_modes)``."""
    n, shifted = k.shape[0], k + shift * inertia
    # Ordering vertices instead of unknowns gives a third less fill: by minimum degree, from the factorisation of a
    # well-conditioned matrix with their graph.
    graph = _vertex_graph(shifted)
    laplacian = sp.csc_matrix((np.full(graph.nnz, -1.0), graph.indices, graph.indptr), shape=graph.shape)
    degrees = np.diff(graph.indptr)
    by_vertex = factorize(laplacian + sp.identity(len(degrees)) * (1.0 + degrees.max()))
    order = (3 * np.argsort(by_vertex.perm_c)[:, None] + np.arange(3)).reshape(-1)
    # The transpose of the symmetric matrix has sorted indices, in a fraction of the time of sorting.
    factors = factorize(shifted[order][:, order].tocsr().T, "NATURAL")

    momentum = momentum.T.tocsr()

    def elastic_solve(forces: FloatArray) -> FloatArray:
        solved = np.empty(n)
        solved[order] = factors.solve(forces.reshape(-1)[order])
        return solved - rigid @ (momentum @ solved)

    # A fixed start makes modes reproducible. Full accuracy: a looser tolerance misses copies of equal eigenvalues.
    start = elastic_solve(np.random.default_rng(0).standard_normal(n))
    inverse = LinearOperator((n, n), matvec=elastic_solve, dtype=np.float64)
    n_vectors = min(n_modes + MORE_VECTORS, n)
    vectors: FloatArray = eigsh(k, n_modes, inertia, sigma=-shift, OPinv=inverse, v0=start, ncv=n_vectors, tol=0)[1]
    return vectors


def _vertex_graph(k: sp.csc_matrix) -> sp.csc_matrix:
    """Vertex adjacency from the block structure of a matrix. *Shape:* ``(3N, 3N) -> (N, N)``."""
    blocks = k.T.tobsr((3, 3))
    n = k.shape[0] // 3
    return sp.csc_matrix((np.ones(len(blocks.indices)), blocks.indices, blocks.indptr), shape=(n, n))


def _orthonormal(columns: FloatArray, inertia: sp.csr_matrix) -> FloatArray:
    """M-orthonormal basis of the span of independent columns. *Shape:* ``(3N, k) -> (3N, k)``."""
    root = np.sqrt(np.asarray(inertia.sum(axis=1)))
    basis = np.linalg.qr(root * columns)[0] / root
    # Scaled by the lumped masses, the spectrum of M is within [1/5, 1]: the product is well conditioned.
    upper = scipy.linalg.cholesky(basis.T @ (inertia @ basis))
    orthonormal: FloatArray = scipy.linalg.solve_triangular(upper, basis.T, trans="T").T
    return orthonormal


def _signs(modes: FloatArray) -> FloatArray:
    """Signs that make the first of the largest components positive. *Shape:* ``(k,)``."""
    magnitude = np.abs(modes)
    # Within a thousandth: rounding must not choose between equal magnitudes of symmetric shapes.
    first = (magnitude >= 0.999 * magnitude.max(axis=0)).argmax(axis=0)
    return np.where(np.take_along_axis(modes, first[None], axis=0)[0] < 0, -1.0, 1.0)
