"""Our block Lanczos against SciPy's ARPACK with the same factorisation; a part of precompute.py."""

import time
from collections.abc import Callable

import numpy as np
import scipy.sparse as sp
import scipy.sparse.linalg as spla
from numpy.typing import NDArray

from torch_modal.precompute.eigen import GUARD, N_RIGID, relative_residual, solid_scale
from torch_modal.precompute.lanczos import factored, lowest_spans
from torch_modal.precompute.lattice import lattice
from torch_modal.precompute.stiffness import Mass, arap_hessian, mass_matrix
from torch_modal.precompute.surface import CanonicalSurface

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
CELLS = (0.028, 0.017)
MODES = (30, 50)
REPEATS = 3
SAME_TOLERANCE = 1e-8


def eigensolvers(name: str, vertices: FloatArray, faces: IntArray) -> None:
    """Print how much longer ARPACK takes, and what both leave of a residual."""
    surface = CanonicalSurface.of(vertices, faces)
    for cell in CELLS:
        solid = lattice(surface, cell)
        k, mass = arap_hessian(solid), Mass(mass_matrix(solid))
        shift = solid_scale(solid.vertices).shift
        for n_modes in MODES:
            n_pairs = n_modes + N_RIGID + GUARD
            ways = (
                lambda: next(lowest_spans(k, mass, n_pairs, shift, SAME_TOLERANCE)),  # noqa: B023
                lambda: arpack(k, mass, n_pairs, shift),  # noqa: B023
            )
            (ours, our_cost), (theirs, their_cost) = in_turns(ways)
            print(
                f"{n_modes} modes, {name}, {len(solid.vertices)} tetrahedral vertices: ours {our_cost:.2f} s cpu, "
                f"residual {residual(k, mass, ours):.0e}; eigsh {their_cost / our_cost:.2f} of that, residual "
                f"{residual(k, mass, theirs):.0e}",
                flush=True,
            )


def arpack(k: sp.csc_matrix, mass: Mass, n_pairs: int, shift: float) -> FloatArray:
    """The lowest eigenvectors by ``eigsh``, with our factors of ``K + shift M``. *Shape:* ``(3N, n_pairs)``."""
    n = k.shape[0]
    vertices, solve = factored(k, mass, shift)
    order = (3 * vertices[:, None] + np.arange(3)).reshape(-1)
    inverse = spla.LinearOperator((n, n), matvec=lambda b: solve(np.ascontiguousarray(b).reshape(-1)), dtype=float)
    vectors = np.empty((n, n_pairs))
    vectors[order] = spla.eigsh(
        k[order][:, order],
        n_pairs,
        mass.of_vertices(vertices).for_coordinates(),
        sigma=-shift,
        OPinv=inverse,
        tol=SAME_TOLERANCE,
        v0=np.random.default_rng(0).standard_normal(n),
    )[1]
    return vectors


def residual(k: sp.csc_matrix, mass: Mass, span: FloatArray) -> float:
    """Of the elastic pairs in a span, the last ones left out, as in the package."""
    restricted = span.T @ (k @ span)
    values, rotation = np.linalg.eigh((restricted + restricted.T) / 2)
    own = slice(N_RIGID, len(values) - GUARD)
    modes = (span @ rotation)[:, own]
    return relative_residual(k @ modes, mass @ modes, values[own], values[N_RIGID])


def in_turns(ways: tuple[Callable[[], FloatArray], ...]) -> list[tuple[FloatArray, float]]:
    """What each gives, and its processor seconds, the best of several, taken in turns."""
    results, best = [way() for way in ways], [np.inf] * len(ways)
    for _ in range(REPEATS):
        for index, way in enumerate(ways):
            start = time.process_time()
            way()
            best[index] = min(best[index], time.process_time() - start)
    return list(zip(results, best, strict=True))
