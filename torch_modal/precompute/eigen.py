"""Lowest vibration modes: the generalised eigenproblem ``K phi = lambda M phi``."""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
import scipy.sparse as sp

from torch_modal.arrays import FloatArray
from torch_modal.precompute.lanczos import lowest_spans
from torch_modal.precompute.mass import Mass
from torch_modal.precompute.parallel import one_blas_thread

N_RIGID = 6
GUARD = 4
"""Pairs computed beyond those asked for: the last of a batch are the least settled."""
RIGID_TOLERANCE = 1e-5
"""Largest eigenvalue of a rigid motion, beside the first elastic one: 1e-13 as a rule, 1e-7 in a wire that is 300 times
longer than wide."""
EXACT = 1e-6
"""Residual at which modes are as good as exact."""
ENOUGH = 1e-3
"""Residual that in-betweens do not notice. It is of the highest frequencies, which ``K`` magnifies, and there is next
to none of it in the modes: they lie within 1e-4 of the space of the exact ones. It is accepted whatever was asked for
where further steps do not help: of wires and of flat tetrahedra it is the rounding of ``K phi``."""
INVERTED = 0.3
"""Residual of the inverted problem, over that of the modes, from which on it is worth a look at these."""
SHIFT = 1.0
"""Negative shift in units of 1 / (bounding-box diagonal)²; the lowest modes of slender bodies lie near it."""
ZERO = 1e-9
"""Largest eigenvalue that counts as zero, in the same units: rounding leaves 1e-13 to 1e-12, and the first
mode of a rod 10,000 times longer than wide is still near 1e-6."""


class ModalAnalysisError(RuntimeError):
    """The eigenproblem has no trustworthy solution; the message says which check failed."""


class VolumeModes(NamedTuple):
    """Lowest modes of a tetrahedral mesh, the six rigid ones apart.

    Attributes:
        eigenvalues: Ascending. *Shape:* ``(k,)``.
        modes: M-orthonormal and M-orthogonal to the rigid motions. *Shape:* ``(3N, k)``.
        rigid_eigenvalues: As computed, zero up to rounding. *Shape:* ``(6,)``.
        n_zero: How many eigenvalues are zero, the six included: six for each loose component.
        residual: Largest ``|K phi - lambda M phi| / (lambda |M phi|)``.
    """

    eigenvalues: FloatArray
    modes: FloatArray
    rigid_eigenvalues: FloatArray
    n_zero: int
    residual: float


def rigid_motions(positions: FloatArray, mass: Mass) -> FloatArray:
    """M-orthonormal basis of the translations and infinitesimal rotations. *Shape:* ``(3N, 6)``.

    Args:
        positions: Rest positions, not all on one line. *Shape:* ``(N, 3)``.
        mass: Mass matrix.
    """
    n = len(positions)
    lumped = mass.lumped()
    centered = positions - np.average(positions, axis=0, weights=lumped)
    # Of order 1 like the translations, so that the factorisation below is well conditioned.
    centered = centered / np.sqrt(np.average((centered**2).sum(axis=1), weights=lumped))
    motions = np.zeros((n, 3, 6))
    motions[:, :, :3] = np.eye(3)
    for axis in range(3):
        motions[:, :, 3 + axis] = np.cross(np.eye(3)[axis], centered)
    return mass.orthonormal(motions.reshape(3 * n, 6))[0]


@one_blas_thread()
def lowest_modes(
    k: sp.csc_matrix,
    mass: FloatArray | sp.spmatrix,
    positions: FloatArray,
    n_modes: int,
    tolerance: float = EXACT,
) -> VolumeModes:
    """Lowest elastic modes of ``K phi = lambda M phi``.

    Shift-invert block Lanczos with a negative shift: ``K + |shift| M`` is positive definite, and the modes are
    those of ``K`` itself, which a regularised ``K + eps M`` would not give for free. Then two steps of dense
    clean-up: the span is made exactly M-orthogonal to the rigid motions, and ``K`` is diagonalised in it
    (Rayleigh-Ritz). Lanczos goes on until the modes pass the check of their residuals. Small problems are solved
    densely. Of each mode's largest components, the first is positive.

    Args:
        k: Stiffness, symmetric positive semi-definite. *Shape:* ``(3N, 3N)``.
        mass: Mass of each vertex, positive, or a mass matrix for vertices. *Shape:* ``(N,)`` or ``(N, N)``.
        positions: Rest positions. *Shape:* ``(N, 3)``.
        n_modes: Number of elastic modes.
        tolerance: Largest residual ``|K phi - lambda M phi| / (lambda |M phi|)`` at which Lanczos ends.

    Returns:
        The modes. Zero modes beyond the six (loose components) stay in as the first of them.

    Raises:
        ValueError: More modes than the mesh has.
        ModalAnalysisError: The six zero modes are missing, the stiffness is indefinite, nothing but zero
            modes was found, or a residual is too large.
    """
    possible = 3 * len(positions) - N_RIGID
    if not 1 <= n_modes <= possible:
        raise ValueError(
            f"{n_modes} modes asked for, but {len(positions)} tetrahedral vertices have {possible} elastic modes; "
            f"give 1 to {possible}"
        )
    inertia = Mass.of(mass)
    if not (has_mass := inertia.lumped() > 0).all():
        raise ModalAnalysisError(f"{int((~has_mass).sum())} vertices have no mass; remove unused vertices first")
    n_pairs = min(n_modes + N_RIGID + GUARD, k.shape[0])
    spans = lowest_spans(k, inertia, n_pairs, SHIFT / _squared_diagonal(positions), INVERTED * tolerance)
    rigid = rigid_motions(positions, inertia)
    while (span := _next_of(spans)) is not None:
        found, first_elastic = _modes_in_span(k, inertia, positions, span, rigid, n_modes)
        not_rigid = float(np.abs(found.rigid_eigenvalues).max())
        if found.residual < tolerance and not_rigid < RIGID_TOLERANCE * first_elastic:
            return found
    if not not_rigid < RIGID_TOLERANCE * first_elastic:
        raise ModalAnalysisError(
            f"the six rigid motions have eigenvalues up to {not_rigid:.2e}, which is not zero beside the first elastic "
            f"one, {first_elastic:.2e}; the tetrahedra are degenerate"
        )
    if found.residual < ENOUGH:
        return found
    raise ModalAnalysisError(
        f"the modes leave a relative residual of {found.residual:.2e} (allowed: {ENOUGH:g}), and further "
        "steps do not help; the tetrahedra are likely degenerate"
    )


def _next_of(spans: Iterator[FloatArray]) -> FloatArray | None:
    """The next span, or None after the last."""
    try:
        return next(spans, None)
    except (RuntimeError, np.linalg.LinAlgError) as error:  # of Lanczos, of SuperLU on a singular matrix, of LAPACK
        raise ModalAnalysisError(f"the eigenproblem could not be solved: {error}") from error


def _modes_in_span(
    k: sp.csc_matrix, mass: Mass, positions: FloatArray, span: FloatArray, rigid: FloatArray, n_modes: int
) -> tuple[VolumeModes, float]:
    """The lowest elastic modes that a span holds, and the first eigenvalue that is not zero."""
    rigid_eigenvalues = _rayleigh_ritz(span, k @ span)[0][:N_RIGID]

    # The rigid part is taken out exactly: six directions of the span lose all their length, and are left
    # behind.
    moved = mass @ rigid
    elastic = span - rigid @ (moved.T @ span)
    lengths, directions = np.linalg.eigh(elastic.T @ (mass @ elastic))
    elastic = elastic @ (directions / np.sqrt(np.maximum(lengths, np.finfo(np.float64).tiny)))[:, N_RIGID:]
    elastic -= rigid @ (moved.T @ elastic)
    # Orthonormal but for the rounding of these two steps, so that this is as good as QR, at a fifth of its time.
    elastic = elastic @ np.linalg.inv(np.linalg.cholesky(elastic.T @ (mass @ elastic))).T
    forces = k @ elastic
    eigenvalues, rotation = _rayleigh_ritz(elastic, forces)

    first_elastic, n_zero = _count_zeros(eigenvalues, positions)
    eigenvalues, rotation = eigenvalues[:n_modes], rotation[:, :n_modes]
    modes = elastic @ rotation
    residual = relative_residual(forces @ rotation, mass @ modes, eigenvalues, first_elastic)
    # Zero modes of loose pieces come out as -1e-13 as well as 1e-13; nobody should meet the root of that.
    found = VolumeModes(np.maximum(eigenvalues, 0.0), modes * _signs(modes), rigid_eigenvalues, n_zero, residual)
    return found, first_elastic


def relative_residual(forces: FloatArray, inertia: FloatArray, eigenvalues: FloatArray, smallest: float) -> float:
    """Largest ``|K phi - lambda M phi| / (lambda |M phi|)``, Euclidean norms.

    A zero mode counts as if its eigenvalue were ``smallest``, the first that is not zero.

    Args:
        forces: ``K phi`` of each mode. *Shape:* ``(3N, k)``.
        inertia: ``M phi``. *Shape:* ``(3N, k)``.
        eigenvalues: *Shape:* ``(k,)``.
        smallest: Above zero.
    """
    difference = np.linalg.norm(forces - inertia * eigenvalues, axis=0)
    return float((difference / (np.maximum(eigenvalues, smallest) * np.linalg.norm(inertia, axis=0))).max())


def _count_zeros(eigenvalues: FloatArray, positions: FloatArray) -> tuple[float, int]:
    """The first eigenvalue that is not zero, and the number of those that are, the rigid ones included."""
    zero = ZERO / _squared_diagonal(positions)
    if eigenvalues[0] < -zero:
        raise ModalAnalysisError(
            f"the stiffness is indefinite: its lowest eigenvalue is {eigenvalues[0]:.2e}; "
            "the tetrahedra are likely degenerate"
        )
    n_extra = int((eigenvalues < zero).sum())
    if n_extra == len(eigenvalues):
        raise ModalAnalysisError(
            f"all of the lowest {n_extra} modes are motions without deformation: the mesh falls into loose "
            "pieces, each of which moves in six ways of its own; join them, or ask for more modes than that"
        )
    return float(eigenvalues[n_extra]), N_RIGID + n_extra


def _signs(modes: FloatArray) -> FloatArray:
    """Signs that make the first of the largest components positive. *Shape:* ``(k,)``.

    "Largest" up to a thousandth: symmetric shapes have components of equal magnitude and opposite sign, and
    rounding must not choose among them.
    """
    magnitude = np.abs(modes)
    first = (magnitude >= 0.999 * magnitude.max(axis=0)).argmax(axis=0)
    return np.where(np.take_along_axis(modes, first[None], axis=0)[0] < 0, -1.0, 1.0)


def _squared_diagonal(positions: FloatArray) -> float:
    """Squared diagonal of the bounding box: eigenvalues are proportional to its inverse."""
    return float(((positions.max(axis=0) - positions.min(axis=0)) ** 2).sum())


def _rayleigh_ritz(basis: FloatArray, forces: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Eigenvalues of ``K`` within the span of an M-orthonormal basis, and its eigenvectors in that basis.

    *Shape:* ``(3N, k), (3N, k) -> (k,), (k, k)``; the second is ``K`` times the first.
    """
    restricted = basis.T @ forces
    values, rotation = np.linalg.eigh((restricted + restricted.T) / 2)
    return values, rotation
