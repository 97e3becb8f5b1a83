"""Other factorisations under our block Lanczos, on large meshes; a part of precompute.py.

Each runs in a process of its own, ``python solvers.py SOLVER JOB.npz``, so that its memory can be told.
"""

import importlib.util
import json
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from torch_modal.precompute import lanczos
from torch_modal.precompute.eigen import lowest_modes
from torch_modal.precompute.lattice import lattice
from torch_modal.precompute.stiffness import arap_hessian, mass_matrix
from torch_modal.precompute.surface import CanonicalSurface
from torch_modal.precompute.tetrahedra import Tetrahedra

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
Solve = Callable[[FloatArray], FloatArray]

N_MODES = 50
SIZES = (20_000, 44_000)
LONGEST = 1500.0


def cholespy(a: sp.csc_matrix) -> Solve:
    """CHOLMOD with the BLAS and LAPACK of Netlib; wheels, BSD-3-Clause around LGPL."""
    from cholespy import CholeskySolverD, MatrixType

    entries = a.tocoo()
    rows, columns = entries.row.astype(np.int32), entries.col.astype(np.int32)
    factors = CholeskySolverD(a.shape[0], rows, columns, entries.data, MatrixType.COO)

    def solve(b: FloatArray) -> FloatArray:
        b = np.ascontiguousarray(b)
        x = np.empty_like(b)
        factors.solve(b, x)
        return x

    return solve


def qdldl(a: sp.csc_matrix) -> Solve:
    """Simplicial factorisation, one right-hand side at a time; wheels, Apache-2.0."""
    from qdldl import Solver

    factors = Solver(a)
    return lambda b: np.stack([factors.solve(column) for column in np.ascontiguousarray(b.T)], axis=1)


OTHERS: dict[str, Callable[[sp.csc_matrix], Solve]] = {"cholespy": cholespy, "qdldl": qdldl}


def solvers(vertices: FloatArray, faces: IntArray) -> None:
    """Print time and memory of each solver that is installed."""
    surface = CanonicalSurface.of(vertices, faces)
    missing = [name for name in OTHERS if importlib.util.find_spec(name) is None]
    if missing:
        print(f"not installed, so not compared: {', '.join(missing)}")
    with tempfile.TemporaryDirectory() as folder:
        for size in SIZES:
            solid = of_size(surface, size)
            job = Path(folder) / f"{size}.npz"
            np.savez(job, vertices=solid.vertices, tets=solid.tets)
            ours = None
            for name in ("superlu", *(name for name in OTHERS if name not in missing)):
                try:
                    command = [sys.executable, __file__, name, str(job)]
                    run = subprocess.run(command, check=True, capture_output=True, text=True, timeout=LONGEST)
                except subprocess.TimeoutExpired:
                    print(f"{N_MODES} modes, {len(solid.vertices)} vertices, {name}: not done in {LONGEST:g} s")
                    continue
                cost = json.loads(run.stdout)
                ours = ours or cost
                print(
                    f"{N_MODES} modes, {len(solid.vertices)} tetrahedral vertices, {name}: {cost['wall']:.1f} s, "
                    f"{cost['processor']:.1f} cpu, {cost['gib']:.2f} GiB, residual {cost['residual']:.0e}; against "
                    f"SuperLU: {cost['processor'] / ours['processor']:.2f} cpu, {cost['gib'] / ours['gib']:.2f} memory",
                    flush=True,
                )


def of_size(surface: CanonicalSurface, n_vertices: int) -> Tetrahedra:
    """A lattice in the surface, each tetrahedron cut into eight, with about so many vertices."""
    low, high = 0.01, 0.06
    for _ in range(12):
        middle = (low * high) ** 0.5
        solid = refined(lattice(surface, middle))
        low, high = (middle, high) if len(solid.vertices) > n_vertices else (low, middle)
    return solid


def refined(solid: Tetrahedra) -> Tetrahedra:
    """Each tetrahedron cut into eight at the middles of its edges."""
    pairs = [(0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3)]
    ends = np.sort(np.concatenate([solid.tets[:, pair] for pair in pairs]), axis=1)
    unique, edge = np.unique(ends, axis=0, return_inverse=True)
    a, b, c, d = solid.tets.T
    ab, ac, ad, bc, bd, cd = len(solid.vertices) + edge.reshape(6, -1)
    corners = [(a, ab, ac, ad), (ab, b, bc, bd), (ac, bc, c, cd), (ad, bd, cd, d)]
    inner = [(ab, ac, ad, bd), (ab, ac, bd, bc), (ac, ad, bd, cd), (ac, bc, cd, bd)]
    tets = np.concatenate([np.stack(tet, axis=1) for tet in corners + inner])
    return Tetrahedra(np.concatenate([solid.vertices, solid.vertices[unique].mean(axis=1)]), tets)


def main(name: str, job: str) -> None:
    """Solve, and print what it cost as JSON."""
    with np.load(job) as arrays:
        solid = Tetrahedra(arrays["vertices"], arrays["tets"])
    k, mass = arap_hessian(solid), mass_matrix(solid)
    if name != "superlu":
        factored = OTHERS[name]
        lanczos.factored = lambda k, mass, shift: (  # type: ignore[attr-defined]
            np.arange(mass.matrix.shape[0]),
            factored(sp.csc_matrix(k + shift * mass.for_coordinates())),
        )
    wall, before = time.perf_counter(), time.process_time()
    residual = lowest_modes(k, mass, solid.vertices, N_MODES).residual
    cost = {
        "wall": time.perf_counter() - wall,
        "processor": time.process_time() - before,
        "gib": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20,
        "residual": residual,
    }
    print(json.dumps(cost))


if __name__ == "__main__":
    main(*sys.argv[1:])
