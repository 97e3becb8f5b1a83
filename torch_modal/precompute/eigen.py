"""Lowest vibration modes: the generalised eigenproblem ``K phi = lambda M phi``."""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
import scipy.sparse as sp

from torch_modal.arrays import FloatArray
from torch_modal.precompute.lanczos import lowest_spans
from torch_modal.precompute.parallel import one_blas_thread
from torch_modal.precompute.stiffness import Mass

N_RIGID = 6
GUARD = 4
"""Additional pairs: the last ones of a batch have converged least."""
RIGID_TOLERANCE = 1e-5
"""Largest eigenvalue of a rigid motion relative to the first elastic one: typically 1e-13, and 1e-7 for a wire with
aspect ratio 300."""
EXACT = 1e-6
"""Residual at which modes count as exact."""
ENOUGH = 1e-3
"""Residual without effect on in-betweens. It consists of high frequencies, which ``K`` magnifies: the modes lie within
1e-4 of the exact space. It is always accepted if further steps do not help: for wires and flat tetrahedra it is the
rounding of ``K phi``."""
INVERTED = 0.3
"""Residual of the inverted problem, relative to the tolerance, at which the residuals of the modes are checked."""


class Scale(NamedTuple):
    """Orders of eigenvalues."""

    shift: float
    """Lanczos is shifted by minus this: it is near the lowest modes of slender bodies."""
    zero: float
    """Largest eigenvalue that counts as zero."""
    enough: float = ENOUGH
    """Residual that is accepted if further steps do not help."""


class ModalAnalysisError(RuntimeError):
    """The eigenproblem has no trustworthy solution; the message says which check failed."""


class ElasticModes(NamedTuple):
    """Lowest elastic modes of a mesh.

    Attributes:
        eigenvalues: Ascending. *Shape:* ``(k,)``.
        modes: M-orthonormal and M-orthogonal to the rigid motions. *Shape:* ``(3N, k)``.
        rigid_eigenvalues: Zero up to rounding. *Shape:* ``(6,)``.
        n_zero: Number of zero eigenvalues: six for each loose component.
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
    # Scaled to order 1 like the translations, for a well-conditioned factorisation.
    centered = centered / np.sqrt(np.average((centered**2).sum(axis=1), weights=lumped))
    motions = np.zeros((n, 3, 6))
    motions[:, :, :3] = np.eye(3)
    for axis in range(3):
        motions[:, :, 3 + axis] = np.cross(np.eye(3)[axis], centered)
    return mass.orthonormal(motions.reshape(3 * n, 6))[0]


@one_blas_thread()
def lowest_modes(
    k: sp.csc_matrix,
    mass: sp.spmatrix,
    positions: FloatArray,
    n_modes: int,
    tolerance: float = EXACT,
    scale: Scale | None = None,
) -> ElasticModes:
    """Lowest elastic modes of ``K phi = lambda M phi``.

    Shift-invert block Lanczos with a negative shift: ``K + |shift| M`` is positive definite, and the modes are those of
    ``K`` itself. The span is then made M-orthogonal to the rigid motions, and ``K`` is diagonalised in it
    (Rayleigh-Ritz). Lanczos continues until the residuals of the modes are small enough. Small problems are solved
    densely. The first of the largest components of each mode is positive.

    Args:
        k: Stiffness, symmetric positive semi-definite. *Shape:* ``(3N, 3N)``.
        mass: Mass matrix, entries for vertices. *Shape:* ``(N, N)``.
        positions: Rest positions. *Shape:* ``(N, 3)``.
        n_modes: Number of elastic modes.
        tolerance: Largest residual ``|K phi - lambda M phi| / (lambda |M phi|)`` at which Lanczos ends.
        scale: Orders of eigenvalues; by default those of a solid.

    Returns:
        The modes. Further zero modes, of loose components, come first.

    Raises:
        ValueError: More modes than the mesh has.
        ModalAnalysisError: The six zero modes are missing, the stiffness is indefinite, all modes are zero modes, or a
            residual is too large.
    """
    possible = 3 * len(positions) - N_RIGID
    if not 1 <= n_modes <= possible:
        raise ValueError(
            f"{n_modes} modes requested, but a mesh of {len(positions)} vertices has {possible} elastic modes; "
            f"give 1 to {possible}"
        )
    inertia = Mass(sp.csr_matrix(mass))
    if not (has_mass := inertia.lumped() > 0).all():
        raise ModalAnalysisError(f"{int((~has_mass).sum())} vertices have no mass; remove unused vertices first")
    n_pairs = min(n_modes + N_RIGID + GUARD, k.shape[0])
    scale = scale or solid_scale(positions)
    spans = lowest_spans(k, inertia, n_pairs, scale.shift, INVERTED * tolerance)
    rigid = rigid_motions(positions, inertia)
    while (span := _next_of(spans)) is not None:
        found, first_elastic = _modes_in_span(k, inertia, scale.zero, span, rigid, n_modes)
        not_rigid = float(np.abs(found.rigid_eigenvalues).max())
        if found.residual < tolerance and not_rigid < RIGID_TOLERANCE * first_elastic:
            return found
    if not not_rigid < RIGID_TOLERANCE * first_elastic:
        raise ModalAnalysisError(
            f"the six rigid motions have eigenvalues up to {not_rigid:.2e}, which is not zero beside the first elastic "
            f"one, {first_elastic:.2e}; the mesh is degenerate"
        )
    if found.residual < scale.enough:
        return found
    raise ModalAnalysisError(
        f"the modes leave a relative residual of {found.residual:.2e} (allowed: {scale.enough:g}), and further "
        "steps do not help; the mesh is likely degenerate"
    )


def _next_of(spans: Iterator[FloatArray]) -> FloatArray | None:
    """The next span, or None after the last."""
    try:
        return next(spans, None)
    except (RuntimeError, np.linalg.LinAlgError) as error:  # Lanczos, SuperLU on a singular matrix, LAPACK
        raise ModalAnalysisError(f"the eigenproblem could not be solved: {error}") from error


def _modes_in_span(
    k: sp.csc_matrix, mass: Mass, zero: float, span: FloatArray, rigid: FloatArray, n_modes: int
) -> tuple[ElasticModes, float]:
    """Lowest elastic modes in a span, and the first non-zero eigenvalue."""
    rigid_eigenvalues = _rayleigh_ritz(span, k @ span)[0][:N_RIGID]

    # Remove the rigid part: six directions of the span become zero and are dropped.
    moved = mass @ rigid
    elastic = span - rigid @ (moved.T @ span)
    lengths, directions = np.linalg.eigh(elastic.T @ (mass @ elastic))
    elastic = elastic @ (directions / np.sqrt(np.maximum(lengths, np.finfo(np.float64).tiny)))[:, N_RIGID:]
    elastic -= rigid @ (moved.T @ elastic)
    # Nearly orthonormal already, so Cholesky is as accurate as QR, in a fifth of the time.
    elastic = elastic @ np.linalg.inv(np.linalg.cholesky(elastic.T @ (mass @ elastic))).T
    forces = k @ elastic
    eigenvalues, rotation = _rayleigh_ritz(elastic, forces)

    first_elastic, n_zero = _count_zeros(eigenvalues, zero)
    eigenvalues, rotation = eigenvalues[:n_modes], rotation[:, :n_modes]
    modes = elastic @ rotation
    residual = relative_residual(forces @ rotation, mass @ modes, eigenvalues, first_elastic)
    # Zero eigenvalues of loose pieces may be -1e-13; their roots must exist.
    found = ElasticModes(np.maximum(eigenvalues, 0.0), modes * _signs(modes), rigid_eigenvalues, n_zero, residual)
    return found, first_elastic


def relative_residual(forces: FloatArray, inertia: FloatArray, eigenvalues: FloatArray, smallest: float) -> float:
    """Largest ``|K phi - lambda M phi| / (lambda |M phi|)``, Euclidean norms.

    For zero modes, ``smallest`` replaces the eigenvalue.

    Args:
        forces: ``K phi`` of each mode. *Shape:* ``(3N, k)``.
        inertia: ``M phi``. *Shape:* ``(3N, k)``.
        eigenvalues: *Shape:* ``(k,)``.
        smallest: The first non-zero eigenvalue.
    """
    difference = np.linalg.norm(forces - inertia * eigenvalues, axis=0)
    return float((difference / (np.maximum(eigenvalues, smallest) * np.linalg.norm(inertia, axis=0))).max())


def _count_zeros(eigenvalues: FloatArray, zero: float) -> tuple[float, int]:
    """The first non-zero eigenvalue, and the number of zero ones, including the rigid ones."""
    if eigenvalues[0] < -zero:
        raise ModalAnalysisError(
            f"the stiffness is indefinite: its lowest eigenvalue is {eigenvalues[0]:.2e}; the mesh is likely degenerate"
        )
    n_extra = int((eigenvalues < zero).sum())
    if n_extra == len(eigenvalues):
        raise ModalAnalysisError(
            f"all of the lowest {n_extra} modes are motions without deformation: the mesh falls into loose "
            "pieces, each of which has six rigid motions; join them, or request more modes"
        )
    return float(eigenvalues[n_extra]), N_RIGID + n_extra


def _signs(modes: FloatArray) -> FloatArray:
    """Signs that make the first of the largest components positive. *Shape:* ``(k,)``.

    Components within a thousandth of the largest count, so that rounding does not choose between equal magnitudes of
    symmetric shapes.
    """
    magnitude = np.abs(modes)
    first = (magnitude >= 0.999 * magnitude.max(axis=0)).argmax(axis=0)
    return np.where(np.take_along_axis(modes, first[None], axis=0)[0] < 0, -1.0, 1.0)


def solid_scale(positions: FloatArray) -> Scale:
    """Orders of eigenvalues of a solid: proportional to the inverse square of the diagonal of its bounding box.

    Rounding is 1e-13 to 1e-12 in these units, and the first mode of a rod of aspect ratio 10,000 near 1e-6.
    """
    unit = 1 / float(((positions.max(axis=0) - positions.min(axis=0)) ** 2).sum())
    return Scale(shift=unit, zero=1e-9 * unit)


def _rayleigh_ritz(basis: FloatArray, forces: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Eigenvalues of ``K`` within the span of an M-orthonormal basis, and its eigenvectors in that basis.

    *Shape:* ``(3N, k), (3N, k) -> (k,), (k, k)``; the second is ``K`` times the first.
    """
    restricted = basis.T @ forces
    values, rotation = np.linalg.eigh((restricted + restricted.T) / 2)
    return values, rotation
