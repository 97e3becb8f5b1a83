"""Sparse symmetric positive definite systems, differentiable for tensors.

:class:`SparseSolver` is CHOLMOD by ``cholespy``, on the CPU and on CUDA: nested dissection keeps its factors sparse on
surfaces of any size. Without wheels for Linux on ARM, SciPy's SuperLU replaces it there. :func:`factorize` is
SuperLU: on tetrahedra its supernodes take half the time of ``cholespy``, which has none (docs/precompute.md), and it
releases the GIL.
"""

import atexit
import ctypes
import sys
import threading
import weakref
from collections.abc import Callable
from functools import cache

import numpy as np
import torch
from scipy import sparse
from scipy.sparse.linalg import SuperLU, splu
from torch import Tensor

from torch_modal.arrays import FloatArray, IntArray
from torch_modal.autograd import disable_compile, linear_map

try:
    import cholespy
except ImportError:
    cholespy = None

Solve = Callable[[Tensor], Tensor]
"""Products with the inverse of a symmetric matrix. *Shape:* ``(..., V, m) -> (..., V, m)``."""

# Right-hand sides per solve: more are not faster and use more memory; CUDA allows at most 128.
MOST_COLUMNS = 48

# Threads that need the same factors compute them once.
_MAKING = threading.RLock()


def factorize(matrix: sparse.spmatrix, ordering: str = "MMD_AT_PLUS_A") -> SuperLU:
    """Sparse LU factorisation of a symmetric positive definite matrix, without pivoting. *Shape:* ``(n, n)``.

    The ordering is SuperLU's of the columns; ``"NATURAL"`` keeps the order of the unknowns.
    """
    options = {"SymmetricMode": True}
    return splu(sparse.csc_matrix(matrix), permc_spec=ordering, diag_pivot_thresh=0.0, options=options)


class SparseSolver:
    """The inverse of a sparse symmetric positive definite matrix, in float64.

    Solves run on the device of the right-hand side, or on the CPU for GPUs other than the first, which ``cholespy``
    does not support. The matrix is factorised at the first use, and again after pickling.

    Args:
        matrix: *Shape:* ``(V, V)``.
        free: Unknowns to solve for; the others are zero. Default: all.
    """

    def __init__(self, matrix: sparse.spmatrix, free: IntArray | None = None) -> None:
        self.n = matrix.shape[0]
        self.fixed = np.zeros(0, dtype=np.int64) if free is None else np.setdiff1d(np.arange(self.n), free)
        # Fixed unknowns have rows of the identity: no right side has to be gathered, and no solution scattered.
        kept = np.ones(self.n)
        kept[self.fixed] = 0
        self._inner = sparse.csr_matrix(sparse.diags(kept) @ matrix @ sparse.diags(kept) + sparse.diags(1 - kept))
        self._inner.eliminate_zeros()
        self._solves: dict[torch.device, Solve] = {}

    def __getstate__(self) -> dict[str, object]:
        """Without the factors, which cannot be pickled."""
        return {**self.__dict__, "_solves": {}}

    def __call__(self, right: Tensor) -> Tensor:
        """Solve for right-hand sides in columns, without gradient. *Shape:* ``(..., V, m) -> (..., V, m)``.

        Raises:
            ValueError: The matrix is not positive definite.
        """
        if right.is_meta:
            return torch.empty_like(right)
        device = right.device if _is_served(right.device) else torch.device("cpu")
        columns = right.detach().to(device, torch.float64).movedim(-2, 0)
        if not columns.numel():
            return torch.zeros_like(right)
        with _MAKING:
            if device not in self._solves:
                _SOLVERS.add(self)
                self._solves[device] = _superlu(self._inner) if cholespy is None else _cholesky(self._inner, device)
        solved = [self._solves[device](block.contiguous()) for block in columns.flatten(1).split(MOST_COLUMNS, 1)]
        out = solved[0] if len(solved) == 1 else torch.cat(solved, 1)
        out.index_fill_(0, torch.from_numpy(self.fixed).to(device), 0)
        return out.view(columns.shape).movedim(0, -2).to(right).contiguous()


_SOLVERS: weakref.WeakSet[SparseSolver] = weakref.WeakSet()


@atexit.register
def _free_factors() -> None:
    """Free all factors before the interpreter ends: ``cholespy`` prints warnings about those that are left."""
    for solver in list(_SOLVERS):
        solver._solves.clear()


@cache
def _is_served(device: torch.device) -> bool:
    """True for devices of ``cholespy``: the first GPU only if the driver library is found by its plain name."""
    if device.type != "cuda" or device.index or cholespy is None or torch.version.cuda is None:
        return device.type == "cpu"
    try:
        ctypes.CDLL("nvcuda.dll" if sys.platform == "win32" else "libcuda.so")
    except OSError:
        return False
    return True


def _superlu(matrix: sparse.csr_matrix) -> Solve:
    factor = factorize(matrix)
    return lambda right: torch.from_numpy(factor.solve(right.numpy()))


def _cholesky(matrix: sparse.csr_matrix, device: torch.device) -> Solve:
    whole = [torch.from_numpy(array.astype(np.int32)) for array in (matrix.indptr, matrix.indices)]
    entries = [array.to(device) for array in (*whole, torch.from_numpy(matrix.data.astype(np.float64)))]
    # CSR is copied; CSC would be sorted and freed in place.
    solver = cholespy.CholeskySolverD(matrix.shape[0], *entries, cholespy.MatrixType.CSR)

    def solve(right: Tensor) -> Tensor:
        out = torch.empty_like(right)
        if device.type == "cpu":
            solver.solve(right, out)
            return out
        # Its kernels always run on the default stream.
        current, default = torch.cuda.current_stream(device), torch.cuda.default_stream(device)
        default.wait_stream(current)
        solver.solve(right, out)
        current.wait_stream(default)
        return out

    return solve


@disable_compile
def solve_by(solver: Solve, right: Tensor) -> Tensor:
    """Solve with gradients, which are solves, too. *Shape:* ``(..., V, m) -> (..., V, m)``."""
    return linear_map(solver, solver, right)


def graph_laplacian(edges: IntArray, weights: FloatArray, n: int) -> sparse.csr_matrix:
    """``sum_e w_e (x_i - x_j)^2`` as a matrix. *Shape:* ``(E, 2), (E,) -> (n, n)``."""
    half = sparse.coo_matrix((weights, (edges[:, 0], edges[:, 1])), shape=(n, n))
    adjacency = (half + half.T).tocsr()
    return (sparse.diags(np.asarray(adjacency.sum(1)).reshape(-1)) - adjacency).tocsr()
